"""Compile the kernels of the tests once, before the workers of pytest start: otherwise each would compile them."""

import numpy as np

import daq
from daq.core.virtual_bench.bench import Bench
from tests.benchmarks.chain import full_scene

if __name__ == "__main__":
    daq.warm_up()
    Bench(full_scene()).acquire(np.zeros((1, 10)))
