"""Common style of all figures, and their reproducible output: the same data gives files with the same bytes."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from rig.core.base.arrays import Array
from rig.core.base.escaping import escape_figure
from rig.core.base.figure_types import Axes, Figure
from rig.core.base.output_files import atomic_write, csv_text

if TYPE_CHECKING:
    from matplotlib.axis import Axis

# Colors that are distinguishable with any color blindness (Okabe and Ito), darker colors first.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#555555", "#000000")
# Default width of a figure.
WIDTH_INCH = 7.2
# Resolution of PNG files, dots per inch.
_DPI = 150
# Compression level of PNG files. Level 6, the default, takes 50 % longer and makes files only 5 % smaller.
_PNG_COMPRESSION = 3
# Number of title characters that fit into the default width, at the font size below.
_TITLE_CHARACTERS = 70
# If the ratio of the limits of a logarithmic axis is smaller than this value, powers of ten would give too few labels.
_MIN_DECADE_RATIO = 300.0
# Smallest and largest value of a logarithmic axis that matplotlib can draw.
_DRAWABLE_RANGE = 1e-250, 1e250
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
# Number of characters per line of a subtitle.
_SUBTITLE_CHARACTERS = 100
# Number of characters per line of a note below a figure, whose font is smaller.
_NOTE_CHARACTERS = 118
# Name of the text below all axes.
_CAPTION = "caption"
# Maximum number of legend entries in one line, if their labels are short.
_LEGEND_COLUMNS = 5
_LINE_CHARACTERS = 66
# Space between the axes and a title above a subtitle [points].
_SUBTITLE_HEIGHT = 18.0
# Line spacing of a subtitle [points].
_LINE_HEIGHT = 11.0
# Maximum number of characters of a legend entry in two columns.
_LEGEND_CHARACTERS = 46

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
    # Curves remain visible behind a legend.
    "legend.framealpha": 0.85,
    "legend.edgecolor": "none",
    "legend.fontsize": 8.5,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    # Ticks from 0.001 to 1000 are plain numbers.
    "axes.formatter.min_exponent": 4,
    "svg.hashsalt": "shotrig",
    "svg.fonttype": "none",
    "path.simplify": True,
}


def _load_matplotlib() -> Any:
    """Import matplotlib without the backend in MPLBACKEND: it may not be installed, and files do not need it."""
    if "matplotlib" not in sys.modules:
        backend = os.environ.pop("MPLBACKEND", None)
        import matplotlib

        if backend is not None:
            os.environ["MPLBACKEND"] = backend
            with suppress(ValueError):
                matplotlib.rcParams["backend"] = backend
    return sys.modules["matplotlib"]


def _own_style() -> AbstractContextManager[None]:
    """Return a context with the common style, in which the user's matplotlibrc has no effect."""
    matplotlib = _load_matplotlib()
    defaults = {name: value for name, value in matplotlib.rcParamsDefault.items() if name != "backend"}
    context: AbstractContextManager[None] = matplotlib.rc_context(defaults | _STYLE)
    return context


def use_style() -> None:
    """Use the common style for all figures that a script draws with matplotlib."""
    matplotlib = _load_matplotlib()
    from matplotlib.rcsetup import cycler

    matplotlib.rcParams.update(_STYLE | {"axes.prop_cycle": cycler(color=COLORS)})


@contextmanager
def new_figure(height: float, width: float = WIDTH_INCH) -> Iterator[Figure]:
    """Provide an empty figure in the common style; draw inside the `with` block."""
    with _own_style():
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        yield figure


def save_figure(figure: Figure, stem: Path) -> list[Path]:
    """Write `stem`.png and `stem`.svg without dates or versions, and return their paths."""
    png, svg = stem.with_name(stem.name + ".png"), stem.with_name(stem.name + ".svg")
    with _own_style():
        layout_engine = figure.get_layout_engine()
        if layout_engine is not None:
            figure.set_dpi(_DPI)
            layout_engine.execute(figure)
            # With a layout engine, matplotlib draws each file twice.
            figure.set_layout_engine(None)
            _align_captions(figure)
        # Both files are renamed at the end, so an interrupted run leaves neither and can be repeated.
        with atomic_write(png) as temporary_png, atomic_write(svg) as temporary_svg:
            compression = {"compress_level": _PNG_COMPRESSION}
            figure.savefig(temporary_png, dpi=_DPI, metadata={"Software": None}, pil_kwargs=compression)
            # The positions of the axis labels are fixed once drawn, so the second file needs no layout pass. The layout
            # engine fixes them too early, before its last change of the axes.
            for axes in figure.axes:
                for axis in (axes.xaxis, axes.yaxis):
                    to_axes = axis.label.get_transform() - axes.transAxes
                    axis.set_label_coords(*to_axes.transform(axis.label.get_position()))
            figure.savefig(temporary_svg, metadata={"Date": None, "Creator": None})
    return [png, svg]


def _align_captions(figure: Figure) -> None:
    """Move legends and captions below the axes to the left end of the axes."""
    left = min((axes.get_position().x0 for axes in figure.axes), default=0.0)
    for legend in figure.legends:
        legend.set_bbox_to_anchor((left, 0.0, 1.0 - left, 1.0), transform=figure.transFigure)
        legend.borderaxespad = 0.2
    for text in figure.texts:
        if text.get_gid() == _CAPTION:
            text.set_x(left)


def add_title(axes: Axes, text: str) -> None:
    """Add a title to the top axes, wrapped to the width of the figure. Set up the vertical axis first.

    Text in parentheses at its end, such as test and level, becomes a subtitle in regular weight.
    Only the exponent above a vertical axis can move a title. Without it, the position is fixed: matplotlib would
    measure the tick labels of the axes three more times.
    """
    from matplotlib.ticker import ScalarFormatter

    has_exponent = isinstance(axes.yaxis.get_major_formatter(), ScalarFormatter)
    name, subtitle = re.fullmatch(r"(.*?)(?: \(((?:[^()]|\([^()]*\))*)\))?", text, re.DOTALL).groups()  # type: ignore[union-attr]
    title = _lines(escape_figure(name), _TITLE_CHARACTERS)
    lines = _lines(escape_figure(subtitle or ""), _SUBTITLE_CHARACTERS)
    pad = _SUBTITLE_HEIGHT + _LINE_HEIGHT * lines.count("\n") if lines else None
    axes.set_title(title, y=None if has_exponent else 1.0, pad=pad)
    if lines:
        axes.annotate(
            lines, (0.0, 1.0), xycoords="axes fraction", xytext=(0.0, 5.0), textcoords="offset points", fontsize=8.5,
        )  # fmt: skip


def add_page_title(figure: Figure, name: str, text: str = "") -> None:
    """Add a bold title, and a line in regular weight below it, above several panels."""
    from matplotlib.text import Annotation

    # An empty line of the title is free for the text.
    lines = escape_figure(name) + ("\n" if text else "")
    title = figure.suptitle(lines, x=0.01, ha="left", fontweight="bold", fontsize=11.0)
    figure.add_artist(Annotation(escape_figure(text), (0.0, 0.0), xycoords=title, va="bottom", fontsize=9.5))


def frequency_axis(axes: Axes, low: float, high: float, labeled: bool) -> None:
    """Set up a frequency axis with plain tick labels, logarithmic unless its range is short."""
    axes.set_xlim(low, high)
    if high / low >= 2.0:
        set_log_scale(axes.xaxis, 12)
    if labeled:
        axes.set_xlabel("frequency / Hz")
    else:
        axes.tick_params(labelbottom=False)


def log_axis(axes: Axes, values: Any, max_decades: float = 7.0) -> None:
    """Set up a logarithmic vertical axis of 1 to `max_decades` decades that contains the positive values."""
    values = np.concatenate([np.ravel(v) for v in values])
    values = np.clip(values[np.isfinite(values) & (values > 0)], *_DRAWABLE_RANGE)
    if not values.size:
        # Without positive values, the axis has default limits.
        axes.set_yticks([])
        return
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(lambda value, _: _plain_label(value))
    axes.yaxis.set_minor_formatter("")
    high = values.max() * 1.6
    low = max(values.min() / 1.6, high / 10.0**max_decades)
    low = min(low, high / 10.0)
    if high < _MIN_DECADE_RATIO * low:
        set_log_scale(axes.yaxis)
    axes.set_ylim(low, high)


def power_label(value: float, position: float) -> str:
    """Label a power of ten by its exponent.

    >>> power_label(0.01, 0)
    '10⁻²'
    """
    return f"10{str(round(np.log10(value))).translate(_SUPERSCRIPTS)}"


def _plain_label(value: float) -> str:
    """Label a value without an exponent, or with a power of ten.

    >>> _plain_label(0.02), _plain_label(2e-6), _plain_label(1e-6)
    ('0.02', '2·10⁻⁶', '10⁻⁶')
    """
    mantissa, _, exponent = f"{value:g}".partition("e")
    power = f"10{str(int(exponent or 0)).translate(_SUPERSCRIPTS)}"
    return mantissa if not exponent else power if mantissa == "1" else f"{mantissa}·{power}"


def round_ticks(low: float, high: float, max_ticks: int = 8) -> list[float]:
    """Select at most `max_ticks` round numbers on a logarithmic axis; even steps if there are too few.

    >>> round_ticks(0.08, 3.0), round_ticks(0.08, 3.0, 4)
    ([0.1, 0.2, 0.5, 1.0, 2.0], [0.1, 0.3, 1.0, 3.0])
    >>> round_ticks(0.71, 0.95)
    [0.75, 0.8, 0.85, 0.9]
    """
    from matplotlib.ticker import MaxNLocator

    for mantissas in ((1, 1.5, 2, 3, 4, 5, 6, 8), (1, 2, 5), (1, 3), (1,)):
        candidates = [float(f"{mantissa}e{exponent}") for exponent in range(-12, 13) for mantissa in mantissas]
        ticks = [tick for tick in candidates if low <= tick <= high]
        if len(ticks) <= max_ticks:
            break
    if len(ticks) < 3:
        even_steps = MaxNLocator(5).tick_values(low, high)
        ticks = [round(float(tick), 12) for tick in even_steps if low <= tick <= high]
    return ticks


def set_log_scale(axis: Axis, max_ticks: int = 8, factor: float = 1.0) -> None:
    """Set up a logarithmic axis with few, plain tick labels; each label is the axis value times `factor`."""
    from matplotlib.ticker import Locator, NullFormatter

    class RoundTicks(Locator):
        def tick_values(self, low: float, high: float) -> list[float]:
            return [tick / factor for tick in round_ticks(factor * low, factor * high, max_ticks)]

        def __call__(self) -> list[float]:
            return self.tick_values(*sorted(axis.get_view_interval()))

    axis.axes.set(**{f"{axis.axis_name}scale": "log"})  # type: ignore[attr-defined]
    axis.set_major_locator(RoundTicks())
    axis.set_major_formatter(lambda value, _: _plain_label(factor * value))
    axis.set_minor_formatter(NullFormatter())


def cell_edges(centers: Array, logarithmic: bool) -> Array:
    """Compute the edges of the cells of a map from their centers; a single cell is 10 % wide.

    >>> cell_edges(np.array([1.0, 2.0, 4.0]), False).tolist()
    [0.5, 1.5, 3.0, 5.0]
    """
    x = np.log(centers) if logarithmic else centers
    if len(x) == 1:
        edges = np.array([x[0] - 0.05 * abs(x[0]) - 1e-9, x[0] + 0.05 * abs(x[0]) + 1e-9])
    else:
        inner = 0.5 * (x[1:] + x[:-1])
        edges = np.concatenate([[2 * x[0] - inner[0]], inner, [2 * x[-1] - inner[-1]]])
    return np.exp(edges) if logarithmic else edges


def add_caption(figure: Figure, *sentences: str) -> None:
    """Add sentences below all axes, for elements that are not in a legend."""
    if sentences:
        figure.supxlabel(_wrapped(figure, sentences), x=0.01, ha="left", fontsize=7.5, color="#555555", gid=_CAPTION)


def add_legend_below(figure: Figure, *sentences: str) -> None:
    """Add a common legend below all axes, with sentences below it as in `add_caption`."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    if not entries:
        add_caption(figure, *sentences)
        return
    title = _wrapped(figure, sentences) or None
    scale = figure.get_figwidth() / WIDTH_INCH
    columns = 1 if max(map(len, entries)) > _LEGEND_CHARACTERS * scale else 2
    if len(entries) <= _LEGEND_COLUMNS and sum(map(len, entries)) + 4 * len(entries) <= _LINE_CHARACTERS * scale:
        columns = len(entries)
    legend = figure.legend(
        list(entries.values()), list(entries), loc="outside lower left", ncols=columns, title=title,
        title_fontsize=7.5, alignment="left",
    )  # fmt: skip
    legend.get_title().set_color("#555555")
    # The title of a legend is above its entries; a caption is the last text of a figure.
    legend.get_children()[0].get_children().reverse()


def _wrapped(figure: Figure, sentences: Sequence[str]) -> str:
    return _lines(" ".join(filter(None, sentences)), int(_NOTE_CHARACTERS * figure.get_figwidth() / WIDTH_INCH))


def _lines(text: str, characters: int) -> str:
    r"""Wrap text into lines of similar length; a number, its uncertainty and its unit stay on one line.

    >>> _lines("height 2.1 ± 0.2 mm", 14), _lines("one two three four", 14)
    ('height\n2.1 ± 0.2 mm', 'one two\nthree four')
    """
    joined = re.sub(r"(?<=\d) (?=[^\W\d]{1,3}\b|%)|(?<=±) | (?=±)", "\u00a0", text)
    count = len(wrap(joined, characters))
    shortest = max([1, len(joined) // max(count, 1), *map(len, joined.split(" "))])
    narrowest = next((width for width in range(shortest, characters) if len(wrap(joined, width)) <= count), characters)
    return "\n".join(wrap(joined, narrowest)).replace("\u00a0", " ")


def save_with_table(figure: Figure, stem: Path, rows: Iterable[Sequence[object]]) -> list[Path]:
    """Write a figure by `save_figure`, and its table, whose first row is the header; return the three paths.

    Raises `SceneError`, `RunError` if a file cannot be written.
    """
    table = stem.with_name(stem.name + ".csv")
    with atomic_write(table) as temporary:
        temporary.write_text(csv_text(rows), encoding="utf-8", newline="")
        figures = save_figure(figure, stem)
    return [*figures, table]
