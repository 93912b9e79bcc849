"""Frequency responses from hammer impacts: truth within the uncertainty, overloads, drift, delays, unmarked impacts."""

import warnings

import numpy as np
import pytest

import analysis
import daq
import rig
from analysis.core.responses.force_pulse import samples_after_impact
from analysis.core.responses.hammer_impacts import HammerImpacts
from analysis.core.responses.impact_errors import force_noise
from analysis.core.responses.local_models import local_spectra
from daq.core.recording.markers import Marker
from daq.core.signal_chain.channel import ChannelInfo
from daq.extras.importing.channel_table import Column
from rig.core.base.errors import RecordingError
from rig.core.results.uncertainty import SENSITIVITY
from rig.core.system.natural_modes import natural_modes
from rig.core.system.structural_model import receptance, structure_matrices
from tests.analysis.responses import synthetic
from tests.peak_memory import peak_memory

pytestmark = pytest.mark.usefixtures("few_lines")

HAMMER_TEST = """
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


def coverage(rec, curves, low=3.0, high=60.0):
    """Return the share of lines whose bound contains the truth, and the largest median relative error of a curve.

    `low`, `high`: evaluated band, Hz.
    """
    shares, errors = [], []
    for body, frf in enumerate(curves):
        frf = frf.between(low, high)
        exact = receptance(rec.scene, frf.frequency)[body]
        shares.append(np.mean(abs(frf.value - exact) <= frf.bound(0.95)))
        errors.append(np.median(abs(frf.value / exact - 1)))
    return np.mean(shares), max(errors)


def test_free_vibration_of_earlier_hits_is_corrected(tmp_path):
    with daq.open(synthetic.impulses(tmp_path / "a.mcap", hits=3, interval=5.0, noise=1e-4)) as rec:
        [curves] = analysis.frequency_responses(rec)
        modes = analysis.identify(curves, count=3)
    np.testing.assert_allclose(modes.frequency, synthetic.NATURAL_FREQUENCIES, rtol=2e-4)
    np.testing.assert_allclose(modes.damping, 0.005, rtol=0.02)


def test_uncertainty_of_single_hit_contains_truth(tmp_path):
    with daq.open(synthetic.impulses(tmp_path / "a.mcap", hits=1, interval=5.0, noise=1e-4)) as rec:
        [curves] = analysis.frequency_responses(rec)
        exact = receptance(rec.scene, curves[0].frequency)
    f = curves[0].frequency
    band = (f > 5.0) & (f < 60.0)
    for body, frf in enumerate(curves):
        # The force is linear between samples, which at 60 Hz is 0.2 % less than the sampled amplitude.
        is_within_bound = abs(frf.value - exact[body]) < frf.bound(0.95) + 0.005 * abs(exact[body])
        assert np.mean(is_within_bound[band]) > 0.9
        assert np.isfinite(frf.error).all()


def test_force_noise_of_hits_is_its_relative_variance(tmp_path):
    noise, frequency = 0.3, np.array([5.0, 20.0, 40.0])
    with daq.open(synthetic.impulses(tmp_path / "a.mcap", hits=2, interval=1.0, noise=noise)) as rec:
        impacts = HammerImpacts.of(rec)
        change = force_noise(impacts, rec, [(0, rec.samples)], frequency)
        n_after, n_taper = samples_after_impact(rec.channels[impacts.channel])
    samples = np.mean([end - begin + 1 for begin, end in impacts.arrivals]) + n_after + n_taper / 2
    pulse = 50.0 * np.sin(np.pi * np.arange(16) / 16)
    spectrum = np.exp(-2j * np.pi * frequency[:, None] * np.arange(16) / synthetic.RATE) @ pulse
    # White noise is divided equally between the two quadrature components.
    variance = 0.5 * np.sum(abs(change) ** 2, axis=1)
    np.testing.assert_allclose(variance, 0.5 * samples * noise**2 / (2.0 * abs(spectrum) ** 2), rtol=0.2)


def test_force_noise_changes_over_the_window_bandwidth(tmp_path):
    with daq.open(synthetic.impulses(tmp_path / "a.mcap", hits=2, interval=1.0, noise=0.3)) as rec:
        impacts = HammerImpacts.of(rec)
        [(begin, end), _] = impacts.arrivals
        n_after, n_taper = samples_after_impact(rec.channels[impacts.channel])
        bandwidth = rec.rate / (end + 1 - begin + n_after + n_taper // 2)
        change = force_noise(
            impacts, rec, [(0, rec.samples)], np.array([10.0, 10.0 + 0.3 * bandwidth, 10.0 + bandwidth])
        )
    covariance = abs(change @ change.conj().T)
    correlation = covariance[0] / np.sqrt(covariance[0, 0] * np.diag(covariance))
    # White noise in a rectangular window.
    np.testing.assert_allclose(correlation, np.sinc([0.0, 0.3, 1.0]), atol=0.02)


def test_measured_rebound_causes_no_error(tmp_path):
    with daq.open(synthetic.impulses(tmp_path / "a.mcap", hits=1, interval=8.0, rebound=(1,))) as rec:
        [[frf]] = analysis.frequency_responses(rec, ["body3"])
        exact = receptance(rec.scene, frf.frequency)[2]
    significant = (frf.frequency > 5.0) & (frf.frequency < 60.0) & (abs(exact) > 2e-6)
    np.testing.assert_allclose(frf.value[significant], exact[significant], rtol=0.02)


def test_overload_is_excluded_and_reported(tmp_path):
    settings = {"cutoff": "", "converter": "{rate: 2560 Hz, range: 5 V}"}
    path = record_hits(tmp_path / "a.mcap", settings, repeats=3)
    with daq.open(path) as rec:
        [without_overload] = analysis.frequency_responses(rec)
        second_hit = sorted(marker.first_sample for marker in rec.markers if marker.kind == "hit")[1]
        share, _ = coverage(rec, without_overload)
        rec.markers.append(Marker("overload", second_hit, second_hit + 20, {"channel": "a1"}))
        [with_overload] = analysis.frequency_responses(rec)
        share_with_overload, error = coverage(rec, with_overload)
    assert "a1 overloaded" in " ".join(with_overload[0].warnings) and not without_overload[0].warnings
    assert share > 0.9 and share_with_overload > 0.9 and error < 0.01


def test_other_channels_remain_after_overload(tmp_path):
    path = record_hits(tmp_path / "a.mcap", {"cutoff": "", "converter": "{rate: 2560 Hz, range: 5 V}"})
    with daq.open(path) as rec:
        rec.markers.append(Marker("overload", 0, rec.samples - 1, {"channel": "a1"}))
        with pytest.raises(RecordingError, match=r"or use only the other channels \(`response`: a2\)\.$"):
            analysis.frequency_responses(rec)
        [[frf]] = analysis.frequency_responses(rec, ["a2"])
    assert not frf.warnings


def test_uncertainty_contains_error_due_to_settling_bias(tmp_path):
    scene = rig.loads(
        HAMMER_TEST.format(cutoff="", converter="{preset: NI 9234, rate: 2560 Hz}")
        .replace("sensitivity: 100 mV/g, low_cutoff: 0.3 Hz", "preset: PCB 352C33")
        .replace("sensitivity: 100 mV/g", "preset: PCB 352C33")
    )
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        first = next(marker for marker in rec.markers if marker.kind == "hit").first_sample
        [curves] = analysis.frequency_responses(rec)
        share, error = coverage(rec, curves)
    # The first hit waits until the bias of the sensors has nearly settled.
    assert first > 8.0 * rec.rate
    assert share > 0.9 and error < 0.12
    assert set(curves[0].limits) >= {SENSITIVITY}


@pytest.mark.parametrize(("interval", "is_reported"), [(6.0, False), (2.0, True)])
def test_uncertainty_contains_error_due_to_motion_before_hit(interval, is_reported, tmp_path):
    settings = {"cutoff": "", "converter": "{rate: 2560 Hz, range: 5 V, remove_delay: true}"}
    scene = rig.loads(HAMMER_TEST.format(**settings).replace("6 s", f"{interval} s"))
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        second = [marker for marker in rec.markers if marker.kind == "hit"][1]
        # A recording that begins 49 ms before the second hit, in the free decay of the first.
        rows = {name: rec.read(name, second.first_sample - 125) for name in rec.channels}
    np.savez(tmp_path / "cut.npz", **rows)
    units = {name: Column(name, unit="N" if name == "hammer" else "m/s^2") for name in rows}
    scene = rig.loads(HAMMER_TEST.format(**settings).replace("repeats: 2", "repeats: 1"))
    with warnings.catch_warnings(action="ignore"):
        daq.import_files(tmp_path / "cut.npz", scene, tmp_path / "cut.mcap", table=units)
    with daq.open(tmp_path / "cut.mcap") as rec:
        [curves] = analysis.frequency_responses(rec)
        share, error = coverage(rec, curves)
    assert share > 0.9 and error < 0.2
    assert is_reported == any("before an impact" in text for text in curves[0].warnings)
    np.testing.assert_array_equal(curves[0].frequency, curves[1].frequency)


@pytest.mark.filterwarnings("ignore:.*:rig.core.base.errors.RunWarning")
def test_recording_may_begin_with_its_hit(tmp_path):
    scene = rig.loads(
        HAMMER_TEST.format(cutoff="", converter="{rate: 2560 Hz, range: 5 V}").replace("repeats: 2", "repeats: 1")
    )
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        [hit] = [marker for marker in rec.markers if marker.kind == "hit"]
        rows = {name: rec.read(name, hit.first_sample - 1) for name in rec.channels}
    np.savez(tmp_path / "cut.npz", **rows)
    units = {name: Column(name, unit="N" if name == "hammer" else "m/s^2") for name in rows}
    daq.import_files(tmp_path / "cut.npz", scene, tmp_path / "cut.mcap", table=units)
    with daq.open(tmp_path / "cut.mcap") as rec:
        [curves] = analysis.frequency_responses(rec)
        _, error = coverage(rec, curves)
    assert error < 0.01
    assert any("is assumed to be at rest" in text for text in curves[0].warnings)


def test_integrator_drift_causes_no_error_far_above_resonance(tmp_path):
    scene = rig.loads("""
structure: {masses: [1 kg], springs: [2.4 kN/m], damping: {modal: 1 %}}
test: {kind: impulse, body: 1, peak: 15 N, width: 4 ms, repeats: 1, interval: 12 s}
channels:
  - name: a1
    at: body 1
    accelerometer: {sensitivity: 100 mV/g, noise: 30 ug/sqrt(Hz)}
    integrator: {order: 2, corner: 1 Hz, gain: 2400}
  - {name: hammer, at: hammer, hammer: {sensitivity: 0.4 V/N}}
converter: {rate: 732 Hz}
seed: 2
""")
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        [curves] = analysis.frequency_responses(rec)
        # Far above the resonance at 8 Hz, where displacements are smallest.
        share, error = coverage(rec, curves, 20.0, 230.0)
    assert share > 0.95 and error < 0.05


def test_channel_of_few_counts_is_excluded(tmp_path):
    scene = rig.loads(HAMMER_TEST.format(cutoff="", converter="{rate: 2 kHz, bits: 12, range: 5 V}"))
    channels = [
        scene.channels[0].model_dump(),
        {**scene.channels[1].model_dump(), "accelerometer": {"sensitivity": 2e-4}},
    ]
    scene = scene.replace(channels=(*channels, scene.channels[2].model_dump()))
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        [curves] = analysis.frequency_responses(rec)
    assert [np.isfinite(frf.bound(0.95)).any() for frf in curves] == [True, False]
    modes = analysis.identify(curves)
    assert modes.responses == ("a1",)
    assert any(note.startswith("a2 was omitted") for note in modes.warnings)
    with pytest.raises(RecordingError, match="uncertainty of the responses at a2"):
        analysis.identify(curves[1:])


def test_missing_force_channel_is_explained(tmp_path):
    path = synthetic.impulses(tmp_path / "a.mcap", hammer=False, interval=1.0)
    with daq.open(path) as rec, pytest.raises(RecordingError, match=r"Add \{name: hammer, at: hammer\}"):
        analysis.frequency_responses(rec)


def record_hits(path, settings, repeats=2):
    """Record hits on body 1; `settings`: cutoff of the hammer and converter, for `HAMMER_TEST`."""
    scene = rig.loads(HAMMER_TEST.format(**settings).replace("repeats: 2", f"repeats: {repeats}"), where="a test")
    return daq.record(scene, path)


def largest_errors(rec, curves, low):
    """Return the largest relative error of magnitude, and of phase in degrees, from `low` to 120 Hz."""
    errors = []
    for body, frf in enumerate(curves):
        frf = frf.between(low, 120.0)
        ratio = frf.value / receptance(rec.scene, frf.frequency)[body]
        errors.append((abs(abs(ratio) - 1.0).max(), abs(np.angle(ratio, deg=True)).max()))
    return np.max(errors, axis=0)


@pytest.mark.parametrize("rate", ["5120 Hz", "25.6 kHz"])
def test_force_window_follows_delayed_hit(tmp_path, rate):
    settings = {"cutoff": "", "converter": f"{{rate: {rate}, filter: delta_sigma}}"}
    with daq.open(record_hits(tmp_path / "a.mcap", settings)) as rec:
        assert rec.channels["hammer"].delay > 0
        [curves] = analysis.frequency_responses(rec)
        magnitude, phase = largest_errors(rec, curves, 2.0)
    assert magnitude < 0.005 and phase < 0.5


@pytest.mark.parametrize(("sensor", "converter"), [("0.01 Hz", "0.5 Hz"), ("0.5 Hz", "0.5 Hz"), ("0.05 Hz", "5 Hz")])
def test_high_pass_filters_are_corrected(tmp_path, sensor, converter):
    settings = {
        "cutoff": f", low_cutoff: {sensor}",
        "converter": f"{{rate: 2560 Hz, filter: delta_sigma, coupling: AC, ac_corner: {converter}}}",
    }
    with daq.open(record_hits(tmp_path / "a.mcap", settings)) as rec:
        [curves] = analysis.frequency_responses(rec)
        magnitude, phase = largest_errors(rec, curves, 1.0)
    assert magnitude < 0.001 and phase < 0.1


def test_missed_hit_is_reported(tmp_path):
    # The hit occurs 200 samples after its marker.
    force = np.zeros(6400)
    force[840:856] = 50.0
    infos = [info for info in synthetic.channels("acceleration") if info.at != "table"]
    infos.append(ChannelInfo("hammer", "hammer", "force", sensitivity=1.0, rate=synthetic.RATE))
    scene = synthetic.scene("{kind: impulse, body: 1, peak: 50 N, width: 6.25 ms}")
    rows = np.vstack([synthetic.simulate(force), force])
    path = synthetic.write(tmp_path / "a.mcap", scene, infos, rows, [("hit", 640, 655, {})])
    with daq.open(path) as rec, pytest.raises(RecordingError, match="at most 0 N at the marker of the impact"):
        analysis.frequency_responses(rec)


def record_many_hits(tmp_path, repeats):
    scene = rig.loads(
        f"""
        structure: {{masses: [1 kg], springs: [30 kN/m], damping: {{modal: 1 %}}}}
        test: {{kind: impulse, body: 1, peak: 100 N, width: 1 ms, interval: 2 s, repeats: {repeats}}}
        channels:
          - {{name: a, at: body 1, accelerometer: {{sensitivity: 100 mV/g, noise: 200 ug/sqrt(Hz)}}}}
          - {{name: h, at: hammer, hammer: {{sensitivity: 2 mV/N, noise: 5 mN/sqrt(Hz)}}}}
        converter: {{rate: 2560 Hz}}
        recording: {{display: false}}
        """
    )
    return scene, daq.record(scene, tmp_path / f"{repeats}.mcap")


@pytest.mark.parametrize("limit", [("_MAX_HITS", 2), ("_MAX_SAMPLES", 11000), ("_MAX_SAMPLES", 4000)])
def test_groups_of_hits_agree_with_theory(tmp_path, monkeypatch, limit):
    scene, path = record_many_hits(tmp_path, 6)
    with daq.open(path) as recording:
        together = analysis.frfs(recording)["a"]
        monkeypatch.setattr(f"analysis.core.responses.segment_fits.{limit[0]}", limit[1])
        frf = analysis.frfs(recording)["a"]
    relative_errors = []
    for curve in (frf, together):
        exact = receptance(scene, curve.frequency)[0]
        band = (curve.frequency > 10.0) & (curve.frequency < 300.0)
        assert (abs(curve.value - exact)[band] < curve.bound()[band]).mean() > 0.9
        relative_errors.append(np.median(curve.error[band] / abs(exact[band])))
    # The mean of the groups is as precise as the fit to all hits.
    assert 0.7 < relative_errors[0] / relative_errors[1] < 1.4
    assert any("are used" in warning for warning in frf.warnings) == (limit == ("_MAX_SAMPLES", 4000))


def test_memory_does_not_grow_with_hits(tmp_path, monkeypatch):
    monkeypatch.setattr("analysis.core.responses.segment_fits._MAX_HITS", 2)
    peaks, fitted_bins = [], []
    fit = local_spectra.local_fit

    def count(output, reference, end_phases, lines, half_width, *arguments):
        fitted_bins[-1] += lines.size * len(reference) * half_width
        return fit(output, reference, end_phases, lines, half_width, *arguments)

    monkeypatch.setattr(local_spectra, "local_fit", count)
    for repeats in (6, 12):
        with daq.open(record_many_hits(tmp_path, repeats)[1]) as recording:
            fitted_bins.append(0)
            peaks.append(peak_memory(analysis.frfs, recording)[0])
    assert peaks[1] < 1.2 * peaks[0]
    assert fitted_bins[1] < 2.2 * fitted_bins[0]


def test_hammer_tolerance_does_not_affect_shapes(tmp_path):
    text = HAMMER_TEST.format(cutoff="", converter="{rate: 2560 Hz}").replace(", low_cutoff: 0.3 Hz", "")
    scene = rig.loads(text.replace("hammer: {", "hammer: {sensitivity_tolerance: 15 %, "))
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        [curves] = analysis.frequency_responses(rec)
    modes = analysis.identify(curves)
    mass, _, stiffness = structure_matrices(scene.structure)
    exact = natural_modes(mass, stiffness)[1]
    exact = exact / exact[abs(exact).argmax(axis=0), np.arange(len(mass))]
    assert {curve.uncertainty.scale for curve in curves} == {0.15}
    assert modes.shape_std.max() < 0.01
    rows = [int(rec.channels[name].at.split()[1]) - 1 for name in modes.responses]
    np.testing.assert_allclose(modes.shapes.real, exact[rows], atol=5e-3)
