"""Base class of all results: a summary in one line, a drawing in matplotlib axes, tables for pandas and xarray."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rig.core.base.errors import RunError
from rig.core.base.escaping import escape_html, escape_terminal
from rig.core.base.figure_style import set_log_scale
from rig.core.base.figure_types import Axes
from rig.core.results.table import Table

if TYPE_CHECKING:
    import pandas
    import xarray

# Columns of an empty result.
_NO_COLUMNS = (("", np.empty(0)),)


class Result(ABC):
    """A computed or measured result over one axis.

    A subclass defines its columns, a summary of one line, and how it is drawn.
    """

    @abstractmethod
    def columns(self) -> Mapping[str, NDArray[Any]]:
        """Return the result as columns of equal length, named with their units; the first is the abscissa."""

    @abstractmethod
    def summary(self) -> str:
        """Describe the result in one line."""

    @abstractmethod
    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw into axes and label them; `style` applies to the curves."""

    def table(self) -> Table:
        """Return the table that commands print and notebooks show; by default the range of each column."""
        rows = [(name, _range(np.asarray(column))) for name, column in self.columns().items()]
        return Table(("column", "range"), "<<", rows)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {escape_terminal(self.summary())}>".replace("\n", " ")

    def _repr_html_(self) -> str:
        """Return the summary and the table as HTML for notebooks."""
        return f"<p>{escape_html(repr(self))}</p>{self.table().html()}"

    def plot(self, ax: Axes | None = None, **style: Any) -> Axes:
        """Draw the result.

        Parameters
        ----------
        ax : matplotlib Axes, optional
            Axes to draw into; omitted: new axes of pyplot.
        **style
            Line properties of the curves, as for `Axes.plot`.

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
                set_log_scale(axis)
        if ax.get_legend_handles_labels()[0]:
            ax.legend()
        return ax

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the columns as a pandas table, with the first column as index.

        Raises
        ------
        RunError
            If pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise missing_package("pandas") from None
        (abscissa_name, abscissa), *others = self.columns().items() or _NO_COLUMNS
        return pandas.DataFrame(dict(others), index=pandas.Index(abscissa, name=abscissa_name))

    def to_xarray(self) -> xarray.Dataset:
        """Return the columns as an xarray data set over the first column.

        Raises
        ------
        RunError
            If xarray is not installed.
        """
        try:
            import xarray
        except ImportError:
            raise missing_package("xarray") from None
        (abscissa_name, abscissa), *others = self.columns().items() or _NO_COLUMNS
        return xarray.Dataset({name: (abscissa_name, column) for name, column in others}, {abscissa_name: abscissa})


def join_columns(tables: Sequence[Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Join the columns of tables end to end."""
    return {name: np.concatenate([table[name] for table in tables]) for table in tables[:1] for name in table}


def complete_style(style: Mapping[str, Any], **defaults: Any) -> dict[str, Any]:
    """Return a style, with defaults for properties that it does not specify."""
    return defaults | dict(style)


def missing_package(package: str) -> RunError:
    """Return the error for a package that is not installed; it belongs to the extra `tables`."""
    return RunError(f'{package} is not installed. Run pip install "shotrig[tables]".')


def _range(column: NDArray[Any]) -> str:
    """Describe the values of a column: smallest and largest, or the distinct texts."""
    if not column.size:
        return "empty"
    if column.dtype.kind not in "fciu":
        return ", ".join(dict.fromkeys(map(str, column[:1000])))[:60]
    values = abs(column) if column.dtype.kind == "c" else column
    finite = values[np.isfinite(values)]
    limits = f"{finite.min():.6g} to {finite.max():.6g}" if finite.size else "unknown"
    return f"{'magnitude ' * (column.dtype.kind == 'c')}{limits}"
