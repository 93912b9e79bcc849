"""SVG drawing of an animated mode shape in a report."""

from collections.abc import Sequence

from analysis.commands.figures.modes_figure import is_known_shape
from analysis.core.modal.modes import BodyShapes
from rig.core.base.escaping import escape_html
from rig.core.base.palette import location_styles
from rig.core.results.table import typeset
from rig.core.results.uncertainty import expand

# Size of a body in a mode shape [px].
_SHAPE_WIDTH = 90
_SHAPE_HEIGHT = 26
# Width of a mode shape [px], wide enough for the values at the right, which are larger on phones.
_SHAPE_VIEW = 228
# Distance between two bodies in a mode shape [px].
_SHAPE_SPACING = 36
# Amplitude of the largest component of an animated mode shape [px], so small that bodies in antiphase do not meet.
_MAX_AMPLITUDE = 0.45 * _SHAPE_SPACING


def mode_drawing(shapes: BodyShapes, locations: Sequence[str], mode: int, title: str) -> str:
    """Draw a mode shape; outlines show the bodies at rest, and `locations` of the bodies determine their colors."""
    count, uncertainties = len(shapes.names), expand(shapes.errors[:, mode])
    opacity = 1.0 if is_known_shape(uncertainties) else 0.4
    height = count * (_SHAPE_HEIGHT + _SHAPE_SPACING)
    parts = []
    for k, (name, style) in enumerate(zip(shapes.names, location_styles(locations), strict=True)):
        y = height - _SHAPE_SPACING // 2 - k * (_SHAPE_HEIGHT + _SHAPE_SPACING) - _SHAPE_HEIGHT
        component, expanded = float(shapes.shapes[k, mode].real), float(uncertainties[k])
        bar = _MAX_AMPLITUDE * min(expanded, 1.0)
        interval = f" ± {expanded:.2f}" if expanded >= 0.005 else ""
        box = f'x="24" y="{y}" width="{_SHAPE_WIDTH}" height="{_SHAPE_HEIGHT}" rx="3"'
        parts.append(
            f'<rect {box} stroke="currentColor" stroke-opacity="0.4" stroke-dasharray="3 3"/>'
            f'<g class="moving" style="--swing:{_MAX_AMPLITUDE * component:.2f}px">'
            f'<rect {box} fill="var(--page)"/>'
            f'<rect {box} stroke="{style.color}" fill="{style.color}" fill-opacity="0.15"/>'
            f'<text x="30" y="{y + 17}">{escape_html(name)}</text>'
            f'<path class="bound" stroke="currentColor" d="M{_SHAPE_WIDTH + 18} '
            f'{y + _SHAPE_HEIGHT / 2 - bar:.2f}v{2 * bar:.2f}m-3 0h6m0 {-2 * bar:.2f}h-6"/></g>'
            f'<text x="{_SHAPE_WIDTH + 32}" y="{y + 17}">{f"{component:+.2f}".replace("-", "−")}{interval}</text>'
        )
    return (
        f'<figure><svg role="img" aria-label="Mode shape at {escape_html(title)}" viewBox="0 0 {_SHAPE_VIEW} {height}" '
        f'width="{_SHAPE_VIEW}" height="{height}" fill="none" opacity="{opacity}"><path stroke="currentColor" '
        f'd="M10 34V14m-4 6l4 -6l4 6"/><text x="6" y="48">+</text>{"".join(parts)}</svg>'
        f"<figcaption>{typeset(title)}</figcaption></figure>"
    )
