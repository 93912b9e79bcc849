"""How a channel reads a jump of its body's velocity, and the filters that look for that in its samples."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from analysis.responses.frf import MOTIONS

if TYPE_CHECKING:
    from analysis.damper_motion.landing_pulse import Pulse
    from daq.signal_chain.channel import ChannelInfo

Array = NDArray[np.float64]

# Samples on either side of a jump that determine the motion before and after it: in acceleration, and in
# integrated channels so much time as well, s.
_SIDE, _SIDE_TIME = 6, 1e-3
# A jump is looked for so many samples before and after the middle of the window.
SHIFT = 4
# Instants within a sample: enough that a resonance turns by less than this between two, rad; and no fewer.
_TURN, _FEWEST = 0.5, 8
_FINER = 8
# Poles faster than this part of the sample rate, rad per sample, shape a jump; slower ones only bend what
# follows.
_FAST = 0.3
# Decay times of a resonance until nothing is left of a jump, and those looked at.
_GONE, _LOOK = 14.0, 3.0
# A decimation filter rings so many samples to either side, and is looked at over so many.
_FILTER_GONE, _FILTER_LOOK = 40, 12
# Singular values of the filters below this part of the largest are rounding.
_RANK_TOLERANCE = 1e-12


@dataclass(frozen=True)
class Signature:
    """Readings of a jump of velocity, a step of acceleration and a kink of it, and how they are fitted.

    All is done on differences of the readings, of such an order that everything about a jump is short: two
    more than the channel integrates. The differences are only bookkeeping; the fit is least squares in
    the readings themselves, whose noise is white.
    """

    difference: int  # Order of the differences
    instants: int
    """Resolved instants within a sample."""
    coarse: int
    """Every so many of them suffice to find a jump; all of them to take it out."""
    filters: Array
    """Applied to a window of differences they give independent coordinates of unit noise per unit noise of
    the readings: kink, step without the kink's part, jump without both; a polynomial is taken off before. Row
    g stands for a jump (g + 1/2) / instants - SHIFT samples after the window's sample 0. Shape (2 SHIFT
    instants, 3, window)."""
    triangles: Array
    """Upper triangular; turns sizes (kink, step, jump) into those coordinates; shape (2 SHIFT instants, 3,
    3)."""
    window_start: int
    """Place of the window's first difference against its sample 0."""
    shapes: Array
    """Differences of unit jump, step and kink; shape (2 SHIFT instants, 3, length)."""
    shape_start: int
    """Place of their first one against sample 0."""
    curvature: int
    """Order of the polynomial that a window's smooth motion follows, in the readings."""
    lasts: int
    """Samples until a jump has come about; 0: at once."""

    @cached_property
    def scan_space(self) -> tuple[Array, Array]:
        """Orthonormal basis of the jump filters that suffice to find a jump, and their weights on it.

        Shapes (rank, window) and (filters, rank): a few dozen filters have a rank of about ten to rounding.
        """
        first = SHIFT * self.instants + self.coarse // 2
        filters = self.filters[first : first + self.instants : self.coarse, 2]
        left, singular, basis = np.linalg.svd(filters, full_matrices=False)
        rank = int(np.sum(singular > _RANK_TOLERANCE * singular[0]))
        return np.ascontiguousarray(basis[:rank]), left[:, :rank] * singular[:rank]

    def background(self, length: int) -> int:
        """Order of the polynomial that the smooth motion follows over so many differences."""
        return self.curvature + max(0, (self.curvature - 1) * (length - self.window) // self.window)

    @property
    def window(self) -> int:
        """Differences looked at at a time."""
        return int(self.filters.shape[-1])

    @property
    def reach(self) -> int:
        """Samples that two jumps must be apart not to be taken for one."""
        return self.window + self.difference

    @property
    def ring(self) -> int:
        """Samples until nothing is left of a jump."""
        return int(self.shapes.shape[-1])

    @property
    def gain(self) -> float:
        """Standard deviation of a jump in m/s per unit noise of the readings, at the worst instant."""
        middle = slice(SHIFT * self.instants, (SHIFT + 1) * self.instants)
        return float(1.0 / abs(self.triangles[middle, 2, 2]).min())


def signature(
    info: ChannelInfo, curvature: int = 2, pulse: Pulse | None = None, together: int = 1
) -> Signature:
    """Work out how a channel reads a jump, from its data sheet.

    Parameters
    ----------
    info : daq.signal_chain.channel.ChannelInfo
        Channel of acceleration, velocity or displacement.
    curvature : int
        Order of the polynomial that the acceleration around a jump is let to follow beside step and kink.
    pulse : Pulse, optional
        How jump, step and kink come about where they take their time: the wall passes all of them on as it does the
        jump. None: at once.
    together : int
        Samples whose mean is a reading.
    """
    integrations, rate = 2 - MOTIONS.index(info.quantity), info.rate / together
    # Behind a decimation filter nothing beyond half the sample rate rings.
    fastest = np.pi * info.rate if info.filter else np.inf
    fast = [pole for pole in info.poles if _FAST * rate < abs(pole) < fastest]
    turning = max((abs(pole.imag) for pole in fast), default=0.0) / rate if pulse is None else 0.0
    ringing = max((-rate / pole.real for pole in fast), default=0.0)
    lasts = 0 if pulse is None else int(np.ceil(pulse.duration * rate))
    # A reading that changes within an instant is smeared: by a resonance most, by the filter's main lobe little.
    coarse = _FINER if turning else 4 if info.filter and together == 1 else 1
    instants = max(_FEWEST, int(np.ceil(turning / _TURN))) * coarse
    side = _SIDE if integrations == 0 else max(_SIDE, round(_SIDE_TIME * rate))
    look = int(np.ceil(_FILTER_LOOK / together)) if info.filter else 0
    before = SHIFT + side + look
    after = SHIFT + side + integrations + look + lasts + int(np.ceil(min(_LOOK * ringing, 4 * side)))
    extra = int(np.ceil(_FILTER_GONE / together)) if info.filter else 2
    gone = after + int(np.ceil(_GONE * ringing)) + extra
    readings = _readings(info, integrations, instants, before + extra, gone, pulse, together)
    shapes = np.diff(readings, 2, axis=-1) / rate**integrations
    inside = readings[..., extra : extra + before + after]
    filters, triangles = _fit(inside, integrations, curvature, rate)
    return Signature(
        difference=integrations + 2,
        instants=instants,
        coarse=coarse,
        filters=filters,
        triangles=triangles,
        window_start=3 - before,
        shapes=shapes,
        shape_start=3 - before - extra,
        curvature=curvature + integrations,
        lasts=lasts,
    )


def _readings(
    info: ChannelInfo,
    integrations: int,
    instants: int,
    before: int,
    after: int,
    pulse: Pulse | None,
    together: int,
) -> Array:
    """Accelerations read, samples 1 - before to after, for unit jump, step and kink at each instant."""
    rate = info.rate / together
    size = 2 * fft.next_fast_len(before + after + 2 * SHIFT + 2)
    frequency = fft.rfftfreq(size * instants, 1.0 / (rate * instants))
    with np.errstate(divide="ignore", invalid="ignore"):
        response = replace(info, average=False, delay=0.0).response(frequency)
    # High passes take away the mean in the long run; for the moments around a jump there are none.
    response[0] = 1.0
    if info.filter:
        # Nothing gets through there, and the filter's response is tabulated no further than this.
        response[frequency > info.rate] = 0.0
    if pulse is not None:
        # What comes about within half an instant on either side of each.
        ends = (np.arange(size * instants + 1) - 0.5) / (rate * instants)
        response *= fft.rfft(np.diff(pulse.exchanged(ends)))
    boxes = integrations + int(info.average)
    if not info.average:
        # Means of averages are averages over longer; of samples at instants, sums.
        late = np.exp(-2j * np.pi * np.outer(np.arange(together), frequency) / info.rate)
        response *= late.mean(axis=0)
    # Half an instant for each average that is not taken: the sums below run over whole instants.
    response *= np.exp(2j * np.pi * frequency * 0.5 * (1 - boxes) / (rate * instants))
    fine = fft.irfft(response, size * instants) * rate * instants
    for _ in range(boxes):
        total = np.cumsum(np.concatenate([fine[-instants:], fine]))
        fine = (total[instants:] - total[:-instants]) / instants
    fine = np.roll(fine, (before + SHIFT) * instants)
    step = (np.cumsum(fine) - 0.5 * fine) / (rate * instants)
    kink = (np.cumsum(step) - 0.5 * step) / (rate * instants)
    instant = np.arange(-SHIFT * instants, SHIFT * instants)
    sample = np.arange(1 - before, after + 1)
    place = (before + SHIFT + sample) * instants - instant[:, None] - 1
    return np.stack([part[place] for part in (fine, step, kink)], axis=1)


def _fit(readings: Array, integrations: int, curvature: int, rate: float) -> tuple[Array, Array]:
    """Least squares in the readings, written for their differences."""
    shape = (*readings.shape[:-1], integrations)
    rows = np.concatenate([np.zeros(shape), readings], axis=-1)
    for _ in range(integrations):
        rows = np.cumsum(rows, axis=-1) / rate
    length = rows.shape[-1]
    smooth = np.polynomial.legendre.legvander(np.linspace(-1.0, 1.0, length), curvature + integrations)
    smooth, _ = np.linalg.qr(smooth)
    columns = np.swapaxes(rows[:, ::-1], 1, 2)
    # Twice: once leaves rounding of the polynomials, which are much larger than what is looked for.
    for _ in range(2):
        columns = columns - smooth @ (smooth.T @ columns)
    basis, triangles = np.linalg.qr(columns)
    filters = np.swapaxes(basis, 1, 2)
    for _ in range(integrations + 2):
        filters = -np.cumsum(filters, axis=-1)[..., :-1]
    return np.ascontiguousarray(filters), triangles
