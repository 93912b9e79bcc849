"""A sensor's bias that decays at the beginning of a test: excluded samples, and uncertainties with its error."""

import numpy as np
import pytest

import analysis
import daq
import rig
from analysis.core.responses.checks.clean_segments import settling_flaws
from rig.core.system.structural_model import receptance
from tests.analysis.responses.test_clean_segments import StandIn

RATE = 200.0  # Hz
DURATION = 60.0  # s
LOWEST_FREQUENCY = 5.0  # Hz, of the test.


def recording(bias, time_constant, seed=1):
    """Return a recording of a channel with white noise of rms 1 and a decaying bias; time constant in s."""
    random = np.random.default_rng(seed)
    time = np.arange(int(DURATION * RATE)) / RATE
    samples = random.standard_normal(time.size) + bias * np.exp(-time / time_constant)
    return StandIn(
        rate=RATE, samples=time.size, read=lambda name, first, last: samples[first:last], channels={}, markers=[]
    )


@pytest.mark.parametrize(("bias", "time_constant"), [(10.0, 0.5), (300.0, 2.0), (1e5, 1.0)])
def test_samples_with_decaying_bias_are_excluded(bias, time_constant):
    [flaw] = settling_flaws(recording(bias, time_constant), ["a"], 0, int(DURATION * RATE), LOWEST_FREQUENCY)
    # The noise of a mean of 40 samples, a period of the lowest frequency, is 0.16; a drift exceeds five times that.
    residual_bias = bias * np.exp(-flaw.stop / RATE / time_constant)
    assert flaw.first == 0 and 0.1 < residual_bias < 1.2


def test_no_samples_are_excluded_without_bias():
    for seed in range(20):
        assert settling_flaws(recording(0.0, 1.0, seed), ["a"], 0, int(DURATION * RATE), LOWEST_FREQUENCY) == []


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("bias", [0.0, 300.0])
def test_pauses_between_bursts_are_no_reference(count, bias):
    rec = recording(bias, 2.0)
    distance = int(DURATION * RATE) // count
    bursts, read = (distance, distance // 2), rec.read
    in_burst = np.arange(int(DURATION * RATE)) % distance < bursts[1]
    rec.read = lambda name, first, last: read(name, first, last) * np.where(in_burst[first:last], 1.0, 1e-6)
    flaws = settling_flaws(rec, ["a"], 0, int(DURATION * RATE), LOWEST_FREQUENCY, bursts)
    assert [flaw.first for flaw in flaws] == [0] * (bias > 0.0)
    assert all(0.1 < bias * np.exp(-flaw.stop / RATE / 2.0) < 1.2 for flaw in flaws)


def test_lost_samples_have_no_decaying_bias():
    rec = recording(0.0, 1.0)
    rec.read = lambda name, start, stop: np.full(stop - start, np.nan)
    assert settling_flaws(rec, ["a"], 0, int(DURATION * RATE), LOWEST_FREQUENCY) == []


@pytest.mark.parametrize("options", [{}, {"estimator": "H1", "block": 1.0}])
def test_uncertainty_contains_response_below_sensor_noise(options, tmp_path):
    # The motion due to the drive of 1 µm is smaller than the noise of the sensors.
    scene = rig.loads(
        """
        structure: {masses: [1 kg], springs: [10 kN/m], damping: {modal: 0.02}}
        shaker: {kind: table, body: 1, spring: 6 kN/m}
        test: {kind: random, from: 8 Hz, to: 40 Hz, duration: 20 s, drive: 1 um}
        channels:
          - {name: a1, at: body 1, accelerometer: {noise: 2 mg/sqrt(Hz)}}
          - {name: table, at: table, accelerometer: {noise: 2 mg/sqrt(Hz)}}
        """,
        where="a test",
    )
    path = tmp_path / "a.mcap"
    daq.record(scene, path)
    with daq.open(path) as rec:
        [[frf]] = analysis.frequency_responses(rec, **options)
    error = abs(frf.value - receptance(scene, frf.frequency)[0])
    # Noise of the body's sensor is also in the reference (the spring force) and resembles a response of -1 / (6 kN/m).
    assert np.median(error) > 0.3 * np.median(abs(receptance(scene, frf.frequency)[0]))
    assert np.mean(error <= frf.bound()) > 0.9


def multisine_with_settling_bias(path, multisine: str, converter: str, seed: int = 1):
    """Return the response of a body whose accelerometer bias settles during the test, and its error."""
    scene = rig.loads(f"""
structure: {{masses: [2 kg], springs: [200 kN/m], damping: {{modal: 2 %}}}}
shaker: {{kind: force, body: 1}}
test: {{kind: multisine, from: 20 Hz, {multisine}, realisations: 1, force: 5 N}}
channels:
- {{name: b1, at: body 1, accelerometer: {{sensitivity: 100 mV/g, bias: 9 V, bias_settling: 2 s}}}}
- {{name: F, at: shaker, hammer: {{sensitivity: 50 mV/N}}}}
converter: {{rate: 2048 Hz, range: 20 V{converter}}}
seed: {seed}
""")
    with daq.open(daq.record(scene, path)) as recording:
        [curve] = analysis.frfs(recording)
    return curve, abs(curve.value - receptance(scene, curve.frequency)[0])


def test_multisine_with_decaying_bias_is_within_uncertainty(tmp_path):
    curve, error = multisine_with_settling_bias(tmp_path / "a.mcap", "to: 200 Hz, lines: 50, periods: 2", "")
    assert (error <= curve.bound()).mean() > 0.9
    assert np.median(error / abs(curve.value)) < 0.02


def test_coarse_multisine_with_bias_is_within_uncertainty(tmp_path):
    curve, error = multisine_with_settling_bias(
        tmp_path / "a.mcap", "to: 600 Hz, lines: 300, periods: 8", ", bits: 12", seed=3
    )
    assert (error <= curve.bound()).mean() > 0.9
