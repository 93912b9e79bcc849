"""What results have in common: a line about them, a drawing into given axes, tables for pandas and xarray."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from math import floor, isfinite, log10
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rig.errors import RunError
from rig.escaping import html, shown
from rig.figure_style import plain_logarithmic
from rig.numerics.runs import runs_of

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes

# The columns of what found nothing.
_NOTHING = (("", np.empty(0)),)
# More ranges than these nobody reads.
_MOST_RANGES = 8


def plainly(value: float) -> str:
    """Three figures, without a power of ten for what is neither tiny nor huge.

    Examples
    --------
    >>> [plainly(value) for value in (2.6, 3000.0, 12345.6, 1.5e-7)]
    ['2.6', '3000', '12300', '1.5e-07']
    """
    return f"{float(f'{value:.3g}'):.10g}"


class Result(ABC):
    """Something computed or measured, over one axis.

    A subclass defines its columns, a summary of one line, and how it is drawn.
    """

    @abstractmethod
    def columns(self) -> Mapping[str, NDArray[Any]]:
        """Give the result as columns of one length, named with their units; the first is what the others are over."""

    @abstractmethod
    def summary(self) -> str:
        """Say in a line what this is."""

    @abstractmethod
    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw into axes, label them; `style` goes to the curves."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {shown(self.summary())}>".replace("\n", " ")

    def _repr_html_(self) -> str:
        """Show the line and the range of each column, as notebooks do."""
        rows = "".join(
            f"<tr><td>{html(name)}</td><td>{html(_range(np.asarray(column)))}</td></tr>"
            for name, column in self.columns().items()
        )
        return f"<p>{html(repr(self))}</p><table>{rows}</table>"

    def plot(self, ax: Axes | None = None, **style: Any) -> Axes:
        """Draw it.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Where to; omitted, new ones of pyplot.
        **style
            For the curves, as `Axes.plot` takes it.

        Returns
        -------
        matplotlib Axes
        """
        if ax is None:
            import matplotlib.pyplot as plt

            ax = plt.subplots(layout="constrained")[1]
        self.draw(ax, **style)
        for axis in (ax.xaxis, ax.yaxis):
            if axis.get_scale() == "log":
                plain_logarithmic(axis)
        if ax.get_legend_handles_labels()[0]:
            ax.legend()
        return ax

    def to_dataframe(self) -> pandas.DataFrame:
        """Give the columns as a pandas table, the first one as its index.

        Raises
        ------
        RunError
            If pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise _missing("pandas") from None
        (index, over), *others = self.columns().items() or _NOTHING
        return pandas.DataFrame(dict(others), index=pandas.Index(over, name=index))

    def to_xarray(self) -> xarray.Dataset:
        """Give the columns as an xarray data set over the first one.

        Raises
        ------
        RunError
            If xarray is not installed.
        """
        try:
            import xarray
        except ImportError:
            raise _missing("xarray") from None
        (index, over), *others = self.columns().items() or _NOTHING
        return xarray.Dataset({name: (index, column) for name, column in others}, {index: over})


def rounded(value: float, bound: float) -> str:
    """Write a number with no more digits than its bound leaves it: to the bound's second one.

    Examples
    --------
    >>> rounded(0.0123456, 0.00021), rounded(1078.4, 134.0), rounded(3.14159, 0.0)
    ('0.01235', '1078', '3.142')
    """
    if not isfinite(bound) or bound <= 0.0:
        return f"{value:.4g}"
    return f"{value:.{min(max(1 - floor(log10(bound)), 0), 9)}f}"


def bounded(value: float, bound: float, unit: str) -> str:
    """Write a number with its bound and unit, in brackets so that the bound of a percentage is no share of it.

    Examples
    --------
    >>> bounded(2.4213, 0.204, "%"), bounded(935.21, float("inf"), "µm/N")
    ('(2.42 ± 0.20) %', '935.2 µm/N (no bound)')
    """
    if not isfinite(bound):
        return f"{rounded(value, bound)} {unit} (no bound)"
    return f"({rounded(value, bound)} ± {rounded(bound, bound)}) {unit}"


def frequency_ranges(frequencies: Sequence[float], chosen: Sequence[bool]) -> str:
    """Write which of some frequencies in Hz are chosen, neighbours as ranges; of many ranges how many, and the ends.

    >>> frequency_ranges([10.0, 11.0, 12.5, 14.0, 20.0], [True, False, True, True, True])
    '10 and 12.5 to 20 Hz'
    >>> frequency_ranges([3.0, 1.0, 3.0], [False, True, True])
    '1 to 3 Hz'
    >>> frequency_ranges(range(40), [k % 2 == 0 for k in range(40)])
    '20 of 40 frequencies from 0 to 38 Hz'
    """
    places, of = np.unique(np.asarray(frequencies, dtype=np.float64), return_inverse=True)
    flags = np.zeros(places.size, dtype=bool)
    flags[of[np.asarray(chosen, dtype=bool)]] = True
    ends = [(f"{places[first]:.4g}", f"{places[stop - 1]:.4g}") for first, stop in runs_of(flags)]
    if len(ends) > _MOST_RANGES:
        return f"{flags.sum()} of {flags.size} frequencies from {ends[0][0]} to {ends[-1][1]} Hz"
    *before, last = [low if low == high else f"{low} to {high}" for low, high in ends]
    return f"{', '.join(before)} and {last} Hz" if before else f"{last} Hz"


def joined(parts: Sequence[Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Join columns end to end."""
    return {name: np.concatenate([part[name] for part in parts]) for part in parts[:1] for name in part}


def styled(style: Mapping[str, Any], **defaults: Any) -> dict[str, Any]:
    """Complete the style that a caller asked for."""
    return defaults | dict(style)


def _missing(package: str) -> RunError:
    return RunError(f'{package} is not installed; to install it: pip install "shotrig[tables]"')


def _range(column: NDArray[Any]) -> str:
    if not column.size:
        return "empty"
    if column.dtype.kind not in "fciu":
        return ", ".join(dict.fromkeys(map(str, column[:1000])))[:60]
    size = abs(column) if column.dtype.kind == "c" else column
    known = size[np.isfinite(size)]
    ends = f"{known.min():.6g} to {known.max():.6g}" if known.size else "unknown"
    return f"{'magnitude ' * (column.dtype.kind == 'c')}{ends}"
