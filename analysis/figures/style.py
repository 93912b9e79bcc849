"""The look that all figures share, and how they are saved: the same input gives the same bytes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from rig.escaping import drawn
from rig.output_files import make_ready, replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Colours that remain apart for every kind of colour blindness (Okabe and Ito's set, the darker ones first).
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#555555", "#000000")
WIDTH_INCH = 7.2
# Characters of a title that fit into this width.
_LONGEST_LINE = 70

_STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9.0,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#d9d9d9",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.3,
    "lines.markersize": 2.6,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "svg.hashsalt": "shotrig",
    "svg.fonttype": "none",
    "path.simplify": True,
}


@contextmanager
def drawing(height: float, width: float = WIDTH_INCH) -> Iterator[Figure]:
    """Give an empty figure in the common style; draw on it inside the `with`."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        yield figure


def save(figure: Figure, stem: Path) -> list[Path]:
    """Write `stem`.png and `stem`.svg, without dates or versions inside, and name them."""
    import matplotlib

    png, svg = stem.with_name(stem.name + ".png"), stem.with_name(stem.name + ".svg")
    make_ready(stem.parent)
    with matplotlib.rc_context(_STYLE), replacing(png) as part:
        figure.savefig(part, dpi=150, metadata={"Software": None})
    with matplotlib.rc_context(_STYLE), replacing(svg) as part:
        figure.savefig(part, metadata={"Date": None, "Creator": None})
    return [png, svg]


def heading(axes: Axes, text: str) -> None:
    """Title above the uppermost axes, in lines no longer than the figure is wide."""
    axes.set_title("\n".join(wrap(drawn(text), _LONGEST_LINE)))


def colour(index: int) -> str:
    """Colour of the curve with this index."""
    return COLOURS[index % len(COLOURS)]


def frequency_axis(axes: Axes, low: float, high: float, labelled: bool) -> None:
    """Logarithmic frequency axis whose ticks read as plain numbers."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

    axes.set_xscale("log")
    axes.set_xlim(low, high)
    if high / low < 2.0:
        # Within an octave a logarithm hardly bends, and round numbers are what one looks for.
        axes.set_xscale("linear")
        axes.set_xlim(low, high)
        if labelled:
            axes.set_xlabel("frequency / Hz")
        else:
            axes.tick_params(labelbottom=False)
        return
    wide = high / low > 30.0
    digits = (1, 2, 5) if wide else (1, 1.5, 2, 3, 4, 5, 6, 8)
    ticks = [d * 10.0**e for e in range(-3, 6) for d in digits if low <= d * 10.0**e <= high]
    axes.xaxis.set_major_locator(FixedLocator(ticks))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    if labelled:
        axes.set_xlabel("frequency / Hz")
    else:
        axes.tick_params(labelbottom=False)


def decades(axes: Axes, values: Any, most: float = 6.0, least: float = 1.0) -> None:
    """Logarithmic vertical axis around positive values, at most so many decades deep."""
    import numpy as np

    values = np.concatenate([np.ravel(v) for v in values])
    values = values[np.isfinite(values) & (values > 0)]
    axes.set_yscale("log")
    if values.size:
        high = values.max() * 1.6
        low = max(values.min() / 1.6, high / 10.0**most)
        axes.set_ylim(min(low, high / 10.0**least), high)


def plain_ticks(low: float, high: float) -> list[float]:
    """Round numbers along a logarithmic axis; where it is so short that hardly any lie on it, even steps.

    Examples
    --------
    >>> plain_ticks(0.08, 3.0)
    [0.1, 0.2, 0.5, 1.0, 2.0]
    >>> plain_ticks(0.65, 1.5)
    [0.8, 1.0, 1.2, 1.4]
    """
    from matplotlib.ticker import MaxNLocator

    ticks = [d * 10.0**e for e in range(-9, 9) for d in (1, 2, 5)]
    inside = [tick for tick in ticks if low <= tick <= high]
    if len(inside) < 3:
        inside = [
            round(float(tick), 12) for tick in MaxNLocator(5).tick_values(low, high) if low <= tick <= high
        ]
    return inside


def plain_logarithmic(axes: Axes, values: Any) -> None:
    """Logarithmic horizontal axis over positive values whose few ticks read as plain numbers."""
    import numpy as np
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter

    values = np.concatenate([np.ravel(v) for v in values])
    low, high = 0.8 * float(values.min()), 1.25 * float(values.max())
    digits = (1,) if high / low > 30.0 else (1, 3) if high / low > 8.0 else (1, 2, 5)
    ticks = [d * 10.0**e for e in range(-9, 9) for d in digits if low <= d * 10.0**e <= high]
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    axes.xaxis.set_major_locator(FixedLocator(ticks))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
