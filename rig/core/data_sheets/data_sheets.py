"""Data sheets of common sensors, shakers and converter modules, which a scene names as `preset`."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Annotated, Any

import yaml
from pydantic import Field

from rig.core.base.errors import SceneError
from rig.core.settings.problems import Problem

Preset = Annotated[str, Field(min_length=1, max_length=80)]

#: Settings that accept a preset, by their key in a data sheet.
KINDS = ("accelerometer", "hammer", "converter", "output", "shaker")


@dataclass(frozen=True)
class DataSheet:
    """Data sheet of a sensor, shaker or module; `preset: NAME` in a scene takes its values."""

    name: str
    """Maker and model."""
    summary: str
    """Description: the first line of its file."""
    sources: tuple[str, ...]
    """Sources of the figures."""
    unsourced: tuple[str, ...]
    """Values without a source (key `unchecked` of the file)."""
    settings: dict[str, dict[str, Any]]
    """Data-sheet values for each part of a scene that accepts the preset (`KINDS`), as in scene files."""
    facts: dict[str, Any]
    """All other data: `module`, `inputs`, `outputs` (see `modules`), `teds` (IEEE 1451.4)."""

    @property
    def unsourced_note(self) -> str:
        """Sentence that lists the figures without a source; empty if every figure has a source."""
        return f"No source at hand for {', '.join(self.unsourced)}." if self.unsourced else ""


@cache
def data_sheets() -> dict[str, DataSheet]:
    """List the available data sheets by name.

    >>> list(data_sheets())  # doctest: +ELLIPSIS
    ['BK 8206', 'LDS V203', 'NI 9234', ..., 'PCB 356B18', 'USB-4431']
    """
    sheets = {}
    folder = files("rig.core.data_sheets") / "presets"
    for file in sorted(folder.iterdir(), key=lambda file: file.name):
        if not file.name.endswith(".yaml"):
            continue
        text = file.read_text(encoding="utf-8")
        sheet, summary = yaml.safe_load(text), text.partition("\n")[0].lstrip("# ")
        name, sources = sheet.pop("part"), tuple(sheet.pop("sources"))
        unsourced = tuple(sheet.pop("unchecked", ()))
        settings = {kind: sheet.pop(kind) for kind in KINDS if kind in sheet}
        sheets[name] = DataSheet(name, summary, sources, unsourced, settings, sheet)
    return sheets


def data_sheet(name: str, kind: str | None = None) -> DataSheet:
    """Return the data sheet of a name; case, spaces and hyphens are ignored.

    `kind`: required kind, one of `KINDS` or ``"module"``; default: any. Raises `SceneError` if no data sheet has that
    name and kind.
    """
    candidates = {
        _normalize(sheet.name): sheet
        for sheet in data_sheets().values()
        if kind is None or kind in sheet.settings or kind in sheet.facts
    }
    if _normalize(name) in candidates:
        return candidates[_normalize(name)]
    from difflib import get_close_matches

    names = sorted(sheet.name for sheet in candidates.values())
    similar = get_close_matches(_normalize(name), candidates, n=1)
    hint = f". Did you mean {candidates[similar[0]].name!r}?" if similar else ""
    noun = f"{kind} preset" if kind else "preset"
    raise SceneError(f"unknown {noun} {name!r}; expected one of {', '.join(names)}{hint}")


def describe_preset(name: str) -> list[str]:
    """Return lines with every value that a scene takes from a preset; values without a source are marked.

    Raises `SceneError` if no data sheet has that name.

    >>> describe_preset("ni9263")[1:4]
    ['  as output: {preset: NI 9263}', '    bits   16', '    range  10 V']
    """
    sheet = data_sheet(name)
    lines = [f"{sheet.name}: {sheet.summary}"]
    for kind, settings in sheet.settings.items():
        figures = dict(_flatten(settings))
        width = max(map(len, figures))
        lines.append(f"  as {kind}: {{preset: {sheet.name}}}")
        for key, value in figures.items():
            mark = "   (no source at hand)" if {key, f"{kind} {key}"} & set(sheet.unsourced) else ""
            lines.append(f"    {key:{width}}  {str(value).lower() if isinstance(value, bool) else value}{mark}")
    lines += ["  from", *(f"    {source}" for source in sheet.sources)]
    return (
        [*lines, f"  {sheet.unsourced_note} Check these values before you rely on them."] if sheet.unsourced else lines
    )


def _flatten(settings: dict[str, Any]) -> Iterable[tuple[str, Any]]:
    """Yield the values of nested settings with dotted names, such as coil.resistance."""
    for key, value in settings.items():
        if isinstance(value, dict):
            yield from ((f"{key}.{inner}", figure) for inner, figure in value.items())
        else:
            yield key, value


def _normalize(name: str) -> str:
    return "".join(letter for letter in name.lower() if letter.isalnum())


def check_preset(preset: str | None, kind: str) -> Iterable[Problem]:
    """Check that a preset has a data sheet for this part of a scene."""
    if preset is not None:
        try:
            data_sheet(preset, kind)
        except SceneError as error:
            yield Problem(("preset",), str(error))
