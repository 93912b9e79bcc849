"""Colors of drawings and curves: a body and its channels have the same color."""

from __future__ import annotations

Color = tuple[int, int, int]

STEEL: Color = (176, 184, 194)
DARK_STEEL: Color = (96, 104, 116)
GROUND: Color = (74, 80, 90)
LEAD: Color = (214, 122, 46)
INACTIVE: Color = (120, 112, 104)
DRIVE: Color = (120, 200, 130)
HAMMER: Color = (240, 240, 240)
MARK: Color = (150, 156, 166)
BACKGROUND: Color = (22, 24, 29)
BODIES: tuple[Color, ...] = (
    (86, 156, 214),
    (229, 192, 80),
    (224, 108, 117),
    (152, 118, 214),
    (78, 190, 180),
    (206, 130, 190),
)


def body_color(body: int) -> Color:
    """Return the color of a body, counted from 1; the colors repeat after six bodies.

    >>> body_color(1) == body_color(7)
    True
    """
    return BODIES[(body - 1) % len(BODIES)]


def channel_color(at: str) -> Color:
    """Return the color of a channel with a sensor at a location such as ``body 2``.

    >>> channel_color("body 2") == body_color(2)
    True
    """
    if at.startswith("body "):
        return body_color(int(at.removeprefix("body ")))
    return DRIVE if at.startswith(("table", "drive")) else HAMMER


def hex_color(color: Color) -> str:
    """Return a color as in style sheets, ``#b0b8c2``."""
    return "#{:02x}{:02x}{:02x}".format(*color)
