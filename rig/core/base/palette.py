"""Colors, dashes and markers, the same in figures, report, bench page and replay.

A body has one color everywhere, and so have tables, hammers and dampers. Curves of recordings have other colors; the
baseline of a comparison is dark gray. Bodies 1 to 3, table and damper remain distinct with any color blindness (Okabe
and Ito); dashes and markers distinguish curves in gray prints.
"""

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

#: Bodies 1, 2, ...; the styles repeat after six bodies.
BODIES = ("#0072B2", "#D55E00", "#009E73", "#56B4E9", "#9A6324", "#7E6BC4")
#: Table and drive of a shaker.
TABLE = "#CC79A7"
HAMMER = "#6E7681"
DAMPER = "#E69F00"
#: Reference of a comparison.
BASELINE = "#404040"
#: Recordings that are compared with a baseline.
RECORDINGS = ("#AA4499", "#44AA99", "#A6761D", "#7E6BC4", "#CC6677", "#999933")
#: Dampers by their type of motion (`rig.studies.motion_map`), from rest to irregular.
MOTIONS = ("#e4e4e4", "#a6cee3", "#3f8fc4", "#1b4f7e", "#cf9a2b", "#e07b39", "#8c1c3a")
#: Background of dark pages.
DARK_PAGE = "#14181d"
#: Smallest contrast of curves on dark pages: thinner than text, for which WCAG requires 4.5.
MIN_DARK_CONTRAST = 6.0
# Curves by type of motion; the lightest shade of the map would be too pale for a line.
_MOTION_CURVES = {"riding": "#777777", "I": "#5ba3cf", "II": "#2171b5", "III": "#0b3c6b"}
_OTHER_MOTION = "#e07b39"
# Lengths of dashes and gaps, in line widths.
_DASHES: tuple[tuple[float, ...], ...] = ((), (6, 2), (8, 2, 2, 2), (2, 1.5), (10, 3), (6, 2, 1, 2, 1, 2))
_MARKERS = "os^DvP"
_BODY = re.compile(r"body ([1-9][0-9]*)")


class CurveStyle(NamedTuple):
    """Color, dashes (empty: solid) and marker of a curve."""

    color: str
    dashes: tuple[float, ...] = ()
    marker: str = "o"

    @property
    def line(self) -> str | tuple[float, tuple[float, ...]]:
        """Line style for matplotlib."""
        return (0.0, self.dashes) if self.dashes else "-"


def body_style(body: int) -> CurveStyle:
    """Return the style of a body, counted from 1."""
    index = (body - 1) % len(BODIES)
    return CurveStyle(BODIES[index], _DASHES[index], _MARKERS[index])


def location_style(place: str) -> CurveStyle:
    """Return the style of a location such as ``body 2``, ``table`` or ``hammer``.

    >>> location_style("body 2") == body_style(2), location_style("table").color == TABLE
    (True, True)
    """
    if body := _BODY.fullmatch(place):
        return body_style(int(body[1]))
    return CurveStyle(TABLE, (4, 2)) if place.startswith(("table", "drive")) else CurveStyle(HAMMER, (1, 2))


def location_styles(places: Sequence[str]) -> list[CurveStyle]:
    """Return the styles of curves by their locations; at an unknown location, curve n has the style of body n.

    Further curves of the same location have other dashes and markers.

    >>> [style.color == BODIES[2] for style in location_styles(["body 3", "shaker", "", "body 3"])]
    [True, False, True, True]
    """
    styles: list[CurveStyle] = []
    for position, place in enumerate(places, 1):
        known = _BODY.fullmatch(place) or place.startswith(("table", "drive", "hammer", "shaker"))
        style = location_style(place) if known else body_style(position)
        repeated = sum(style.color == other.color for other in styles)
        other = body_style(_DASHES.index(style.dashes) + 1 + repeated) if repeated else style
        styles.append(style._replace(dashes=other.dashes, marker=other.marker))
    return styles


def level_styles(levels: Iterable[float]) -> dict[float, CurveStyle]:
    """Return the style of each level of a test, in the colors of recordings.

    >>> [style.marker for style in level_styles([0.9, 0.9, 1.2]).values()]
    ['s', '^']
    """
    distinct = dict.fromkeys(map(float, levels))
    return dict(zip(distinct, recording_styles([False] * len(distinct)), strict=True))


def motion_color(name: str) -> str:
    """Return the color of a type of damper motion for curves: types I to III as in the motion map, but darker.

    >>> motion_color("I") == motion_color("type I"), motion_color("period 2") == motion_color("I")
    (True, False)
    """
    kind = name.removeprefix("type ")
    return _MOTION_CURVES.get(kind, _OTHER_MOTION)


def faded(color: str) -> str:
    """Return a pale shade of a color, for curves that are not determined.

    >>> faded("#0072B2")
    '#a6cee4'
    """
    return "#" + "".join(f"{round(0.35 * part + 0.65 * 255):02x}" for part in bytes.fromhex(color[1:]))


def recording_styles(is_baseline: Sequence[bool]) -> list[CurveStyle]:
    """Return the styles of compared curves: curves of the baseline are dark gray, independent of the order.

    >>> [style.color == BASELINE for style in recording_styles([False, True, False])]
    [False, True, False]
    """
    styles = []
    for position, baseline in enumerate(is_baseline):
        index = sum(other == baseline for other in is_baseline[:position])
        color = BASELINE if baseline else RECORDINGS[index % len(RECORDINGS)]
        index = (index if baseline else index + 1) % len(_DASHES)
        styles.append(CurveStyle(color, _DASHES[index], _MARKERS[index]))
    return styles


def on_dark(color: str) -> str:
    """Return the shade of a color for curves on a dark page: lighter until its contrast suffices, as in the report.

    >>> on_dark(BODIES[0]), on_dark(DAMPER) == DAMPER
    ('#59a2cd', True)
    """
    while contrast(color, DARK_PAGE) < MIN_DARK_CONTRAST:
        color = "#" + "".join(f"{int(part + 0.1 * (255 - part) + 0.5):02x}" for part in bytes.fromhex(color[1:]))
    return color


def contrast(color: str, background: str) -> float:
    """Return the contrast ratio of two colors (WCAG 2.1), from 1 to 21.

    >>> round(contrast("#ffffff", "#000000"))
    21
    """
    brighter, darker = sorted(map(_luminance, (color, background)), reverse=True)
    return (brighter + 0.05) / (darker + 0.05)


def _luminance(color: str) -> float:
    values = [part / 255 for part in bytes.fromhex(color[1:])]
    linear = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in values]
    return sum(weight * v for weight, v in zip((0.2126, 0.7152, 0.0722), linear, strict=True))
