"""Studies that compute their pieces in this process, without the start of worker processes, and small designs."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest


@contextmanager
def pieces_in_this_process() -> Iterator[pytest.MonkeyPatch]:
    """Let `Workers` compute pieces in this process, as if it shared each piece with another MPI rank."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rig.core.base.workers.SERIAL", True)
        yield patch


def reduce_chart_and_check(patch: pytest.MonkeyPatch, points_per_peak: int) -> None:
    """Let designs have a coarse chart, and a check with few frequencies around each peak."""
    patch.setattr("rig.studies.design.design.CHART_CLEARANCES", np.array([0.5, 1.0, 2.0]))
    patch.setattr("rig.studies.design.design.LEVEL_STEP_RATIO", 2.0)
    patch.setattr("rig.studies.design.check.POINTS_PER_PEAK", points_per_peak)
