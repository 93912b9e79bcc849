"""Dwells are detected in the force of an imported stepped-sine test, and not in other tests."""

import numpy as np
import pytest
from scipy import signal
from typer.testing import CliRunner

import analysis
import daq
from daq.commands.cli import app
from rig.core.base.errors import RecordingError
from tests.daq.importing.files import RATE, make_scene, write_npz

# Digital filter from force (N) to acceleration (m/s^2): a mode of 1 kg at 40 Hz with 3 % damping.
OMEGA = 2 * np.pi * 40.0
MODE_FILTER = signal.bilinear([1.0, 0.0, 0.0], [1.0, 2 * 0.03 * OMEGA, OMEGA**2], RATE)


def stepped_sine_samples(frequencies, levels=(1.0,), hold_s=3.0, transition_s=0.1) -> np.ndarray:
    """Return the samples of a file: a force that is held at each frequency, and the response of both bodies."""
    hold_samples, transition_samples = round(hold_s * RATE), round(transition_s * RATE)
    steps = [(frequency, level) for level in levels for frequency in frequencies]
    frequency, amplitude = [], []
    for (step_frequency, level), (next_frequency, _) in zip(steps, [*steps[1:], steps[-1]], strict=True):
        frequency.append(np.full(hold_samples, step_frequency))
        frequency.append(np.linspace(step_frequency, next_frequency, transition_samples))
        amplitude.append(np.full(hold_samples + transition_samples, level))
    phase = 2 * np.pi * np.cumsum(np.concatenate(frequency)) / RATE
    force = np.concatenate(amplitude) * np.sin(phase)
    return samples_of(force[: force.size - transition_samples])


def samples_of(force: np.ndarray) -> np.ndarray:
    """Return the samples of a file with noise: body 1 in g, body 2 in m/s^2, force in N."""
    noise = np.random.default_rng(1).standard_normal((3, force.size))
    acceleration = signal.lfilter(*MODE_FILTER, force)
    return np.array([acceleration / 9.80665, 2.0 * acceleration, force]) + 1e-4 * noise


def step_marks(recording: daq.Recording) -> list:
    return [marker for marker in recording.markers if marker.kind == "measure"]


@pytest.mark.parametrize("level", ["1 N", "[0.5 N, 2 N]"])
def test_unmarked_dwells_give_the_response_of_the_mode(level, tmp_path, imported):
    frequencies = np.linspace(36.0, 44.0, 5)
    levels = (1.0,) if level == "1 N" else (0.5, 2.0)
    write_npz(tmp_path / "a.npz", stepped_sine_samples(frequencies, levels))
    scene = make_scene(f"{{kind: stepped_sine, from: 30 Hz, to: 50 Hz, points: 5, force: {level}}}")
    recording, messages = imported(tmp_path / "a.npz", scene)
    steps = step_marks(recording)
    np.testing.assert_allclose(
        [mark.fields["frequency"] for mark in steps], np.tile(frequencies, len(levels)), rtol=1e-6
    )
    assert [mark.fields["level"] for mark in steps] == np.repeat(levels, 5).tolist()
    assert {mark.fields["direction"] for mark in steps} == {"up"}
    for number, mark in enumerate(steps):
        # Each step is 3 s at its frequency, then 0.1 s of transition. The transient of the mode takes up to 2.4 s.
        begin = round(number * 3.1 * RATE)
        assert begin < mark.first_sample and mark.end < begin + 3.02 * RATE
        assert mark.end - mark.first_sample > 0.6 * RATE and mark.fields["settled"]
    groups = analysis.frequency_responses(recording, motion="acceleration")
    assert len(groups) == len(levels)
    for curve in [curve for group in groups for curve in group]:
        factor = 1.0 if curve.response == "body1" else 2.0
        truth = factor * signal.freqz(*MODE_FILTER, curve.frequency, fs=RATE)[1]
        assert np.all(abs(curve.value - truth) < curve.bound()) and np.all(curve.bound() < 0.02 * abs(truth))
    assert not messages


def test_dwells_up_and_down_are_two_sweeps(tmp_path, imported):
    rising = [20.0, 25.0, 31.0]
    write_npz(tmp_path / "a.npz", stepped_sine_samples([*rising, *rising[::-1]], hold_s=2.0))
    scene = make_scene("{kind: stepped_sine, from: 20 Hz, to: 31 Hz, points: 3, force: 1 N, direction: both}")
    recording, _ = imported(tmp_path / "a.npz", scene)
    steps = [(round(mark.fields["frequency"], 3), mark.fields["direction"]) for mark in step_marks(recording)]
    # The highest frequency is held longer, so that it is a single step.
    assert steps == [(20.0, "up"), (25.0, "up"), (31.0, "up"), (25.0, "down"), (20.0, "down")]


def test_tone_after_silence_is_one_step(tmp_path, imported):
    tone = np.zeros(round(20 * RATE))
    tone[round(6 * RATE) :] = np.sin(2 * np.pi * 17.3 * np.arange(round(14 * RATE)) / RATE)
    write_npz(tmp_path / "a.npz", samples_of(tone))
    scene = make_scene("{kind: sine, frequency: 17 Hz, force: 1 N}")
    recording, messages = imported(tmp_path / "a.npz", scene)
    [mark] = step_marks(recording)
    assert abs(mark.fields["frequency"] - 17.3) < 1e-5 and mark.first_sample > 6 * RATE
    assert not messages


def forces_without_steps() -> dict[str, np.ndarray]:
    """Return force time histories of other tests, each of 40 s."""
    random, t = np.random.default_rng(4), np.arange(round(40 * RATE)) / RATE
    band = signal.butter(4, [10.0, 60.0], "bandpass", fs=RATE, output="sos")
    narrow_band = signal.butter(2, [30.0, 31.0], "bandpass", fs=RATE, output="sos")
    noise = signal.sosfilt(band, random.standard_normal(t.size))
    period = round(4 * RATE)
    lines = np.zeros(period // 2 + 1, dtype=complex)
    lines[40:240] = np.exp(2j * np.pi * random.random(200))
    hits = np.zeros(t.size)
    hits[1000 :: round(5 * RATE)] = 100.0
    return {
        "random": noise,
        "narrow": signal.sosfilt(narrow_band, random.standard_normal(t.size)),
        "bursts": noise * (t % 4 < 2),
        "multisine": np.tile(np.fft.irfft(lines), 10),
        "sweep": signal.chirp(t, 10.0, 40.0, 60.0),
        "log": signal.chirp(t, 10.0, 40.0, 60.0, "logarithmic"),
        "slow": signal.chirp(t, 30.0, 40.0, 31.0),
        "hits": hits,
        "nothing": np.zeros(t.size),
    }


@pytest.mark.parametrize("kind", forces_without_steps())
def test_no_dwells_are_detected_in_other_tests(kind, tmp_path, imported):
    write_npz(tmp_path / "a.npz", samples_of(forces_without_steps()[kind]))
    scene = make_scene("{kind: stepped_sine, from: 10 Hz, to: 60 Hz, points: 5, force: 1 N}")
    recording, messages = imported(tmp_path / "a.npz", scene)
    assert not step_marks(recording)
    with pytest.raises(RecordingError, match="no dwell was detected"):
        analysis.frequency_responses(recording)
    assert any("no dwell was detected" in each for each in messages)


def test_import_command_reports_dwells(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_npz(tmp_path / "a.npz", stepped_sine_samples([20.0, 25.0], hold_s=2.0))
    scene = make_scene("{kind: stepped_sine, from: 20 Hz, to: 25 Hz, points: 2, force: 1 N}")
    (tmp_path / "bench.yaml").write_text(scene.to_si_yaml().replace("rate: 5120.0 Hz", "rate: 2048 Hz"))
    result = CliRunner().invoke(app, ["import", "a.npz", "--scene", "bench.yaml"])
    assert result.exit_code == 0, result.output
    assert "2 dwells detected, 20 to 25 Hz" in result.output
