"""One mode of a free decay: its envelope, and its damping ratio against amplitude."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import fft

from rig.results import Result, bounded, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
_SAME_MODE = 0.1
# A damping ratio counts when noise leaves it uncertain by less than this part (one standard deviation).
WORST = 0.05
# Levels in nepers: the damping ratio at an amplitude is read off the fall by 6 dB around it, every 1.5 dB.
_HALF = 3.0 / 20.0 * np.log(10.0)
# What the band-pass and the fall do to a damping ratio that changes with amplitude is estimated by doing more of it:
# with a band-pass that smears over so much more time, and over so much more of a fall.
_SMEAR, _FALL = 2.0**0.5, 1.5
# The smear shifts a smooth change by its square and a kink by itself: the difference gives it to this factor.
_SMEAR_SHARE = 2.5
# Where a fall has a kink in its middle, a parabola misses it by an eighth (rms) of what it says too little.
_KINK = 8.0
# A change is felt by so many levels on either side of it.
_FELT = 2
# Points of the envelope that one damping ratio is fitted to, at most.
_POINTS = 64


@dataclass(frozen=True, repr=False)
class ModalDecay(Result):
    """Decay of one mode after band-pass.

    Attributes
    ----------
    frequency, frequency_error : float
        Natural frequency at the amplitude at which it is known best, Hz, and its standard uncertainty: noise, what
        band-pass and fall do, the clock. NaN where no amplitude determines it: it is then the centre.
    centre : float
        Of the band-pass, Hz: the peak in the spectrum.
    time, envelope : ndarray, shape (n,)
        s after the hit; amplitude of the acceleration in m/s².
    noise : float
        Root mean square of what noise adds to the envelope, m/s².
    amplitude : ndarray, shape (levels,)
        Acceleration amplitudes, m/s², falling; only those at which noise limits the damping ratio to
        `WORST`.
    damping, damping_error : ndarray, shape (levels,)
        Damping ratio at those amplitudes, and its standard uncertainty: noise, and half of `damping_smear`.
    damping_smear : ndarray, shape (levels,)
        How far the damping ratio may be off because band-pass and fall take in what it is at amplitudes around.
    natural, natural_error : ndarray, shape (levels,)
        Natural frequency at those amplitudes, Hz, and its standard uncertainty from the same causes.
    """

    frequency: float
    frequency_error: float
    centre: float
    time: Array
    envelope: Array
    noise: float
    amplitude: Array
    damping: Array
    damping_error: Array
    damping_smear: Array
    natural: Array
    natural_error: Array

    def summary(self) -> str:
        """Say which mode, and its damping ratio from the largest amplitude to the smallest."""
        what = f"{self.frequency_text()}, {self.damping.size} amplitudes"
        if not self.damping.size:
            return what
        return (
            f"{what}, damping ratio {100 * self.damping[0]:.3g} % at {self.amplitude[0]:.3g} m/s², "
            f"{100 * self.small_damping():.3g} % at small ones"
        )

    def columns(self) -> dict[str, Array]:
        """Amplitude, damping ratio and natural frequency there, and their standard uncertainties."""
        return {
            "amplitude_m/s²": self.amplitude,
            "damping_ratio": self.damping,
            "damping_ratio_std": self.damping_error,
            "frequency_Hz": self.natural,
            "frequency_std_Hz": self.natural_error,
        }

    def frequency_text(self) -> str:
        """Write the natural frequency with its 95 % bound."""
        return bounded(self.frequency, 2.0 * self.frequency_error, "Hz")

    def draw(self, ax: Axes, **style: Any) -> None:
        """Damping ratio against amplitude, with its 95 % bound."""
        percent, half = 100.0 * self.damping, 200.0 * self.damping_error
        (line,) = ax.semilogx(
            self.amplitude, percent, "o-", **styled(style, ms=3, label=self.frequency_text())
        )
        ax.fill_between(
            self.amplitude, percent - half, percent + half, color=line.get_color(), alpha=0.2, lw=0
        )
        ax.set(xlabel="amplitude / (m/s²)", ylabel="damping ratio / %")

    @property
    def decrement(self) -> Array:
        """Logarithmic decrement at each amplitude: ln of the ratio of successive maxima."""
        return 2.0 * np.pi * self.damping / np.sqrt(1.0 - np.minimum(self.damping, 0.99) ** 2)

    def small_damping(self) -> float:
        """Damping ratio near the end of the decay: median of the lowest third of the amplitudes."""
        return (
            float(np.median(self.damping[-max(1, self.damping.size // 3) :])) if self.damping.size else np.nan
        )

    def at(self, amplitude: float) -> float:
        """Damping ratio at an amplitude, between those measured; NaN outside."""
        if not self.damping.size:
            return float("nan")
        order = np.argsort(self.amplitude)
        return float(
            np.interp(amplitude, self.amplitude[order], self.damping[order], left=np.nan, right=np.nan)
        )


def spectral_peaks(acceleration: Array, rate: float, most: int, low: float, high: float) -> Array:
    """Frequencies of the `most` highest resonances of a decay, in Hz, rising.

    Peaks of the spectrum that stand out by 10 dB from what lies around them and by 20 dB from the median
    of the band, refined by a parabola through the logarithm of three bins.
    """
    size = fft.next_fast_len(4 * acceleration.size, real=True)
    fall = np.cos(np.linspace(0.0, np.pi / 2, acceleration.size)) ** 2
    level = 20.0 * np.log10(abs(fft.rfft(acceleration * fall, size)) + 1e-300)
    frequency = fft.rfftfreq(size, 1.0 / rate)
    inside = (frequency >= low) & (frequency <= high)
    level, frequency = level[inside], frequency[inside]
    where, _ = scipy.signal.find_peaks(level, prominence=10.0, height=float(np.median(level)) + 20.0)
    kept: list[int] = []
    for peak in where[np.argsort(level[where], kind="stable")[::-1]]:
        # Dampers shift a mode as they come to rest; that smears or splits its peak but makes no second mode.
        if all(abs(frequency[peak] / frequency[other] - 1.0) > _SAME_MODE for other in kept):
            kept.append(int(peak))
    where = np.sort(np.array(kept[:most], dtype=int))
    left, mid, right = level[where - 1], level[where], level[where + 1]
    shift = 0.5 * (left - right) / (left - 2.0 * mid + right)
    return frequency[where] + shift * (frequency[1] - frequency[0])


def band_width(frequencies: Array, index: int) -> float:
    """Choose the Gaussian band-pass for one of several modes: its standard deviation in Hz.

    A quarter of the distance to the nearest other mode (the neighbour is then let through at exp(-8) of its
    amplitude), and at most a quarter of the frequency.
    """
    others = np.delete(frequencies, index)
    nearest = np.min(abs(others - frequencies[index])) if others.size else np.inf
    return float(min(nearest, frequencies[index]) / 4.0)


def modal_decay(
    acceleration: Array,
    rate: float,
    frequency: float,
    width: float,
    begin: int,
    amplitudes: Array | None = None,
    clock: float = 0.0,
) -> ModalDecay:
    """Envelope of one mode, and its damping ratio against amplitude.

    A Gaussian band-pass over positive frequencies gives the analytic signal at once; a Gaussian changes an
    exponential decay by a constant factor only, so the slope of the envelope is unbiased from three of its
    widths in time after the hit on. The damping ratio at an amplitude is the slope of the logarithm of the
    envelope while it falls by 6 dB around it, from when it is last above the upper level to when it is last
    above the lower one.

    Parameters
    ----------
    acceleration : ndarray, shape (n,)
        m/s², beginning before the hit.
    rate : float
        Hz.
    frequency, width : float
        Centre and standard deviation of the band-pass, Hz.
    begin : int
        Sample at which the free decay begins.
    amplitudes : ndarray, optional
        Amplitudes in m/s² at which the damping ratio is wanted, NaN where the decay has none; omitted, every
        1.5 dB down to the noise.
    clock : float
        Share of itself by which the rate may be off.
    """
    analytic, edge = _band_passed(acceleration, rate, frequency, width)
    envelope = np.abs(analytic)
    time = (np.arange(acceleration.size) - begin) / rate
    usable = slice(begin + edge, max(acceleration.size - edge, begin + edge))
    noise = _noise(analytic[usable], rate, frequency, width)
    levels = _levels(envelope[usable]) if amplitudes is None else np.log(amplitudes)
    damping, natural, kink = _damping(analytic[usable], levels, _HALF)
    # Half of the noise changes the envelope; at the two levels it is independent.
    amplitude = np.exp(levels)
    relative = np.hypot(np.exp(-_HALF), np.exp(_HALF)) * noise / np.sqrt(2.0) / amplitude / (2.0 * _HALF)
    more, more_edge = _band_passed(acceleration, rate, frequency, width / _SMEAR)
    late = slice(begin + more_edge, max(acceleration.size - more_edge, begin + more_edge))
    smeared, natural_smeared, _ = _damping(more[late], levels, _HALF)
    longer, natural_longer, _ = _damping(analytic[usable], levels, _FALL * _HALF)
    # What noise bends is no kink.
    kink = np.sqrt(np.maximum(kink**2 - (_KINK * np.sqrt(1.5) * noise / amplitude / _HALF) ** 2, 0.0))
    smear = _smear(damping, smeared, longer, kink)
    error = np.hypot(relative * damping, 0.5 * smear)
    # The phase at the two levels is as uncertain as the logarithm of the envelope; between them it turns by much more.
    natural_error = np.hypot(
        np.hypot(relative * damping, 0.5 * clock) * natural,
        0.5 * _natural_smear(natural, natural_smeared, natural_longer),
    )
    good = np.ones(levels.size, dtype=bool)
    if amplitudes is None:
        good = np.isfinite(damping) & (damping > 0) & (relative < WORST)
    turns = rate / (2.0 * np.pi)
    natural, natural_error = turns * natural[good], turns * natural_error[good]
    return ModalDecay(
        *_best(natural, natural_error, frequency), frequency, time[begin:], envelope[begin:], noise,
        amplitude[good], damping[good], error[good], smear[good], natural, natural_error,
    )  # fmt: skip


def _best(natural: Array, error: Array, peak: float) -> tuple[float, float]:
    """Choose the natural frequency that is known best, with its error; the peak in the spectrum where none is.

    A neighbour that is not resolved and decays more slowly has the small amplitudes for itself.
    """
    own = np.flatnonzero(np.isfinite(error) & (abs(natural / peak - 1.0) < _SAME_MODE))
    if not own.size:
        return peak, float("nan")
    best = own[np.argmin(error[own])]
    return float(natural[best]), float(error[best])


def _band_passed(
    acceleration: Array, rate: float, frequency: float, width: float
) -> tuple[ComplexArray, int]:
    """Analytic signal behind a Gaussian band-pass, and the samples over which an end is felt."""
    size = fft.next_fast_len(acceleration.size + int(8 * rate / (2 * np.pi * width)))
    spectrum = fft.fft(acceleration, size)
    bins = fft.fftfreq(size, 1.0 / rate)
    spectrum *= np.where(bins > 0, 2.0 * np.exp(-0.5 * ((bins - frequency) / width) ** 2), 0.0)
    return fft.ifft(spectrum)[: acceleration.size], int(np.ceil(3.0 * rate / (2 * np.pi * width)))


def _noise(analytic: ComplexArray, rate: float, frequency: float, width: float) -> float:
    """Find what noise adds to the envelope, rms: what the end of the decay differs by from an exponential.

    At the end all dampers are at rest and the structure rings linearly; while they are not, their doing
    counts as noise.
    """
    step = max(1, int(rate / (8.0 * width)))
    tail = analytic[-(analytic.size // 4) :][::step]
    if tail.size < 8:
        return 0.0
    t = np.arange(tail.size) * step / rate
    slow = tail * np.exp(-2j * np.pi * frequency * t)
    weight = abs(slow)
    decay, size = np.polyfit(t, np.log(np.maximum(weight, 1e-300)), 1, w=weight)
    turn, angle = np.polyfit(t, np.unwrap(np.angle(slow)), 1, w=weight)
    left = slow - np.exp(decay * t + size + 1j * (turn * t + angle))
    # Four numbers were fitted to as many complex readings as are independent.
    independent = max(t[-1] * np.sqrt(np.pi) * width, 3.0)
    return float(np.sqrt(np.mean(abs(left) ** 2) * independent / (independent - 2.0)))


def _falling(envelope: Array) -> Array:
    """Logarithm of the largest amplitude still to come: falls steadily, so that each level is passed once."""
    return np.log(np.maximum(np.maximum.accumulate(envelope[::-1])[::-1], 1e-300))


def _levels(envelope: Array) -> Array:
    """Logarithms of the amplitudes at which a decay has a damping ratio."""
    if envelope.size < 8 or envelope.max() <= 0:
        return np.empty(0)
    hull = _falling(envelope)
    return np.arange(hull[0] - 1.25 * _HALF, hull[-1] + _HALF, -_HALF / 2.0)


def _damping(analytic: ComplexArray, levels: Array, half: float) -> tuple[Array, Array, Array]:
    """Damping ratios at levels, each from the fall by `half` nepers on either side; NaN where there is none.

    The natural frequency, in radians per sample, is that of the same fall: dampers that come to rest lower it. And the
    part of each damping ratio by which a kink in the fall would let it be off.
    """
    envelope = np.abs(analytic)
    if envelope.size < 8 or envelope.max() <= 0:
        nothing = np.full(levels.size, np.nan)
        return nothing, nothing, np.zeros(levels.size)
    hull = _falling(envelope)
    upper, lower = _passed(hull, levels + half), _passed(hull, levels - half)
    logarithm, phase = np.log(np.maximum(envelope, 1e-300)), np.unwrap(np.angle(analytic))
    place = np.arange(envelope.size)
    turned = np.interp(lower, place, phase) - np.interp(upper, place, phase)
    fits = [_slope(logarithm, a, b, level) for a, b, level in zip(upper, lower, levels, strict=True)]
    fall, rest = np.array(fits).reshape(-1, 2).T
    with np.errstate(divide="ignore", invalid="ignore"):
        natural = np.hypot(turned / (lower - upper), fall)
        return np.asarray(fall / natural), natural, _KINK * rest / half


def _slope(logarithm: Array, first: float, last: float, level: float) -> tuple[float, float]:
    """Rate of fall per sample where a curve passes a level, and what the fit leaves of the curve, rms.

    The fit is a parabola between two places: a straight line would give the mean of a slope that changes. Along
    either beats average out.
    """
    if not (np.isfinite(first) and np.isfinite(last)) or last - first < 4.0:
        return float("nan"), 0.0
    places = np.arange(round(first), round(last) + 1, max(1, int((last - first) / _POINTS)))
    middle, half = 0.5 * (first + last), 0.5 * (last - first)
    along = (places - middle) / half
    bend, slope, value = np.polyfit(along, logarithm[places] - level, 2)
    rest = logarithm[places] - level - (bend * along**2 + slope * along + value)
    # Where the parabola passes the level: one step from where the straight part does.
    at = -value / slope if slope < 0 else 0.0
    steep = slope + 2.0 * bend * at
    if steep < 0:
        at -= (value + slope * at + bend * at**2) / steep
    fall = float(-(slope + 2.0 * bend * float(np.clip(at, -0.5, 0.5))) / half)
    return fall, float(np.sqrt(np.mean(rest**2)))


def _smear(damping: Array, smeared: Array, longer: Array, kink: Array) -> Array:
    """How far damping ratios may be off, from how they change where band-pass and fall take in more."""
    out = np.nan_to_num(kink * damping)
    for other, share in ((smeared, _SMEAR_SHARE), (longer, 1.0)):
        off = abs(other - damping)
        known = np.flatnonzero(np.isfinite(off))
        if known.size:
            # At the ends, where more cannot be taken in, what is known nearest counts.
            out += share * np.interp(np.arange(off.size), known, off[known])
    return np.asarray(scipy.ndimage.maximum_filter1d(out, 2 * _FELT + 1) if out.size else out)


def _natural_smear(natural: Array, smeared: Array, longer: Array) -> Array:
    """How far natural frequencies may be off for band-pass and fall; NaN where one of the effects is undetermined."""
    if not (np.isfinite(smeared - natural).any() and np.isfinite(longer - natural).any()):
        return np.full(natural.size, np.nan)
    return _smear(natural, smeared, longer, np.zeros(natural.size))


def _passed(hull: Array, levels: Array) -> Array:
    """Place, between samples, at which a falling curve passes each level; NaN where it does not."""
    after = hull.size - np.searchsorted(hull[::-1], levels, side="left")
    inside = (after > 0) & (after < hull.size)
    after = np.clip(after, 1, hull.size - 1)
    high, low = hull[after - 1], hull[after]
    part = np.divide(high - levels, high - low, out=np.zeros(levels.shape), where=high > low)
    at_start = levels >= hull[0] - 1e-9
    return np.where(inside, after - 1 + part, np.where(at_start & (levels <= hull[0] + 1e-9), 0.0, np.nan))
