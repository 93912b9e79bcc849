"""SVG drawing of the test rig of a scene in a report."""

from collections.abc import Iterator, Sequence
from math import isfinite

from rig.core.base.escaping import escape_html
from rig.core.base.palette import DAMPER, HAMMER, TABLE, location_style
from rig.core.results import format_number
from rig.core.scene.joint import Joint
from rig.core.scene.scene import Scene
from rig.core.scene.shaker import Shaker

# Size of a body [px].
_BODY_WIDTH = 150
_BODY_HEIGHT = 50
# Distance between two bodies [px].
_SPACING = 36
# Position of the left edge of the bodies [px].
_LEFT = 145
# Position of shakers and hammers, left of the bodies [px].
_SHAKER_X = 44
_WIDTH = 400
# Margin above and below the drawing [px].
_MARGIN = 22
# Number of zigzag corners of a drawn spring.
_COILS = 8


def rig_drawing(scene: Scene) -> str:
    """Draw the bodies, springs, dampers, shakers and sensors of a scene, not to scale.

    >>> import rig
    >>> drawing = rig_drawing(rig.load("fig8-three-dampers"))
    >>> drawing.count('class="body"'), drawing.count('class="damper"')
    (3, 3)
    """
    structure = scene.structure
    count = structure.bodies
    height = 2 * _MARGIN + count * _BODY_HEIGHT + count * _SPACING
    tops = [height - _MARGIN - (body * (_BODY_HEIGHT + _SPACING)) for body in range(1, count + 1)]
    carriers = [shaker for shaker in scene.shakers if shaker.carries_structure]
    elements = [*map(_table, carriers, [height - _MARGIN])] or [_ground(height - _MARGIN)]
    for body in range(1, count + 1):
        elements += _body(scene, body, tops[body - 1])
    for number, shaker in enumerate(scene.shakers, 1):
        for body in shaker.bodies:
            elements += _shaker(shaker, tops[body - 1] + _BODY_HEIGHT / 2, number if len(scene.shakers) > 1 else None)
    if scene.test is not None and scene.hammer is not None:
        y = tops[scene.hammer - 1] + _BODY_HEIGHT / 2
        elements.append(f'<text x="4" y="{y - 12:g}">hammer, {scene.test.level_text(None)}</text>{_push(y, HAMMER)}')
    for joint in scene.joints:
        elements += _joint(joint, tops)
    elements += _channels(scene, tops)
    names = ", ".join(structure.labels)
    return (
        f'<svg role="img" aria-label="Drawing of the rig: {escape_html(names)}" viewBox="0 0 {_WIDTH} {height}" '
        f'width="{_WIDTH}" height="{height}" stroke-width="1.3" fill="none">{"".join(elements)}</svg>'
    )


def _ground(y: float) -> str:
    hatching = "".join(f"M{x} {y + 8}l10 -8" for x in range(_LEFT, _LEFT + _BODY_WIDTH, 12))
    return f'<path stroke="currentColor" d="M{_LEFT} {y}h{_BODY_WIDTH}{hatching}"/>'


def _table(shaker: Shaker, y: float) -> str:
    """Draw a table that carries the structure, whose top is at `y`."""
    return (
        f'<rect x="{_LEFT}" y="{y:g}" width="{_BODY_WIDTH}" height="14" rx="3" stroke="{TABLE}" fill="{TABLE}" '
        f'fill-opacity="0.2"/><text x="{_LEFT - 8}" y="{y + 11:g}" text-anchor="end">'
        f"{escape_html(shaker.glyph.title)}</text>"
    )


def _body(scene: Scene, body: int, top: float) -> Iterator[str]:
    """Draw a body, the spring below it (dashed if the scene gives matrices) and the dampers inside."""
    structure = scene.structure
    color = location_style(f"body {body}").color
    middle = _LEFT + _BODY_WIDTH / 2
    body_mass = "" if structure.masses is None else f", {structure.masses[body - 1]:.4g} kg"
    yield (
        f'<rect class="body" x="{_LEFT}" y="{top:g}" width="{_BODY_WIDTH}" height="{_BODY_HEIGHT}" rx="3" '
        f'stroke="{color}" fill="{color}" fill-opacity="0.12"/>'
        f'<text x="{_LEFT + 6}" y="{top + 16:g}">{escape_html(structure.label(body))}{body_mass}</text>'
    )
    stiffness = None if structure.springs is None else structure.springs[body - 1]
    if stiffness:
        yield _spring(_LEFT + 24, top + _BODY_HEIGHT, top + _BODY_HEIGHT + _SPACING)
        yield f'<text x="{_LEFT + 40}" y="{top + _BODY_HEIGHT + 22:g}">{stiffness / 1e3:.4g} kN/m</text>'
    elif stiffness is None:
        yield (f'<path stroke="currentColor" stroke-dasharray="3 4" d="M{middle} {top + _BODY_HEIGHT:g}v{_SPACING}"/>')
    dampers = [damper for damper in scene.dampers if damper.body == body]
    for k, damper in enumerate(dampers):
        x = _LEFT + 12 + k * (_BODY_WIDTH - 24) / max(len(dampers), 1)
        ceiling = "h-26" if isfinite(damper.clearance) else ""
        yield (
            f'<g class="damper"><path stroke="currentColor" d="M{x:g} {top + 23:g}v22h26v-22{ceiling}"/>'
            f'<circle cx="{x + 13:g}" cy="{top + 37:g}" r="7" fill="{DAMPER}"/></g>'
        )
        if len(dampers) == 1:
            clearance = (
                f", {format_number(1e3 * damper.clearance)} mm" if isfinite(damper.clearance) else ", no ceiling"
            )
            if damper.spring is not None:
                clearance = f", {damper.spring:.4g} N/m{f', {damper.walls_text}' if damper.has_walls else ''}"
            if damper.friction is not None:
                clearance += f", friction {damper.friction:.3g}"
            mass = (
                f"{1e3 * damper.mass:.4g} g" if damper.mass is not None else f"{100 * (damper.mass_ratio or 0):.3g} %"
            )
            locked = ", locked" if damper.locked else ""
            yield f'<text x="{x + 32:g}" y="{top + 43:g}">{mass}{locked}{clearance}</text>'


def _joint(joint: Joint, tops: Sequence[float]) -> Iterator[str]:
    """Draw the block of a joint between two neighboring bodies; other joints are listed in the settings."""
    lower, upper = joint.ends
    if upper is not None and upper == (0 if lower is None else lower + 1):
        x, y = _LEFT + _BODY_WIDTH - 30, tops[upper] + _BODY_HEIGHT
        yield (
            f'<path class="joint" stroke="currentColor" d="M{x} {y:g}v{_SPACING - 8}h14v{8 - _SPACING}"/>'
            f'<text x="{x + 20}" y="{y + _SPACING - 6:g}">{joint.short_text}</text>'
        )


def _spring(x: float, top: float, bottom: float, color: str = "currentColor") -> str:
    step = (bottom - top) / (_COILS + 2)
    zigzag = "".join(f"L{x + (7 if k % 2 else -7):g} {top + (k + 1) * step:g}" for k in range(1, _COILS + 1))
    return f'<path stroke="{color}" d="M{x:g} {top:g}v{step:g}{zigzag}L{x:g} {bottom:g}"/>'


def _shaker(shaker: Shaker, y: float, number: int | None) -> Iterator[str]:
    """Draw a shaker below an arm of the body that it drives, with its coil spring if it has one."""
    yield f'<text x="4" y="{y - 12:g}">{escape_html(shaker.glyph.title)}{"" if number is None else f" {number}"}</text>'
    if shaker.coil_spring is not None:
        yield f'<path stroke="currentColor" d="M{_SHAKER_X - 14} {y:g}H{_LEFT}"/>'
        yield _spring(_SHAKER_X, y, y + 33, TABLE)
        yield f'<rect x="{_SHAKER_X - 20}" y="{y + 33:g}" width="40" height="28" rx="3" stroke="currentColor"/>'
        yield f'<text x="{_SHAKER_X + 14}" y="{y + 22:g}">{shaker.coil_spring / 1e3:.4g} kN/m</text>'
    else:
        yield _push(y, TABLE)


def _push(y: float, color: str) -> str:
    """Draw a force in the direction of motion, at the end of an arm from the body to the left."""
    arrow = f'<path stroke="{color}" stroke-width="2" d="M{_SHAKER_X} {y + 40:g}V{y + 3:g}m-6 9l6 -9l6 9"/>'
    return f'<path stroke="currentColor" d="M{_SHAKER_X - 14} {y:g}H{_LEFT}"/>{arrow}'


def _channels(scene: Scene, tops: Sequence[float]) -> Iterator[str]:
    """Write the names of the channels next to the body or table at which their sensor is mounted."""
    names_at: dict[str, list[str]] = {}
    tables, other_channels = dict(scene.tables), []
    for channel in scene.channels or ():
        names_at.setdefault(channel.at, []).append(channel.name)
    for location, names in names_at.items():
        color = location_style(location).color
        carries_structure = location in tables and tables[location].carries_structure
        if location.startswith("body ") or carries_structure:
            number = 0 if carries_structure else int(location.removeprefix("body "))
            y = tops[number - 1] + _BODY_HEIGHT / 2 if number else tops[0] + _BODY_HEIGHT + _SPACING + 7
            x = _LEFT + _BODY_WIDTH
            yield (
                f'<path stroke="{color}" d="M{x} {y:g}h14"/><rect x="{x + 14}" y="{y - 6:g}" width="12" height="12" '
                f'fill="{color}"/><text x="{x + 32}" y="{y + 4:g}">{escape_html(", ".join(names))}</text>'
            )
        elif location in tables:
            y = tops[tables[location].first_body - 1] + _BODY_HEIGHT / 2
            yield (
                f'<rect x="{_SHAKER_X - 6}" y="{y + 41:g}" width="12" height="12" fill="{color}"/>'
                f'<text x="{_SHAKER_X + 26}" y="{y + 51:g}">{escape_html(", ".join(names))}</text>'
            )
        elif location != "hammer":
            other_channels.append(f"{', '.join(names)} ({location})")
    if other_channels:
        yield f'<text x="4" y="12">Other channels: {escape_html("; ".join(other_channels))}</text>'
