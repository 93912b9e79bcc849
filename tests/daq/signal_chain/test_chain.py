"""A complete signal chain: samples of sensor, amplifier and converter against closed forms and stated responses.

An effect is a property by which a real channel deviates from an ideal one, such as noise. The stated response is that
of the channel's data sheets.
"""

import numpy as np
import pytest
from scipy.linalg import expm

import rig
from daq.core.dsp.circuit import Circuit, high_pass, integration, resonance
from daq.core.signal_chain.chain import Chain
from rig.core.base.errors import SceneError
from tests.daq.dsp.analytic_motion import PointMotion, at_rest, chain_of, cut, motion_of, scene_of

SENSOR = ", accelerometer: {sensitivity: 100 mV/g, resonance: 30 kHz, low_cutoff: 4 Hz}"
# Keys of a channel and of a converter with all effects.
ALL_EFFECTS = (
    ", accelerometer: {sensitivity: 100 mV/g, sensitivity_tolerance: 5 %, resonance: 30 kHz, low_cutoff: 0.5 Hz, "
    "noise: 20 ug/sqrt(Hz), noise_corner: 10 Hz, bias: 10 mV, bias_settling: 2 s, transverse: 3 %, "
    "saturation: 20 g, overload_recovery: 10 ms, temperature_drift: 0.05 %/K, temperature_change: 10 K}, "
    "integrator: {order: 1, corner: 1 Hz, gain: 100, noise: 50 nV/sqrt(Hz), saturation: 12 V}"
)
CONVERTER_WITH_ALL_EFFECTS = (
    "{rate: 5120 Hz, bits: 24, range: 5 V, noise: 50 nV/sqrt(Hz), coupling: AC, filter: delta_sigma, "
    "skew: 1 us, jitter: 1 ns, clock_error: 10 ppm}"
)


def random_impacts(count, duration, seed):
    """Return impacts (time in s, jump of velocity in m/s) at random times."""
    rng = np.random.default_rng(seed)
    return tuple(zip(np.sort(rng.uniform(0.02, 0.95, count)) * duration, rng.normal(size=count), strict=True))


def measured_and_stated_response(channel_keys, rate, frequency, seconds=2.0):
    """Return the complex ratio of a channel's reading to the true amplitude of a tone, and its stated response."""
    chain, _ = chain_of(scene_of(channel_keys, converter=f"{{rate: {rate} Hz}}"))
    info = chain.channels[0]
    derivative = ("displacement", "velocity", "acceleration").index(info.quantity)
    omega = 2 * np.pi * frequency
    amplitude, phase = omega ** (2 - derivative), 0.4  # of the acceleration; the measured quantity has the amplitude 1
    path = PointMotion(tones=((amplitude, frequency, phase),))
    readings = chain.measure(motion_of([path], rate, round(seconds * rate)))[0] / info.sensitivity
    t = np.arange(readings.size) / rate
    # In the second half, transients have decayed; a constant and a drift are fitted too.
    second_half = t > seconds / 2
    basis = np.stack([np.cos(omega * t), -np.sin(omega * t), np.ones(t.size), t], axis=1)[second_half]
    real, imag, *_ = np.linalg.lstsq(basis, readings[second_half], rcond=None)[0]
    truth = amplitude * np.exp(1j * phase) * (1j * omega) ** (derivative - 2)
    return (real + 1j * imag) / truth, complex(info.response(frequency))


# Keys of channels in a scene.
CHANNELS = {
    "ideal": "",
    "sensor": SENSOR,
    "velocity": SENSOR + ", integrator: {order: 1, corner: 4 Hz, gain: 100}",
    "displacement": SENSOR + ", integrator: {order: 2, corner: 4 Hz, gain: 1000}",
    "ideal integrator": ", integrator: {order: 2}",
}


@pytest.mark.parametrize("channel_keys", CHANNELS.values(), ids=CHANNELS)
def test_low_frequencies_have_stated_response(channel_keys):
    for rate, frequencies in ((5120.0, (97.0, 307.0)), (51200.0, (211.0, 1000.0))):
        for frequency in frequencies:
            measured, stated = measured_and_stated_response(channel_keys, rate, frequency)
            assert measured == pytest.approx(stated, rel=1e-6)


@pytest.mark.parametrize("rate", [5120.0, 51200.0])
@pytest.mark.parametrize("order", [1, 2])
def test_integrator_follows_its_transfer_function(order, rate):
    channel_keys = f", integrator: {{order: {order}, corner: 1 Hz, gain: 50}}"
    for frequency in (1.0, 7.0, 60.0, 450.0, 1000.0):
        seconds = 6.0 if frequency < 10 else 2.0
        measured, _ = measured_and_stated_response(channel_keys, rate, frequency, seconds)
        s, corner = 2j * np.pi * frequency, 2 * np.pi
        ratio = measured / (s / (s + corner)) ** order
        assert abs(ratio) == pytest.approx(1.0, abs=1e-3)
        assert np.angle(ratio, deg=True) == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize("name", ["sensor", "velocity", "displacement"])
def test_high_frequencies_have_stated_response(name):
    for frequency, tolerance in ((400.0, 1e-6), (1000.0, 1e-4), (2000.0, 1e-3)):
        measured, stated = measured_and_stated_response(CHANNELS[name], 5120.0, frequency)
        assert measured == pytest.approx(stated, rel=tolerance)


@pytest.mark.parametrize("rate", [5120.0, 51200.0])
@pytest.mark.parametrize("order", [1, 2])
def test_samples_of_impacts_have_closed_form(order, rate):
    samples = 150
    impacts = list(random_impacts(25, samples / rate, seed=order))
    # Two impacts are almost simultaneous, two are a millionth of a sample apart, and one is on a sample.
    impacts[4] = (impacts[3][0] + 1e-16 / rate, 0.7)
    impacts[9] = (impacts[8][0] + 1e-6 / rate, -0.3)
    impacts[15] = (round(impacts[15][0] * rate) / rate, 0.2)
    channel_keys = f"{SENSOR}, integrator: {{order: {order}, corner: 1 Hz}}"
    chain, _ = chain_of(scene_of(channel_keys, converter=f"{{rate: {rate} Hz}}"))
    volts = chain.measure(motion_of([PointMotion(impacts=tuple(sorted(impacts)))], rate, samples))[0]
    circuit = Circuit.series([resonance(30e3, 30.0), high_pass(4.0, "low cut-off"), *[integration(1.0, 1.0)] * order])
    t = np.arange(samples) / rate
    expected, transition = np.zeros(samples), expm(circuit.a / rate)
    for instant, jump in impacts:
        first = np.flatnonzero(t >= instant - 1e-12 / rate)[0]
        state = expm(circuit.a * (t[first] - instant)) @ circuit.b[0] * jump
        for k in range(first, samples):
            expected[k] += circuit.c @ state
            state = transition @ state
    expected *= 0.1 / 9.80665  # sensitivity, V per m/s^2
    assert volts == pytest.approx(expected, abs=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("rate", [5120.0, 51200.0])
def test_double_integration_returns_displacement(rate):
    path = PointMotion(tones=((300.0, 34.8, 0.3), (90.0, 13.0, 2.0)), impacts=random_impacts(300, 1.0, seed=7))
    chain, _ = chain_of(scene_of(", integrator: {order: 2}", converter=f"{{rate: {rate} Hz}}"))
    motion = motion_of([path], rate, round(rate))
    truth = motion.displacement[0] - motion.displacement[0, 0]
    assert chain.measure(motion)[0] == pytest.approx(truth, abs=1e-11 * np.abs(truth).max())


def test_summed_samples_return_velocity():
    rate = 5120.0
    path = PointMotion(tones=((300.0, 34.8, 0.3),), impacts=random_impacts(100, 0.5, seed=3), start_velocity=0.4)
    chain, _ = chain_of(scene_of())
    motion = motion_of([path], rate, round(rate / 2))
    assert np.cumsum(chain.measure(motion)[0]) / rate == pytest.approx(motion.velocity[0], abs=1e-12)


def test_samples_do_not_depend_on_blocks():
    scene = scene_of(ALL_EFFECTS, SENSOR, converter=CONVERTER_WITH_ALL_EFFECTS)
    paths = [
        PointMotion(tones=((200.0, 60.0, 0.0),), impacts=random_impacts(30, 0.1, seed=1)),
        PointMotion(tones=((90.0, 33.0, 1.0),), impacts=random_impacts(20, 0.1, seed=2)),
    ]
    _, rate = chain_of(scene)
    motion = motion_of(paths, rate, 512)
    expected = chain_of(scene)[0].measure(motion)
    for block_size in (1, 7, 128):
        chain, _ = chain_of(scene)
        blocks = [chain.measure(cut(motion, k, min(k + block_size, 512))) for k in range(0, 512, block_size)]
        assert np.array_equal(np.concatenate(blocks, axis=1), expected)


def test_channels_are_independent():
    paths = [PointMotion(tones=((200.0, 60.0, 0.0),), impacts=random_impacts(30, 0.1, seed=1))] * 3
    scene, with_other_channel = scene_of("", ALL_EFFECTS, SENSOR), scene_of(SENSOR, ALL_EFFECTS, SENSOR)
    motion = motion_of(paths, 5120.0, 512)
    samples = chain_of(scene)[0].measure(motion)
    assert np.array_equal(chain_of(with_other_channel)[0].measure(motion)[1:], samples[1:])


def test_effects_list_is_complete():
    assert chain_of(scene_of())[0].effects == {"body1": {"averaging": 1}}
    sensor = {"resonance": 2, "low cut-off": 1}
    chain, _ = chain_of(scene_of(SENSOR, SENSOR + ", integrator: {order: 2}", converter="{bits: 24, range: 5 V}"))
    assert chain.effects == {
        "c1": sensor | {"averaging": 1, "clipping": 0, "quantization": 0},
        "c2": sensor | {"integration": 2, "point sampling": 0, "clipping": 0, "quantization": 0},
    }
    effects = chain_of(scene_of(ALL_EFFECTS, converter=CONVERTER_WITH_ALL_EFFECTS))[0].effects["c1"]
    # The spectrum of 1/f noise requires a first-order state for every two octaves.
    assert effects["1/f noise"] > 5
    assert {"1/f noise", "offset settling", "overload recovery", "decimation filter", "jitter"} <= set(effects)


def test_constant_displacement_reads_zero():
    chain, rate = chain_of(scene_of(*CHANNELS.values()))
    motion = at_rest(len(CHANNELS), rate, 50)
    motion.displacement[:] = 0.3
    assert not chain.measure(motion).any()


def test_initial_velocity_reads_as_impulse():
    chain, rate = chain_of(scene_of(", integrator: {order: 1}"))
    samples = chain.measure(motion_of([PointMotion(start_velocity=0.25)], rate, 10))[0]
    assert samples == pytest.approx(np.full(10, 0.25), rel=1e-12)


def test_force_drive_adds_a_force_channel():
    text = "structure: {masses: [1 kg], springs: [1 kN/m]}\n"
    hammer = rig.loads(text + "test: {kind: impulse, body: 1, peak: 5 N, width: 4 ms}")
    shaker = rig.loads(text + "shaker: {kind: force, body: 1}")
    for scene, input_name in ((hammer, "hammer"), (shaker, "shaker")):
        chain = Chain(scene, 5120.0, ["body 1"], inputs=[input_name])
        assert [(info.name, info.quantity) for info in chain.channels] == [
            ("body1", "acceleration"),
            ("force", "force"),
        ]
        forces = np.arange(12.0)[None]
        samples = chain.measure(at_rest(1, 5120.0, 12), forces)[1]
        # Averages of the linearly increasing force over the intervals that end at the samples.
        assert samples == pytest.approx([0.0, *(np.arange(11.0) + 0.5)])


def test_unused_hammer_reads_zero():
    scene = rig.loads(
        "structure: {masses: [1 kg], springs: [1 kN/m]}\ntest: {kind: impulse, body: 1, peak: 5 N, width: 4 ms}"
    )
    assert not Chain(scene, 5120.0, ["body 1"]).measure(at_rest(1, 5120.0, 5)).any()


def test_error_names_unknown_location():
    with pytest.raises(SceneError, match=r"has no body 2.*body 1"):
        Chain(scene_of("", ""), 5120.0, ["body 1"])


@pytest.mark.parametrize("factor", [0.5, 1.01])
def test_motion_rate_must_be_multiple_of_sample_rate(factor):
    with pytest.raises(SceneError, match="rate"):
        Chain(scene_of(), 5120.0 * factor, ["body 1"])


def test_empty_block_changes_nothing():
    scene = scene_of(ALL_EFFECTS, SENSOR, converter=CONVERTER_WITH_ALL_EFFECTS)
    chain, rate = chain_of(scene)
    motion = motion_of([PointMotion(tones=((200.0, 60.0, 0.0),))] * 2, rate, 20)
    assert chain.measure(cut(motion, 0, 0)).shape == (2, 0)
    first = chain.measure(cut(motion, 0, 9))
    assert chain.measure(cut(motion, 9, 9)).shape == (2, 0)
    joined = np.concatenate([first, chain.measure(cut(motion, 9, 20))], axis=1)
    assert np.array_equal(joined, chain_of(scene)[0].measure(motion))
