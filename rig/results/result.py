"""Base class of all results: a summary in one line, a drawing into given axes, tables for pandas and xarray."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rig.errors import RunError
from rig.escaping import html, shown
from rig.figure_style import plain_logarithmic

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes

# Columns of an empty result.
_NOTHING = (("", np.empty(0)),)


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
            raise missing("pandas") from None
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
            raise missing("xarray") from None
        (index, over), *others = self.columns().items() or _NOTHING
        return xarray.Dataset({name: (index, column) for name, column in others}, {index: over})


def joined(parts: Sequence[Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Join columns end to end."""
    return {name: np.concatenate([part[name] for part in parts]) for part in parts[:1] for name in part}


def styled(style: Mapping[str, Any], **defaults: Any) -> dict[str, Any]:
    """Complete the style that a caller asked for."""
    return defaults | dict(style)


def missing(package: str) -> RunError:
    """Error for a package of an extra that is not installed."""
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
