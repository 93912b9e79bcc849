"""Types of matplotlib for annotations; matplotlib itself is imported when a figure is drawn, because it is large."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure
else:
    Axes, Figure = "matplotlib.axes.Axes", "matplotlib.figure.Figure"
