"""Responses to random, burst, multisine and swept excitation, compared with exact receptances."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

import analysis
import daq
import rig
from analysis.core.responses.estimator import Blocks, Request
from analysis.core.responses.estimators import estimate
from analysis.core.responses.measurands import motion_of, reference_of
from analysis.core.responses.multisine import LIFTED, NONLINEAR, best_linear_approximation
from rig.core.base.errors import RecordingError, SceneError
from rig.core.system.structural_model import receptance
from tests.analysis.responses import synthetic

pytestmark = pytest.mark.usefixtures("few_lines")

RATE, OVERSAMPLING = synthetic.RATE, synthetic.OVERSAMPLING
ANTIRESONANCES = (17.8, 28.1, 44.4)  # Hz
RANDOM = "{kind: random, from: 8 Hz, to: 60 Hz, duration: 60 s, force: 1 N}"


@pytest.fixture(scope="module")
def random_file(tmp_path_factory):
    force = synthetic.band_noise(90.0, 6.0, 62.0)
    marks = [("measure", 0, int(90 * RATE) - 1, {"from": 8.0, "to": 60.0, "level": 1.0})]
    path = tmp_path_factory.mktemp("random") / "random.mcap"
    return synthetic.record_response(path, force, RANDOM, marks, noise=0.02)


@pytest.mark.parametrize("estimator", [None, "H1"])
def test_reference_relative_to_itself_is_one(tmp_path, estimator):
    samples = np.random.default_rng(1).standard_normal((4, int(20 * RATE)))
    marks = [("measure", 0, samples.shape[1] - 1, {"from": 8.0, "to": 60.0, "level": 1.0})]
    path = synthetic.write(tmp_path / "a.mcap", synthetic.scene(RANDOM), synthetic.channels(), samples, marks)
    with daq.open(path) as rec:
        [[curve]] = analysis.frequency_responses(rec, channels=["table"], reference="table", estimator=estimator)
    np.testing.assert_allclose(curve.value, 1.0, rtol=1e-12)
    assert curve.bound().max() < 1e-12


def test_block_average_is_within_uncertainty_away_from_peaks(random_file):
    with daq.open(random_file) as rec:
        [curves] = analysis.frequency_responses(rec, block=8.0)
        exact = receptance(rec.scene, curves[0].frequency)
    # A Hann window wider than the resonance widens its peak; the resolution of the curve states this.
    f = curves[0].frequency
    far_from_peaks = np.all([abs(f - peak) > 2.0 for peak in synthetic.NATURAL_FREQUENCIES], axis=0)
    for body, frf in enumerate(curves):
        # Noise bandwidth of a Hann window of 8 s.
        assert frf.resolution == pytest.approx(1.5 / 8.0)
        assert np.mean((abs(frf.value - exact[body]) < frf.bound(0.95))[far_from_peaks]) > 0.9
        assert np.max(frf.coherence) > 0.99


@pytest.mark.thorough
def test_short_blocks_warn_of_high_damping(random_file):
    with daq.open(random_file) as rec:
        [curves] = analysis.frequency_responses(rec, block=4.0)
        modes = analysis.identify(curves, count=3)
    # The damping ratio is 0.005.
    assert modes.damping[0] > 0.0055
    assert any("widens the peaks" in warning and "blocks of at least" in warning for warning in modes.warnings)


@pytest.mark.parametrize(("estimator", "overlap"), [("H1", None), ("H1", 0.75), ("H2", 0.75)])
def test_block_average_agrees_with_scipy(estimator, overlap, random_file):
    with daq.open(random_file) as rec:
        [[frf]] = analysis.frequency_responses(rec, ["body2"], estimator=estimator, block=4.0, overlap=overlap)
        x, force = rec.read("body2"), rec.read("force")
    samples = int(4.0 * RATE)
    options = {"fs": RATE, "window": "hann", "nperseg": samples, "noverlap": int((overlap or 0.5) * samples)}
    f, cross = signal.csd(force, x, **options)
    force_power, power = (signal.welch(each, **options)[1] for each in (force, x))
    expected = cross / force_power if estimator == "H1" else power / cross.conj()
    in_band = (f >= 8.0) & (f <= 60.0)
    np.testing.assert_allclose(frf.value, expected[in_band], rtol=1e-9)
    np.testing.assert_allclose(frf.coherence, (abs(cross) ** 2 / (force_power * power))[in_band], rtol=1e-9)


def test_hv_lies_between_h1_and_h2():
    random = np.random.default_rng(0)
    force = random.standard_normal((4000, 2)) @ [1, 1j]
    noise = 0.5 * random.standard_normal((2, 4000, 2)) @ [1, 1j]
    response, force = 2.0 * force + noise[0], force + noise[1]
    spectra = np.mean(abs(response) ** 2), np.mean(abs(force) ** 2), np.mean(response * force.conj())
    h1, hv, h2 = (abs(estimate(name, *spectra)) for name in ("H1", "Hv", "H2"))
    assert h1 < hv < h2
    with pytest.raises(SceneError, match="H1, H2, Hv"):
        estimate("H3", *spectra)


def test_responses_to_bursts_have_no_leakage(tmp_path):
    block_s, burst_s = 20.0, 3.0
    burst = synthetic.band_noise(3 * block_s, 6.0, 62.0, seed=5)
    time = np.arange(burst.size) / (RATE * OVERSAMPLING) % block_s
    burst *= np.where(time < burst_s, np.sin(np.pi * np.minimum(time / burst_s, 1.0)) ** 0.5, 0.0)
    fields = {"from": 8.0, "to": 60.0, "level": 1.0, "burst": 0.125, "block": int(block_s * RATE)}
    marks = [("measure", 0, int(3 * block_s * RATE) - 1, fields)]
    with daq.open(synthetic.record_response(tmp_path / "a.mcap", burst, RANDOM, marks)) as rec:
        [curves] = analysis.frequency_responses(rec)
        exact = receptance(rec.scene, curves[0].frequency)
    assert curves[0].resolution == 0.0
    for body, frf in enumerate(curves):
        significant = abs(exact[body]) > 1e-5
        np.testing.assert_allclose(frf.value[significant], exact[body][significant], rtol=0.02)


def test_block_longer_than_recording_is_rejected(random_file):
    with daq.open(random_file) as rec, pytest.raises(RecordingError, match="too few to average"):
        analysis.frequency_responses(rec, block=100.0)


def test_block_of_few_samples_is_rejected(random_file):
    with daq.open(random_file) as rec, pytest.raises(RecordingError, match="Choose longer blocks"):
        analysis.frequency_responses(rec, block=2.0 / rec.rate)


@pytest.mark.parametrize("selection", [{"level": "1 N"}, {"direction": "up"}])
def test_selection_of_a_sweep_requires_tones(random_file, selection):
    with daq.open(random_file) as rec, pytest.raises(SceneError, match="no sweeps of steady tones"):
        analysis.frfs(rec, **selection)


def multisine(path, realisations, periods=4, noise=0.01):
    """Record periodic random forces with a period of 8 s; each realization begins with three unmeasured periods."""
    period = 8.0
    forces, marks, first = [], [], 0
    for number in range(realisations):
        force_of_period = synthetic.band_noise(period, 8.0, 60.0, seed=10 + number)
        forces.append(np.tile(force_of_period, periods + 3))
        first += int(3 * period * RATE)
        fields = {
            "realisation": number + 1, "period": int(period * RATE), "periods": periods,
            "lines": [64, 480], "level": 1.0, "settled": True,
        }  # fmt: skip
        marks.append(("measure", first, first + int(periods * period * RATE) - 1, fields))
        first += int(periods * period * RATE)
    test = "{kind: multisine, from: 8 Hz, to: 60 Hz, period: 8 s, force: 1 N}"
    return synthetic.record_response(path, np.concatenate(forces), test, marks, noise=noise)


@pytest.fixture(scope="module")
def multisine_file(tmp_path_factory):
    return multisine(tmp_path_factory.mktemp("multisine") / "a.mcap", realisations=5)


def test_uncertainty_of_multisine_contains_truth(multisine_file):
    with daq.open(multisine_file) as rec:
        [curves] = analysis.frequency_responses(rec)
        exact = receptance(rec.scene, curves[0].frequency)
        modes = analysis.identify(curves)
    inside = [abs(frf.value - exact[body]) < frf.random_bound(0.95) for body, frf in enumerate(curves)]
    assert 0.93 < np.mean(inside) < 0.99
    np.testing.assert_allclose(modes.frequency, synthetic.NATURAL_FREQUENCIES, rtol=2e-4)
    np.testing.assert_allclose(modes.damping, 0.005, rtol=0.02)


def test_note_on_missing_periods_gives_the_reason(tmp_path):
    with daq.open(multisine(tmp_path / "a.mcap", realisations=1)) as rec:
        [marker] = [marker for marker in rec.markers if marker.kind == "measure"]
        marker.fields["periods"] += 1
        [curves] = analysis.frequency_responses(rec)
    assert "1 of 5 periods of realization 1 omitted: the recording ends." in curves[0].warnings


def test_linear_structure_shows_no_distortion(multisine_file):
    with daq.open(multisine_file) as rec:
        measured = [marker for marker in rec.markers if marker.kind == "measure"]
        names = list(rec.channels)
        request = Request(rec, names, "force", "displacement", Blocks(), None, names, measured)
        approximation = best_linear_approximation(request)
        body_and_force = motion_of(rec, "body3"), reference_of(rec, "force")
        noise_alone = replace(approximation, scatter=approximation.noise, noise=None)
        noise, total = (np.median(each.frf(rec, *body_and_force).error) for each in (noise_alone, approximation))
    assert 0.7 < total / noise < 1.3


def test_rounding_is_not_called_nonlinear(tmp_path):
    """The signals have few counts and little noise, so their rounding repeats in each period of a realization."""
    scene = rig.loads(
        """
        structure:
          masses: [12 kg, 5 kg, 0.8 kg]
          springs: [300 kN/m, 60 kN/m, 3.5 kN/m]
          damping: {dashpots: [30 N s/m, 15 N s/m, 0.5 N s/m]}
        shaker: {kind: base}
        test: {kind: multisine, from: 3 Hz, to: 40 Hz, period: 8 s, periods: 4, realisations: 2, drive: 0.5 m/s^2}
        channels:
        - {name: table, at: table, accelerometer: {sensitivity: 10 mV/(m/s^2)}}
        - {name: a1, at: body 1, accelerometer: {sensitivity: 100 mV/g}}
        - {name: a3, at: body 3, accelerometer: {sensitivity: 100 mV/g}}
        converter: {rate: 128 Hz, bits: 13, range: 1 V, coupling: AC, ac_corner: 5 Hz}
        """
    )
    [curves] = analysis.frequency_responses(daq.record(scene, tmp_path / "a.mcap"))
    assert NONLINEAR not in [text for curve in curves for text in curve.warnings]


def test_tone_that_lifts_a_damper_is_recommended(tmp_path):
    test = {"kind": "multisine", "from": 30.0, "to": 40.0, "period": 2.0, "realisations": 2, "force": 0.05}
    scene = rig.load("fig8-three-dampers").replace(
        shaker={"kind": "force", "body": 1},
        test=test,
        channels=[*({"name": f"a{j}", "at": f"body {j}"} for j in (1, 2, 3)), {"name": "force", "at": "shaker"}],
        recording={"display": False},
    )
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as rec:
        [curves] = analysis.frequency_responses(rec)
    [warning] = curves[0].warnings
    force, frequency = re.search(r"of more than (\S+) N at (\S+) Hz lift a damper", warning).groups()
    tone = {"kind": "stepped_sine", "frequencies": [float(frequency)]}
    below_limit, above_limit = (scene.replace(test=tone | {"force": ratio * float(force)}) for ratio in (0.9, 1.1))
    assert rig.frequency_response(below_limit, [float(frequency)]).motion_type[0] == "riding"
    assert rig.frequency_response(above_limit, [float(frequency)]).motion_type[0] != "riding"


def sweep(path, duration, spacing="log"):
    """Record a sweep from 8 to 60 Hz; duration in s."""
    rate = RATE * OVERSAMPLING
    time = np.arange(int(duration * rate)) / rate
    if spacing == "log":
        log_ratio = np.log(60.0 / 8.0)
        cycles = duration * 8.0 * np.expm1(log_ratio * time / duration) / log_ratio
    else:
        cycles = 8.0 * time + (60.0 - 8.0) * time**2 / 2 / duration
    fields = {"from": 8.0, "to": 60.0, "spacing": spacing, "level": 1.0, "duration": duration, "settled": True}
    marks = [("measure", 0, int(duration * RATE) - 1, fields)]
    test = f"{{kind: swept_sine, from: 8 Hz, to: 60 Hz, duration: {duration} s, force: 1 N, spacing: {spacing}}}"
    return synthetic.record_response(path, np.sin(2 * np.pi * cycles), test, marks, noise=1e-3)


@pytest.mark.thorough
@pytest.mark.parametrize("spacing", ["log", "linear"])
def test_response_to_slow_sweep_is_accurate(tmp_path, spacing):
    with daq.open(sweep(tmp_path / "a.mcap", 50.0, spacing)) as rec:
        [curves] = analysis.frequency_responses(rec)
        f = curves[0].frequency
        exact = receptance(rec.scene, f)
        modes = analysis.identify(curves, count=3)
    far_from_extrema = np.all(
        [abs(f - extremum) > 1.5 for extremum in synthetic.NATURAL_FREQUENCIES + ANTIRESONANCES], axis=0
    )
    for body, frf in enumerate(curves):
        assert np.median(abs(frf.value / exact[body] - 1)[far_from_extrema]) < 0.01
    np.testing.assert_allclose(modes.frequency, synthetic.NATURAL_FREQUENCIES, rtol=2e-3)


@pytest.mark.thorough
def test_fast_sweep_does_not_widen_peaks(tmp_path):
    with daq.open(sweep(tmp_path / "a.mcap", 20.0)) as rec:
        [curves] = analysis.frequency_responses(rec)
        modes = analysis.identify(curves, count=3)
    np.testing.assert_allclose(modes.damping, 0.005, rtol=0.02)
    assert not modes.warnings


@pytest.mark.filterwarnings("ignore:.*an unusual value")
@pytest.mark.parametrize(("force", "is_reported"), [(15.0, True), (0.3, False)])
def test_possible_flight_in_multisine_is_reported(tmp_path, force, is_reported):
    scene = rig.loads(f"""
structure: {{masses: [1.1 kg], springs: [4.4 kN/m], damping: {{modal: 2 %}}}}
dampers: [{{body: 1, mass_ratio: 0.001, clearance: 0.3 mm}}]
shaker: {{kind: force, body: 1}}
test: {{kind: multisine, from: 6 Hz, to: 12.5 Hz, period: 2.5 s, periods: 2, realisations: 3, force: {force} N}}
channels:
- {{name: a1, at: body 1, accelerometer: {{sensitivity: 50 mV/(m/s^2), noise: 30 mg/sqrt(Hz)}}}}
- {{name: force, at: shaker}}
converter: {{rate: 2560 Hz}}
""")
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as recording:
        [curve] = analysis.frfs(recording)
    assert (LIFTED in curve.warnings) == is_reported
    assert any("No nonlinear distortion is detected" in warning for warning in curve.warnings) != is_reported


SCENE = """
structure: {masses: [1 kg], springs: [12.8 kN/m], damping: {modal: 0.5 %}}
dampers: [{body: 1, mass_ratio: 9 %, clearance: 1.5 mm}]
shaker: {kind: force, body: 1}
test: {kind: swept_sine, from: 14 Hz, to: 21 Hz, duration: 2 s, force: 13 N}
channels: [{name: a, at: body 1, accelerometer: {}}, {name: force, at: shaker}]
converter: {rate: 1024 Hz}
"""


@pytest.mark.parametrize(("end", "warned"), [(21.0, True), (14.05, False)])
def test_fast_sweep_with_flight_warns(tmp_path, end, warned):
    scene = rig.loads(SCENE, where="a test")
    path = tmp_path / "a.mcap"
    daq.record(scene.replace(test=scene.test.replace(to=end)), path)
    with daq.open(path) as rec:
        [[frf]] = analysis.frequency_responses(rec)
    # Two digits, so that several responses share the warning.
    assert any(re.match(r"Between \d\d and \d\d Hz this sweep is too fast", text) for text in frf.warnings) == warned


def test_overloaded_part_of_sweep_is_omitted(tmp_path):
    test = {"kind": "swept_sine", "from": "8 Hz", "to": "40 Hz", "duration": "20 s", "force": "1 N"}
    scene = rig.loads(SCENE, where="a test").replace(dampers=[], test=test)
    # The reading exceeds the range near the resonance, 18 Hz.
    with daq.open(daq.record(scene.replace(converter={"rate": "1024 Hz", "range": 10.0}), tmp_path / "a.mcap")) as rec:
        [[frf]] = analysis.frequency_responses(rec)
    omitted = frf.omitted
    assert omitted.min() < 18.0 < omitted.max() and frf.frequency.size + omitted.size == 400
    assert not np.any((frf.frequency > omitted.min()) & (frf.frequency < omitted.max()))
