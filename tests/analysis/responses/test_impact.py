from __future__ import annotations

import numpy as np
import pytest

import analysis
import daq
import rig
from daq.signal_chain.channel import ChannelInfo
from rig.errors import RecordingError
from rig.system.receptance import receptance
from rig.system.structure import structure_matrices
from tests.analysis.responses import synthetic

HIT = """
name: two bodies
structure: {{masses: [2 kg, 1 kg], springs: [80 kN/m, 20 kN/m], damping: {{modal: 1 %}}}}
test: {{kind: impulse, body: 1, peak: 100 N, width: 4 ms, repeats: 2, interval: 6 s}}
channels:
  - {{name: a1, at: body 1, accelerometer: {{sensitivity: 100 mV/g, low_cutoff: 0.3 Hz}}}}
  - {{name: a2, at: body 2, accelerometer: {{sensitivity: 100 mV/g}}}}
  - {{name: hammer, at: hammer, hammer: {{sensitivity: 2.25 mV/N{cutoff}}}}}
converter: {converter}
recording: {{display: false}}
"""


def test_given_a_response_that_rings_on_when_averaged_then_the_windows_damping_is_taken_off(tmp_path):
    with daq.open(synthetic.impulses(tmp_path / "a.mcap", hits=3, interval=5.0, noise=1e-4)) as rec:
        [curves] = analysis.frequency_responses(rec)
        modes = analysis.identify(curves, count=3)
    assert curves[0].shift > 0
    assert sum("still rang from the hit before" in warning for warning in curves[0].warnings) == 2
    np.testing.assert_allclose(2 * np.pi * modes.frequency, [81.911, 218.512, 312.041], rtol=2e-4)
    np.testing.assert_allclose(modes.damping, 0.005, rtol=0.02)


def test_given_a_block_in_which_all_dies_out_when_averaged_then_compliance_is_exact(tmp_path):
    with daq.open(synthetic.impulses(tmp_path / "a.mcap", hits=1, interval=15.0)) as rec:
        [curves] = analysis.frequency_responses(rec)
        exact = receptance(rec.scene, curves[0].frequency)
    assert curves[0].shift == 0
    near = (curves[0].frequency > 5.0) & (curves[0].frequency < 60.0)
    for body, frf in enumerate(curves):
        strong = near & (abs(exact[body]) > 2e-6)
        # The force between samples is a straight line, which at 60 Hz is 0.2 % less than the samples tell.
        np.testing.assert_allclose(frf.value[strong], exact[body][strong], rtol=0.02)
    assert any("One hit" in warning for warning in curves[0].warnings)


def test_given_a_rebound_when_averaged_then_that_hit_is_left_out(tmp_path):
    with daq.open(synthetic.impulses(tmp_path / "a.mcap", hits=3, interval=12.0, rebound=(2,))) as rec:
        [curves] = analysis.frequency_responses(rec)
    assert any("Hit 2 left out: the hammer hit 2 times" in warning for warning in curves[0].warnings)
    assert curves[0].degrees[0] == 2.0


def test_given_rebounds_in_every_hit_when_averaged_then_no_clean_hit_is_said(tmp_path):
    path = synthetic.impulses(tmp_path / "a.mcap", hits=2, interval=4.0, rebound=(1, 2))
    with daq.open(path) as rec, pytest.raises(RecordingError, match="no clean hit"):
        analysis.frequency_responses(rec)


def test_given_no_force_channel_when_averaged_then_it_says_what_to_add(tmp_path):
    path = synthetic.impulses(tmp_path / "a.mcap", hammer=False, interval=1.0)
    with daq.open(path) as rec, pytest.raises(RecordingError, match=r"add \{name: hammer, at: hammer\}"):
        analysis.frequency_responses(rec)


def hit(path, where):
    """A recording of two hits on body 1 with a scene's sensors and converter."""
    scene = rig.loads(HIT.format(**where), where="a test")
    return daq.record(scene, path)


def wrong_by(rec, curves, low, high):
    """Largest error of magnitude, relative, and of phase, degrees, along the line of the exponential window."""
    mass, damping, stiffness = structure_matrices(rec.scene.structure)
    worst = []
    for body, frf in enumerate(curves):
        frequency = frf.frequency[(frf.frequency >= low) & (frf.frequency <= high)]
        s = (2j * np.pi * frequency + frf.shift)[:, None, None]
        exact = np.linalg.inv(mass * s**2 + damping * s + stiffness)[:, body, 0]
        ratio = frf.between(low, high).value / exact
        worst.append((abs(abs(ratio) - 1.0).max(), abs(np.angle(ratio, deg=True)).max()))
    return np.max(worst, axis=0)


@pytest.mark.parametrize("rate", ["5120 Hz", "25.6 kHz"])
def test_given_a_filter_that_delays_the_hit_when_averaged_then_the_force_window_follows_it(tmp_path, rate):
    where = {"cutoff": "", "converter": f"{{rate: {rate}, filter: delta_sigma}}"}
    with daq.open(hit(tmp_path / "a.mcap", where)) as rec:
        assert rec.channels["hammer"].delay > 0
        [curves] = analysis.frequency_responses(rec)
        magnitude, phase = wrong_by(rec, curves, 2.0, 120.0)
    assert magnitude < 0.005 and phase < 0.5


@pytest.mark.parametrize(
    ("sensor", "converter"), [("0.01 Hz", "0.5 Hz"), ("0.5 Hz", "0.5 Hz"), ("0.05 Hz", "5 Hz")]
)
def test_given_high_passes_when_averaged_then_the_receptance_is_exact_far_below_the_modes(
    tmp_path, sensor, converter
):
    where = {
        "cutoff": f", low_cutoff: {sensor}",
        "converter": f"{{rate: 2560 Hz, filter: delta_sigma, coupling: AC, ac_corner: {converter}}}",
    }
    with daq.open(hit(tmp_path / "a.mcap", where)) as rec:
        [curves] = analysis.frequency_responses(rec)
        magnitude, phase = wrong_by(rec, curves, 2.0, 120.0)
    assert magnitude < 0.005 and phase < 0.5


def test_given_a_marker_that_misses_its_hit_when_averaged_then_the_force_outside_it_is_told(tmp_path):
    force = np.zeros(6400)
    force[840:856] = 50.0
    infos = [info for info in synthetic.channels("acceleration") if info.at != "table"]
    infos.append(ChannelInfo("hammer", "hammer", "force", sensitivity=1.0, rate=synthetic.RATE))
    where = synthetic.scene("{kind: impulse, body: 1, peak: 50 N, width: 6.25 ms}")
    rows = np.vstack([synthetic.simulate(force), force])
    path = synthetic.write(tmp_path / "a.mcap", where, infos, rows, [("hit", 640, 655, {})])
    with daq.open(path) as rec, pytest.raises(RecordingError, match="0 N at most where the hit is marked"):
        analysis.frequency_responses(rec)
