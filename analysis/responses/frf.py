"""Measured frequency responses: values, error bars, coherence and conversions of one, and all of a test together."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray
from scipy import special

from rig.errors import SceneError
from rig.results import Result, bounded, styled
from rig.scene.quantities import FREQUENCY, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from analysis.responses.error_parts import LocalErrors, MeanErrors

# Curves with more points than this are drawn without a dot at each.
DOTS = 120
MOTIONS = ("displacement", "velocity", "acceleration")
_NAMES = {
    ("displacement", "force"): ("compliance", "m/N"),
    ("velocity", "force"): ("mobility", "m/(N s)"),
    ("acceleration", "force"): ("accelerance", "m/(N s²)"),
    ("displacement", "table"): ("transmissibility", "m/m"),
    ("velocity", "table"): ("velocity per table displacement", "1/s"),
    ("acceleration", "table"): ("acceleration per table displacement", "1/s²"),
}

# Points whose bounds are larger than this part of their value are hardly known.
_HARDLY_KNOWN = 0.5
#: Systematic parts of what a data sheet allows a sample clock and sensors to be off by, one figure for a whole test.
CLOCK, SENSITIVITY = "sample clock", "sensors' sensitivity"

# Units in which engineers read a curve: a name, and how many of them make one in SI.
_SHOWN = {"m/N": ("µm/N", 1e6), "m/(N s)": ("mm/(N s)", 1e3)}


@dataclass(frozen=True, repr=False, eq=False)
class Frf(Result):
    """Frequency response of one channel, as measured.

    Attributes
    ----------
    frequency : ndarray, shape (n,)
        Hz, in the order in which the points were measured.
    value : ndarray of complex, shape (n,)
        Response / reference for motion Re(X e^{iwt}): a lagging response has a negative phase.
    error : ndarray, shape (n,)
        Random part: standard deviation of ``abs(value)``, and of either quadrature component; NaN where one
        average alone gives no scatter to estimate it from.
    coherence : ndarray, shape (n,)
        Share of the response that repeats with the reference, 0 to 1.
    degrees : ndarray, shape (n,)
        Degrees of freedom behind `error` (two for each complex average beyond the mean).
    response, reference : str
        Channel of the response; ``"force"`` or ``"table"``.
    motion : str
        ``"displacement"``, ``"velocity"`` or ``"acceleration"`` of the response.
    label : str
        Scene and setting, for legends.
    resolution : float
        Width in Hz over which leakage smears each point: 0 for steady tones, the window's for random, Hann's
        where another program leaves it open.
    unsteady : ndarray of bool, shape (n,), or None
        Where the motion had not become steady; None where that is no question.
    held : ndarray, shape (n,), or None
        Amplitude of the reference that acted at each point, where it is a tone; with dampers the value holds for that
        and no other.
    warnings : tuple of str
        What a reader of the curve must know, in full sentences.
    systematic : mapping of str to ndarray, shape (n,)
        Systematic parts by name: how far each can put the value off at most, however long one averages.
    shared : float
        How many neighbouring points rest on the same samples, so that their errors are one.
    errors : LocalErrors or MeanErrors, optional
        How random errors follow from those of what was read, for covariances with other responses and lines.
    left_out : ndarray, shape (m,)
        Hz: frequencies of the test that have no point, as something spoilt them.
    clock : float
        Largest share by which the sample clock puts all frequencies off; what that does to values is a systematic part.
    scale : float
        Largest share by which the sensor of the reference puts all values off alike, those of other responses to it as
        well; what the sensors' sensitivities do holds it.
    output_at, input_at : str
        Where the response is, and where the reference acts: bodies by their names, or ``body 1``; empty where that is
        not known.
    """

    frequency: NDArray[np.float64]
    value: NDArray[np.complex128]
    error: NDArray[np.float64]
    coherence: NDArray[np.float64]
    degrees: NDArray[np.float64]
    response: str
    reference: str = "force"
    motion: str = "displacement"
    label: str = ""
    resolution: float = 0.0
    warnings: tuple[str, ...] = ()
    systematic: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    unsteady: NDArray[np.bool_] | None = None
    held: NDArray[np.float64] | None = None
    shared: float = 1.0
    errors: LocalErrors | MeanErrors | None = None
    left_out: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    clock: float = 0.0
    scale: float = 0.0
    output_at: str = ""
    input_at: str = ""

    @property
    def input(self) -> str:
        """What the response is divided by and where it acts: ``force at body 1``."""
        return f"{self.reference} at {self.input_at}" if self.input_at else self.reference

    @property
    def ratio(self) -> str:
        """Output and input: ``arm / force at base``."""
        return f"{self.response} / {self.input}"

    @property
    def is_driving_point(self) -> bool:
        """Whether the response is where the force acts, and along it."""
        return self.reference == "force" and bool(self.input_at) and self.output_at == self.input_at

    @property
    def name(self) -> str:
        """Name of the ratio: compliance, mobility, accelerance, transmissibility."""
        return _NAMES[self.motion, self.reference][0]

    @property
    def unit(self) -> str:
        """Unit of `value` and `error`."""
        return _NAMES[self.motion, self.reference][1]

    @property
    def shown_in(self) -> tuple[str, float]:
        """Unit in which the curve is drawn and printed, and how many of it make one of `unit`."""
        return _SHOWN.get(self.unit, (self.unit, 1.0))

    def summary(self) -> str:
        """Say which ratio this is, between which frequencies, its highest point and what bounds that."""
        what = f"{self.label}, {self.ratio}: {self.name}, {self.frequency.size} points"
        if not np.isfinite(self.value).any():
            return what
        size, (unit, factor) = abs(self.value), self.shown_in
        # What is hardly known is no peak, as at low frequencies, where noise is divided by their square.
        known = ~(self.bound() > _HARDLY_KNOWN * size)
        top = int(np.nanargmax(np.where(known, size, np.nan) if np.isfinite(size[known]).any() else size))
        bound, tallest = float(self.bound()[top]), int(np.nanargmax(size))
        height = f"{factor * abs(self.value[top]):.4g} {unit}"
        if bound > 0.0:
            height = bounded(factor * float(abs(self.value[top])), factor * bound, unit)
        what_of_it = "largest contribution" if np.isfinite(bound) else "unbounded by"
        mostly = f"; {what_of_it}: {self.parts()[top]}" if bound > 0.0 else ""
        under = ""
        if self.held is not None and self.reference == "force":
            under = f" under {self.held[top]:.4g} N"
        return (
            f"{what}, {self.frequency.min():.4g} to {self.frequency.max():.4g} Hz, highest {height} "
            f"at {self.frequency[top]:.4g} Hz{under}{mostly}{'' if tallest == top else self._hardly_known(tallest)}"
        )

    def _hardly_known(self, point: int) -> str:
        """Describe a higher point that is too uncertain to be the peak."""
        (unit, factor), bound = self.shown_in, float(self.bound()[point])
        far = f"{bound / abs(self.value[point]):.0%}" if np.isfinite(bound) else "unbounded"
        return (
            f"; ignored as too uncertain: {factor * abs(self.value[point]):.4g} {unit} at "
            f"{self.frequency[point]:.4g} Hz (uncertainty {far}, {self.parts()[point]})"
        )

    def parts(self) -> list[str]:
        """Name the largest part of the bound at each point: ``"scatter"`` or one of `systematic`."""
        names = ("scatter", *self.systematic)
        sizes = np.nan_to_num([self.random_bound(), *self.systematic.values()], posinf=np.inf)
        return [names[index] for index in np.argmax(sizes, axis=0)]

    def columns(self) -> dict[str, NDArray[Any]]:
        """Frequency, value, and how far it may be off with 95 % confidence."""
        return {
            "frequency_Hz": self.frequency,
            f"value_{self.unit}": self.value,
            f"bound_{self.unit}": self.bound(),
            "coherence": self.coherence,
        }

    def draw(self, ax: Axes, **style: Any) -> None:
        """Magnitude with its 95 % bound, both axes logarithmic."""
        curve, (unit, factor) = self.with_gaps(), self.shown_in
        size, bound = factor * abs(curve.value), factor * np.nan_to_num(curve.bound())
        (line,) = ax.loglog(
            curve.frequency,
            size,
            **styled(
                style,
                label=f"{self.label} {self.response}".strip(),
                marker="o" if size.size <= DOTS else None,
                ms=2.5,
            ),
        )
        low = np.maximum(size - bound, 1e-3 * size)
        ax.fill_between(curve.frequency, low, size + bound, color=line.get_color(), alpha=0.2, lw=0)
        ax.set(xlabel="frequency / Hz", ylabel=f"|{self.name}| / ({unit})")

    def to(self, motion: str) -> Frf:
        """Express the same measurement as displacement, velocity or acceleration per reference.

        Examples
        --------
        >>> one = np.ones(1)
        >>> frf = Frf(one * 10, one * 1e-3j, one * 1e-6, one, one * 38, "body3")
        >>> print(frf.to("velocity").name, f"{frf.to('velocity').value[0].real:.6f}")
        mobility -0.062832
        """
        if motion not in MOTIONS:
            raise SceneError(f"unknown motion {motion!r}: expected {', '.join(MOTIONS)}")
        s = 2j * np.pi * self.frequency
        factor = s ** (MOTIONS.index(motion) - MOTIONS.index(self.motion))
        size = abs(factor)
        return replace(
            self,
            value=self.value * factor,
            error=self.error * size,
            systematic={name: part * size for name, part in self.systematic.items()},
            errors=None if self.errors is None else self.errors.scaled(np.asarray(factor, dtype=complex)),
            motion=motion,
        )

    def bound(self, confidence: float = 0.95) -> NDArray[np.float64]:
        """Radius of the circle in the complex plane that holds the true value with the given confidence.

        The random radius and the systematic parts have nothing to do with each other: their squares add up. What data
        sheets allow comes on top, as clock and sensors of a test may well be off by all of it. Infinite where a part
        is: there nothing is claimed.
        """
        return np.hypot(self.random_bound(confidence), self._uncertain()) + self._allowed()

    def systematic_bound(self) -> NDArray[np.float64]:
        """Root of the sum of squares of the parts, each of which has a cause of its own, and what data sheets allow."""
        return self._uncertain() + self._allowed()

    def _uncertain(self) -> NDArray[np.float64]:
        parts = [part for name, part in self.systematic.items() if name not in (CLOCK, SENSITIVITY)]
        return np.asarray(np.linalg.norm([np.zeros(self.value.size), *parts], axis=0))

    def _allowed(self) -> NDArray[np.float64]:
        parts = [self.systematic[name] for name in (CLOCK, SENSITIVITY) if name in self.systematic]
        return np.asarray(np.sum([np.zeros(self.value.size), *parts], axis=0))

    def random_bound(self, confidence: float = 0.95) -> NDArray[np.float64]:
        """Radius of the circle that holds the mean of many such measurements with the given confidence.

        A complex mean with equal, independent errors in its two components is F-distributed about the
        truth with 2 and `degrees` degrees of freedom [1]_.

        References
        ----------
        .. [1] J. S. Bendat, A. G. Piersol, Random Data, 4th ed., Wiley 2010, section 9.2.
        """
        return self.error * radius(confidence, self.degrees)

    def band(self, confidence: float = 0.95) -> NDArray[np.float64]:
        """Half-width of the confidence interval of ``abs(value)`` for the random part, from Student's t."""
        return self.error * special.stdtrit(np.maximum(self.degrees, 1.0), 0.5 + confidence / 2.0)

    def sorted(self) -> Frf:
        """Return the same curve with rising frequency."""
        return self.at(np.argsort(self.frequency, kind="stable"))

    def with_gaps(self) -> Frf:
        """Return the same curve with rising frequency and NaN where points were left out: a line breaks there."""
        curve = self.sorted()
        places = np.searchsorted(curve.frequency, np.sort(self.left_out))

        def broken(column: NDArray[Any], value: float = np.nan) -> NDArray[Any]:
            return np.insert(column, places, value)

        return replace(
            curve,
            frequency=np.insert(curve.frequency, places, np.sort(self.left_out)),
            value=broken(curve.value),
            error=broken(curve.error),
            coherence=broken(curve.coherence),
            degrees=broken(curve.degrees, 0.0),
            systematic={name: broken(part) for name, part in curve.systematic.items()},
            errors=None,
            unsteady=None if curve.unsteady is None else broken(curve.unsteady, False),
            held=None if curve.held is None else broken(curve.held),
        )

    def between(self, low: float | str, high: float | str) -> Frf:
        """Keep the points from `low` to `high`, in Hz or as texts with their unit."""
        first, last = number(low, FREQUENCY, "low"), number(high, FREQUENCY, "high")
        return self.at((self.frequency >= first) & (self.frequency <= last))

    def at(self, points: NDArray[np.bool_] | NDArray[np.intp]) -> Frf:
        """Keep some points."""
        return replace(
            self,
            frequency=self.frequency[points],
            value=self.value[points],
            error=self.error[points],
            coherence=self.coherence[points],
            degrees=self.degrees[points],
            systematic={name: part[points] for name, part in self.systematic.items()},
            unsteady=None if self.unsteady is None else self.unsteady[points],
            held=None if self.held is None else self.held[points],
            errors=None if self.errors is None else self.errors.at(points),
        )


class FrfSet(Result, Sequence[Frf]):
    """Frequency responses measured together, by number or by the name of their channel.

    Parameters
    ----------
    curves : iterable of Frf
        At the same frequencies.
    """

    def __init__(self, curves: Iterable[Frf]) -> None:
        self._curves = tuple(curves)

    def __len__(self) -> int:
        return len(self._curves)

    @overload
    def __getitem__(self, which: int | str) -> Frf: ...
    @overload
    def __getitem__(self, which: slice) -> FrfSet: ...
    def __getitem__(self, which: int | str | slice) -> Frf | FrfSet:
        """Give one by its number or channel, or some of them."""
        if isinstance(which, str):
            return self._named(which)
        return FrfSet(self._curves[which]) if isinstance(which, slice) else self._curves[which]

    def keys(self) -> tuple[str, ...]:
        """List the channels of the responses, by which they are chosen."""
        return tuple(curve.response for curve in self._curves)

    def _named(self, name: str) -> Frf:
        """Give the response of a channel, or of the only one at a place."""
        fitting = [curve for curve in self._curves if curve.response == name]
        fitting = fitting or [
            curve for curve in self._curves if curve.output_at == name.removeprefix("body ")
        ]
        fitting = fitting or [curve for curve in self._curves if curve.output_at == name]
        if len(fitting) == 1:
            return fitting[0]
        if fitting:
            channels = " or ".join(curve.response for curve in fitting)
            raise SceneError(
                f"{len(fitting)} responses are at {name}; expected one of them by its channel, {channels}"
            )
        near = get_close_matches(name, [*self.keys(), *(curve.output_at for curve in self._curves)], n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(self.keys())}"
        raise SceneError(f"no response {name!r}; {hint}")

    def summary(self) -> str:
        """Say which they are."""
        first = self._curves[0]
        return (
            f"{first.label}: {first.name} of {', '.join(curve.response for curve in self._curves)}, "
            f"{first.frequency.size} points, {first.frequency.min():.4g} to {first.frequency.max():.4g} Hz"
        )

    def columns(self) -> dict[str, NDArray[Any]]:
        """Frequency; value and 95 % bound of each."""
        found: dict[str, NDArray[Any]] = {"frequency_Hz": self._curves[0].frequency}
        for curve in self._curves:
            found[f"{curve.response}_{curve.unit}"] = curve.value
            found[f"{curve.response}_bound_{curve.unit}"] = curve.bound()
        return found

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw all into one."""
        for curve in self._curves:
            curve.draw(ax, **styled(style, label=curve.response))


def radius(confidence: float, degrees: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radius of `Frf.random_bound` in standard deviations."""
    return np.asarray(np.sqrt(2.0 * special.fdtri(2.0, np.maximum(degrees, 1.0), confidence)))
