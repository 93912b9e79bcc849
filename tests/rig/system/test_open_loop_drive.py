"""The open-loop drive of a swept sine."""

import numpy as np
import pytest

import rig
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import drive_per_level, riding_response, sampled_drive, tone_drive
from tests.peak_memory import peak_memory


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


def test_drive_of_a_table_is_the_command() -> None:
    shaker = {"kind": "table", "body": 1, "spring": "6.6 kN/m", "bandwidth": 400.0}
    test = {"kind": "sine", "frequency": 60.0, "drive": 1e-3}
    scene = rig.load("fig4-structure").replace(shaker=shaker, test=test, channels=None)
    system = assemble(scene)

    tone = tone_drive(scene, system)

    assert tone is not None and tone.amplitudes[0] == -1e-3j
    # The table follows with the response of its servo, from the start.
    table = -1e-3j / (1.0 + 60j / 400.0) ** 2
    row = system.points.index("table")
    assert tone.state[row] == pytest.approx(table.real)
    assert tone.state[system.coordinates + row] == pytest.approx((2j * np.pi * 60.0 * table).real)
    assert abs(table) == pytest.approx(1e-3 * abs(riding_response(system, "shaker", 2.0 * np.pi * 60.0)[row]))


def test_memory_of_one_more_frequency_is_small() -> None:
    scene = rig.load("fig4-structure").replace(
        structure={"masses": [1.0] * 30, "springs": ["1 MN/m"] * 30, "damping": {"modal": 0.01}}, channels=None
    )
    system, peaks = assemble(scene), []
    for count in (1000, 2000):
        peaks.append(peak_memory(riding_response, system, "shaker", np.linspace(1.0, 1000.0, count))[0])
    # A complex matrix of 60 states and more would take 58 kB.
    assert peaks[1] - peaks[0] < 10_000 * 1000


def test_response_is_independent_of_other_frequencies() -> None:
    system, omega = assemble(rig.load("fig4-structure")), np.linspace(10.0, 400.0, 40_000)
    states = riding_response(system, "shaker", omega)
    for index in (0, 12_345, omega.size - 1):
        np.testing.assert_array_equal(states[:, index], riding_response(system, "shaker", float(omega[index])))
