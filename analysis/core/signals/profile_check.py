"""Comparison of the motion of control and limited channels with the profile of a test (IEC 60068-2-6, -2-64).

Power spectral densities are averages over half-overlapping segments with a Hann window (P. D. Welch, IEEE Trans. Audio
Electroacoust. 15 (1967) 70), with chi-square intervals.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.core.recordings.opening import takes_path
from analysis.core.recordings.slices import interpolated, read_slices
from daq.core.excitation.profiles.profile_checks import line_warnings
from daq.core.excitation.profiles.sweep_control import estimate_amplitudes, observation_samples
from daq.core.recording.recording import Recording
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError
from rig.core.base.figure_types import Axes
from rig.core.base.palette import BASELINE, CurveStyle, location_styles
from rig.core.base.renamed import renamed
from rig.core.numerics.runs import ranges_of, runs_of
from rig.core.results import Result, complete_style, format_frequencies
from rig.core.results.table import Table
from rig.core.scene.excitation.kind import Chirp
from rig.core.scene.excitation.profile import ProfileControl, limits_drive

# Distance from its limit below which a channel limits the drive [dB], if the control channels are below the profile.
_NOTCH_DB = 1.5
# An excess below this value [dB] is noise.
_SMALLEST_EXCESS_DB = 0.05
# Number of periods of a window for the amplitude of a sweep: fewer do not separate harmonics, more blur the sweep.
_PERIODS = 4.0
_OUTSIDE_COLOR = "#222222"
# Independent averages per segment, for half-overlapping segments with a Hann window: 1 / (1 + 2 / 36) (P. D. Welch,
# IEEE Trans. Audio Electroacoust. 15 (1967) 70-73).
_INDEPENDENT_RATIO = 0.95


@dataclass(frozen=True)
class Level:
    """Motion of a channel at each frequency with its 95 % interval, and its profile or limit; all of shape (n,)."""

    channel: str
    place: str  # location of the sensor: "body 2", "table"
    values: Array
    low: Array
    high: Array
    limit: Array  # profile or limit; NaN where there is none
    rms: float  # root mean square in the band of the profile [m/s²]; of a sine, that of the readings
    kurtosis: float

    bound = renamed("bound", "limit")


@dataclass(frozen=True, repr=False)
class ProfileCheck(Result):
    """Motion of the control channels and of the limited channels, compared with profile and limits.

    Attributes
    ----------
    label : str
        Name of the scene.
    unit : str
        Unit of the values: (m/s²)²/Hz for densities, m/s² for amplitudes.
    frequency : ndarray, shape (n,)
        Frequencies [Hz].
    control : ndarray, shape (n,)
        Combination of the control channels.
    profile : ndarray, shape (n,)
        Profile.
    channels, limited : tuple of Level
        Control channels, and channels with limits.
    tolerance, abort : float
        Tolerance and abort limit relative to the profile [dB].
    freedom : float
        Degrees of freedom of each line of a density; 0 for amplitudes.
    warnings : tuple of str
        Warnings about lines that do not resolve the response, limits that end early, and overloads before the full
        level.
    """

    label: str
    unit: str
    frequency: Array
    control: Array
    profile: Array
    channels: tuple[Level, ...]
    limited: tuple[Level, ...]
    tolerance: float
    abort: float
    freedom: float = 0.0
    warnings: tuple[str, ...] = ()

    @property
    def is_density(self) -> bool:
        """Whether the values are densities, not amplitudes."""
        return "Hz" in self.unit

    @property
    def _decibels(self) -> float:
        """Decibels of a factor 10."""
        return 10.0 if self.is_density else 20.0

    @property
    def band(self) -> tuple[Array, Array]:
        """Profile minus and plus the tolerance."""
        ratio = 10.0 ** (self.tolerance / self._decibels)
        return self.profile / ratio, self.profile * ratio

    @property
    def deviation(self) -> Array:
        """Control relative to the profile [dB]; -inf where the control channels read nothing."""
        with np.errstate(divide="ignore"):
            return self._decibels * np.log10(self.control / self.profile)

    def excess(self, level: Level) -> Array:
        """Return a limited channel relative to its limit [dB]; NaN where there is no limit."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return self._decibels * np.log10(level.values / level.limit)

    def is_limited(self, level: Level) -> NDArray[np.bool_]:
        """Return flags of the frequencies at which a channel limits the drive.

        The controller keeps a density below its limit. The channel therefore counts as limited where the upper end of
        its 95 % interval is near the limit.
        """
        end = replace(level, values=np.where(np.isfinite(level.high), level.high, level.values))
        return limits_drive(-self.deviation, -self.excess(end), _NOTCH_DB)

    @property
    def is_reduced(self) -> NDArray[np.bool_]:
        """Flags of the frequencies at which a limit keeps the control below the tolerance."""
        is_limited = np.any([self.is_limited(level) for level in self.limited], axis=0)
        return np.asarray(is_limited & (self.deviation < -self.tolerance))

    @property
    def is_outside(self) -> NDArray[np.bool_]:
        """Flags of the frequencies outside the tolerance at which no limit acts."""
        return np.asarray((abs(self.deviation) > self.tolerance) & ~self.is_reduced)

    @property
    def within(self) -> float:
        """Fraction of the frequencies within the tolerance or reduced by a limit."""
        return float(1.0 - np.mean(self.is_outside))

    def styles(self) -> list[CurveStyle]:
        """Return the style of the control, and of each limited channel."""
        return location_styles([level.place for level in (self.channels[0], *self.limited)])

    def strips(self) -> list[tuple[NDArray[np.bool_], str]]:
        """Return flags and color of the frequencies that a chart marks: reduced by a limited channel, and outside."""
        colors = [style.color for style in self.styles()[1:]]
        return [*zip(self._notch_flags(), colors, strict=True), (self.is_outside, _OUTSIDE_COLOR)]

    def _notch_flags(self) -> list[NDArray[np.bool_]]:
        """Return flags of the frequencies at which each limited channel keeps the control below the tolerance."""
        return [self.is_limited(level) & self.is_reduced for level in self.limited]

    def notches(self) -> list[tuple[str, float, float]]:
        """Return channel, lowest and highest frequency of each band below the tolerance because of a limit [Hz]."""
        return [
            (level.channel, float(self.frequency[start]), float(self.frequency[stop - 1]))
            for level, is_notch in zip(self.limited, self._notch_flags(), strict=True)
            for start, stop in runs_of(is_notch)
        ]

    def excesses(self) -> list[str]:
        """Return the largest excess of each channel above its limit in words."""
        texts = []
        for level in self.limited:
            excess = self.excess(level)
            if (excess > 0.0).any():
                highest = int(np.nanargmax(excess))
                limited = np.flatnonzero(np.isfinite(level.limit))
                is_end = highest in limited[[0, -1]] and limited.size < level.limit.size
                place = f"at {self.frequency[highest]:.4g} Hz{', where the limit ends' * is_end}"
                texts.append(f"{level.channel} up to {excess[highest]:.1f} dB above its limit, {place}")
        return texts

    def summary(self) -> str:
        """Return the agreement with the profile, and the largest excesses above limits."""
        return "; ".join([self.agreement(), *self.excesses()])

    def agreement(self) -> str:
        """Return the fractions of frequencies within the tolerance, reduced by limits and outside, and the rms."""
        worst = int(np.argmax(self.deviation))
        inside = np.mean(abs(self.deviation) <= self.tolerance)
        parts = [f"{100 * inside:.1f} % of the frequencies within {self.tolerance:g} dB of the profile"]
        if self.is_reduced.any():
            parts.append(f"{100 * self.is_reduced.mean():.1f} % below it because of limits")
        if self.within < 1.0:
            places = format_frequencies(self.frequency.tolist(), self.is_outside.tolist())
            parts.append(f"{100.0 * (1.0 - self.within):.1f} % outside, where no limit acts ({places})")
        if self.is_density:
            rms = [_rms(values, self.frequency) for values in (self.control, self.profile)]
            parts.append(f"rms {rms[0]:.3g} m/s² (profile {rms[1]:.3g} m/s²)")
            parts.append(f"{self.freedom:.0f} degrees of freedom per line")
        if self.deviation[worst] >= _SMALLEST_EXCESS_DB:
            parts.append(f"highest {self.deviation[worst]:+.1f} dB at {self.frequency[worst]:.4g} Hz")
        return f"{self.label}: {'; '.join(parts)}"

    def table(self) -> Table:
        """Return rms and kurtosis of each channel."""
        heading = ("channel", "rms / (m/s²)" if self.is_density else "rms of readings", "kurtosis")
        levels = (*self.channels, *self.limited)
        return Table(heading, "<>>", [(each.channel, f"{each.rms:.4g}", f"{each.kurtosis:.2f}") for each in levels])

    def columns(self) -> Mapping[str, Array]:
        """Return frequency, profile, control, and values, interval and limit of each channel."""
        columns = {"frequency_Hz": self.frequency, "profile": self.profile, "control": self.control}
        for level in (*self.channels, *self.limited):
            columns |= {f"{level.channel}": level.values, f"{level.channel} low": level.low}
            columns |= {f"{level.channel} high": level.high, f"{level.channel} bound": level.limit}
        return columns

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw control and limited channels with profile, tolerance, limits, and strips where a limit acts."""
        ax.loglog(self.frequency, self.profile, "--", color=BASELINE, lw=1.2, label="profile", zorder=3)
        ax.fill_between(self.frequency, *self.band, color="#999999", alpha=0.3, lw=0)
        control, *limited = self.styles()
        names = " and ".join(level.channel for level in self.channels)
        line = complete_style(style, color=control.color, lw=1.8, label=f"control: {names}")
        ax.loglog(self.frequency, self.control, **line)
        for level, limiting in zip(self.limited, limited, strict=True):
            ax.loglog(self.frequency, level.values, color=limiting.color, lw=0.9, label=level.channel)
            line = {"color": limiting.color, "lw": 1.2, "label": f"limit of {level.channel}"}
            ax.loglog(self.frequency, level.limit, ls=(0, (1, 1.5)), **line)
        labels = [*(f"notch: {level.channel}" for level in self.limited), "outside the tolerance"]
        for (marked, color), label in zip(self.strips(), labels, strict=True):
            for number, ends in enumerate(ranges_of(self.frequency, marked)):
                # The outline makes the strip of a single frequency visible.
                ax.axvspan(*ends, 0.0, 0.02, color=color, lw=1.5, label=None if number else label)
        density = "acceleration spectral density"
        ax.set(xlabel="frequency / Hz")
        ax.set_ylabel(f"{density if self.is_density else 'acceleration amplitude'} / ({self.unit})")


@takes_path
def profile(rec: Recording) -> ProfileCheck:
    """Compare the motion of control and limited channels with the profile of the test, at full level.

    Parameters
    ----------
    rec : daq.Recording, str or Path
        Recording of a test with profile control.

    Returns
    -------
    ProfileCheck
        Densities [(m/s²)²/Hz] or amplitudes [m/s²] of the channels, with profile and limits.

    Raises
    ------
    RecordingError
        If the test has no profile, or did not reach its full level.
    """
    test = None if rec.scene.test is None else rec.scene.test.profile_control
    measured = [mark for mark in rec.markers if mark.kind == "measure"]
    if test is None:
        raise RecordingError(f"{rec.path}: {rec.test.name} has no profile. Use `analysis frf` or `analysis srs`.")
    if not measured:
        raise RecordingError(f"{rec.path}: the test did not reach its full level. `daq info` gives the reason.")
    start, stop = measured[-1].first_sample, measured[-1].end + 1
    has_lines = test.resolution is not None
    names = list(dict.fromkeys(name for _, name in test.named_channels))
    frequency, values, freedom = (_densities if has_lines else _amplitudes)(rec, test, names, start, stop)
    # Amplitudes have no degrees of freedom: their interval is NaN.
    quantiles = freedom / scipy.stats.chi2.ppf([0.975, 0.025], freedom)
    warnings = (
        *(line_warnings(test, rec.scene, rec.channels.values()) if has_lines else ()),
        *_early_overloads(rec, start),
    )

    def level(name: str, limit: Array) -> Level:
        """Return the motion of a channel."""
        samples, here = _finite(rec, name, start, stop), values[name]
        rms, kurtosis = float(np.std(samples)), float(scipy.stats.kurtosis(samples, fisher=False))
        low, high = here * quantiles[0], here * quantiles[1]
        rms = _rms(here, frequency) if has_lines else rms
        return Level(name, rec.channels[name].at, here, low, high, limit, rms, kurtosis)

    bound = test.profile.at(frequency)
    control = test.control.combined(np.array([values[name] for name in test.control.channels]))
    return ProfileCheck(
        rec.scene.name, "(m/s²)²/Hz" if has_lines else "m/s²", frequency, control, bound,
        tuple(level(name, bound) for name in test.control.channels),
        tuple(level(limit.channel, limit.at(frequency)) for limit in test.limits),
        test.tolerance, test.abort, freedom, warnings,
    )  # fmt: skip


def _early_overloads(rec: Recording, start: int) -> list[str]:
    """Report the channels that were overloaded after the sensors had settled and before the full level, at `start`."""
    settled = max((mark.stop for mark in rec.markers if mark.kind == "settle" and mark.stop <= start), default=0)
    first: dict[str, float] = {}
    for mark in sorted(rec.markers, key=lambda mark: mark.first_sample):
        if mark.kind == "overload" and mark.stop > settled and mark.first_sample < start:
            first.setdefault(str(mark.fields["channel"]), mark.first_sample / rec.rate)
    if not first:
        return []
    listed = ", ".join(f"{name} (from {seconds:.2f} s)" for name, seconds in first.items())
    return [
        f"Channels were overloaded before the full level: {listed}. The identified responses to the drive may be "
        "wrong. Increase converter.range, or lower the profile."
    ]


def _densities(
    rec: Recording, test: ProfileControl, names: Sequence[str], start: int, stop: int
) -> tuple[Array, dict[str, Array], float]:
    """Return frequencies, the density of each channel, and the degrees of freedom."""
    assert test.resolution is not None
    size = min(2 * max(2, round(rec.rate / test.resolution / 2.0)), stop - start)
    low, high = test.profile.frequencies[0], test.profile.frequencies[-1]
    lines = np.asarray(np.fft.rfftfreq(size, 1.0 / rec.rate), dtype=np.float64)
    inside = (lines >= low - 1e-9 * high) & (lines <= high * (1.0 + 1e-9))
    segments = max(1, (stop - start) // (size // 2) - 1)
    densities = {}
    for name in names:
        density = scipy.signal.welch(_finite(rec, name, start, stop), rec.rate, "hann", size, size // 2)[1][inside]
        densities[name] = density * _power_factor(rec.channels[name], lines[inside])
    return lines[inside], densities, 2.0 * max(1.0, _INDEPENDENT_RATIO * segments)


def _amplitudes(
    rec: Recording, test: ProfileControl, names: Sequence[str], start: int, stop: int
) -> tuple[Array, dict[str, Array], float]:
    """Return frequencies, the amplitude of each channel in windows of some periods, and 0."""
    # The phase of the tone is computed from the sweep except for a constant, which does not change the amplitude.
    sweep = rec.scene.test
    assert sweep is not None
    total, samples = round(sweep.shortest * rec.rate), stop - start
    tone = sweep.wave(samples, rec.rate)
    assert isinstance(tone, Chirp)
    end, windows = 0, list[slice]()
    while end < min(samples, total):
        first, end = end, end + round(_PERIODS * observation_samples(float(tone.frequency[end]), rec.rate) / 2.0)
        windows += [slice(first, end)] if end <= samples else []
    if not windows:
        raise RecordingError(f"{rec.path}: the sweep is shorter than {_PERIODS:g} periods. Record a longer sweep.")
    segments = read_slices(rec, names, [(start + window.start, start + window.stop) for window in windows])
    values = np.array([
        abs(estimate_amplitudes(segment, tone.phase[window], rec.rate)[0])
        for window, segment in zip(windows, segments, strict=True)
    ])  # fmt: skip
    frequency = np.array([tone.frequency[(window.start + window.stop) // 2] for window in windows])
    order = np.argsort(frequency)
    values, frequency = values[order], frequency[order]
    factors = (np.sqrt(_power_factor(rec.channels[name], frequency)) for name in names)
    return frequency, {name: row * factor for name, row, factor in zip(names, values.T, factors, strict=True)}, 0.0


def _rms(density: Array, frequency: Array) -> float:
    """Return the root mean square of a density over a band."""
    return float(np.sqrt(np.trapezoid(density, frequency)))


def _finite(rec: Recording, name: str, start: int, stop: int) -> Array:
    """Return samples with lost samples interpolated."""
    samples = rec.read(name, start, min(stop, rec.samples))
    lost = ~np.isfinite(samples)
    if lost.all():
        raise RecordingError(f"{rec.path}: all samples of {name} are lost. Record again.")
    return interpolated(samples, ~lost)


def _power_factor(info: ChannelInfo, frequency: Array) -> Array:
    """Return the square of the ratio of acceleration amplitude to amplitude of a reading."""
    order = 2 - (info.derivative or 0)
    return np.asarray(abs((2.0 * np.pi * frequency) ** order / info.response(frequency)) ** 2)
