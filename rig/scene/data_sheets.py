"""Data sheets of common sensors and modules, which a scene names as `preset`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from importlib.resources import files
from typing import Annotated, Any

import yaml
from pydantic import Field

from rig.errors import SceneError
from rig.scene.settings import Mistake

Preset = Annotated[str, Field(min_length=1, max_length=80)]

#: Settings that take a preset, by the key under which a data sheet has them.
KINDS = ("accelerometer", "hammer", "converter", "output")


@dataclass(frozen=True)
class DataSheet:
    """A part's data sheet."""

    name: str
    """Maker and model."""
    sources: tuple[str, ...]
    """Where the figures come from."""
    unchecked: tuple[str, ...]
    """Figures that could not be compared with a source."""
    settings: dict[str, dict[str, Any]]
    """For each kind of settings that may name it (`KINDS`), figures by the scene's keys, as a scene file has them."""
    facts: dict[str, Any]
    """Everything else: `module`, `inputs`, `outputs` (see `rig.scene.modules`), `teds` (see `rig.scene.teds`)."""


@cache
def data_sheets() -> dict[str, DataSheet]:
    """List the data sheets there are, by name.

    >>> sorted(data_sheets())
    ['NI 9234', 'NI 9250', 'NI 9260', 'NI 9263', 'PCB 086C03', 'PCB 352C33', 'USB-4431']
    """
    found = {}
    for file in files("rig.scene").joinpath("data", "presets").iterdir():
        if not file.name.endswith(".yaml"):
            continue
        sheet = yaml.safe_load(file.read_text(encoding="utf-8"))
        name, sources = sheet.pop("part"), tuple(sheet.pop("sources"))
        unchecked = tuple(sheet.pop("unchecked", ()))
        settings = {kind: sheet.pop(kind) for kind in KINDS if kind in sheet}
        found[name] = DataSheet(name, sources, unchecked, settings, sheet)
    return found


def data_sheet(name: str, kind: str) -> DataSheet:
    """Find the data sheet of a part; capitals, spaces and hyphens do not matter.

    Parameters
    ----------
    name : str
        Of the part.
    kind : str
        What it has to tell of: one of `KINDS`, or ``"module"``.

    Raises
    ------
    SceneError
        If there is none of that name that does.
    """
    known = {
        _plain(each.name): each
        for each in data_sheets().values()
        if kind in each.settings or kind in each.facts
    }
    if _plain(name) in known:
        return known[_plain(name)]
    names = sorted(each.name for each in known.values())
    near = get_close_matches(_plain(name), known, n=1)
    hint = f'; did you mean "{known[near[0]].name}"?' if near else ""
    raise SceneError(f'unknown {kind} preset "{name}"; there is {", ".join(names)}{hint}')


def _plain(name: str) -> str:
    return "".join(letter for letter in name.lower() if letter.isalnum())


def unknown_preset(preset: str | None, kind: str) -> Iterable[Mistake]:
    """Check that there is a data sheet of the part that settings of a kind name as their preset."""
    if preset is not None:
        try:
            data_sheet(preset, kind)
        except SceneError as error:
            yield Mistake(("preset",), str(error))
