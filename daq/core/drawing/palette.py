"""Colors of drawings and curves on a dark page: those of figures and report (`rig.core.base.palette`), lightened."""

from rig.core.base import palette

Color = tuple[int, int, int]


def _rgb(color: str) -> Color:
    red, green, blue = bytes.fromhex(palette.on_dark(color).removeprefix("#"))
    return red, green, blue


# Neutral grays, distinct from the colors of the bodies on the dark page.
STEEL: Color = (176, 184, 194)
DARK_STEEL: Color = (96, 104, 116)
GROUND: Color = (74, 80, 90)
DAMPER = _rgb(palette.DAMPER)
INACTIVE: Color = (120, 112, 104)
DRIVE = _rgb(palette.TABLE)
HAMMER = _rgb(palette.HAMMER)
MARK: Color = (150, 156, 166)
LABEL: Color = (207, 214, 222)
BACKGROUND: Color = (22, 24, 29)


def body_color(body: int) -> Color:
    """Return the color of a body, counted from 1; the colors repeat after six bodies.

    >>> body_color(1) == body_color(7)
    True
    """
    return _rgb(palette.body_style(body).color)


def channel_color(at: str) -> Color:
    """Return the color of a channel with a sensor at a location such as ``body 2``.

    >>> channel_color("body 2") == body_color(2)
    True
    """
    return _rgb(palette.location_style(at).color)


def hex_color(color: Color) -> str:
    """Return a color as in style sheets, ``#b0b8c2``."""
    return "#{:02x}{:02x}{:02x}".format(*color)
