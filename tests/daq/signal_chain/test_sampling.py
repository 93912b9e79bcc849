"""Samples without a filter: point samples, and interval averages, which include every impulse."""

import numpy as np
import pytest
from scipy.linalg import expm

import rig
from daq.core.dsp.circuit import Circuit, high_pass, resonance
from daq.core.virtual_bench.bench import Bench
from rig.core.base.errors import SceneError
from tests.daq.dsp.analytic_motion import PointMotion, chain_of, motion_of, scene_of


@pytest.mark.parametrize("seed", range(6))
def test_point_samples_are_instant_voltages(seed):
    rng = np.random.default_rng([16, seed])
    rate, resonance_frequency = np.exp(rng.uniform(np.log([1e3, 2e3]), np.log([1e5, 6e4])))
    q, corner = rng.uniform(1.0, 40.0), rng.uniform(0.1, 20.0)
    samples, oversampling = 60, int(rng.integers(1, 4))
    impacts = [(rng.uniform(0.05, 0.9) * samples / rate, rng.normal()) for _ in range(5)]
    scene = scene_of(
        f", accelerometer: {{resonance: {resonance_frequency}, q: {q}, low_cutoff: {corner}}}",
        converter=f"{{rate: {rate}, sampling: point}}",
    )
    chain, motion_rate = chain_of(scene, oversampling)
    motion = motion_of([PointMotion(impacts=tuple(sorted(impacts)))], motion_rate, samples * oversampling)
    circuit = Circuit.series([resonance(resonance_frequency, q), high_pass(corner, "low cut-off")])
    time = np.arange(samples) / rate
    expected = np.zeros(samples)
    for instant, jump in impacts:
        for k in np.flatnonzero(time >= instant):
            expected[k] += circuit.c @ expm(circuit.a * (time[k] - instant)) @ circuit.b[0] * jump
    assert chain.measure(motion)[0] == pytest.approx(expected, abs=1e-10 * np.abs(expected).max())
    info = chain.channels[0]
    assert (info.sampling, info.average) == ("point", False)
    assert "point sampling" in chain.effects["c1"]


def test_only_averages_include_impulses():
    jump = 0.7  # m/s
    path = PointMotion(impacts=((0.01234, jump),))
    for sampling, measured_jump in (("point", 0.0), ("average", jump)):
        chain, rate = chain_of(scene_of(converter=f"{{rate: 1 kHz, sampling: {sampling}}}"))
        samples = chain.measure(motion_of([path], rate, 30))[0]
        assert samples.sum() / rate == pytest.approx(measured_jump, abs=1e-12)


def test_averages_include_momentum_of_short_impacts():
    scene = rig.loads(
        """
        structure: {masses: [0.8 kg], springs: [4 kN/m]}
        dampers: [{body: 1, mass: 60 g, clearance: 0.5 mm, contact: {duration: 0.05 ms}, restitution: 0.8}]
        test: {kind: impulse, body: 1, peak: 400 N, width: 2 ms, repeats: 1}
        channels: [{name: a, at: body 1}]
        converter: {rate: 2 kHz}
        """
    )
    bench = Bench(scene)
    time = np.arange(200) / bench.rate
    block = bench.acquire(np.where(time <= 2e-3, 400.0 * np.sin(np.pi * time / 2e-3), 0.0)[None])
    assert (block.motion.events["kind"] == "touch").sum() >= 2
    velocity = np.cumsum(block.samples[0]) / bench.rate
    assert velocity == pytest.approx(block.motion.velocity[0], abs=1e-10)


@pytest.mark.parametrize("filter_key", ["filter: delta_sigma", "preset: NI 9234"])
def test_point_samples_with_a_filter_are_rejected(filter_key):
    with pytest.raises(SceneError, match="sampling: got point, but the filter delta_sigma"):
        rig.loads(f"structure: {{masses: [1], springs: [1]}}\nconverter: {{rate: 5120, sampling: point, {filter_key}}}")
