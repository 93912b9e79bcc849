"""The open-loop drive of a swept sine."""

from __future__ import annotations

import numpy as np
import pytest

import rig
from rig.system.assembly import assemble
from rig.system.open_loop_drive import drive_per_level, sampled_drive


@pytest.mark.parametrize("spacing", ["linear", "log"])
@pytest.mark.parametrize("band", [(10.0, 55.0), (500.0, 5.0)])
def test_sweep_reaches_its_force_at_sharp_resonances(band: tuple[float, float], spacing: str) -> None:
    test = {"kind": "swept_sine", "from": band[0], "to": band[1], "duration": 20.0, "force": 2.0, "spacing": spacing}
    scene = rig.load("fig4-structure").replace(test=test)
    system, rate = assemble(scene), 2000.0
    drive = sampled_drive(scene, system, 40_000, rate)[system.inputs.index("shaker")]
    progress, (first, last) = np.arange(drive.size) / drive.size, band
    if spacing == "log":
        ratio = last / first
        frequency, periods = first * ratio**progress, first * 20.0 * (ratio**progress - 1.0) / np.log(ratio)
    else:
        frequency, periods = (
            first + (last - first) * progress,
            20.0 * progress * (first + 0.5 * (last - first) * progress),
        )
    gain = drive_per_level(scene, system, 2.0 * np.pi * frequency)
    expected = 2.0 * (gain * np.exp(2j * np.pi * periods)).imag
    # The gain is interpolated within 0.1 %, and the force is 2 N.
    assert (abs(drive - expected) < 2.1e-3 * abs(gain)).all()
