"""Free decays: frequency, damping as a function of amplitude, energy and envelope, compared with known decays."""

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import analysis
import daq
import rig
from analysis.commands.cli import app
from analysis.core.decays.band_pass import band_width
from analysis.core.decays.close_modes import close_poles
from analysis.core.decays.modal_decay import modal_decay, spectral_peaks
from analysis.core.decays.overlap import resolve_close_modes
from analysis.core.decays.sensor_correction import correct_motion
from analysis.core.recordings.slices import impact_ranges
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.errors import RecordingError, RunWarning, SceneError
from rig.core.system.structural_model import structural_model
from tests.analysis.responses import synthetic
from tests.gauntlet.linear_decays import draw_linear_decay

MODAL_DAMPING = 0.005  # damping ratio of each mode of the synthetic structure and of `STIFF_BODY`
STIFF_BODY = """
structure: {{masses: [1 kg], springs: [{stiffness} N/m], damping: {{modal: 0.5 %}}}}
test: {{kind: free, displacement: [1 um], duration: {duration} s}}
channels: [{{name: a, at: body 1, accelerometer: {{sensitivity: 100 mV/g}}}}]
converter: {{rate: 25.6 kHz}}
recording: {{display: false}}
"""


def test_linear_decay_has_same_damping_at_every_amplitude(tmp_path):
    with daq.open(synthetic.impulses(tmp_path / "a.mcap")) as rec:
        decay = analysis.decay(rec, channel="body3")
    assert [round(mode.frequency, 1) for mode in decay.modes] == [13.0, 34.8, 49.7]
    for mode in decay.modes:
        assert mode.damping.size > 4
        np.testing.assert_allclose(mode.damping, MODAL_DAMPING, rtol=0.003)
        np.testing.assert_allclose(mode.decrement, 2 * np.pi * mode.damping, rtol=1e-4)
    assert decay.warnings == ()


def test_linear_decay_frequencies_lie_within_bounds():
    rng, rate, begin = np.random.default_rng(5), 1280.0, 640
    normalized_errors, peak_error_ratios = [], []
    for _ in range(20):  # Random decays of four modes with noise.
        natural = np.array([11.0, 24.0, 50.0, 110.0]) * rng.uniform(0.9, 1.1, 4)
        ratio, amplitude = np.exp(rng.uniform(np.log(0.002), np.log(0.03), 4)), rng.uniform(1.0, 20.0, 4)
        time = np.arange(int(rng.uniform(2.0, 8.0) * rate))[:, None] / rate
        angle = 2 * np.pi * natural * np.sqrt(1 - ratio**2) * time + rng.uniform(0, 2 * np.pi, 4)
        decay = np.sum(amplitude * np.exp(-2 * np.pi * natural * ratio * time) * np.cos(angle), axis=1)
        signal = np.concatenate([np.zeros(begin), decay])
        signal += np.exp(rng.uniform(np.log(1e-4), np.log(0.1))) * rng.standard_normal(signal.size)
        peak_frequencies = spectral_peaks(signal[begin:], rate, 4, 2.0, 200.0)
        for index, peak in enumerate(peak_frequencies):
            mode = modal_decay(signal, rate, peak, band_width(peak_frequencies, index), begin)
            if np.isfinite(mode.frequency_std):
                true_frequency = natural[np.argmin(abs(natural - peak))]
                normalized_errors.append((mode.frequency - true_frequency) / mode.frequency_std)
                peak_error_ratios.append(abs(peak / true_frequency - 1.0) / abs(mode.frequency / true_frequency - 1.0))
    # Of 80 modes, more than 60 have a determined frequency; 95 % lie within two standard uncertainties.
    assert len(normalized_errors) > 60
    assert np.mean(np.abs(normalized_errors) < 2.0) > 0.95 and np.max(np.abs(normalized_errors)) < 4.0
    # The error of the frequency of the spectral peak is more than ten times this error.
    assert np.median(peak_error_ratios) > 10.0


CLOSE_MODES = """
structure:
  matrices:
    mass: [[3, 0], [0, 3.02]]
    stiffness: [[{diagonal}, -{coupling}], [-{coupling}, {diagonal}]]
    damping: [[4, -0.3], [-0.3, 5]]
test: {{kind: impulse, body: 1, peak: 120 N, width: 3 ms, repeats: 1, interval: 8 s}}
channels:
- {{name: h, at: hammer, hammer: {{sensitivity: 10 mV/N}}}}
- {{name: a1, at: body 1, accelerometer: {{sensitivity: 100 mV/g}}}}
converter: {{rate: 2 kHz, bits: 24, range: 10 V}}
"""


@pytest.mark.parametrize(("coupling", "is_determined"), [(600, False), (1200, False), (3000, True), (12000, True)])
def test_close_modes_are_separated_or_undetermined(tmp_path, coupling, is_determined):
    """At a coupling of 600 N/m, the modes are closer than their half-power width."""
    scene = rig.loads(CLOSE_MODES.format(diagonal=120000 + coupling, coupling=coupling), where="a test")
    decay = analysis.decay(daq.record(scene, tmp_path / "a.mcap"), "a1")
    model = structural_model(scene)
    blocks = [[np.zeros((2, 2)), np.eye(2)], [-model.stiffness, -model.damping]]
    poles = np.linalg.eigvals(np.block([blocks[0], list(np.linalg.solve(model.mass, blocks[1]))]))
    poles = poles[np.argsort(poles.imag)][2:]
    frequencies, ratios = abs(poles) / (2.0 * np.pi), -poles.real / abs(poles)
    assert [mode.center for mode in decay.modes] == pytest.approx(frequencies, rel=1e-4)
    for mode, frequency, damping in zip(decay.modes, frequencies, ratios, strict=True):
        assert (mode.damping.size > 0) == is_determined
        assert not is_determined or abs(mode.frequency - frequency) < 3.0 * mode.frequency_std
        assert np.all(abs(mode.damping - damping) < 3.0 * mode.damping_std)
    assert sum("`analysis modes`" in text for text in decay.warnings) == (not is_determined)


def two_modes(weak, separation, ratios, noise=0.0):
    """Return a decay of two modes at 40 Hz and above with amplitudes 1 and `weak`, and the first sample and rate."""
    rate, begin = 1280.0, 640
    time = np.arange(6 * int(rate)) / rate
    natural = 40.0 + np.array([0.0, separation])
    decay = np.exp(2 * np.pi * natural * (1j * np.sqrt(1 - np.square(ratios)) - ratios) * time[:, None]) @ [1.0, weak]
    random = noise * np.random.default_rng(4).standard_normal(begin + time.size)
    return np.append(np.zeros(begin), decay.real) + random, begin, rate


@pytest.mark.parametrize("weak", [0.003, 0.01, 0.025])
@pytest.mark.parametrize("ratios", [(0.006, 0.004), (0.004, 0.006), (0.008, 0.0012)])
@pytest.mark.parametrize("separation", [0.2, 0.5, 1.5])
def test_weak_close_mode_is_in_bounds(weak, ratios, separation):
    signal, begin, rate = two_modes(weak, separation, ratios, noise=1e-5)
    peaks = spectral_peaks(signal[begin:], rate, 1, 2.0, 200.0)
    frequencies, overlaps = resolve_close_modes(signal, rate, peaks, begin)
    for index, (frequency, overlap) in enumerate(zip(frequencies, overlaps, strict=True)):
        width = band_width(frequencies, index)
        mode = modal_decay(signal, rate, frequency, width, begin, overlap=overlap)
        own = int(abs(frequency - 40.0) > 0.5 * separation)
        assert mode.damping.size or overlap.is_close
        assert np.all(abs(mode.damping - ratios[own]) < 3.0 * mode.damping_std)
        assert not abs(mode.frequency - 40.0 - own * separation) > 3.0 * mode.frequency_std


FEW_COUNTS = """
structure: {{masses: [2 kg, 3 kg], springs: [20 kN/m, 30 kN/m], damping: {{modal: 1 %}}}}
test: {{kind: impulse, body: 1, peak: {peak} N, width: 3 ms, repeats: 1, interval: 5 s}}
channels:
- {{name: h, at: hammer, hammer: {{sensitivity: 1 mV/N}}}}
- {{name: a2, at: body 2, accelerometer: {{sensitivity: 100 mV/g}}}}
converter: {{rate: 2 kHz, bits: 12, range: 10 V}}
"""


@pytest.mark.parametrize("peak", [8, 30, 100, 300, 1000])
def test_few_counts_do_not_bias_damping(tmp_path, peak):
    """The reading is constant after the motion falls below half a count of 0.5 m/s²."""
    decay = analysis.decay(daq.record(rig.loads(FEW_COUNTS.format(peak=peak)), tmp_path / "a.mcap"), "a2")
    for mode in decay.modes:
        assert np.all(abs(mode.damping - 0.01) < 3.0 * mode.damping_std)
        assert mode.noise > 0.01
    assert sum(mode.damping.size for mode in decay.modes) >= (3 if peak > 50 else 0)
    assert any("below 10 counts of the converter" in text for text in decay.warnings) == (peak < 50)


@pytest.mark.parametrize("amplitude", [0.0, 1.0])
def test_signal_of_fewer_poles_has_no_close_modes(amplitude):
    decay = amplitude * np.exp((-0.01 + 0.1j) * np.arange(200))
    assert not close_poles(decay, 1.0).is_mode.any()


@pytest.mark.parametrize("noise", [1e-4, 1e-3, 1e-2])
def test_single_modes_are_not_split(noise):
    rng, rate, begin = np.random.default_rng(8), 1280.0, 640
    time = np.arange(6 * int(rate)) / rate
    for _ in range(20):
        frequency, ratio = rng.uniform(12.0, 120.0), np.exp(rng.uniform(np.log(0.002), np.log(0.03)))
        decay = np.exp((-ratio + 1j) * 2 * np.pi * frequency * time).real
        signal = np.append(np.zeros(begin), decay) + noise * rng.standard_normal(begin + decay.size)
        ([resolved], _) = resolve_close_modes(signal, rate, spectral_peaks(signal[begin:], rate, 1, 2.0, 200.0), begin)
        assert resolved == pytest.approx(frequency, rel=0.02)


def test_clock_error_is_in_frequency_bound(tmp_path):
    scene = rig.loads(STIFF_BODY.format(stiffness=(2 * np.pi * 100.0) ** 2, duration=2.0))
    with_clock_error = scene.replace(converter={"rate": 25600.0, "clock_error": 1e-3})
    with daq.open(daq.record(with_clock_error, tmp_path / "a.mcap")) as rec:
        (mode,) = analysis.decay(rec).modes
    # A clock error of 0.1 % at 100 Hz.
    assert abs(mode.frequency - 100.0) == pytest.approx(0.1, rel=0.01)
    assert 2.0 * mode.frequency_std == pytest.approx(0.1, rel=0.01)


def test_damping_above_noise_floor_is_correct(tmp_path):
    with daq.open(synthetic.impulses(tmp_path / "a.mcap", noise=2e-3)) as rec:
        decay = analysis.decay(rec, channel="body3")
    for mode in decay.modes:
        above_noise = mode.amplitude > 0.05 * mode.amplitude[0]
        np.testing.assert_allclose(mode.damping[above_noise], MODAL_DAMPING, rtol=0.03)


def test_integrated_energy_decreases_monotonically(tmp_path):
    with daq.open(synthetic.impulses(tmp_path / "a.mcap")) as rec:
        decay = analysis.decay(rec)
    assert decay.energy[0] == 0.0 and np.all(np.diff(decay.energy) <= 0)
    assert 0.1 < decay.halving < 3.0
    assert decay.time_below(1e9) == 0.0
    steps = replace(decay, time=np.arange(4.0), acceleration=np.array([2.0, -2.0, 0.5, 0.5]))
    assert steps.time_below(1.0) == 2.0 and np.isnan(steps.time_below(0.5))


def test_damping_proportional_to_amplitude_is_estimated():
    # With the damping ratio c A, the amplitude obeys A' = -c w A^2, so that A = A0 / (1 + c w A0 t).
    rate, omega, initial, c = 2560.0, 2 * np.pi * 30.0, 20.0, 1e-3
    time = np.arange(int(6 * rate)) / rate
    amplitude = initial / (1.0 + c * omega * initial * time)
    signal = np.concatenate([np.zeros(1280), amplitude * np.cos(omega * time)])
    mode = modal_decay(signal, rate, 30.0, 5.0, 1280)
    assert mode.amplitude[0] > 5 * mode.amplitude[-1]
    np.testing.assert_allclose(mode.damping, c * mode.amplitude, rtol=0.06)


# Damping ratio as a function of the amplitude of the acceleration in m/s^2.
DAMPING_LAWS = {
    "step at 1 g": lambda amplitude: np.where(amplitude > 9.81, 0.03, 0.005),
    "friction": lambda amplitude: 0.003 + 0.02 / np.maximum(amplitude, 0.5),
    "square root": lambda amplitude: 0.004 * np.sqrt(amplitude),
}


@pytest.mark.parametrize("law", DAMPING_LAWS)
@pytest.mark.parametrize("noise", [1e-3, 0.05])
def test_amplitude_dependent_damping_lies_within_bounds(law, noise):
    random = np.random.default_rng(3)
    rate, natural, amplitude, envelope = 1280.0, 24.0, 50.0, np.empty(5120)
    for index in range(envelope.size):
        envelope[index] = amplitude
        amplitude *= np.exp(-float(DAMPING_LAWS[law](amplitude)) * 2 * np.pi * natural / rate)
    tone = envelope * np.cos(2 * np.pi * natural / rate * np.arange(envelope.size) + 1.0)
    signal = np.append(np.zeros(640), tone) + noise * random.standard_normal(5760)
    mode = modal_decay(signal, rate, natural, natural / 4.0, 640)
    error = abs(mode.damping - DAMPING_LAWS[law](mode.amplitude))
    assert mode.damping.size > 10 and np.mean(error <= 2.0 * mode.damping_std) >= 0.95
    assert np.median(mode.damping_std / mode.damping) < 0.1


@pytest.mark.parametrize("lost", [0, 20])
def test_imported_decays_end_with_their_files(lost, tmp_path):
    rate, natural, ratio = 2048.0, np.array([18.3, 47.6, 83.9]), np.array([0.012, 0.008, 0.015])
    time = np.arange(2400)[:, None] / rate
    tip = ([4.0, 8.0, 12.0] * np.exp(-2 * np.pi * ratio * natural * time) * np.sin(2 * np.pi * natural * time)).sum(1)
    tip, force = (np.concatenate([np.zeros(300), part]) for part in (tip, np.sin(np.pi * time[:5, 0] * rate / 4)))
    files = [tmp_path / f"{k}.npz" for k in (1, 2)]
    for k, file in enumerate(files):
        noise = 1e-3 * np.random.default_rng(k).standard_normal((2, tip.size))
        noise[1, 1500 : 1500 + lost] = np.nan
        np.savez(file, fs=rate, force=np.pad(100.0 * force, (0, tip.size - force.size)) + noise[0], tip=tip + noise[1])
    scene = """
        structure: {masses: [1 kg], springs: [1 kN/m], damping: {dashpots: [1 N s/m]}}
        test: {kind: impulse, body: 1, peak: 100 N, width: 2 ms}
        channels: [{name: force, at: hammer}, {name: tip, at: body 1}]
        """
    table = {"force": {"column": "force", "unit": "N"}, "tip": {"column": "tip", "unit": "m/s^2"}}
    with pytest.warns(RunWarning):
        path = daq.import_files(files, rig.loads(scene), tmp_path / "a.mcap", table=table)
    with daq.open(path) as rec:
        decay = analysis.decay(rec)
    assert 0.95 * 2400 / rate < decay.time[-1] < 2400 / rate and bool(decay.warnings) == bool(lost)
    np.testing.assert_allclose([mode.frequency for mode in decay.modes], natural, rtol=1e-3)
    assert max(mode.noise for mode in decay.modes) < 0.02


def test_displacement_channel_gives_acceleration_decay(tmp_path):
    force = np.zeros(640 + int(4 * synthetic.RATE))
    force[640:656] = 50.0 * np.sin(np.pi * np.arange(16) / 16)
    infos = [info for info in synthetic.channels("displacement") if info.at != "table"]
    scene = synthetic.scene("{kind: impulse, body: 1, peak: 50 N, width: 6.25 ms}")
    rows = synthetic.simulate(force, quantity="displacement")
    path = synthetic.write(tmp_path / "a.mcap", scene, infos, rows, [("hit", 640, 655, {})])
    with daq.open(path) as rec:
        decay = analysis.decay(rec, channel="body3")
    true_acceleration = synthetic.simulate(force)[2][656 : 656 + decay.time.size]
    inner = slice(200, -2000)  # without the ends, where the differentiation is inaccurate
    assert np.max(abs(decay.acceleration[inner] - true_acceleration[inner])) < 0.01 * abs(true_acceleration).max()


@pytest.mark.parametrize(
    ("interval", "impact", "error", "message"),
    [
        (None, 1, RecordingError, "kind: impulse"),
        (1.0, 2, SceneError, "impacts 1 to 1"),
        (0.1, 1, RecordingError, "only 240 samples follow impact 1"),
    ],
)
def test_missing_decay_is_explained(tmp_path, interval, impact, error, message):
    path = tmp_path / "a.mcap"
    if interval is None:
        synthetic.stepped_sine(path, [12.0])
    else:
        synthetic.impulses(path, interval=interval)
    with daq.open(path) as rec, pytest.raises(error, match=message):
        analysis.decay(rec, impact=impact)


def within_bounds(mode, expected):
    """Return where the damping differs by less than 3 %, or by less than its bound if noise makes it larger."""
    bound = 2.0 * mode.damping_std / mode.damping
    return abs(mode.damping / expected.damping - 1.0) < np.maximum(bound, 0.03)


def test_three_dampers_have_true_damping(tmp_path):
    scene = rig.load("fig10b-three-dampers")
    test = scene.test.model_dump(exclude_none=True) | {"repeats": 1, "interval": 4.0}
    scene = scene.replace(test=test, recording={"truth": True, "display": False})
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        decay = analysis.decay(rec, "body2")
        ideal_sensor = ChannelInfo("true", "body 2", "displacement", 1.0, rec.rate)
        true_acceleration = correct_motion(ideal_sensor, rec.truth("displacement")[1], "acceleration", 2.0, 800.0)
        [(_, last)] = impact_ranges(rec)
    frequencies = np.array([mode.center for mode in decay.modes])
    np.testing.assert_allclose(frequencies, [12.4, 34.7, 49.0], rtol=0.05)
    for index, mode in enumerate(decay.modes):
        width = band_width(frequencies, index)
        expected = modal_decay(true_acceleration, rec.rate, mode.center, width, last + 1, amplitudes=mode.amplitude)
        assert mode.damping.size > 5 and within_bounds(mode, expected).mean() > 0.95
    # Above 1 g the dampers dissipate; below 1 g only the structural damping of 0.5 % remains, with the riding masses.
    assert max(mode.damping.max() for mode in decay.modes) > 0.02
    assert 0.003 < decay.modes[1].small_damping() < 0.006


@pytest.mark.parametrize("order", [0, 2])
def test_free_decay_agrees_with_noise_free_run(tmp_path, order):
    accelerometer = {"sensitivity": 0.0102, "noise": 1.96e-4, "resonance": 30e3, "low_cutoff": 0.5}
    amplifier = {"integrator": {"order": 2, "corner": 1.0, "gain": 1000.0}} if order else {}
    scene = rig.load("fig10b-three-dampers").replace(
        test={"kind": "free", "velocity": (0.9, -0.5, 0.4), "duration": 5.0},
        channels=[{"name": "body3", "at": "body 3", "accelerometer": accelerometer, **amplifier}],
        converter={"rate": 5120.0, "bits": 24, "range": 20.0},
        recording={"display": False},
    )
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        decay = analysis.decay(rec)
    motion = rig.simulate(scene, duration=5.0, rate=5120.0)
    ideal_sensor = ChannelInfo("true", "body 3", "displacement", 1.0, 5120.0)
    true_acceleration = correct_motion(ideal_sensor, motion.displacement[2], "acceleration", 2.0, 800.0)
    frequencies = np.array([mode.center for mode in decay.modes])
    assert len(frequencies) >= 2
    for index, mode in enumerate(decay.modes):
        width = band_width(frequencies, index)
        expected = modal_decay(true_acceleration, 5120.0, mode.center, width, 0, amplitudes=mode.amplitude)
        assert mode.damping.size > 5 and within_bounds(mode, expected).mean() > 0.95


def test_only_amplitudes_above_noise_are_reported(tmp_path):
    for noise in (1e-3, 1e-2):
        with daq.open(synthetic.impulses(tmp_path / "a.mcap", noise=noise)) as rec:
            decay = analysis.decay(rec, channel="body3")
        for mode in decay.modes:
            assert mode.amplitude.min() > 20.0 * mode.noise
            noise_part = np.sqrt(mode.damping_std**2 - (0.5 * mode.damping_bias_limit) ** 2)
            assert np.all(noise_part <= 0.05 * mode.damping)
            error = mode.damping - MODAL_DAMPING
            normalized_error = error / np.maximum(mode.damping_std, 0.01 * MODAL_DAMPING)
            assert np.max(abs(normalized_error)) < 4.0


def test_decay_below_noise_has_no_damping(tmp_path):
    with daq.open(synthetic.impulses(tmp_path / "a.mcap", noise=30.0)) as rec:
        assert all(mode.damping.size == 0 for mode in analysis.decay(rec, channel="body3").modes)


def test_envelope_is_bounded_by_largest_acceleration(tmp_path):
    with daq.open(synthetic.impulses(tmp_path / "a.mcap", interval=2.0)) as rec:
        decay = analysis.decay(rec)
    magnitude = abs(decay.acceleration)
    rounding = 1e-12 * magnitude.max()
    assert np.all(decay.envelope >= magnitude - rounding) and decay.envelope.max() <= magnitude.max() + rounding


def test_truncated_decay_keeps_its_envelope(tmp_path):
    short_path, long_path = (synthetic.impulses(tmp_path / f"{s}.mcap", interval=s) for s in (2.0, 8.0))
    with daq.open(short_path) as short, daq.open(long_path) as long:
        decay, expected = analysis.decay(short), analysis.decay(long)
    assert 1.8 < decay.time[-1] < 2.0
    near_end = decay.time > 1.0
    difference = abs(decay.envelope - expected.envelope[: decay.time.size])[near_end]
    assert difference.max() < 0.1 * expected.envelope[: decay.time.size][near_end].max()


def test_decay_ends_before_delayed_next_hit(tmp_path):
    scene = rig.load("fig10b-no-damper")
    test = scene.test.model_dump(exclude_none=True) | {"repeats": 2, "interval": 2.0}
    for remove_delay in (False, True):
        converter = {"rate": 2560.0, "filter": "delta_sigma", "remove_delay": remove_delay}
        filtered = scene.replace(test=test, converter=converter, recording={"truth": True, "display": False})
        with daq.open(daq.record(filtered, tmp_path / f"{remove_delay}.mcap")) as rec:
            decay = analysis.decay(rec, "body2")
            ideal_sensor = ChannelInfo("true", "body 2", "displacement", 1.0, rec.rate)
            true_acceleration = correct_motion(ideal_sensor, rec.truth("displacement")[1], "acceleration", 2.0, 800.0)
            begin = impact_ranges(rec)[0][1] + 1
        # The next hit is after 2 s; the delay of the filter and one period are discarded.
        assert 1.8 < decay.time[-1] < 2.0
        difference = abs(decay.acceleration - true_acceleration[begin : begin + decay.time.size])[decay.time > 0.05]
        assert difference.max() < 0.02 * abs(decay.acceleration).max()


def test_high_mode_in_short_record_is_resolved(tmp_path):
    scene = rig.loads(STIFF_BODY.format(stiffness=(2 * np.pi * 900.0) ** 2, duration=0.2))
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        decay = analysis.decay(rec)
    (mode,) = decay.modes
    assert abs(mode.frequency - 900.0) < 0.1
    np.testing.assert_allclose(mode.damping, MODAL_DAMPING, rtol=0.01)
    assert decay.halving == pytest.approx(np.log(2.0) / (2 * np.pi * 900.0 * MODAL_DAMPING), rel=0.02)


@pytest.mark.parametrize(("number", "channel"), [(24, "a2"), (44, "a2"), (48, "a1")])
def test_mixture_of_linear_modes_is_undetermined(tmp_path, number, channel):
    scene = draw_linear_decay(15, number, "decay_linear")
    decay = analysis.decay(daq.record(scene, tmp_path / "a.mcap"), channel=channel)
    assert [mode.damping.size for mode in decay.modes] == [0] and "cannot be separated" in " ".join(decay.warnings)


def test_low_mode_of_a_structure_is_resolved(tmp_path):
    scene = rig.loads(STIFF_BODY.format(stiffness=(2 * np.pi * 0.7) ** 2, duration=40))
    (mode,) = analysis.decay(daq.record(scene, tmp_path / "a.mcap")).modes
    assert abs(mode.frequency - 0.7) < 1e-3
    np.testing.assert_allclose(mode.damping, MODAL_DAMPING, rtol=0.01)


def imported_tower(folder, stiffness, quiet_samples=0):
    """Import a decay of 0.8 and 3.3 Hz with damping ratios of 1 %, after samples without motion."""
    rate, natural = 50.0, np.array([0.8, 3.3])
    time = np.arange(2900)[:, None] / rate
    tower = np.exp(-2 * np.pi * 0.01 * natural * time) * np.sin(2 * np.pi * natural * time) * [1.0, 0.3]
    samples = np.append(np.zeros(quiet_samples), tower.sum(axis=1))
    np.savez(folder / "a.npz", fs=rate, top=samples + 1e-3 * np.random.default_rng(1).standard_normal(samples.size))
    scene = f"""
        structure: {{masses: [1 kg], springs: [{stiffness} N/m]}}
        shaker: {{kind: force, body: 1}}
        test: {{kind: free, mode: 1, amplitude: 1 mm}}
        channels: [{{name: top, at: body 1}}]
        """
    table = {"top": {"column": "top", "unit": "m/s^2"}}
    return daq.import_files([folder / "a.npz"], rig.loads(scene), folder / "a.mcap", table=table)


@pytest.mark.parametrize("stiffness", [5.0, 400.0])
def test_imported_decay_below_2_hz_is_found(tmp_path, stiffness):
    modes = analysis.decay(imported_tower(tmp_path, stiffness)).modes
    np.testing.assert_allclose([mode.frequency for mode in modes], [0.8, 3.3], rtol=1e-3)
    assert all(abs(mode.damping[0] - 0.01) < 2.0 * mode.damping_std[0] for mode in modes)


def test_rest_before_an_imported_decay_is_named(tmp_path):
    decay = analysis.decay(imported_tower(tmp_path, 25.0, quiet_samples=100))
    assert "top is nearly at rest for the first 2 s" in decay.warnings[-1]


def test_short_decay_has_no_time_of_6_db(tmp_path):
    scene = rig.loads(STIFF_BODY.format(stiffness=4000, duration=10).replace("0.5 %", "0.05 %"))
    decay = analysis.decay(daq.record(scene, tmp_path / "a.mcap"))
    assert np.isnan(decay.halving) and "does not fall by 11 dB" in " ".join(decay.warnings)


def test_undamped_motion_is_not_a_decay(tmp_path):
    scene = rig.loads(STIFF_BODY.format(stiffness=(2 * np.pi * 300.0) ** 2, duration=0.5).replace("0.5 %", "0 %"))
    path = daq.record(scene, tmp_path / "a.mcap")
    with daq.open(path) as rec:
        decay = analysis.decay(rec)
    assert np.isnan(decay.halving) and "does not fall" in " ".join(decay.warnings)
    result = CliRunner().invoke(app, ["decay", str(path), "-o", str(tmp_path)])
    assert result.exit_code == 0 and "does not fall by 11 dB" in result.output
    assert (tmp_path / "a-decay.png").stat().st_size
