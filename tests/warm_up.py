"""Compile what the tests need, once and on both cores: otherwise every worker would compile it for itself."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

import rig


def bench() -> None:
    """Engine for contacts that do not feel each other, and the measurement chain."""
    from daq.signal_chain.bench import Bench
    from tests.benchmarks.chain import full_scene

    Bench(full_scene()).acquire(np.zeros((1, 10)))


def joint_contacts_and_orbits() -> None:
    """Engine for a full mass matrix; shooting."""
    rig.simulate(rig.load(Path(__file__).parent / "cases" / "kicks-through-mass.yaml"), 0.01, rate=1000.0)
    rig.orbit_response(rig.load("fig9"), [49.0])


if __name__ == "__main__":
    with ProcessPoolExecutor(2) as both_cores:
        for job in [both_cores.submit(bench), both_cores.submit(joint_contacts_and_orbits)]:
            job.result()
