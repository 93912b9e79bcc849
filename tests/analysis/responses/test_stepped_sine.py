"""Frequency responses from stepped sines: exact values, bounds, and points without steady state or with overloads."""

from dataclasses import replace

import numpy as np
import pytest

import analysis
import daq
import rig
from analysis.core.damper_motion.comparison import peak
from analysis.core.responses.spectral_lines import residual_transient
from analysis.core.responses.stepped_sine import sweeps
from daq.core.measurement.run_report import summary
from daq.core.recording.recorder import Recorder
from rig.core.base.errors import RecordingError, SceneError
from rig.core.system.structural_model import receptance, transmissibility
from tests.analysis.responses import synthetic


def test_response_to_ideal_stepped_sine_is_exact(tmp_path):
    frequencies = np.linspace(8.0, 60.0, 25)
    with daq.open(synthetic.stepped_sine(tmp_path / "a.mcap", frequencies)) as rec:
        for body in (1, 2, 3):
            frf = analysis.compliance(rec, response=f"body{body}")
            exact = receptance(rec.scene, frequencies)[body - 1]
            np.testing.assert_allclose(frf.value, exact, rtol=1e-9)


def record_groups(path, scene, groups):
    """Record groups of simultaneous tones of linear motion, one group after another."""
    count = 5120
    blocks, marks = [], []
    for number, frequencies in enumerate(groups):
        motions = receptance(scene, frequencies)
        motions = np.vstack([motions, 1.0 / synthetic.SPRING + motions[0]])
        blocks.append((motions @ np.exp(2j * np.pi * np.outer(frequencies, np.arange(count)) / synthetic.RATE)).real)
        limits = number * count, (number + 1) * count - 1
        marks += [("measure", *limits, {"frequency": each, "level": 1.0}) for each in frequencies]
    samples = np.concatenate(blocks, axis=1)
    return synthetic.write(path, scene, synthetic.channels(), samples, marks)


def test_groups_of_tones_at_once_ascend(tmp_path):
    scene = synthetic.scene()
    with daq.open(record_groups(tmp_path / "r.mcap", scene, [[33.3, 20.0], [24.0, 41.0]])) as rec:
        response = analysis.frfs(rec)
    assert response.frequency.tolist() == [20.0, 24.0, 33.3, 41.0]
    assert response["body3"].value == pytest.approx(receptance(scene, response.frequency)[2], rel=1e-9)


def test_loading_of_tones_at_once_adds_up(tmp_path):
    scene = synthetic.scene().replace(dampers=[{"body": 3, "mass": "50 g", "clearance": "2 mm"}])
    loadings = []
    for name, groups in (("alone", [[20.0], [24.0], [33.3], [41.0]]), ("groups", [[33.3, 20.0], [24.0, 41.0]])):
        with daq.open(record_groups(tmp_path / f"{name}.mcap", scene, groups)) as rec:
            loadings.append(analysis.frfs(rec).loading)
    (first, second, third, fourth), together = loadings
    expected = [first + third, second + fourth, first + third, second + fourth]
    np.testing.assert_allclose(together, expected, rtol=1e-9)


def test_repeated_frequencies_have_a_peak(tmp_path):
    frequencies = [31.0, 32.0, 33.0, 34.0, 34.5, 35.0, 36.0, 34.5, 37.0, 31.0]
    path = synthetic.stepped_sine(tmp_path / "r.mcap", frequencies)
    once = synthetic.stepped_sine(tmp_path / "once.mcap", sorted(set(frequencies)))
    peaks = []
    for each in (path, once):
        with daq.open(each) as rec:
            peaks.append(peak(analysis.frfs(rec)["body1"], 31.0, 37.0))
    assert peaks[0].value == pytest.approx(peaks[1].value, rel=1e-6)


def test_high_pass_filter_and_delay_are_corrected(tmp_path):
    corner = 2 * np.pi * 1.0  # rad/s
    chain = {"zeros": (0j, 0j), "poles": (-corner * (0.7 + 0.7j), -corner * (0.7 - 0.7j)), "delay": 3e-4}
    frequencies = np.linspace(8.0, 60.0, 11)
    infos = synthetic.channels("velocity", **chain)
    path = synthetic.stepped_sine(tmp_path / "a.mcap", frequencies, infos=infos)
    with daq.open(path) as rec:
        frf = analysis.compliance(rec, response="body3")
        exact = receptance(rec.scene, frequencies)[2]
    assert np.max(abs(frf.value / exact - 1)) < 1e-9


def test_table_reference_includes_spring(tmp_path):
    frequencies = np.linspace(8.0, 60.0, 11)
    with daq.open(synthetic.stepped_sine(tmp_path / "a.mcap", frequencies)) as rec:
        frf = analysis.compliance(rec, response="body 2", reference="table")
        exact = transmissibility(rec.scene, frequencies)[1]
    np.testing.assert_allclose(frf.value, exact, rtol=1e-9)
    assert frf.name == "transmissibility"


def test_sweeps_are_computed_once_per_recording(tmp_path):
    path = synthetic.stepped_sine(tmp_path / "a.mcap", np.linspace(8.0, 60.0, 3))
    with daq.open(path) as rec, daq.open(path) as other:
        (sweep,) = sweeps(rec)
        assert sweeps(rec, list(rec.channels))[0] is sweep
        assert sweeps(other)[0] is not sweep
        assert sweeps(rec, ["body1"])[0].lines.channels == ("body1",)


def test_bounds_contain_truth_in_95_percent(tmp_path):
    frequencies = np.linspace(9.0, 58.0, 60)
    is_within_bound, coherence = [], []
    for seed in range(2):
        path = synthetic.stepped_sine(tmp_path / "a.mcap", frequencies, noise=1e-5, seed=seed)
        with daq.open(path) as rec:
            exact = receptance(rec.scene, frequencies)
            for [*curves] in analysis.frequency_responses(rec):
                for body, frf in enumerate(curves):
                    is_within_bound.append(abs(frf.value - exact[body]) < frf.random_bound(0.95))
                    coherence.append(frf.coherence)
    assert 0.92 < np.mean(is_within_bound) < 0.98
    assert np.max(coherence) > 0.9999 and np.min(coherence) < 0.95


def test_force_amplitude_is_sorted_with_points(tmp_path):
    with daq.open(synthetic.stepped_sine(tmp_path / "a.mcap", [34.0, 12.0], level=2.61)) as rec:
        frf = analysis.compliance(rec)
    np.testing.assert_allclose(frf.amplitude, 2.61, rtol=1e-9)
    assert "at 12 Hz under 2.61 N" in frf.summary()
    gap = replace(frf, omitted=np.array([20.0])).with_gaps()
    np.testing.assert_allclose(gap.amplitude, [2.61, np.nan, 2.61], rtol=1e-9)


def test_mobility_is_receptance_times_i_omega(tmp_path):
    with daq.open(synthetic.stepped_sine(tmp_path / "a.mcap", [12.0, 20.0])) as rec:
        frf = analysis.compliance(rec)
    mobility = frf.to("velocity")
    np.testing.assert_allclose(mobility.value, 2j * np.pi * frf.frequency * frf.value)
    np.testing.assert_allclose(mobility.to("displacement").value, frf.value)
    assert mobility.unit == "m/(N s)"


@pytest.mark.parametrize(
    ("level", "name"),
    [
        ("kind: stepped_sine, force: [1 N, 3 N]", "3 N up"),
        ("kind: stepped_sine, drive: [1 m, 3 m]", "level 3 up"),
        ("kind: constant_response, at: body 1, displacement: [1 m, 3 m]", "3000 mm up"),
        ("kind: constant_response, at: body 1, acceleration: [1 m/s^2, 3 m/s^2]", "3 m/s² up"),
    ],
    ids=["force", "drive", "displacement", "acceleration"],
)
def test_ambiguous_level_lists_the_levels(level, name, tmp_path):
    infos = synthetic.channels()
    scene = synthetic.scene(f"{{frequencies: [20 Hz], {level}}}")
    markers = [
        ("measure", 0, 2559, {"frequency": 20.0, "level": 1.0, "direction": "up"}),
        ("measure", 2560, 5119, {"frequency": 20.0, "level": 3.0, "direction": "up"}),
    ]
    samples = np.tile(np.sin(2 * np.pi * 20 / synthetic.RATE * np.arange(5120)), (4, 1))
    samples[3] *= 1.5
    with daq.open(synthetic.write(tmp_path / "a.mcap", scene, infos, samples, markers)) as rec:
        with pytest.raises(SceneError, match="level=1, direction='up'; level=3"):
            analysis.compliance(rec)
        assert analysis.compliance(rec, level=3.0).label.endswith(f", {name}")
        assert len(analysis.frequency_responses(rec)) == 2


@pytest.mark.parametrize(
    ("response", "message"), [("bodi3", "Did you mean 'body3'"), ("hammer", "no channel 'hammer'")]
)
def test_error_for_unknown_channel_names_the_nearest(tmp_path, response, message):
    with (
        daq.open(synthetic.stepped_sine(tmp_path / "a.mcap", [12.0])) as rec,
        pytest.raises(RecordingError, match=message),
    ):
        analysis.compliance(rec, response=response)


def test_missing_table_channel_is_explained(tmp_path):
    infos = synthetic.channels()[:3]
    markers = [("measure", 0, 2559, {"frequency": 20.0, "level": 1.0, "direction": "up"})]
    path = synthetic.write(tmp_path / "a.mcap", synthetic.scene(), infos, np.ones((3, 2560)), markers)
    with daq.open(path) as rec, pytest.raises(RecordingError, match="needs a motion channel at table"):
        analysis.compliance(rec)


def test_missing_measurements_are_explained(tmp_path):
    rows = np.ones((4, 2560))
    path = synthetic.write(tmp_path / "a.mcap", synthetic.scene(), synthetic.channels(), rows, [])
    with daq.open(path) as rec, pytest.raises(RecordingError, match="no steady state was measured"):
        analysis.compliance(rec)


def test_overloaded_and_unsettled_points_warn(tmp_path):
    infos = synthetic.channels()
    fields = {"level": 1.0, "direction": "up", "settled": False}
    markers = [
        ("measure", 0, 1279, fields | {"frequency": 20.0}),
        ("measure", 1280, 2559, fields | {"frequency": 30.0}),
        ("overload", 100, 120, {"channel": "body3"}),
        # Irrelevant to the requested response.
        ("overload", 1300, 1310, {"channel": "body2"}),
    ]
    samples = np.random.default_rng(0).standard_normal((4, 2560))
    with daq.open(synthetic.write(tmp_path / "a.mcap", synthetic.scene(), infos, samples, markers)) as rec:
        frf = analysis.compliance(rec)
    warnings = " ".join(frf.warnings)
    assert "20 Hz omitted: body3 overloaded" in warnings and "No steady state at 30 Hz" in warnings
    assert frf.frequency.tolist() == [30.0] and frf.unsteady.tolist() == [True]


def test_unsettled_neighbors_form_ranges(tmp_path):
    settled = np.ones(40, dtype=bool)
    settled[[3, *range(10, 31)]] = False
    markers = [
        ("measure", 512 * k, 512 * k + 511, {"frequency": 20.0 + k, "level": 1.0, "settled": bool(settled[k])})
        for k in range(40)
    ]
    samples = np.random.default_rng(0).standard_normal((4, 512 * 40))
    path = synthetic.write(tmp_path / "a.mcap", synthetic.scene(), synthetic.channels(), samples, markers)
    with daq.open(path) as rec:
        assert any("No steady state at 23 and 30 to 50 Hz:" in note for note in analysis.compliance(rec).warnings)
    assert "steady state reached: 18 of 40 measurements, not at 23 and 30 to 50 Hz" in summary(path)


def test_overloaded_points_of_sweeps_are_listed(tmp_path):
    # Two sweeps of five points; overloads in two points of the first sweep, and in all points of the second.
    fields = [{"frequency": 20.0 + 10 * (k % 5), "level": 1.0 + k // 5, "direction": "up"} for k in range(10)]
    markers = [("measure", 256 * k, 256 * k + 255, fields[k]) for k in range(10)]
    markers += [("overload", 256 * k + 9, 256 * k + 20, {"channel": "body3"}) for k in (1, 3, 5, 6, 7, 8, 9)]
    samples = np.random.default_rng(0).standard_normal((4, 2560))
    path = synthetic.write(tmp_path / "a.mcap", synthetic.scene(), synthetic.channels(), samples, markers)
    with daq.open(path) as rec:
        [[frf]] = analysis.frequency_responses(rec, ["body3"])
    assert frf.frequency.tolist() == [20.0, 40.0, 60.0] and frf.omitted.tolist() == [30.0, 50.0]
    assert frf.warnings == (
        "1 N up: 2 frequencies from 30 to 50 Hz omitted: body3 overloaded in their windows.",
        "2 N up: 5 frequencies from 20 to 60 Hz omitted: body3 overloaded in their windows.",
        "2 N up: no frequency of this sweep is usable.",
    )


def test_overload_in_all_windows_is_explained(tmp_path):
    markers = [
        ("measure", 0, 2559, {"frequency": 20.0, "level": 1.0, "direction": "up"}),
        ("overload", 0, 2559, {"channel": "body3"}),
    ]
    path = synthetic.write(tmp_path / "a.mcap", synthetic.scene(), synthetic.channels(), np.ones((4, 2560)), markers)
    with daq.open(path) as rec, pytest.raises(RecordingError, match="overloaded in every measured window"):
        analysis.compliance(rec)


def test_lost_samples_omit_only_their_frequency(tmp_path):
    infos = synthetic.channels()
    tone = np.tile(np.sin(2 * np.pi * 20 / synthetic.RATE * np.arange(2560)), (4, 1)) * [[1], [1], [1], [2]]
    with Recorder(tmp_path / "a.mcap", synthetic.scene(), infos, synthetic.RATE) as recorder:
        for first, frequency in ((0, 20.0), (2560, 40.0), (5120, 20.0)):
            recorder.mark("measure", first, first + 2559, frequency=frequency, level=1.0, direction="up")
        recorder.write(tone)
        recorder.write(tone[:, :1000])
        recorder.gap(60)
        recorder.write(tone[:, 1060:])
        recorder.write(tone)
    with daq.open(tmp_path / "a.mcap") as rec:
        frf = analysis.compliance(rec)
    # The second measurement, at 40 Hz, is omitted.
    assert frf.frequency.tolist() == [20.0, 20.0]
    assert any("40 Hz omitted: samples of " in warning for warning in frf.warnings)
    assert frf.omitted.tolist() == [40.0]


@pytest.mark.parametrize("parts", [5, 20])
@pytest.mark.parametrize("rotation", [0.0, 0.5, 1.5])  # rad per part, for five parts
def test_rotating_transient_is_bounded(parts, rotation):
    # Decay factor from part to part; 20 parts are averaged to four.
    factor = 0.9 * np.exp(1j * rotation * 5.0 / parts)
    amplitudes = 1.0 + 0.1 * factor ** np.arange(parts)
    bound = residual_transient(amplitudes[:, None, None])[0, 0]
    assert abs(np.mean(amplitudes) - 1.0) == pytest.approx(bound, rel=1e-6)


def test_slow_transients_with_damper_are_nearly_within_uncertainty(tmp_path):
    scene = rig.loads(
        """
        structure:
          masses: [0.71023, 0.75068, 0.61985]
          springs: [23994, 22798, 21519]
          damping: {modal: 0.0040337}
        dampers:
        - {body: 2, mass_ratio: 0.081553, clearance: 0.801 mm, restitution: 0, contact: {duration: 2.0136 ms}}
        shaker: {kind: force, body: 2}
        test: {kind: stepped_sine, from: 12.48, to: 13.02, points: 6, force: 2.087}
        channels: [{name: a2, at: body 2}, {name: force, at: shaker}]
        converter: {rate: 5120}
        """
    )
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        frf = analysis.compliance(rec, response="a2")
    exact = rig.orbit_response(scene, frf.frequency).compliance[1]
    # All errors, of which one in twenty may exceed the 95 % bound.
    assert np.all(abs(frf.value - exact) < 1.5 * frf.bound(0.95))


def test_rounding_error_of_impacts_lies_within_resolution(tmp_path):
    # In every period, the pulse of an impact and the rounding of the tone to counts are equal.
    frequency, count = 12.804, 4000
    cycles = frequency / synthetic.RATE * np.arange(count)
    pulses = np.exp(-0.5 * (((cycles + 0.2) % 1.0 - 0.5) / 0.01) ** 2)
    offsets = np.array([[0.0], [0.15], [0.3], [0.45]])
    motion = 20.4 * np.cos(2.0 * np.pi * cycles) + 60.0 * pulses + offsets
    marks = [("measure", 0, count - 1, {"frequency": frequency, "level": 1.0, "direction": "up"})]
    means, bounds = [], []
    for steps, samples in ((None, motion), (1.0, np.rint(motion).astype(np.int32))):
        infos = synthetic.channels(volts_per_count=steps)
        path = synthetic.write(tmp_path / f"{steps}.mcap", synthetic.scene(), infos, samples, marks)
        with daq.open(path) as rec:
            [sweep] = sweeps(rec)
            means.append(sweep.lines.mean[:, 0])
            bounds.append(sweep.lines.resolution[:, 0])
    error = abs(means[1] - means[0])
    assert np.all(error < bounds[1]) and error.max() > 0.5 * bounds[1].max()


PARTS = 4  # of a window
LINES = 120  # frequencies


def complex_noise(seed, shape):
    random = np.random.default_rng(seed)
    return random.standard_normal(shape) + 1j * random.standard_normal(shape)


@pytest.mark.parametrize("seed", range(3))
def test_noise_alone_has_no_transient(seed):
    deviation = np.sqrt(2.0 / PARTS)
    assert np.median(residual_transient(complex_noise(seed, (PARTS, 1, LINES)))) < 0.15 * deviation


@pytest.mark.parametrize("decay_per_period", [0.3, 2.0, 8.0])
def test_modal_transient_is_bounded_at_most_lines(decay_per_period):
    # The mode lies between two lines. The faster its transient decays, the more lines it affects.
    pole = (-decay_per_period + 2j * np.pi * 60.3) / (2j * np.pi)
    first = 40.0 / (np.arange(LINES) - pole)
    transient = first * np.exp(2j * np.pi * pole * np.arange(PARTS))[:, None, None]
    bound = residual_transient(transient + 0.05 * complex_noise(1, (PARTS, 1, LINES)))[0]
    error = abs(transient.mean(axis=0)[0])
    significant = error > 0.2
    assert np.mean(bound[significant] > 0.8 * error[significant]) > 0.9


def test_early_end_of_the_test_is_reported(tmp_path):
    motion = np.cos(2.0 * np.pi * 10.0 / synthetic.RATE * np.arange(2560))
    measured = {"frequency": 10.0, "level": 1.0, "direction": "up", "settled": True}
    marks = [("measure", 0, 2559, measured), ("abort", 2559, 2559, {"reason": "interrupted"})]
    samples = np.outer([1e-5, 2e-5, 3e-5, 2e-4], motion)
    path = synthetic.write(tmp_path / "a.mcap", synthetic.scene(), synthetic.channels(), samples, marks)
    (warning,) = analysis.frf(path)[0].warnings
    assert "ended early (interrupted)" in warning
