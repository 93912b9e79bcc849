"""Saturation of a sensor or an amplifier limits the signal before it is sampled, and is flagged as overload.

The reference is a time-stepping simulation with 200 steps per period of the sensor's resonance.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter

import rig
from daq.core.signal_chain.decimation_filter import DecimationFilter
from daq.core.virtual_bench.bench import Bench
from tests.daq.dsp.analytic_motion import PointMotion, chain_of, cut, motion_of, scene_of

RATES = (1000.0, 5120.0, 51200.0, 204800.0)  # Hz


@dataclass(frozen=True)
class SaturatedChain:
    """A sensor, an integrating amplifier and a converter, whose sensor is excited by impacts."""

    rate: float  # Hz
    resonance: float  # Hz
    q: float
    step: float  # Of the simulation, s.
    duration: float  # s
    impacts: list[tuple[int, float]]  # Step, and jump of velocity in m/s.
    recovery: float  # Time constant of the zero shift after an overload, s; 0 for no zero shift.
    order: int  # Number of integrators.
    gain: float
    corner: float  # Hz
    relative_saturation: float  # Limit of the sensor, relative to its largest signal without a limit.
    relative_amplifier_saturation: float  # Limit of the integrators, relative to their largest signal.
    sampling: str  # point, average or filter
    oversampling: int

    def simulate(self, saturation, amplifier_saturation):
        """Simulate the chain with these limits of sensor and amplifier, V (sensitivity 1 V per m/s^2).

        Returns the voltage at the converter, and the largest signals of the sensor and of the integrators, V.
        """
        omega = 2 * np.pi * self.resonance
        transition = expm(np.array([[0.0, omega], [-omega, -omega / self.q]]) * self.step)
        jumps = np.zeros(int(self.duration / self.step) + 1)
        for step, jump in self.impacts:
            jumps[step] += jump
        denominator = [1.0, -np.trace(transition), np.linalg.det(transition)]
        sensor_signal = lfilter([0.0, transition[0, 1] * omega], denominator, jumps)
        voltage, zero_shift = np.empty(sensor_signal.size), 0.0
        for k, value in enumerate(sensor_signal):
            voltage[k] = min(max(value - zero_shift, -saturation), saturation)
            if self.recovery:
                zero_shift += self.step / self.recovery * (value - zero_shift - voltage[k] - zero_shift)
        integrated_signals = []
        for _ in range(self.order):
            state, decay = 0.0, np.exp(-2 * np.pi * self.corner * self.step)
            mean = 0.5 * (voltage + np.concatenate([[0.0], voltage[:-1]]))
            increments = mean * self.step * self.gain ** (1 / self.order)
            voltage = np.empty(increments.size)
            for k, increment in enumerate(increments):
                state = min(max(decay * state + increment, -amplifier_saturation), amplifier_saturation)
                voltage[k] = state
            integrated_signals.append(voltage)
        return voltage, np.abs(sensor_signal).max(), np.abs(integrated_signals).max(initial=0.0)

    def sample(self, voltage):
        """Return the converter's samples of a simulated voltage."""
        time = np.arange(voltage.size) * self.step
        instants = np.arange(int(self.duration * self.rate) - 1) / self.rate
        if self.sampling == "point":
            return np.interp(instants, time, voltage)
        if self.sampling == "average":
            integral = np.concatenate([[0.0], np.cumsum(0.5 * (voltage[1:] + voltage[:-1])) * self.step])
            return np.diff(np.interp(instants, time, integral), prepend=0.0) * self.rate
        low_pass = DecimationFilter.standard(self.rate)
        lag = np.linspace(-low_pass.delay, low_pass.delay, 100_001)
        kernel = low_pass.impulse_response(lag)
        samples = [
            np.interp((instant - time) * self.rate - low_pass.delay, lag, kernel, 0.0, 0.0) @ voltage
            for instant in instants
        ]
        return np.array(samples) * self.step * self.rate

    def scene(self, saturation, amplifier_saturation):
        """Return the scene of the chain with these limits of sensor and amplifier, V."""
        recovery = f", overload_recovery: {self.recovery}" if self.recovery else ""
        sensor_keys = f"resonance: {self.resonance}, q: {self.q}, saturation: {saturation}{recovery}"
        channel_keys = f", accelerometer: {{{sensor_keys}}}"
        if self.order:
            limit = f", saturation: {amplifier_saturation}" if np.isfinite(amplifier_saturation) else ""
            channel_keys += f", integrator: {{order: {self.order}, corner: {self.corner}, gain: {self.gain}{limit}}}"
        sampling = "filter: delta_sigma" if self.sampling == "filter" else f"sampling: {self.sampling}"
        return scene_of(channel_keys, converter=f"{{rate: {self.rate}, {sampling}}}")


def random_chain(seed):
    """Return a chain with random settings; the seed selects them."""
    rng = np.random.default_rng([1610, seed])
    rate, resonance = np.exp(rng.uniform(np.log([3e3, 3e3]), np.log([6e4, 4e4])))
    sampling = rng.choice(["point", "average", "filter"])
    step, duration = 1.0 / (200.0 * resonance), max(0.004, (110.0 if sampling == "filter" else 30.0) / rate)
    order = int(rng.integers(0, 3))
    impacts = [(round(rng.uniform(0.05, 0.3) * duration / step), rng.normal()) for _ in range(rng.integers(1, 6))]
    return SaturatedChain(
        rate=rate,
        resonance=resonance,
        q=rng.uniform(0.6, 40.0),
        step=step,
        duration=duration,
        impacts=sorted(impacts),
        recovery=rng.choice([0.0, rng.uniform(1e-4, 2e-2)]),
        order=order,
        gain=10.0 ** (3 * order),
        corner=rng.uniform(0.0, 5.0),
        relative_saturation=rng.uniform(0.2, 1.2),
        relative_amplifier_saturation=rng.uniform(0.2, 1.2) if rng.random() < 0.5 else np.inf,
        sampling=sampling,
        oversampling=int(rng.integers(1, 4)),
    )


@pytest.mark.parametrize("seed", range(12))
def test_saturated_samples_agree_with_simulation(seed):
    case = random_chain(seed)
    saturation = float(case.relative_saturation * case.simulate(np.inf, np.inf)[1])
    largest_integrated = case.simulate(saturation, np.inf)[2]
    amplifier_saturation = float(case.relative_amplifier_saturation) * largest_integrated if case.order else np.inf
    expected = case.sample(case.simulate(saturation, amplifier_saturation)[0])

    scene = case.scene(saturation, amplifier_saturation)
    chain, rate = chain_of(scene, case.oversampling)
    path = PointMotion(impacts=tuple((step * case.step, jump) for step, jump in case.impacts))
    motion = motion_of([path], rate, (expected.size - 1) * case.oversampling + 1)
    samples = chain.measure(motion)[0]
    assert samples == pytest.approx(expected, abs=5e-3 * np.abs(expected).max())
    overload = chain.overload[0]
    amplifier_saturates = case.order > 0 and case.relative_amplifier_saturation < 1.0
    assert overload.any() == (case.relative_saturation < 1.0 or amplifier_saturates)

    blocks = []
    chain, _ = chain_of(scene, case.oversampling)
    edges = [0, 1, 8, *range(40, motion.displacement.shape[1], 150), motion.displacement.shape[1]]
    for first, stop in pairwise(sorted(set(edges))):
        blocks.append((chain.measure(cut(motion, first, stop))[0], chain.overload[0]))
    joined_samples, joined_overload = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    assert np.array_equal(joined_samples, samples) and np.array_equal(joined_overload, overload)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("filter_key", ["", ", filter: delta_sigma"])
def test_saturation_does_not_depend_on_rate(seed, filter_key):
    rng = np.random.default_rng([1617, seed])
    frequency, q, jump = np.exp(rng.uniform(np.log([5e3, 2.0, 0.01]), np.log([6e4, 40.0, 1.0])))
    # Peak of the impulse response of the sensor's resonance.
    exponent = np.arctan(np.sqrt(4 * q * q - 1)) / np.sqrt(4 * q * q - 1)
    peak = jump * 2 * np.pi * frequency * np.exp(-exponent)
    path = PointMotion(impacts=((0.01 + rng.uniform(0.0, 1e-3), jump),))
    for relative_saturation in (0.995, 1.005):
        saturation = relative_saturation * peak
        channel_keys = f", accelerometer: {{resonance: {frequency}, q: {q}, saturation: {saturation}}}"
        for rate in RATES[:3]:
            chain, _ = chain_of(scene_of(channel_keys, converter=f"{{rate: {rate}{filter_key}}}"))
            chain.measure(motion_of([path], rate, int(0.02 * rate)))
            assert chain.overload.any() == (relative_saturation < 1.0)


def test_impulse_saturates_sensor_without_resonance():
    instant, jump = 0.0123, 0.4  # s, m/s
    for rate in RATES:
        scene = scene_of(", accelerometer: {saturation: 50}, integrator: {order: 1}", converter=f"{{rate: {rate}}}")
        chain, _ = chain_of(scene)
        samples = chain.measure(motion_of([PointMotion(impacts=((instant, jump),))], rate, int(0.02 * rate)))[0]
        assert samples == pytest.approx(np.zeros(samples.size), abs=1e-12)
        assert np.flatnonzero(chain.overload[0]).tolist() == [int(np.ceil(instant * rate))]


def test_zero_shift_is_part_of_the_overload():
    scene = scene_of(", accelerometer: {resonance: 20 kHz, saturation: 100, overload_recovery: 5 ms}")
    chain, rate = chain_of(scene)
    samples = chain.measure(motion_of([PointMotion(impacts=((0.01, 0.05),))], rate, 600))[0]
    flagged = np.flatnonzero(chain.overload[0])
    assert flagged[0] == np.ceil(0.01 * rate)
    assert np.array_equal(flagged, np.arange(flagged[0], flagged[-1] + 1))
    # After the flagged samples, the zero shift is at most a thousandth of the limit, 100.
    assert np.abs(samples[flagged[-1] + 1 :]).max() < 1.1e-3 * 100
    # Two to eight time constants of the recovery, 5 ms.
    assert 0.01 < (flagged[-1] - flagged[0]) / rate < 0.04


def test_saturation_due_to_damper_impacts_is_flagged():
    scene = rig.load("fig8-three-dampers")
    drive = 3.0 * np.sin(2 * np.pi * 34.8 / 5120.0 * np.arange(1500))[None]
    for saturation, is_overloaded in (("5 g", True), ("5000 g", False)):
        sensor = {"resonance": "30 kHz", "saturation": saturation}
        channels = [{"name": "a1", "at": "body 1", "accelerometer": sensor}]
        for converter in ({"rate": 5120.0}, {"rate": 5120.0, "filter": "delta_sigma", "range": 1e6}):
            block = Bench(scene.replace(channels=channels, converter=converter)).acquire(drive)
            assert (block.motion.events["speed"] > 0.05).any()
            assert block.overload.any() == is_overloaded
