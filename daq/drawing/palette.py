"""Colours of the displays: one for each body, shared by its drawing, channels and damper."""

from __future__ import annotations

Colour = tuple[int, int, int]

STEEL: Colour = (176, 184, 194)
DARK_STEEL: Colour = (96, 104, 116)
GROUND: Colour = (74, 80, 90)
LEAD: Colour = (214, 122, 46)
GLUED: Colour = (120, 112, 104)
DRIVE: Colour = (120, 200, 130)
HAMMER: Colour = (240, 240, 240)
MARK: Colour = (150, 156, 166)
BACKGROUND: Colour = (22, 24, 29)
BODIES: tuple[Colour, ...] = (
    (86, 156, 214),
    (229, 192, 80),
    (224, 108, 117),
    (152, 118, 214),
    (78, 190, 180),
    (206, 130, 190),
)


def body_colour(body: int) -> Colour:
    """Colour of a body, counted from 1; the colours repeat beyond six bodies.

    >>> body_colour(1) == body_colour(7)
    True
    """
    return BODIES[(body - 1) % len(BODIES)]


def channel_colour(at: str) -> Colour:
    """Colour of a channel, by the position of its sensor.

    >>> channel_colour("body 2") == body_colour(2)
    True
    """
    if at.startswith("body "):
        return body_colour(int(at.removeprefix("body ")))
    return DRIVE if at.startswith(("table", "drive")) else HAMMER


def hex_colour(colour: Colour) -> str:
    """Write a colour as in style sheets, ``#b0b8c2``."""
    return "#{:02x}{:02x}{:02x}".format(*colour)
