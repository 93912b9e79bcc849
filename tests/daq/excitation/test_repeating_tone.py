"""Number of periods of the tone after which motions repeat: synthetic motions, and motions on the bench."""

import math
from collections.abc import Generator
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import rig
from daq.core.excitation.tones.repeating_tone import RepeatingTone, amplitudes_of_periods, repetition
from rig.core.base.arrays import Array
from tests.daq.measurement.bench_run import run

PER_PERIOD = 64
TOLERANCE = 1e-3
PHASES = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)


def time_of(periods: int) -> Array:
    """Return the time of each sample, periods."""
    return np.arange(periods * PER_PERIOD) / PER_PERIOD


TIME = time_of(20)


def of_motion(modulation: Array, noise: float = 0.0, seed: int = 0, mode: Array | float = 0.0) -> int:
    """Return the repetition of a tone with a modulation, noise and another mode, relative to its amplitude."""
    samples = (1.0 + modulation) * np.sin(2.0 * np.pi * np.arange(modulation.size) / PER_PERIOD) + mode
    samples += noise * np.random.default_rng(seed).standard_normal(samples.size)
    # Largest difference of the amplitudes in Hann windows of two periods, with a margin of 2 in the variance.
    expected = noise * (2.0 * 2.0 * 2.0 * 1.5 * 2.0 / (2 * PER_PERIOD)) ** 0.5
    return repetition(amplitudes_of_periods(samples, 1.0, float(PER_PERIOD)), TOLERANCE, expected)


def alternating(ratio: float, time: Array = TIME) -> Array:
    """Return a modulation that alternates between successive periods."""
    return ratio * np.sign(np.sin(np.pi * time))


def logistic_map(growth: float) -> Array:
    """Return a modulation of successive periods by up to 5 % with the logistic map."""
    values = [0.3]
    for _ in range(1000):
        values.append(growth * values[-1] * (1.0 - values[-1]))
    return np.repeat(0.05 * np.array(values[-20:]), PER_PERIOD)


@pytest.mark.parametrize("ratio", [1e-3, 1e-2])
def test_small_doubling_is_two_periods(ratio: float) -> None:
    assert of_motion(alternating(ratio), noise=1e-4) == 2


def test_chaotic_motion_does_not_repeat() -> None:
    # Below 3.57 the map has periods of 2, 4, ...; at 3.9 it is chaotic.
    assert [of_motion(logistic_map(growth)) for growth in (3.2, 3.5, 3.9)] == [2, 4, 0]


def test_chaotic_motion_is_no_transient() -> None:
    # In 10 periods, the deviations of some of these motions happen to decrease.
    value, found = 0.3, set()
    for _ in range(200):
        values = []
        for _ in range(10):
            value = 3.9 * value * (1.0 - value)
            values.append(value)
        found.add(of_motion(np.repeat(0.01 * np.array(values), PER_PERIOD)))
    assert 1 not in found


def test_quasi_periodic_motion_is_irregular() -> None:
    # The envelope at the frequency itself is constant.
    assert of_motion(0.0 * TIME, mode=0.02 * np.sin(2.0 * np.pi * 0.382 * TIME)) == 0


@pytest.mark.parametrize("periods", [20, 50, 60])
@pytest.mark.parametrize("frequency", [0.31, 0.35, 0.36, 0.48, 0.49, 0.51, 0.52, 0.65])
def test_beat_of_subharmonic_is_irregular(periods: int, frequency: float) -> None:
    time = time_of(periods)
    modes = [0.01 * np.sin(2.0 * np.pi * frequency * time + phase) for phase in PHASES[::3]]
    assert {of_motion(0.0 * time, mode=mode) for mode in modes} == {0}


@pytest.mark.parametrize("periods", [12, 20, 50, 200])
def test_drift_beyond_tolerance_is_irregular(periods: int) -> None:
    drifts = [ratio * TOLERANCE * time_of(periods) / periods for ratio in (2.0, 3.0)]
    assert [of_motion(drift) for drift in drifts] == [1, 0]


def test_doubling_in_a_few_periods_is_recognized() -> None:
    assert [of_motion(alternating(0.1, time_of(periods))) for periods in (4, 5, 6)] == [0, 2, 2]


@pytest.mark.parametrize("periods", [6, 10, 20, 50, 200])
@pytest.mark.parametrize("decaying", [0.15, 1.0])
def test_decrease_of_doubling_leaves_two_periods(periods: int, decaying: float) -> None:
    time = time_of(periods)
    assert of_motion(alternating(0.01, time) * (1.0 + decaying * np.exp(-2.0 * time / periods))) == 2


def test_growing_doubling_is_irregular() -> None:
    # Feedback held an orbit of one period at 17.3715 Hz while its doubled motion grew from 0.3 to 0.8 %.
    assert of_motion(alternating(0.01) * np.exp(TIME / 20.0 - 1.0)) == 0


@pytest.mark.parametrize("doubling", [0.0, 0.01])
@pytest.mark.parametrize(("periods", "beat"), [(20, 60), (100, 25), (100, 50), (200, 400)])
def test_beat_of_any_phase_is_irregular(periods: int, beat: int, doubling: float) -> None:
    # In some phases, the differences of periods decrease as those of a transient. The beat can divide the measurement.
    time = time_of(periods)
    modulations = [0.01 * np.sin(2.0 * np.pi * time / beat + phase) for phase in PHASES]
    assert {of_motion(alternating(doubling, time) + each) for each in modulations} == {0}


def test_transient_within_tolerance_repeats() -> None:
    assert of_motion(0.9 * TOLERANCE * np.exp(-TIME / 20.0)) == 1


@pytest.mark.parametrize("periods", [10, 20, 50, 200])
@pytest.mark.parametrize("frequency", [0.37, 0.5, 0.6, 2.0 / 3.0])
@pytest.mark.parametrize("time_constant", [0.1, 0.5, 1.0])
def test_decaying_mode_is_no_multiple(periods: int, frequency: float, time_constant: float) -> None:
    time = time_of(periods)
    decay = 0.005 * np.exp(-time / (time_constant * periods))
    modes = [decay * np.cos(2.0 * np.pi * frequency * time + phase) for phase in PHASES[::3]]
    # It is measured again if it does not repeat yet.
    assert {of_motion(0.0 * time, 1e-4, mode=mode) for mode in modes} <= {0, 1}


def test_small_alternating_transient_is_no_multiple() -> None:
    assert of_motion(alternating(0.1 * TOLERANCE)) == 1


@pytest.mark.parametrize("periods", [5, 20])
@pytest.mark.parametrize("noise", [1e-4, 1e-2, 1e-1])
def test_noise_is_no_multiple(periods: int, noise: float) -> None:
    assert {of_motion(np.zeros(periods * PER_PERIOD), noise, seed) for seed in range(200)} == {1}


@pytest.mark.parametrize(
    ("deviations", "longest", "n_measured"),
    [
        ([1.0, 0.7, 0.5, 0.49, 0.1], 100, 4),  # the motion no longer decays
        ([1.0, 0.7, 0.5, 0.3, 0.2], 3, 3),  # the longest time of settling
        ([math.nan, math.nan], 100, 1),
    ],
)
def test_measurements_are_repeated_during_a_decay(deviations: list[float], longest: int, n_measured: int) -> None:
    station = SimpleNamespace(now=0, samples=int)
    tone = SimpleNamespace(station=station, _settle=SimpleNamespace(longest=longest), _deviation=0.0)

    def measure() -> Generator[Any, Any, tuple[int, bool]]:
        yield
        tone._deviation = deviations[station.now]
        station.now += 1
        return station.now, True

    measuring = RepeatingTone.until_decayed(cast(Any, tone), measure)
    with pytest.raises(StopIteration) as end:
        while True:
            next(measuring)
    assert end.value.value == n_measured


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
    reason = " ".join([bench_run.reason, *bench_run.warnings])
    assert "the motion is irregular at 61.1 Hz, or settles over more than 100 periods." in reason
