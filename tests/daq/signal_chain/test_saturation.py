"""Saturation of a sensor or an amplifier acts on the signal itself at any sample rate and is marked as overload."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter

import rig
from daq.signal_chain.decimation_filter import Decimation
from daq.virtual_bench.bench import Bench
from tests.daq.dsp.analytic_motion import Path, chain_of, cut, motion_of, scene_of

RATES = (1000.0, 5120.0, 51200.0, 204800.0)


def draw(seed):
    """A random sensor, amplifier, converter and shock; resolved finely enough to be followed by small steps."""
    dice = np.random.default_rng([1610, seed])
    rate, frequency = np.exp(dice.uniform(np.log([3e3, 3e3]), np.log([6e4, 4e4])))
    kind = dice.choice(["point", "average", "filter"])
    step, lasts = 1.0 / (200.0 * frequency), max(0.004, (110.0 if kind == "filter" else 30.0) / rate)
    order = int(dice.integers(0, 3))
    hits = [(round(dice.uniform(0.05, 0.3) * lasts / step), dice.normal()) for _ in range(dice.integers(1, 6))]
    return {
        "rate": rate, "frequency": frequency, "q": dice.uniform(0.6, 40.0), "step": step, "lasts": lasts,
        "hits": sorted(hits), "recovery": dice.choice([0.0, dice.uniform(1e-4, 2e-2)]), "order": order,
        "gain": 10.0 ** (3 * order), "corner": dice.uniform(0.0, 5.0), "limit": dice.uniform(0.2, 1.2),
        "rail": dice.uniform(0.2, 1.2) if dice.random() < 0.5 else np.inf,
        "kind": kind, "oversampling": int(dice.integers(1, 4)),
    }  # fmt: skip


def small_steps(case, limit, rail):
    """The voltage at the converter by small steps, and the largest of sensor and of integrators."""
    w, step = 2 * np.pi * case["frequency"], case["step"]
    over = expm(np.array([[0.0, w], [-w, -w / case["q"]]]) * step)
    struck = np.zeros(int(case["lasts"] / step) + 1)
    for place, jump in case["hits"]:
        struck[place] += jump
    sensed = lfilter([0.0, over[0, 1] * w], [1.0, -np.trace(over), np.linalg.det(over)], struck)
    voltage, shift = np.empty(sensed.size), 0.0
    for k, each in enumerate(sensed):
        voltage[k] = min(max(each - shift, -limit), limit)
        if case["recovery"]:
            shift += step / case["recovery"] * (each - shift - voltage[k] - shift)
    stages = []
    for _ in range(case["order"]):
        state, kept = 0.0, np.exp(-2 * np.pi * case["corner"] * step)
        mean = 0.5 * (voltage + np.concatenate([[0.0], voltage[:-1]])) * step * case["gain"] ** (1 / case["order"])
        voltage = np.empty(mean.size)
        for k, each in enumerate(mean):
            state = min(max(kept * state + each, -rail), rail)
            voltage[k] = state
        stages.append(voltage)
    return voltage, np.abs(sensed).max(), np.abs(stages).max(initial=0.0)


def sampled(case, voltage):
    """Samples of a finely known voltage."""
    time, rate = np.arange(voltage.size) * case["step"], case["rate"]
    at = np.arange(int(case["lasts"] * rate) - 1) / rate
    if case["kind"] == "point":
        return np.interp(at, time, voltage)
    if case["kind"] == "average":
        whole = np.concatenate([[0.0], np.cumsum(0.5 * (voltage[1:] + voltage[:-1])) * case["step"]])
        return np.diff(np.interp(at, time, whole), prepend=0.0) * rate
    low_pass = Decimation.standard(rate)
    lag = np.linspace(-low_pass.delay, low_pass.delay, 100_001)
    weights = low_pass.impulse_response(lag)
    each = (np.interp((k - time) * rate - low_pass.delay, lag, weights, 0.0, 0.0) @ voltage for k in at)
    return np.array(list(each)) * case["step"] * rate


@pytest.mark.parametrize("seed", range(12))
def test_limited_samples_agree_with_small_steps(seed):
    case = draw(seed)
    limit = float(case["limit"] * small_steps(case, np.inf, np.inf)[1])
    rail = float(case["rail"]) * small_steps(case, limit, np.inf)[2] if case["order"] else np.inf
    voltage, _, _ = small_steps(case, limit, rail)
    expected = sampled(case, voltage)

    recovery = f", overload_recovery: {case['recovery']}" if case["recovery"] else ""
    keys = f", accelerometer: {{resonance: {case['frequency']}, q: {case['q']}, saturation: {limit}{recovery}}}"
    if case["order"]:
        saturation = f", saturation: {rail}" if np.isfinite(rail) else ""
        keys += f", integrator: {{order: {case['order']}, corner: {case['corner']}, gain: {case['gain']}{saturation}}}"
    kind = "filter: delta_sigma" if case["kind"] == "filter" else f"sampling: {case['kind']}"
    scene = scene_of(keys, converter=f"{{rate: {case['rate']}, {kind}}}")
    chain, rate = chain_of(scene, case["oversampling"])
    path = Path(impacts=tuple((place * case["step"], jump) for place, jump in case["hits"]))
    motion = motion_of([path], rate, (expected.size - 1) * case["oversampling"] + 1)
    read = chain.measure(motion)[0]
    assert read == pytest.approx(expected, abs=5e-3 * np.abs(expected).max())
    overload = chain.overload[0]
    assert overload.any() == (case["limit"] < 1.0 or (case["order"] > 0 and case["rail"] < 1.0))

    blocks = []
    chain, _ = chain_of(scene, case["oversampling"])
    edges = [0, 1, 8, *range(40, motion.displacement.shape[1], 150), motion.displacement.shape[1]]
    for first, stop in pairwise(sorted(set(edges))):
        blocks.append((chain.measure(cut(motion, first, stop))[0], chain.overload[0]))
    together = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    assert all(np.array_equal(parts, whole) for parts, whole in zip(together, (read, overload), strict=True))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("filtered", ["", ", filter: delta_sigma"])
def test_shock_saturates_alike_at_any_rate(seed, filtered):
    dice = np.random.default_rng([1617, seed])
    frequency, q, jump = np.exp(dice.uniform(np.log([5e3, 2.0, 0.01]), np.log([6e4, 40.0, 1.0])))
    decay = np.arctan(np.sqrt(4 * q * q - 1)) / np.sqrt(4 * q * q - 1)
    # A resonance of low damping answers a jump of velocity with jump 2 pi f at the most; this is exact.
    peak = jump * 2 * np.pi * frequency * np.exp(-decay)
    struck = Path(impacts=((0.01 + dice.uniform(0.0, 1e-3), jump),))
    for share in (0.995, 1.005):
        keys = f", accelerometer: {{resonance: {frequency}, q: {q}, saturation: {share * peak}}}"
        for rate in RATES[:3]:
            chain, _ = chain_of(scene_of(keys, converter=f"{{rate: {rate}{filtered}}}"))
            chain.measure(motion_of([struck], rate, int(0.02 * rate)))
            assert chain.overload.any() == (share < 1.0)


def test_sensor_without_bandwidth_loses_the_impulse():
    for rate in RATES:
        scene = scene_of(", accelerometer: {saturation: 50}, integrator: {order: 1}", converter=f"{{rate: {rate}}}")
        chain, _ = chain_of(scene)
        read = chain.measure(motion_of([Path(impacts=((0.0123, 0.4),))], rate, int(0.02 * rate)))[0]
        assert read == pytest.approx(np.zeros(read.size), abs=1e-12)
        assert np.flatnonzero(chain.overload[0]).tolist() == [int(np.ceil(0.0123 * rate))]


def test_zero_shift_keeps_the_flag():
    scene = scene_of(", accelerometer: {resonance: 20 kHz, saturation: 100, overload_recovery: 5 ms}")
    chain, rate = chain_of(scene)
    read = chain.measure(motion_of([Path(impacts=((0.01, 0.05),))], rate, 600))[0]
    flagged = np.flatnonzero(chain.overload[0])
    assert flagged[0] == np.ceil(0.01 * rate)
    assert np.array_equal(flagged, np.arange(flagged[0], flagged[-1] + 1))
    assert np.abs(read[flagged[-1] + 1 :]).max() < 1.1e-3 * 100
    assert 0.01 < (flagged[-1] - flagged[0]) / rate < 0.04


def test_bench_flags_saturating_landings():
    scene = rig.load("fig8-three-dampers")
    drive = 3.0 * np.sin(2 * np.pi * 34.8 / 5120.0 * np.arange(1500))[None]
    for saturation, overloads in (("5 g", True), ("5000 g", False)):
        sensor = {"resonance": "30 kHz", "saturation": saturation}
        channels = [{"name": "a1", "at": "body 1", "accelerometer": sensor}]
        for converter in ({"rate": 5120.0}, {"rate": 5120.0, "filter": "delta_sigma", "range": 1e6}):
            block = Bench(scene.replace(channels=channels, converter=converter)).acquire(drive)
            assert (block.motion.events["speed"] > 0.05).any()
            assert block.overload.any() == overloads
