"""Charts of a report: panels of curves and images, written as JSON that `browser/charts.js` draws."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from itertools import count
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rig.core.base.arrays import Array
from rig.core.base.escaping import escape_html
from rig.core.base.palette import CurveStyle, body_style
from rig.core.results.table import typeset

# A frequency axis is logarithmic if the ratio of its highest to its lowest frequency exceeds this value.
_MIN_LOGARITHMIC_RATIO = 3.0
# Significant digits of a number in a chart: more than a screen can resolve.
_DIGITS = 5
# Significant digits of an abscissa, of which zooming shows more.
_ABSCISSA_DIGITS = 8
# Difference between the brightest and the darkest level of an image [dB].
IMAGE_SPAN_DB = 80.0
# Columns with more values are written as 32-bit binary, which halves their size.
_MAX_TEXT_VALUES = 500
# Distance of symbols from the ends of a horizontal axis, relative to the range of its values.
_SIDE_MARGIN = 0.03
# Distance of values from the ends of a linear vertical axis, relative to their range.
_VERTICAL_MARGIN = 0.15
# Longer notes of a chart are folded [characters].
_MAX_KEY = 300
_DEFAULT_STYLE = body_style(1)
# Style of a prescribed value, such as the required force.
REQUIRED = CurveStyle("#6E7681", (2, 2))


@dataclass(frozen=True)
class EvenlySpaced:
    """Evenly spaced abscissa: `size` values from `start`, `step` apart."""

    start: float
    step: float
    size: int


@dataclass(frozen=True)
class Curve:
    """One curve of a panel, with its uncertainty bounds if they are known.

    All arrays have the shape (n,).
    """

    label: str
    x: ArrayLike | EvenlySpaced
    y: ArrayLike
    low: ArrayLike | None = None  # lower bound of `y`
    high: ArrayLike | None = None  # upper bound of `y`
    style: CurveStyle = _DEFAULT_STYLE
    # "points" of separate tones, the thin line "through" them, or symbols at points: "dots", "crosses", "circles",
    # "arrows", "limits" (triangles that point downward), or a dotted "path" through them in their order; "pale":
    # undetermined line. The readout contains only values of "points" and "line".
    draw: str = "line"


def symbol_curves(name: str, style: CurveStyle, draw: str, points: Iterable[tuple[float, float]]) -> list[Curve]:
    """Return a curve of symbols at points; empty if there are no points."""
    x, y = np.array([*points]).reshape(-1, 2).T
    return [Curve(name, x, y, style=style, draw=draw)] if x.size else []


class Mark(NamedTuple):
    """A label above the axes, joined to a value by a dotted line.

    Labels that would overlap are in rows, the first labels in the lowest.
    """

    x: float
    y: float
    label: str
    color: str = ""  # default: that of text


class Strip(NamedTuple):
    """A marked range of the abscissa at the axis."""

    ends: tuple[float, float]
    color: str


@dataclass(frozen=True)
class Panel:
    """A pair of axes; all panels of a chart share the abscissa."""

    label: str
    unit: str
    curves: Sequence[Curve] = ()
    height: int = 170  # px
    logarithmic: bool = False  # whether the vertical axis is logarithmic
    limits: tuple[float, float] | None = None  # limits of the vertical axis
    ticks: Sequence[float] | None = None  # ticks of the vertical axis
    image: dict[str, Any] | None = None  # image from `level_image`
    marks: Sequence[Mark] = ()
    strips: Sequence[Strip] = ()
    title: str = ""  # inside the axes


@dataclass(frozen=True)
class Chart:
    """Panels one below the other, with a title above them and a text alternative for screen readers."""

    title: str
    alternative: str
    panels: Sequence[Panel]
    x_name: str = "frequency"
    x_unit: str = "Hz"
    logarithmic: bool = False  # horizontal axis
    x_limits: tuple[float, float] | None = None  # minimum extent of the horizontal axis
    x_view: tuple[float, float] | None = None  # part of the horizontal axis that is shown first
    names: Sequence[str] = ()  # curves in the order of the legend; default: in the order of drawing
    notes: Sequence[str] = ()  # sentences below the panels; a long text is folded


@dataclass
class ChartWriter:
    """Writer of charts as HTML, with identifiers that are unique in the page."""

    _numbers: count[int] = field(default_factory=count)

    def write(self, chart: Chart) -> str:
        """Return the HTML of a chart: a figure that the page's script fills, and its data."""
        identifier, label = f"chart-{next(self._numbers)}", f"{chart.x_name} / {_divisor(chart.x_unit)}"
        data = {
            "x": {
                "label": label,
                "name": chart.x_name,
                "unit": chart.x_unit,
                "log": chart.logarithmic,
                "range": chart.x_limits,
                "view": chart.x_view,
            },
            "panels": [_panel(panel) for panel in chart.panels],
            "names": chart.names,
        }
        # The text "</script>" inside the data would end the script element.
        text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
        key = typeset(" ".join(filter(None, chart.notes)))
        key = f'<p class="key">{key}</p>' if key else ""
        if len(key) > _MAX_KEY:
            key = f'<details class="key"><summary>How to read the charts</summary>{key}</details>'
        return (
            f"<figure><figcaption><b>{typeset(chart.title)}</b></figcaption>"
            f'<div class="chart" role="img" aria-label="{escape_html(chart.alternative)}" '
            f'data-source="{identifier}"></div>'
            f'<script type="application/json" id="{identifier}">{text}</script></figure>{key}'
        )


def needs_logarithmic_axis(frequencies: ArrayLike) -> bool:
    """Return whether the band of these frequencies is so wide that their axis is logarithmic."""
    values = np.asarray(frequencies, dtype=float)
    return bool(values.size and values.min() > 0 and values.max() > _MIN_LOGARITHMIC_RATIO * values.min())


def limits_with_margin(curves: Sequence[Curve]) -> tuple[float, float]:
    """Return limits of a linear axis that show all values and bands with a margin for symbols."""
    columns = [column for curve in curves for column in (curve.y, curve.low, curve.high) if column is not None]
    return _widened(np.concatenate([np.asarray(column, dtype=float) for column in columns]), _VERTICAL_MARGIN)


def side_limits(values: Array) -> tuple[float, float]:
    """Return limits of a linear horizontal axis that show all values with a margin for symbols."""
    return _widened(values, _SIDE_MARGIN)


def _widened(values: Array, ratio: float) -> tuple[float, float]:
    """Return the range of values, with a fraction of its width added at both ends."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    margin = ratio * (high - low or 1.0)
    return low - margin, high + margin


def _panel(panel: Panel) -> dict[str, Any]:
    return {
        "label": f"{panel.label} / {_divisor(panel.unit)}" if panel.unit else panel.label,
        "unit": panel.unit,
        "title": panel.title,
        "log": panel.logarithmic,
        "height": panel.height,
        "range": panel.limits,
        "ticks": panel.ticks,
        "curves": [_curve(curve, panel.logarithmic) for curve in panel.curves],
        "image": panel.image,
        "marks": panel.marks,
        "strips": [
            {"ends": _column(strip.ends, digits=_ABSCISSA_DIGITS), "color": strip.color} for strip in panel.strips
        ],
    }


def _divisor(unit: str) -> str:
    """Return a unit for an axis label, in parentheses if it is a quotient.

    >>> _divisor("µm/N"), _divisor("dB")
    ('(µm/N)', 'dB')
    """
    return f"({unit})" if "/" in unit else unit


def _curve(curve: Curve, positive_only: bool) -> dict[str, Any]:
    content: dict[str, Any] = {
        "label": curve.label,
        "color": curve.style.color,
        "marker": curve.style.marker,
        "dash": curve.style.dashes,
        "draw": curve.draw,
        "x": asdict(curve.x) if isinstance(curve.x, EvenlySpaced) else _column(curve.x, digits=_ABSCISSA_DIGITS),
        "y": _column(curve.y, positive_only),
    }
    if curve.low is not None and curve.high is not None:
        content["low"], content["high"] = _column(curve.low, positive_only), _column(curve.high, positive_only)
    return content


def _column(values: ArrayLike, positive_only: bool = False, digits: int = _DIGITS) -> Any:
    """Convert numbers to JSON; undefined values and, if `positive_only`, those that a log axis cannot show are null."""
    # Long columns become 32-bit binary.
    column = np.asarray(values, dtype=float)
    is_drawn = np.isfinite(column) & (column > 0 if positive_only else True)
    if column.size > _MAX_TEXT_VALUES:
        binary = np.where(is_drawn, column, np.nan).astype("<f4")
        return {"float32": base64.b64encode(binary.tobytes()).decode()}
    return [float(f"{value:.{digits}g}") if drawn else None for value, drawn in zip(column, is_drawn, strict=True)]


def level_image(levels: Array, x: tuple[float, float], y: tuple[float, float]) -> dict[str, Any]:
    """Return a spectrogram in dB, first row at the top, as JSON data; `x`, `y`: limits of the image on the axes."""
    brightness = np.clip((levels - float(np.max(levels))) / IMAGE_SPAN_DB + 1.0, 0.0, 1.0)
    rows, columns = levels.shape
    pixels = base64.b64encode(np.round(255 * brightness).astype(np.uint8).tobytes()).decode()
    return {"levels": pixels, "rows": rows, "columns": columns, "x": x, "y": y}
