"""The table of an import: which column of which file is which channel, and what its numbers mean."""

from __future__ import annotations

import csv
import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from rig.errors import SceneError
from rig.input_files import read_whole
from rig.scene.quantities import FREQUENCY, TIME, parse
from rig.scene.yaml_reader import read

EXAMPLE = "body1: {column: ai0, unit: g, sign: -1}"


@dataclass(frozen=True)
class Column:
    """One line of the table.

    Attributes
    ----------
    column : str
        Name of a signal in the files, or its number from 1.
    file : str or None
        Name of the file it is in, where several files have such a one.
    unit : str or None
        What one in the file means: a unit, or a number of them, ``5 V``; None: as the file says.
    sensitivity : str or None
        Volts per unit of the sensor, ``100 mV/g``, where the file's numbers are volts; None: as the scene says.
    sign : int
        -1 turns a sensor round that was mounted upside down.
    offset : float
        Reading at rest, in the file's unit.
    delay : float or None
        By how much the signal comes late, s; None: as the file's start times say.
    rate : float or None
        Samples per second, Hz, where the file says none, or a wrong one.
    """

    column: str
    file: str | None = None
    unit: str | None = None
    sensitivity: str | None = None
    sign: int = 1
    offset: float = 0.0
    delay: float | None = None
    rate: float | None = None


_KEYS = [field.name for field in fields(Column)]


def read_table(path: Path) -> dict[str, Column]:
    """Read a table, YAML or CSV: what it says of each channel, by the channel's name.

    Raises
    ------
    SceneError
        If the file cannot be read or says something that no import knows; all that is wrong is said at once.
    """
    try:
        text = read_whole(path).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from None
    rows = _from_csv(path, text) if path.suffix.lower() == ".csv" else _from_yaml(path, text)
    table: dict[str, Column] = {}
    wrong: list[str] = []
    for line, name, given in rows:
        where = f"{path}:{line}: {name}"
        if name in table:
            wrong.append(f"{where}: there is a line for this channel already")
            continue
        try:
            table[name] = column(given)
        except ValueError as error:
            wrong.append(f"{where}: {error}")
    if not rows:
        wrong.append(f"{path} names no channel; expected lines such as {EXAMPLE}")
    if wrong:
        raise SceneError("\n".join(wrong))
    return table


def column(given: Mapping[str, Any]) -> Column:
    """Check what is said of one channel; raise `ValueError` in words.

    >>> column({"column": "ai0", "unit": "g", "sign": "-1", "delay": "2 us"})
    Column(column='ai0', file=None, unit='g', sensitivity=None, sign=-1, offset=0.0, delay=2e-06, rate=None)
    """
    said = {
        key: str(value).strip() for key, value in given.items() if value is not None and str(value).strip()
    }
    for key in said:
        if key not in _KEYS:
            near = difflib.get_close_matches(key, _KEYS, n=1)
            raise ValueError(
                f"unknown key {key!r}; expected one of {', '.join(_KEYS)}" + (f"; {near[0]}?" if near else "")
            )
    if "column" not in said:
        raise ValueError("column missing; expected the name of a signal in the files, or its number from 1")
    made: dict[str, Any] = {
        key: said[key] for key in ("column", "file", "unit", "sensitivity") if key in said
    }
    if "sign" in said:
        if said["sign"] not in ("1", "+1", "-1", "+", "-"):
            raise ValueError(f"sign: got {said['sign']!r}; expected 1 or -1")
        made["sign"] = -1 if said["sign"].startswith("-") else 1
    for key, kind in (("delay", TIME), ("rate", FREQUENCY)):
        if key in said:
            try:
                made[key] = parse(said[key], kind)
            except ValueError as error:
                raise ValueError(f"{key}: {error}; expected {kind.noun} such as {kind.example}") from None
            if not math.isfinite(made[key]) or (key == "rate" and made[key] <= 0):
                raise ValueError(f"{key}: got {said[key]!r}; expected {kind.noun} such as {kind.example}")
    if "offset" in said:
        try:
            made["offset"] = float(said["offset"])
        except ValueError:
            made["offset"] = math.nan
        if not math.isfinite(made["offset"]):
            raise ValueError(f"offset: got {said['offset']!r}; expected a number, in the file's unit")
    return Column(**made)


Rows = list[tuple[int, str, Mapping[str, Any]]]


def _from_yaml(path: Path, text: str) -> Rows:
    document = read(text)
    if document.mistakes:
        line, mistake = document.mistakes[0]
        raise SceneError(f"{path}:{line}: {mistake.message}")
    content = document.content if document.content is not None else {}
    if not isinstance(content, dict):
        raise SceneError(f"{path}: expected a line for each channel, such as {EXAMPLE}")
    rows: Rows = []
    for name, given in content.items():
        # A channel whose column is all there is to say: body1: ai0
        said = given if isinstance(given, dict) else {"column": given}
        rows.append((document.line((name,)), name, said))
    return rows


def _from_csv(path: Path, text: str) -> Rows:
    try:
        lines = list(csv.reader(text.splitlines()))
    except csv.Error as error:
        raise SceneError(f"{path} is no table of channels: {error}") from None
    if not lines or "channel" not in (heading := [cell.strip() for cell in lines[0]]):
        raise SceneError(
            f"{path}:1: expected the heading channel,column,{','.join(_KEYS[1:])}, as far as it is needed"
        )
    rows: Rows = []
    for number, line in enumerate(lines[1:], 2):
        if not any(cell.strip() for cell in line):
            continue
        if len(line) > len(heading):
            raise SceneError(f"{path}:{number}: {len(line)} cells under a heading of {len(heading)}")
        given = dict(zip(heading, line, strict=False))
        rows.append((number, given.pop("channel").strip(), given))
    return rows
