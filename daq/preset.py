"""Parts by name: data sheets of common sensors and modules, to be named in a scene as `preset`."""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from importlib.resources import files
from typing import Any, TypeVar

import yaml
from pydantic import ValidationError

from rig.errors import SceneError
from rig.quantities import FREQUENCY, parse
from rig.sensor_settings import Accelerometer, Converter, Hammer

Device = TypeVar("Device", Accelerometer, Hammer, Converter)


@dataclass(frozen=True)
class Part:
    """A part's data sheet.

    Attributes
    ----------
    name : str
        Maker and model.
    kind : str
        accelerometer, hammer or converter.
    sources : tuple of str
        Where the figures come from.
    settings : dict of str to any
        Figures by the scene's keys, as a scene file has them.
    clock, largest_divisor : float or None and int
        A module's clock [Hz] and by how much it can be divided; None: any rate.
    """

    name: str
    kind: str
    sources: tuple[str, ...]
    settings: dict[str, Any]
    clock: float | None
    largest_divisor: int


@cache
def parts() -> dict[str, Part]:
    """List the parts there are, by name.

    >>> sorted(parts())
    ['NI 9234', 'PCB 086C03', 'PCB 352C33']
    """
    found = {}
    for file in files("daq").joinpath("presets").iterdir():
        if not file.name.endswith(".yaml"):
            continue
        sheet = yaml.safe_load(file.read_text(encoding="utf-8"))
        clock = sheet.get("clock", {})
        found[sheet["part"]] = Part(
            sheet["part"],
            sheet["kind"],
            tuple(sheet["sources"]),
            sheet["settings"],
            parse(clock["frequency"], FREQUENCY) if clock else None,
            clock.get("largest_divisor", 1),
        )
    return found


def part(name: str, kind: str) -> Part:
    """Find a part; capitals, spaces and hyphens do not matter.

    Raises
    ------
    SceneError
        If there is none of that name and kind.
    """
    known = {_plain(each.name): each for each in parts().values() if each.kind == kind}
    if _plain(name) in known:
        return known[_plain(name)]
    names = sorted(each.name for each in known.values())
    near = get_close_matches(_plain(name), known, n=1)
    hint = f"; did you mean {known[near[0]].name!r}?" if near else ""
    raise SceneError(f"unknown {kind} preset {name!r}: there is {', '.join(names)}{hint}")


def _plain(name: str) -> str:
    return "".join(letter for letter in name.lower() if letter.isalnum())


def filled_in(settings: Device) -> Device:
    """Fill in from the preset, if there is one, what is not given.

    Parameters
    ----------
    settings : Accelerometer, Hammer or Converter
        As a scene has them.

    Returns
    -------
    Accelerometer, Hammer or Converter
        The same kind.

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
