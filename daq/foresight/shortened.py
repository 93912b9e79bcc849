"""The parts of a test that determine its extremes, short enough for a rehearsal.

A short test is rehearsed completely. Of a stepped or swept sine these are the beginning, where sensors have just been
switched on, and the frequencies about the peaks of the linear response, with the dampers on their floors and without
them. Of a long random test it is the beginning, of equal hits the first, of repeated periods a single one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.foresight.linear import channel_readings, test_frequencies
from daq.measurement.estimate import estimate
from daq.measurement.limits import controlled_places
from daq.signal_chain.channel import ChannelInfo
from daq.signal_chain.oversampling import oversampling
from rig.arrays import Array
from rig.scene.excitation import Free, Impulse, Multisine, Random, Settle, Sine, SteppedSine, SweptSine, Test
from rig.scene.presets import complete_from_preset, input_settings
from rig.scene.scene import Scene
from rig.scene.shaker import ElectrodynamicShaker
from rig.system.assembly import assemble
from rig.system.structural_model import structural_model

#: CPU time of a rehearsal, approximately, s.
BUDGET_S = 0.7
# Multiple of that up to which a random test or multisine is rehearsed completely: extremes of a part scatter by 10 %.
_RANDOM_BUDGETS = 4.0
# CPU time measured on one core of 2 GHz, s: of a sample, of each state and of each channel in it, and of each period of
# a sweep with controlled force.
_SAMPLE_S, _STATE_S, _CHANNEL_S, _STEERED_PERIOD_S = 130e-9, 6e-9, 130e-9, 1.2e-3
# Ratio of the CPU time of a channel with a decimation filter to another.
_FILTERED = 2.0
# CPU time of each element of the state matrix, s.
_ELEMENT_S = 0.6e-9
# Duration of a step: a time, s, and a number of time constants of the slowest mode, on the bundled scenes.
_STEP_S, _TIME_CONSTANTS = 1.4, 2.0
# Longest wait for steady motion in a rehearsal of parts, s.
_LONGEST_WAIT_S = 10.0
# Share of a channel's largest peak below which peaks of the linear response are left out.
_LOW_PEAK = 0.15
# Groups of frequencies with fewer frequencies between them are joined.
_NARROW_GAP = 4
# Frequencies before each group whose extremes are not used: the motion is not yet that of the whole test.
_AHEAD = 2
# Frequencies of the stepped sine that replaces a long sweep.
_SWEEP_POINTS = 400


@dataclass(frozen=True)
class Shortened:
    """The rehearsed parts of a test: scenes whose tests are run one after another."""

    # Each scene with the number of steps at its beginning whose extremes are not used.
    parts: tuple[tuple[Scene, int], ...]
    whole: bool = False


def affordable_seconds(scene: Scene) -> float:
    """Duration on the bench that can be rehearsed within the budget, s."""
    system = assemble(scene)
    channels = system.coordinates if scene.channels is None else len(scene.channels)
    states = system.states + system.dampers
    channel = _CHANNEL_S * (1.0 if complete_from_preset(scene.converter).filter is None else _FILTERED)
    sample = _SAMPLE_S + _STATE_S * states + _ELEMENT_S * states**2 + channel * channels
    return BUDGET_S / (scene.converter.true_rate * oversampling(scene) * sample)


def shortened(scene: Scene, channels: tuple[ChannelInfo, ...]) -> Shortened:
    """Choose the parts of a scene's test to rehearse; `channels` are those of the bench."""
    test, seconds = scene.test, affordable_seconds(scene)
    assert test is not None
    if isinstance(test, Random | Multisine):
        seconds *= _RANDOM_BUDGETS
    steered = 0.0
    if isinstance(test, SweptSine) and controlled_places(scene):
        steered = _STEERED_PERIOD_S * (test.from_ + test.to) / 2 * test.duration
    if expected_seconds(scene) / seconds + steered / BUDGET_S <= 1.0:
        return Shortened(((scene, 0),), whole=True)
    if isinstance(test, SteppedSine | SweptSine):
        return about_peaks(scene, test, channels, seconds)
    if isinstance(test, Random):
        part: Test = test.replace(duration=seconds)
    elif isinstance(test, Sine | Free):
        part = test.replace(duration=min(test.duration, seconds))
    elif isinstance(test, Multisine):
        once = test.replace(periods=1)
        share = seconds / expected_seconds(scene.replace(test=once))
        part = once.replace(realisations=max(1, min(test.realisations, int(share * test.realisations))))
    else:
        part = _fewer_hits(test, seconds)
    return Shortened(((scene.replace(test=part), 0),))


def expected_seconds(scene: Scene) -> float:
    """Estimate the duration of a test with its waits, s."""
    least, test = estimate(scene).seconds, scene.test
    if isinstance(test, Multisine):
        # A crossfade, and at least two periods until they are equal; with a held force the iterations of its shape.
        return least * (1.0 + 3.0 / test.periods) + (8.0 if controlled_places(scene) else 0.0)
    if not isinstance(test, SteppedSine):
        return least
    return least + len(test.levels) * len(test.order) * _wait(scene)


def _wait(scene: Scene) -> float:
    """Estimate the time between the measurements of a stepped sine, s, from the slowest mode."""
    assert isinstance(scene.test, SteppedSine)
    modes = structural_model(scene).modes
    slowest = float(1.0 / max(modes.decay_rate[modes.omega > 0.0].min(initial=np.inf), 1e-3))
    return _STEP_S + min(_TIME_CONSTANTS * slowest, scene.test.settle.longest)


def _fewer_hits(test: Impulse, seconds: float) -> Impulse:
    """Keep the first hits, which later hits repeat, with their bounces."""
    double, repeats, interval = test.double_hit, max(1, int(seconds / test.interval)), test.interval
    if test.interval >= seconds:
        interval = max(seconds, 2.0 * (test.width + (0.0 if double is None else double.after)))
    if double is not None and double.hits is not None:
        hits = tuple(hit for hit in double.hits if hit <= repeats)
        double = double.replace(hits=hits) if hits else None
    return test.replace(repeats=repeats, interval=interval, double_hit=double)


def about_peaks(
    scene: Scene, test: SteppedSine | SweptSine, channels: tuple[ChannelInfo, ...], seconds: float
) -> Shortened:
    """Give groups of neighbouring frequencies about the peaks, at the highest level, each started from rest."""
    if isinstance(test, SteppedSine):
        rising, direction = np.unique(test.order), test.direction
        settle, periods = test.settle, test.measure.periods
        level = max(test.levels)
    else:
        rising, direction = test_frequencies(test, _SWEEP_POINTS), "up" if test.from_ < test.to else "down"
        settle, periods = SteppedSine.model_fields["settle"].default, 5
        level = test.force or test.drive or 0.0
    row = _tones(test, direction, level, settle, {"periods": periods})
    runs = 2 if direction == "both" else 1
    step = _wait(scene.replace(test={**row, "frequencies": rising.tolist()})) + periods / rising.mean()
    chosen = _chosen(scene, channels, rising, max(2, int(seconds / step / runs)))
    groups = np.split(chosen, np.flatnonzero(np.diff(chosen) > _NARROW_GAP) + 1)
    if direction == "down":
        groups = groups[::-1]
    beginning = [rising.size - 2, rising.size - 1] if direction == "down" else [0, 1]
    parts: list[tuple[Scene, int]] = []
    for places in (np.clip(beginning, 0, rising.size - 1), *groups):
        first, last, begins = int(places[0]), int(places[-1]), not parts
        if direction != "down" and not begins:
            first = max(first - _AHEAD, 0)
        if direction != "up" and not begins:
            last = min(last + _AHEAD, rising.size - 1)
        frequencies = np.unique(rising[first : last + 1]).tolist()
        ahead = last - int(places[-1]) if direction == "down" else int(places[0]) - first
        # A part with the first tone of the test begins as the test does.
        part = _long_switched_on(scene) if ahead else scene
        parts.append((part.replace(test={**row, "frequencies": frequencies}), ahead))
    return Shortened(tuple(parts))


def _long_switched_on(scene: Scene) -> Scene:
    """Give a scene whose sensors were switched on long before: the bias has settled, to zero behind a high-pass."""
    if scene.channels is None:
        return scene
    channels = []
    for channel in scene.channels:
        sensor, amplifier = channel.accelerometer, channel.integrator
        if sensor is not None and complete_from_preset(sensor).bias is not None:
            blocked = input_settings(scene.converter, channel).coupling == "AC" or (
                amplifier is not None and amplifier.low_cutoff is not None
            )
            settled = complete_from_preset(sensor).replace(preset=None, bias_settling=None)
            channel = channel.replace(accelerometer=settled.replace(bias=0.0) if blocked else settled)
        channels.append(channel)
    return scene.replace(channels=tuple(channels))


def _chosen(scene: Scene, channels: tuple[ChannelInfo, ...], rising: Array, most: int) -> NDArray[np.intp]:
    """Choose positions in a rising list of frequencies: the peaks of the linear response, then their neighbours."""
    seeds: dict[int, float] = {}
    for dampers in dict.fromkeys((scene.dampers, ())):
        for curve in channel_readings(scene.replace(dampers=dampers), channels, rising):
            largest = float(curve.max(initial=0.0))
            padded = np.concatenate([[-1.0], curve, [-1.0]])
            peaks = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]))
            for peak in peaks[curve[peaks] >= _LOW_PEAK * largest].tolist():
                seeds[peak] = max(seeds.get(peak, 0.0), curve[peak] / largest if largest else 0.0)
    ranked = sorted(seeds, key=lambda peak: -seeds[peak])[:most]
    chosen = set(ranked)
    reach = 1
    while len(chosen) < min(most, rising.size) and reach < rising.size:
        for peak in ranked:
            for place in (peak - reach, peak + reach):
                if 0 <= place < rising.size and len(chosen) < most:
                    chosen.add(place)
        reach += 1
    return np.array(sorted(chosen), dtype=np.intp)


def level_key(scene: Scene) -> tuple[str, float, str]:
    """Key of the test's level in the scene, the highest level, and its unit; ("", nan, "") without a level."""
    test = scene.test
    if isinstance(test, Impulse):
        return "test.peak", test.peak, "N"
    for name in ("force", "drive"):
        given = getattr(test, name, None)
        if given is not None:
            unit = "N"
            if name == "drive":
                shaker = scene.driven_shaker
                unit = "V" if isinstance(shaker, ElectrodynamicShaker) else "m"
                unit = "N" if shaker is not None and shaker.kind == "force" else unit
            return f"test.{name}", float(max(given) if isinstance(given, tuple) else given), unit
    return "", np.nan, ""


def at_level(scene: Scene, level: float) -> Scene:
    """Give the scene with another level of its test."""
    key = level_key(scene)[0].removeprefix("test.")
    assert scene.test is not None
    return scene.replace(test=scene.test.replace(**{key: level}))


def around_extreme(scene: Scene, frequency: float | None, seconds: float) -> tuple[Scene | None, int]:
    """Give the scene with the few tones of its test before a frequency, or with its test if that is short."""
    test = scene.test
    if isinstance(test, SteppedSine) and frequency is not None:
        order = list(test.order)
        place = int(np.argmin(np.abs(np.array(order) - frequency)))
        first = max(place - 2, 0)
        direction = "up" if len(order) < 2 or order[place] >= order[max(place - 1, 0)] else "down"
        few = _tones(test, direction, max(test.levels), test.settle, test.measure)
        few["frequencies"] = sorted(set(order[first : place + 2]))
        return scene.replace(test=few), min(place - first, 1)
    return (scene, 0) if estimate(scene).seconds <= seconds else (None, 0)


def _tones(
    test: SteppedSine | SweptSine, direction: str, level: float, settle: Settle, measure: object
) -> dict[str, Any]:
    """Give the settings of a stepped sine in place of a test, without its frequencies."""
    return {
        "kind": "stepped_sine",
        "start": test.start,
        "direction": direction,
        "shaker": test.shaker,
        "settle": settle.replace(longest=min(settle.longest, _LONGEST_WAIT_S)),
        "measure": measure,
        "drive" if test.force is None else "force": level,
    }
