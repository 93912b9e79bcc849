"""Settings of a part named as `preset`: what the scene gives, and from its data sheet what it does not."""

from __future__ import annotations

from typing import TypeVar

from pydantic import ValidationError

from rig.errors import SceneError
from rig.scene.data_sheets import part
from rig.scene.measurement_chain import Accelerometer, Converter, Hammer

Device = TypeVar("Device", Accelerometer, Hammer, Converter)


def filled_in(settings: Device) -> Device:
    """Fill in from the preset, if there is one, what is not given.

    Raises
    ------
    SceneError
        If there is no such part, or what is given does not go with it.

    Examples
    --------
    >>> filled_in(Converter(preset="NI 9234", range=10.0)).bits, filled_in(Converter(preset="ni9234")).range
    (24, 5.0)
    """
    if settings.preset is None:
        return settings
    kind = type(settings).__name__.lower()
    sheet = part(settings.preset, kind)
    given = {
        name: value for name in type(settings).model_fields if (value := getattr(settings, name)) is not None
    }
    try:
        return type(settings).model_validate({**sheet.settings, **given})
    except ValidationError as error:
        reasons = "; ".join(f"{'.'.join(map(str, item['loc']))}: {item['msg']}" for item in error.errors())
        raise SceneError(f"{kind} with preset {sheet.name!r}: {reasons}") from None
