"""Hammer impacts."""

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.base.roots import bracketed_root
from rig.core.scene.body_names import body_problems
from rig.core.scene.excitation.kind import Count, Duration, KindOfTest, Pulses, Start
from rig.core.scene.shaker import Body
from rig.core.settings.problems import Problem
from rig.core.settings.quantities import FORCE, RATIO
from rig.core.settings.quantity_field import Quantity
from rig.core.settings.settings import Settings


class DoubleHit(Settings):
    """Double impact: the hammer rebounds, and a second pulse follows."""

    hits: tuple[Count, ...] | None = Field(None, min_length=1)
    """Numbers of the impacts after which the hammer rebounds, from 1; None: all."""
    after: Duration = 20e-3
    """Time from the start of the first pulse to the start of the second [s]."""
    ratio: Annotated[float, Quantity(RATIO, above=0.0)] = 0.4
    """Peak of the second pulse over the peak of the first pulse."""


class Impulse(KindOfTest):
    """Hammer impacts: half-sine pulses of force on a body."""

    kind: Literal["impulse"] = "impulse"
    recorded_as: ClassVar = "hits"
    level_keys: ClassVar = ("peak",)
    uses_shaker: ClassVar = False
    start: Start = "settled"
    body: Body
    """The body on which the hammer acts, by its number from 1 or its name."""
    peak: Annotated[float | tuple[float, ...], Quantity(FORCE, above=0.0, listed=True)]
    """Peak force of the pulse [N], or a list with a peak for each impact."""
    width: Duration
    """Pulse duration: duration of the half sine [s]; a softer tip makes it longer."""
    repeats: Count = 1
    """Number of impacts."""
    interval: Duration = 6.0
    """Time from one impact to the next, and recording time after the last [s]."""
    double_hit: DoubleHit | None = None
    """Double impacts: the hammer rebounds, and a second pulse follows; None: single impacts only."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check that pulses do not overlap."""
        if self.width >= self.interval:
            yield Problem(
                ("width",),
                f"got {self.width:g} s, which is not shorter than the interval between impacts, {self.interval:g} s. "
                "Give a shorter width or a longer interval.",
            )
        if isinstance(self.peak, tuple) and len(self.peak) != self.repeats:
            message = f"got {len(self.peak)} values; expected {self.repeats}, one for each impact (repeats)"
            yield Problem(("peak",), message)
        if self.double_hit is None:
            return
        if self.double_hit.after < self.width or self.double_hit.after + self.width >= self.interval:
            yield Problem(
                ("double_hit", "after"),
                f"got {self.double_hit.after:g} s, but the second pulse must lie between the first pulse and the next "
                f"impact. Give at least {self.width:g} s and less than {self.interval - self.width:g} s, or a longer "
                "interval.",
            )
        for k, hit in enumerate(self.double_hit.hits or ()):
            if hit > self.repeats:
                yield Problem(
                    ("double_hit", "hits", k),
                    f"impact {hit} does not exist; expected at most {self.repeats}, the number of repeats",
                )

    @property
    def hammer(self) -> int:
        """Number of the body on which the hammer acts, from 1."""
        return self.body

    @property
    def details(self) -> tuple[str, ...]:
        """Number and duration of the impacts."""
        return (f"{self.repeats} impact{'s' * (self.repeats != 1)} of {1e3 * self.width:.3g} ms",)

    @property
    def shortest(self) -> float:
        """Duration of all impacts with their intervals [s]."""
        return self.repeats * self.interval

    @property
    def simulated(self) -> float:
        """Duration of all impacts with their intervals [s]."""
        return self.shortest

    @property
    def peaks(self) -> tuple[float, ...]:
        """Peak of each impact [N]."""
        return self.peak if isinstance(self.peak, tuple) else (self.peak,) * self.repeats

    def at_level(self, level: float) -> Self:
        """Return the test with a different highest peak [N] and the same ratios of the peaks."""
        if not isinstance(self.peak, tuple):
            return self.replace(peak=level)
        return self.replace(peak=tuple(peak * (level / max(self.peak)) for peak in self.peak))

    def is_double(self, hit: int) -> bool:
        """Return whether the hammer rebounds and hits again after an impact; `hit`: its number, from 1."""
        return self.double_hit is not None and (self.double_hit.hits is None or hit in self.double_hit.hits)

    def pulses(self, rate: float) -> list[Array]:
        """Return the force of each impact with its second pulse [N] from the first sample of the impact; `rate`: Hz."""
        shape = half_sine(1.0, self.width, rate)

        def pulse(peak: float, is_double: bool) -> Array:
            if self.double_hit is None or not is_double:
                return peak * shape
            delay = max(1, round(self.double_hit.after * rate))
            double = np.zeros(delay + shape.size)
            double[: shape.size] += peak * shape
            double[delay:] += (peak * self.double_hit.ratio) * shape
            return double

        hits = [(peak, self.is_double(hit)) for hit, peak in enumerate(self.peaks, 1)]
        # Equal pulses share their memory.
        pulses = {hit: pulse(*hit) for hit in dict.fromkeys(hits)}
        return [pulses[hit] for hit in hits]

    def wave(self, samples: int, rate: float) -> Pulses:
        """Return the force of all impacts [N]; the first impact begins at t = 0."""
        force, interval = np.zeros(samples), max(1, round(self.interval * rate))
        for first, pulse in zip(range(0, samples, interval), self.pulses(rate), strict=False):
            force[first : first + pulse.size] = pulse[: samples - first]
        return Pulses("hammer", force)

    def references(self, valid: Mapping[str, Any]) -> Iterable[Problem]:
        """Check that the body of the impacts exists."""
        return body_problems(valid, self.body, ("body",))


def half_sine(peak: float, width: float, rate: float) -> Array:
    """Return samples of a half-sine pulse, N, whose linear interpolation has the requested peak and impulse.

    `peak`: N; `width`: s; `rate`: Hz. Linear interpolation reduces the area of a sampled half sine; the pulse is
    therefore longer than `width`. One sample is at the peak.

    >>> pulse = half_sine(50.0, 4e-3, 5120.0)
    >>> float(pulse.max()), float(round(pulse.sum() / 5120.0 / (50.0 * 4e-3 * 2 / np.pi), 9))
    (50.0, 1.0)
    """
    target_sum = 2 * width * rate / np.pi  # area of the pulse divided by its peak, in samples
    # A width of two samples gives 4 / pi = 1.27; the limit 1.2 accepts the width of the message, rounded to 3 digits.
    if target_sum < 1.2:
        raise SceneError(
            f"test.width: a pulse of {width * 1e3:g} ms is shorter than two samples at {rate:g} Hz; expected at least "
            f"{2.0 / rate * 1e3:.3g} ms. Widen the pulse (a softer tip) or raise the sample rate (converter.rate)."
        )

    def pulse(length: float) -> Array:
        """Sample a half sine with a peak of 1 and a length in samples."""
        half = int(np.ceil(length / 2))
        offset = np.arange(-half, half + 1)
        return np.where(abs(offset) < length / 2, np.cos(np.pi * offset / length), 0.0)

    longest = 2.0 * width * rate + 4.0
    length = bracketed_root(lambda samples: float(pulse(samples).sum()) - target_sum, 1.0, longest, 1e-13)
    return peak * pulse(length)
