"""`daq.warm_up` compiles all functions that a bench needs."""

import subprocess
import sys

import pytest

import rig
from rig.core.base.errors import SceneError

SCRIPT = """
import daq
daq.warm_up()
import numpy as np
from numba.core.event import install_recorder
from daq.core.virtual_bench.bench import Bench
from tests.benchmarks.chain import full_scene
with install_recorder("numba:compile") as recorder:
    Bench(full_scene()).acquire(np.zeros((1, 10)))
print(sorted({event.data["dispatcher"].py_func.__qualname__ for _, event in recorder.buffer}))
"""


def test_nothing_compiles_after_warm_up() -> None:
    result = subprocess.run([sys.executable, "-c", SCRIPT], check=True, capture_output=True, text=True)
    assert result.stdout == "[]\n"


def test_unknown_part_is_rejected() -> None:
    with pytest.raises(SceneError, match="warm_up: got 'wheels'"):
        rig.warm_up("wheels")  # type: ignore[arg-type]
