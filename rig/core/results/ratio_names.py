"""Names and units of frequency responses: motion over the reference, which is a force or the motion of a table."""

from typing import TypeVar

from rig.core.base.errors import SceneError

_Values = TypeVar("_Values")

_NAMES = {
    ("displacement", "force"): ("compliance", "m/N"),
    ("velocity", "force"): ("mobility", "m/(N s)"),
    ("acceleration", "force"): ("accelerance", "m/(N s²)"),
    ("displacement", "table"): ("transmissibility", "m/m"),
    ("velocity", "table"): ("velocity per table displacement", "1/s"),
    ("acceleration", "table"): ("acceleration per table displacement", "1/s²"),
}
_RATIO = ("ratio", "1")
# By SI unit: the unit in which curves are drawn and printed, and the factor from SI to this unit.
_DISPLAY_UNITS = {"m/N": ("µm/N", 1e6), "m/(N s)": ("mm/(N s)", 1e3)}
#: SI units of the references.
REFERENCE_UNITS = {"force": "N", "table": "m"}


def ratio_name(motion: str, reference: str) -> tuple[str, str]:
    """Return the name of a motion over a reference, and its SI unit."""
    return _NAMES.get((motion, reference), _RATIO)


def display_unit(unit: str) -> tuple[str, float]:
    """Return the unit in which a ratio is drawn and printed, and the factor from its SI unit."""
    return _DISPLAY_UNITS.get(unit, (unit, 1.0))


def frf_display(reference: str) -> tuple[str, str, float]:
    """Return the name of displacement over a reference, the unit in which it is printed, and the factor from SI."""
    name, unit = ratio_name("displacement", reference)
    return name, *display_unit(unit)


def per_force(value: _Values, reference: str) -> _Values:
    """Return values that are valid with the force as reference; raises `SceneError` with a different reference."""
    if reference != "force":
        raise SceneError(
            f"compliance: the reference is the displacement of the {reference}, not a force. Use frf and "
            "reference_amplitude."
        )
    return value
