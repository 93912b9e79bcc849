"""Choice of the parts of a test that are simulated in advance, within a CPU-time budget, to predict its extremes.

Such a simulation is called a rehearsal. A short test is rehearsed completely. A stepped or swept sine is represented by
its beginning, where sensors have just been switched on, and by the frequencies about the peaks of the linear response.
These peaks are computed with the dampers on their floors and without dampers. A long random test is represented by its
beginning, equal impacts by the first impacts, and repeated periods by one period.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.core.excitation import procedure_of, test_of
from daq.core.excitation.stepped_sine import expected_wait
from daq.core.prediction.linear import channel_readings, test_frequencies
from daq.core.signal_chain.channel import ChannelInfo
from daq.core.signal_chain.oversampling import choose_oversampling
from rig.core.base.arrays import Array
from rig.core.scene.excitation import Test
from rig.core.scene.presets import complete_from_preset, input_settings
from rig.core.scene.scene import Scene
from rig.core.system.assembly import assemble

# Default CPU time of a rehearsal [s].
_CPU_BUDGET_S = 0.7
# CPU time of a sample without states and channels [s]. All CPU times here were measured on one core of 2 GHz.
_SAMPLE_CPU_S = 130e-9
# CPU time of each state in a sample [s].
_STATE_CPU_S = 6e-9
# CPU time of each channel in a sample [s].
_CHANNEL_CPU_S = 130e-9
# A channel with a decimation filter needs this multiple of the CPU time of a channel without a filter.
_FILTER_TIME_RATIO = 2.0
# CPU time of each element of the state matrix in a sample [s].
_ELEMENT_CPU_S = 0.6e-9
# Longest wait for the steady state in a part [s]: irregular motion would otherwise use up the CPU time.
_LONGEST_WAIT_S = 10.0
# Smallest peak of a channel, relative to its largest peak, that may determine a maximum.
_MIN_PEAK_RATIO = 0.15
# Largest index step within a group: frequencies between cost less than a new start.
_MAX_INDEX_GAP = 4
# Dwells at the start of each group without evaluation: their initial motion differs from the complete test.
_EXCLUDED_DWELLS = 2


@dataclass(frozen=True)
class RehearsalPlan:
    """The rehearsed parts of a test: scenes whose tests are run one after another."""

    # Each scene, with the number of dwells at its beginning that are run but not evaluated.
    parts: tuple[tuple[Scene, int], ...]
    is_complete: bool = False  # whether the only part is the complete test


def affordable_seconds(scene: Scene, cpu_seconds: float = 0.0) -> float:
    """Return the duration of a test [s] whose rehearsal takes the CPU time `cpu_seconds`, at least `_CPU_BUDGET_S`."""
    system, has_filter = assemble(scene), complete_from_preset(scene.converter).filter is not None
    channels = system.coordinates if scene.channels is None else len(scene.channels)
    states = system.states + system.dampers
    channel_cpu_s = _CHANNEL_CPU_S * (_FILTER_TIME_RATIO if has_filter else 1.0)
    sample_cpu_s = _SAMPLE_CPU_S + _STATE_CPU_S * states + _ELEMENT_CPU_S * states**2 + channel_cpu_s * channels
    return max(_CPU_BUDGET_S, cpu_seconds) / (scene.converter.true_rate * choose_oversampling(scene) * sample_cpu_s)


def plan_rehearsal(scene: Scene, channels: tuple[ChannelInfo, ...], cpu_seconds: float = 0.0) -> RehearsalPlan:
    """Choose the parts of a scene's test to rehearse.

    `channels`: channels of the bench; `cpu_seconds`: a test of at most this CPU time is rehearsed completely.
    """
    # Affordable duration of the rehearsed parts [s].
    test, seconds = test_of(scene), affordable_seconds(scene)
    procedure = procedure_of(test)
    seconds *= procedure.budget
    control_cpu_s = procedure.control_seconds(test) if scene.controlled_terms else 0.0
    cpu_ratio = max(1.0, cpu_seconds / _CPU_BUDGET_S)
    if expected_seconds(scene, channels) / seconds + control_cpu_s / _CPU_BUDGET_S <= cpu_ratio:
        return RehearsalPlan(((scene, 0),), is_complete=True)
    if procedure.rehearsal == "peaks":
        return plan_about_peaks(scene, channels, seconds)
    part = procedure.part(test, seconds, scene)
    return RehearsalPlan(((scene.replace(test=part), 0),), is_complete=part == test)


def expected_seconds(scene: Scene, channels: Sequence[ChannelInfo]) -> float:
    """Return the expected duration of a test with its waits for sensors and steady states [s]."""
    test = test_of(scene)
    procedure = procedure_of(test)
    return test.shortest + procedure.waits(test, scene) + procedure.power_on_wait(channels)


def plan_about_peaks(scene: Scene, channels: tuple[ChannelInfo, ...], seconds: float) -> RehearsalPlan:
    """Plan groups of frequencies about the peaks at the highest level, each from rest, of `seconds` in total."""
    test = test_of(scene)
    frequencies, direction = test_frequencies(test), test.sweep_direction
    settings, periods = _stepped_sine_settings(test, direction), procedure_of(test).periods_of_step(test)
    n_directions = 2 if direction == "both" else 1
    step_s = expected_wait(scene, settings["settle"].longest) + periods / frequencies.mean()
    indices = _peak_indices(scene, channels, frequencies, max(2, int(seconds / step_s / n_directions)))
    groups = np.split(indices, np.flatnonzero(np.diff(indices) > _MAX_INDEX_GAP) + 1)
    if direction == "down":
        groups = groups[::-1]
    first_indices = [frequencies.size - 2, frequencies.size - 1] if direction == "down" else [0, 1]
    parts: list[tuple[Scene, int]] = []
    for group_indices in (np.clip(first_indices, 0, frequencies.size - 1), *groups):
        first, last, is_beginning = int(group_indices[0]), int(group_indices[-1]), not parts
        if direction != "down" and not is_beginning:
            first = max(first - _EXCLUDED_DWELLS, 0)
        if direction != "up" and not is_beginning:
            last = min(last + _EXCLUDED_DWELLS, frequencies.size - 1)
        group = np.unique(frequencies[first : last + 1]).tolist()
        excluded_dwells = last - int(group_indices[-1]) if direction == "down" else int(group_indices[0]) - first
        # Only a part that begins with the first tone of the test contains the power-on transient of the sensors.
        part = _with_settled_bias(scene) if excluded_dwells else scene
        parts.append((part.replace(test={**settings, "frequencies": group}), excluded_dwells))
    return RehearsalPlan(tuple(parts))


def _with_settled_bias(scene: Scene) -> Scene:
    """Return the scene with settled biases of its sensors: zero if a high-pass filter follows, otherwise constant."""
    if scene.channels is None:
        return scene
    channels = []
    for channel in scene.channels:
        sensor, amplifier = channel.accelerometer, channel.integrator
        if sensor is not None and complete_from_preset(sensor).bias is not None:
            has_high_pass = input_settings(scene.converter, channel).coupling == "AC" or (
                amplifier is not None and amplifier.low_cutoff is not None
            )
            settled_sensor = complete_from_preset(sensor).replace(preset=None, bias_settling=None)
            channel = channel.replace(
                accelerometer=settled_sensor.replace(bias=0.0) if has_high_pass else settled_sensor
            )
        channels.append(channel)
    return scene.replace(channels=tuple(channels))


def _peak_indices(
    scene: Scene, channels: tuple[ChannelInfo, ...], frequencies: Array, max_count: int
) -> NDArray[np.intp]:
    """Return sorted indices of at most `max_count` frequencies: the highest linear peaks, then their neighbors."""
    peak_heights: dict[int, float] = {}
    for dampers in dict.fromkeys((scene.dampers, ())):
        for readings in channel_readings(scene.replace(dampers=dampers), channels, frequencies):
            largest = float(readings.max(initial=0.0))
            padded = np.concatenate([[-1.0], readings, [-1.0]])
            peaks = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] >= padded[2:]))
            for peak in peaks[readings[peaks] >= _MIN_PEAK_RATIO * largest].tolist():
                peak_heights[peak] = max(peak_heights.get(peak, 0.0), readings[peak] / largest if largest else 0.0)
    ranked = sorted(peak_heights, key=lambda peak: -peak_heights[peak])[:max_count]
    indices = set(ranked)
    distance = 1
    while len(indices) < min(max_count, frequencies.size) and distance < frequencies.size:
        for peak in ranked:
            for index in (peak - distance, peak + distance):
                if 0 <= index < frequencies.size and len(indices) < max_count:
                    indices.add(index)
        distance += 1
    return np.array(sorted(indices), dtype=np.intp)


def highest_level(scene: Scene) -> tuple[str, float, str]:
    """Return key (such as ``test.force``), highest level and unit; ("", nan, "") without a level."""
    test = scene.test
    if test is None or not test.levels:
        return "", np.nan, ""
    return f"test.{test.level_key}", float(max(test.levels)), test.level_unit(scene.driven_shaker)


def with_level(scene: Scene, level: float) -> Scene:
    """Return the scene with a different level of its test, in the unit of `highest_level`."""
    return scene.replace(test=test_of(scene).at_level(level))


def _stepped_sine_settings(test: Test, direction: str) -> dict[str, Any]:
    """Return the settings, except the frequencies, of a stepped sine that replaces a test at its highest level."""
    steady_state = test.steady_state
    return {
        "kind": "stepped_sine",
        "start": test.start,
        "direction": direction,
        "shaker": test.driven,
        "settle": steady_state.replace(longest=min(steady_state.longest, _LONGEST_WAIT_S)),
        "measure": {"periods": procedure_of(test).periods_of_step(test)},
        test.level_key: max(test.levels),
    }
