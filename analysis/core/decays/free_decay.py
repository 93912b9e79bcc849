"""Free decay of a channel after an impact: envelope, energy, damping of each mode, and the time to fall below 1 g.

Energy: backward integration (M. R. Schroeder, J. Acoust. Soc. Am. 37 (1965) 409). A damper is a loose mass that rests
on a floor of its body under gravity. It stays on the floor while the acceleration of the body is below 1 g.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.core.decays.band_pass import band_width
from analysis.core.decays.modal_decay import SAME_MODE_RATIO, ModalDecay, modal_decay, spectral_peaks
from analysis.core.decays.overlap import resolve_close_modes
from analysis.core.decays.sensor_correction import correct_motion, count_of_motion
from analysis.core.recordings.channel_delay import arrival
from analysis.core.recordings.opening import takes_path
from analysis.core.recordings.slices import impact_ranges, interpolated
from analysis.core.responses.errors.systematic import clock_deviation
from analysis.core.responses.measurands import motion_channel, response_channels
from daq.core.recording.markers import BETWEEN_FILES, faulty_impacts
from daq.core.recording.recording import Recording
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError, SceneError
from rig.core.base.figure_types import Axes
from rig.core.base.renamed import renamed, renamed_parameter
from rig.core.results import Result, complete_style, format_percent
from rig.core.results.table import Table
from rig.core.scene.scene import STANDARD_GRAVITY
from rig.core.system.structural_model import structural_model

# Lower limit of the frequency range [Hz] that is searched for modes: drift of sensors dominates below. It is lowered if
# the structure of the scene has lower modes, or the highest peak of an imported decay is lower.
_LOWEST_MODE_HZ = 2.0
# Upper limit of the frequency range that is searched for modes [Hz], raised if the structure of the scene has higher
# modes; higher modes decay at once.
_HIGHEST_MODE_HZ = 200.0
# The range ends at least two octaves above the highest mode of the scene: dampers and bodies that the scene omits shift
# modes upward, and the median of a wider band is farther below the peaks.
_UPPER_RATIO = 4.0
# The range begins at least an octave below the lowest mode.
_LOWER_RATIO = 0.5
# A peak below this number of periods in the decay may be drift.
_MIN_PERIODS = 5.0
# Minimum number of samples of a decay from which a natural frequency and a slope can be estimated.
_MIN_SAMPLES = 256
# If the energy no longer decays in the last tenth of a record, this tenth counts as noise, provided that it contains at
# most this fraction of the energy. Otherwise the motion is not a free decay.
_MAX_FINAL_ENERGY_FRACTION = 0.02
# An imported recording of a free decay may begin before the motion: the readings are below this part of their maximum
# for more than this number of periods of the lowest mode.
_MOVING_RATIO = 0.1
_MAX_LATE_PERIODS = 1.0
#: Why times of a decay have no interval.
NO_INTERVAL = "times without interval, because one impact has no scatter"
#: Energy levels between which the slope of the initial decay is fitted [dB].
INITIAL_DECAY_DB = -1.0, -11.0
# Below this fraction of the initial energy, only rounding errors remain in the backward integral.
_MIN_ENERGY_RATIO = 1e-30
# Rounding changes amplitudes below about 6 counts too much, and the first reported amplitude is 4 dB below the
# largest.
_MIN_COUNTS = 10.0
# If the channel is overloaded for more than this fraction of a decay, its amplitudes are unusable.
_MAX_OVERLOADED_FRACTION = 0.1
# Lost samples are interpolated if they are at most this fraction of a decay.
_MAX_LOST_FRACTION = 0.01
# Assumed frequency of the lowest mode if no mode is detected.
_DEFAULT_MODE_HZ = 10.0


@dataclass(frozen=True, repr=False)
class Decay(Result):
    """Free decay of one channel after one impact.

    Attributes
    ----------
    channel, label : str
        Channel, and scene name for legends.
    impact : int
        Number of the impact, from 1.
    time : ndarray, shape (n,)
        Time from the beginning of the free decay [s].
    acceleration, envelope : ndarray, shape (n,)
        Acceleration, and its envelope (smooth upper bound of its magnitude, by `upper_bound`) [m/s²].
    peak_time, peak : ndarray, shape (peaks,)
        Envelope by peak picking: local maxima of the magnitude, at least one period of the lowest mode apart; s,
        m/s².
    energy : ndarray, shape (n,)
        Backward-integrated (Schroeder) energy of the acceleration, dB relative to its initial value. Beyond the end
        of the record the decay is extrapolated from its last two tenths [1]_.
    modes : tuple of ModalDecay
        Decay of each detected mode.
    gravity : float
        Acceleration due to gravity [m/s²]: below this amplitude no damper on this body leaves its floor.
    warnings : tuple of str
        Warnings about the validity of the results.

    References
    ----------
    .. [1] ISO 3382-2:2008, section 5.3.3.
    """

    channel: str
    label: str
    impact: int
    time: Array
    acceleration: Array
    envelope: Array
    peak_time: Array
    peak: Array
    energy: Array
    modes: tuple[ModalDecay, ...]
    gravity: float
    warnings: tuple[str, ...]

    hit = renamed("hit", "impact")

    def summary(self) -> str:
        """Return the channel, its largest acceleration, and the damping ratio of each mode at large amplitude."""
        modes = [f"{m.frequency_text()} ({100 * m.damping[0]:.3g} %)" for m in self.modes if m.damping.size]
        largest = float(abs(self.acceleration).max())
        return f"{self.label}, {self.channel} after impact {self.impact}: from {largest:.3g} m/s²; {', '.join(modes)}"

    def table(self) -> Table:
        """Return for each mode: frequency, damping ratio at the largest and smallest amplitude, and noise."""
        heading = (
            "natural frequency / Hz", "initial damping ratio / %", "initial amplitude / (m/s²)",
            "final damping ratio / %", "final amplitude / (m/s²)", "noise / (m/s²)",
        )  # fmt: skip
        return Table(heading, ">>>>>>", [mode.cells() for mode in self.modes])

    def columns(self) -> dict[str, Array]:
        """Return time, acceleration, envelope and backward-integrated energy."""
        return {
            "time_s": self.time,
            "acceleration_m/s²": self.acceleration,
            "envelope_m/s²": self.envelope,
            "energy_dB": self.energy,
        }

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the acceleration, and its envelope with both signs."""
        (line,) = ax.plot(self.time, self.envelope, **complete_style(style, lw=1.2, label=self.label))
        ax.plot(self.time, -self.envelope, color=line.get_color(), lw=line.get_linewidth())
        ax.plot(self.time, self.acceleration, color=line.get_color(), lw=0.5, alpha=0.6)
        ax.set(xlabel="time after the impact / s", ylabel="acceleration / (m/s²)")

    def time_below(self, amplitude: float) -> float:
        """Return the time [s] after which the acceleration stays below `amplitude`; NaN if it never does."""
        above = np.flatnonzero(abs(self.acceleration) >= amplitude)
        if not above.size:
            return 0.0
        return float(self.time[above[-1] + 1]) if above[-1] + 1 < self.time.size else float("nan")

    @property
    def quiet_from(self) -> float:
        """Time in s from which the acceleration stays below 1 g, so no damper on this body leaves its floor."""
        return self.time_below(self.gravity)

    @property
    def halving(self) -> float:
        """Time in s in which the amplitude halves, and the energy falls by 6 dB; NaN if unknown.

        It is computed from the slope of a line fitted to the energy between -1 and -11 dB.
        """
        initial = (self.energy <= INITIAL_DECAY_DB[0]) & (self.energy >= INITIAL_DECAY_DB[1])
        if np.sum(initial) < 8 or self.energy.min() > INITIAL_DECAY_DB[1]:
            return float("nan")
        slope = np.polyfit(self.time[initial], self.energy[initial], 1)[0]  # dB/s
        return float(-20.0 * np.log10(2.0) / slope)


def upper_bound(acceleration: Array, period: float) -> Array:
    """Return a smooth upper bound of the magnitude of an acceleration.

    `period`: period of the lowest mode, in samples. The running maximum over half a period on either side is smoothed
    with a window of the same length. All maxima in this window include the sample in its middle, so their weighted
    mean is not smaller than this sample.

    >>> acceleration = np.exp(-0.01 * np.arange(400)) * np.sin(np.arange(400))
    >>> bool(np.all(upper_bound(acceleration, 2 * np.pi) >= abs(acceleration)))
    True
    """
    half_period = max(1, round(0.5 * period))
    largest = scipy.ndimage.maximum_filter1d(abs(acceleration), 2 * half_period + 1, mode="nearest")
    weights = np.hanning(2 * half_period + 3)
    return np.asarray(scipy.ndimage.convolve1d(largest, weights / weights.sum(), mode="nearest"))


@renamed_parameter("hit", "impact")
@takes_path
def decay(rec: Recording, channel: str | None = None, impact: int = 1, modes: int | None = None) -> Decay:
    """Analyze the free decay of a channel's acceleration after an impact.

    Parameters
    ----------
    rec : daq.Recording, str or Path
        Recording of an impact test or a free decay.
    channel : str, optional
        Response channel. Default: the channel of the last body.
    impact : int
        Number of the impact to analyze, counted from 1.
    modes : int, optional
        Maximum number of modes, where close modes with a common peak in the spectrum count as one; default: the number
        of bodies of the structure, and all modes with a peak in an imported recording.

    Returns
    -------
    Decay
        Frequency [Hz] and damping ratio of each mode, envelope of the acceleration [m/s²] and energy of the decay.
    """
    names = response_channels(rec)
    if not names:
        raise RecordingError(
            f"{rec.path}: no motion channel on a body. Add one to the scene's channels, and record again."
        )
    info = motion_channel(rec, channel if channel is not None else names[-1])
    read_start, decay_start, decay_stop, read_stop = _decay_limits(rec, info, impact)
    samples, warnings = _read_samples(rec, info, impact, read_start, read_stop)
    warnings += _overload_warnings(rec, info, impact, decay_start, read_stop)
    if fault := faulty_impacts(rec.markers, ()).get(impact):
        warnings.append(f"Impact {impact} was {fault}. Choose another impact, or record again.")
    # The structure in the scene of an imported recording may be a placeholder.
    max_modes = modes if modes is not None or rec.source else rec.scene.structure.bodies
    natural = structural_model(rec.scene).modes.frequency
    highest_mode = max(_HIGHEST_MODE_HZ, _UPPER_RATIO * float(natural.max()))
    upper_limit = min(0.4 * rec.rate, 4.0 * highest_mode)
    highest_mode, begin = min(highest_mode, upper_limit), decay_start - read_start

    def accelerations(lowest: float) -> Array:
        return correct_motion(info, samples, "acceleration", lowest, upper_limit)[: decay_stop - read_start]

    duration = (decay_stop - decay_start) / rec.rate
    lowest_mode = min(_LOWEST_MODE_HZ, _LOWER_RATIO * float(natural.min()))
    if rec.source:
        low = _MIN_PERIODS / duration
        highest_peak = spectral_peaks(accelerations(low)[begin:], rec.rate, 1, low, highest_mode)
        lowest_mode = min([lowest_mode, *(_LOWER_RATIO * highest_peak)])
    lowest_mode = max(lowest_mode, 1.0 / duration)
    acceleration = accelerations(lowest_mode)
    # After its last change a reading contains no motion, and the filters' responses would be taken for a decay.
    last_change = int(np.flatnonzero(np.diff(samples))[-1]) + 1
    recorded = acceleration[: max(last_change + 1, begin + _MIN_SAMPLES)]
    peak_frequencies = spectral_peaks(recorded[begin:], rec.rate, max_modes, lowest_mode, highest_mode)
    decays, mode_warnings = _modal_decays(rec, info, recorded, begin, peak_frequencies)
    warnings += mode_warnings
    if max_modes is not None and len(decays) < max_modes:
        warnings.append(
            f"Only {len(decays)} of {max_modes} modes have a peak in the decay of {info.name} between "
            f"{lowest_mode:.3g} and {highest_mode:.4g} Hz. Choose another channel for the other modes."
        )
    period = int(rec.rate / (peak_frequencies[0] if peak_frequencies.size else _DEFAULT_MODE_HZ))
    # The envelope of the last period depends on samples after the end, so the last period is discarded.
    end = acceleration.size - min(period, (acceleration.size - begin) // 10)
    free_decay = acceleration[begin:end]
    # Unlike an analytic signal's magnitude, this envelope neither oscillates in beats nor overshoots at the impact.
    longest_period = rec.rate / min((mode.frequency for mode in decays), default=rec.rate / (free_decay.size - 1))
    envelope = upper_bound(acceleration[begin:], longest_period)[: free_decay.size]
    readings = abs(samples[begin:] - np.median(samples[begin:]))
    late = int(np.argmax(readings > _MOVING_RATIO * readings.max()))
    if rec.source and late > _MAX_LATE_PERIODS * longest_period:
        warnings.append(
            f"{info.name} is nearly at rest for the first {late / rec.rate:.3g} s of the decay, which falsifies its "
            "damping. Import the recording from there on."
        )
    peak_indices, _ = scipy.signal.find_peaks(abs(free_decay), distance=max(period, 1))
    energy = _energy_decay(free_decay)
    if energy.min() > INITIAL_DECAY_DB[1]:
        warnings.append(
            f"The energy of {info.name}'s motion does not fall by {-INITIAL_DECAY_DB[1]:.0f} dB within the record, so "
            "its decay is undetermined. Record for longer."
        )
    return Decay(
        channel=info.name,
        label=rec.scene.name,
        impact=impact,
        time=np.arange(free_decay.size) / rec.rate,
        acceleration=free_decay,
        envelope=envelope,
        peak_time=peak_indices / rec.rate,
        peak=abs(free_decay)[peak_indices],
        energy=energy,
        modes=decays,
        gravity=rec.scene.gravity or STANDARD_GRAVITY,
        warnings=tuple(warnings),
    )


def _modal_decays(
    rec: Recording, info: ChannelInfo, acceleration: Array, begin: int, peaks: Array
) -> tuple[tuple[ModalDecay, ...], list[str]]:
    """Return the decays of the modes at the `peaks` of the spectrum [Hz], and warnings about undetermined ones.

    `acceleration`: m/s²; `begin`: sample at which the free decay begins.
    """
    # A damper gives one mode several poles, like close modes of a linear structure.
    linear_modes = structural_model(rec.scene).modes.frequency
    is_single = (_count_near(peaks, linear_modes) < 2) & (not rec.scene.is_linear) & (not rec.source)
    frequencies, overlaps = resolve_close_modes(acceleration, rec.rate, peaks, begin, is_single)
    counts = count_of_motion(info, frequencies, "acceleration")
    clock = clock_deviation(rec)
    decays = [
        modal_decay(
            acceleration,
            rec.rate,
            float(frequency),
            band_width(frequencies, index),
            begin,
            clock=clock,
            overlap=overlaps[index],
            count=float(counts[index]),
        )
        for index, frequency in enumerate(frequencies)
    ]
    # The damping of a mixture of linear modes changes with the amplitude.
    existing, found = (_count_near(frequencies, modes) for modes in (linear_modes, frequencies))
    is_mixed = (existing > found) & (rec.scene.is_linear and not rec.source)
    is_mixed &= np.array([not each.is_linear for each in decays], dtype=bool)
    decays = [each.undetermined() if mixed else each for each, mixed in zip(decays, is_mixed, strict=True)]
    undetermined = [index for index, each in enumerate(decays) if not each.damping.size]
    close = [index for index in undetermined if is_mixed[index] or overlaps[index].is_close]
    few_counts = [
        index
        for index in undetermined
        if index not in close and decays[index].envelope.max(initial=0.0) < _MIN_COUNTS * counts[index]
    ]
    warnings = []
    if close:
        warnings.append(
            f"The modes at {_listed(frequencies[close])} Hz are too close to other modes: their envelopes in "
            f"{info.name} cannot be separated within the record. `analysis modes` determines their damping."
        )
    if few_counts:
        warnings.append(
            f"The damping of the modes at {_listed(frequencies[few_counts])} Hz is undetermined: their amplitudes in "
            f"{info.name} are below {_MIN_COUNTS:.0f} counts of the converter. Use a more sensitive sensor, or a "
            "smaller range."
        )
    return tuple(decays), warnings


def _count_near(frequencies: Array, modes: Array) -> NDArray[np.int64]:
    """Return the number of modes near each frequency."""
    return np.sum(abs(modes / frequencies[:, None] - 1.0) < SAME_MODE_RATIO, axis=1)


def _listed(frequencies: Array) -> str:
    return ", ".join(f"{frequency:.4g}" for frequency in frequencies)


def _read_samples(rec: Recording, info: ChannelInfo, impact: int, start: int, stop: int) -> tuple[Array, list[str]]:
    """Return the samples of an impact with lost samples interpolated, and a warning if there were any."""
    samples, warnings = rec.read(info.name, start, stop), list[str]()
    lost = ~np.isfinite(samples)
    if lost.any():
        if lost.mean() > _MAX_LOST_FRACTION:
            raise RecordingError(
                f"{rec.path}: {format_percent(lost.mean())} of the samples of impact {impact} are lost. Choose another "
                "impact, or record again."
            )
        samples = interpolated(samples, ~lost)
        warnings.append(
            f"{int(lost.sum())} lost samples of {info.name} were interpolated; the decay is inexact at these times."
        )
    if not np.any(abs(samples - samples[0]) > 0):
        raise RecordingError(
            f"{rec.path}: {info.name} is constant throughout the decay of impact {impact}. Choose another channel, or "
            "check the sensor and record again."
        )
    return samples, warnings


def _overload_warnings(rec: Recording, info: ChannelInfo, impact: int, start: int, stop: int) -> list[str]:
    """Return a warning if the channel was overloaded in a decay; raise `RecordingError` if most was overloaded."""
    # First sample that the decay affects, with the delay of the converter's filter.
    first = arrival(info, start, start)[0]
    overloads = [marker for marker in rec.overloads if marker.fields.get("channel") == info.name]
    overloaded = sum(max(min(marker.end + 1, stop) - max(marker.first_sample, first), 0) for marker in overloads)
    fraction = overloaded / max(stop - first, 1)
    if fraction > _MAX_OVERLOADED_FRACTION:
        raise RecordingError(
            f"{rec.path}: {info.name} was overloaded for {format_percent(fraction)} of the decay after impact "
            f"{impact}. Hit more softly, widen the converter's range, or lower the sensitivity in the scene."
        )
    if not fraction:
        return []
    return [
        f"{info.name} was overloaded for {format_percent(fraction)} of the decay, so its first amplitudes are "
        "too low. Hit more softly, or widen the converter's range."
    ]


def _energy_decay(acceleration: Array) -> Array:
    """Return the backward-integrated energy, dB relative to its start; 0 dB if the motion is not a free decay."""
    backward_energy = np.cumsum(acceleration[::-1] ** 2)[::-1]
    energy_after_end = _energy_after_end(acceleration)
    if np.isinf(energy_after_end):
        return np.zeros(acceleration.size)
    # If the samples end in zeros, the energy is zero there, and its logarithm is undefined.
    ratio = (backward_energy + energy_after_end) / (backward_energy[0] + energy_after_end)
    return np.asarray(10.0 * np.log10(np.maximum(ratio, _MIN_ENERGY_RATIO)))


def _energy_after_end(acceleration: Array) -> float:
    """Extrapolate the energy after the end of the record exponentially from its last two tenths, in (m/s²)²."""
    # If the energy does not fall between the last two tenths and the last tenth contains a small fraction of it, the
    # last tenth is noise. If it contains more, the motion is no free decay: its energy after the end is infinite.
    tenth = max(1, acceleration.size // 10)
    previous_energy = float(np.sum(acceleration[-2 * tenth : -tenth] ** 2))
    last_energy = float(np.sum(acceleration[-tenth:] ** 2))
    if previous_energy > last_energy:
        # Sum of the geometric series of the energies of all later tenths.
        return last_energy * last_energy / (previous_energy - last_energy)
    return np.inf if last_energy > _MAX_FINAL_ENERGY_FRACTION * float(np.sum(acceleration**2)) else 0.0


def _decay_limits(rec: Recording, info: ChannelInfo, impact: int) -> tuple[int, int, int, int]:
    """Return sample indices: start of reading, start and end of the decay, end of reading; ends are exclusive."""
    ranges = impact_ranges(rec)
    if not 1 <= impact <= len(ranges):
        raise SceneError(f"{rec.path}: no impact {impact}. Choose one of impacts 1 to {len(ranges)}.")
    first, last = ranges[impact - 1]
    # The converter's filter delays the samples. To correct the delay, samples after the end of the decay are read, too.
    # After the correction, the filter's response to the next impact begins before that impact, so the decay is cut
    # before this response.
    read_stop = arrival(info, ranges[impact][0], ranges[impact][0])[0] if impact < len(ranges) else rec.samples
    max_response_delay = arrival(info, 0, 0)[1]
    ends_of_files = (gap.first_sample for gap in rec.gaps if gap.reason == BETWEEN_FILES and gap.first_sample > last)
    read_stop = min(read_stop, next(ends_of_files, read_stop))
    decay_start, decay_stop = last + 1, read_stop - max_response_delay
    # Include samples before the impact so that the band-pass starts with the structure at rest.
    read_start = max(first - int(0.5 * rec.rate), ranges[impact - 2][1] + 1 if impact > 1 else 0, 0)
    if decay_stop - decay_start < _MIN_SAMPLES:
        raise RecordingError(
            f"{rec.path}: only {max(decay_stop - decay_start, 0)} samples follow impact {impact}; expected "
            f"{_MIN_SAMPLES} or more. Increase test.interval (for a free decay: test.duration), and record again."
        )
    return read_start, decay_start, decay_stop, read_stop
