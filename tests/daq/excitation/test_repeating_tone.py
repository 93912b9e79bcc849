"""Number of periods of the tone after which motions repeat: synthetic motions, and motions on the bench."""

from typing import Any

import numpy as np
import pytest

import rig
from daq.core.excitation.tones.repeating_tone import irregularity_and_decay, repetition
from rig.core.base.arrays import Array
from tests.daq.measurement.bench_run import run

PERIODS, PER_PERIOD = 20, 64
TOLERANCE = 1e-3
# Time in periods.
TIME = np.arange(PERIODS * PER_PERIOD) / PER_PERIOD


def of_motion(modulation: Array, noise: float = 0.0, seed: int = 0, size: int | None = None) -> int:
    """Return the repetition of a tone with a modulation and noise, relative to its amplitude, in `size` samples."""
    samples = (1.0 + modulation) * np.sin(2.0 * np.pi * TIME)
    samples += noise * np.random.default_rng(seed).standard_normal(samples.size)
    # Largest difference of the amplitudes in Hann windows of two periods, with a margin of 2 in the variance.
    expected = noise * (2.0 * 2.0 * 2.0 * 1.5 * 2.0 / (2 * PER_PERIOD)) ** 0.5
    return repetition(*irregularity_and_decay(samples[:size], 1.0, float(PER_PERIOD)), TOLERANCE, expected)


def alternating(ratio: float) -> Array:
    """Return a modulation that alternates between successive periods."""
    return ratio * np.sign(np.sin(np.pi * TIME))


@pytest.mark.parametrize("ratio", [1e-3, 1e-2])
def test_small_doubling_is_two_periods(ratio: float) -> None:
    assert of_motion(alternating(ratio), noise=1e-4) == 2


def test_doubling_in_a_few_periods_is_recognized() -> None:
    assert of_motion(alternating(0.1), size=5 * PER_PERIOD) != 1


def test_slow_beat_does_not_repeat() -> None:
    # The doubled motion of a gauntlet scene at 46.436 Hz, whose force was 0.4 % from that of the orbit.
    beat = 0.006 * np.sin(2.0 * np.pi * TIME / 60.0)
    assert of_motion(alternating(0.01) + beat, noise=1e-4) == 0


@pytest.mark.parametrize("phase", np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False))
def test_slow_beat_of_any_phase_is_irregular(phase: float) -> None:
    # In some phases, the difference of successive periods decreases as that of a transient.
    assert of_motion(0.01 * np.sin(2.0 * np.pi * TIME / 60.0 + phase)) == 0


def test_transient_within_tolerance_repeats() -> None:
    assert of_motion(0.9 * TOLERANCE * np.exp(-TIME / 20.0)) == 1


def test_decaying_mode_is_no_multiple() -> None:
    # Another mode at two thirds of the tone, with a time constant of 25 periods.
    assert of_motion(0.005 * np.cos(2.0 * np.pi / 3.0 * TIME) * np.exp(-TIME / 25.0), noise=1e-3) == 1


def test_small_alternating_transient_is_no_multiple() -> None:
    assert of_motion(alternating(0.1 * TOLERANCE)) == 1


@pytest.mark.parametrize("noise", [1e-4, 1e-2, 1e-1])
def test_noise_is_no_multiple(noise: float) -> None:
    assert {of_motion(np.zeros(TIME.size), noise, seed) for seed in range(50)} == {1}


@pytest.mark.parametrize(
    "test",
    [
        {"kind": "phase_resonance", "frequency": 61.4, "from": 58.4, "to": 64.5, "force": 2.412},
        {"kind": "constant_response", "frequencies": [60.83, 60.95, 61.1], "acceleration": 19.0},
    ],
    ids=lambda test: test["kind"],
)
def test_motion_with_too_many_periods_is_named(test: dict[str, Any]) -> None:
    # The motion repeats after five periods, which differ by 0.17 %: the comparison ends at four.
    sensor = {"sensitivity": "100 mV/g", "noise": "8.77 ug/sqrt(Hz)"}
    scene = rig.load({
        "structure": {
            "masses": [2.2747, 0.52726, 2.1834, 1.1216],
            "springs": [183000.0, 532990.0, 219334.0, 252442.0],
            "damping": {"rayleigh": {"alpha": 1.954589862345038, "beta": 2.2129546447883597e-05}},
        },
        "dampers": [{"body": 4, "mass_ratio": 0.077145, "clearance": ".inf"}],
        "shaker": {"kind": "electrodynamic", "body": 4, "spring": "36.6 kN/m"},
        "test": {"at": "body 4", **test},
        "channels": [{"name": at.replace(" ", ""), "at": at, "accelerometer": sensor} for at in ("body 4", "table")],
        "converter": {"rate": 5120.0, "bits": 24, "range": 10.0},
        "seed": 685751,
    })  # fmt: skip
    bench_run = run(scene)
    fields = bench_run.marks_of("measure")[-1][-1]
    assert not fields["settled"] and fields["repetition"] == 0
    assert "the motion is irregular at 61.1 Hz." in " ".join([bench_run.reason, *bench_run.warnings])
