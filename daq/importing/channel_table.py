"""The table of an import: the column of each channel, and the unit of its numbers."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from rig.errors import SceneError, suggestion
from rig.input_files import read_file
from rig.scene.quantities import FREQUENCY, TIME, parse
from rig.scene.yaml_reader import read_yaml

EXAMPLE = "body1: {column: ai0, unit: g, sign: -1}"
# Line, channel, and the keys given for it.
Rows = list[tuple[int, str, Mapping[str, Any]]]


@dataclass(frozen=True)
class Column:
    """One line of the table.

    `unit`: meaning of 1 in the file: a unit, or a number of units, ``5 V``; None: as the file states; `sensitivity`:
    volts per unit of the sensor, ``100 mV/g``, where the file's numbers are volts; None: as the scene states.
    """

    column: str  # name of a signal in the files, or its number from 1
    file: str | None = None  # name of the file it is in, where several files have such a signal
    unit: str | None = None
    sensitivity: str | None = None
    sign: int = 1  # -1 reverses a sensor that was mounted upside down
    offset: float = 0.0  # reading at rest, in the file's unit
    delay: float | None = None  # delay of the signal, s; None: as the file's start times state
    rate: float | None = None  # samples per second, Hz, where the file states none, or a wrong value


_KEYS = [field.name for field in fields(Column)]


def read_table(path: Path) -> dict[str, Column]:
    """Read a YAML or CSV table into a column for each channel name; raise `SceneError` with all mistakes at once."""
    try:
        text = read_file(path).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from None
    rows = _from_csv(path, text) if path.suffix.lower() == ".csv" else _from_yaml(path, text)
    table: dict[str, Column] = {}
    mistakes = [] if rows else [f"{path} names no channel; expected lines such as {EXAMPLE}"]
    for line, name, values in rows:
        try:
            if name in table:
                raise ValueError("a second line for this channel")
            table[name] = column(values)
        except ValueError as error:
            mistakes.append(f"{path}:{line}: {name}: {error}")
    if mistakes:
        raise SceneError("\n".join(mistakes))
    return table


def column(settings: Mapping[str, Any]) -> Column:
    """Check the keys of one channel; raise `ValueError` in words.

    >>> column({"column": "ai0", "unit": "g", "sign": "-1", "delay": "2 us"})
    Column(column='ai0', file=None, unit='g', sensitivity=None, sign=-1, offset=0.0, delay=2e-06, rate=None)
    """
    texts = {key: text for key, value in settings.items() if value is not None and (text := str(value).strip())}
    for key in texts:
        if key not in _KEYS:
            hint = suggestion(key, _KEYS)
            raise ValueError(f"unknown key {key!r}; expected one of {', '.join(_KEYS)}{hint and '. ' + hint}")
    if "column" not in texts:
        raise ValueError("column missing; expected the name of a signal in the files, or its number from 1")
    values: dict[str, Any] = dict(texts)
    if "sign" in texts:
        if texts["sign"] not in ("1", "+1", "-1", "+", "-"):
            raise ValueError(f"sign: got {texts['sign']!r}; expected 1 or -1")
        values["sign"] = -1 if texts["sign"].startswith("-") else 1
    for key, kind in (("delay", TIME), ("rate", FREQUENCY)):
        if key in texts:
            expected = f"expected {kind.noun} such as {kind.example}"
            try:
                values[key] = parse(texts[key], kind)
            except ValueError as error:
                raise ValueError(f"{key}: {error}; {expected}") from None
            if not math.isfinite(values[key]) or (key == "rate" and values[key] <= 0):
                raise ValueError(f"{key}: got {texts[key]!r}; {expected}")
    if "offset" in texts:
        try:
            values["offset"] = float(texts["offset"])
        except ValueError:
            values["offset"] = math.nan
        if not math.isfinite(values["offset"]):
            raise ValueError(f"offset: got {texts['offset']!r}; expected a number, in the file's unit")
    return Column(**values)


def _from_yaml(path: Path, text: str) -> Rows:
    document = read_yaml(text)
    if document.mistakes:
        line, mistake = document.mistakes[0]
        raise SceneError(f"{path}:{line}: {mistake.message}")
    content = document.content if document.content is not None else {}
    if not isinstance(content, dict):
        raise SceneError(f"{path}: expected a line for each channel, such as {EXAMPLE}")
    # A line of a column alone: `body1: ai0`.
    return [
        (document.line((name,)), name, values if isinstance(values, dict) else {"column": values})
        for name, values in content.items()
    ]


def _from_csv(path: Path, text: str) -> Rows:
    try:
        lines = list(csv.reader(text.splitlines()))
    except csv.Error as error:
        raise SceneError(f"{path} is not a table of channels: {error}. Save it as CSV.") from None
    if not lines or "channel" not in (heading := [cell.strip() for cell in lines[0]]):
        raise SceneError(f"{path}:1: expected the heading channel,column and any of {','.join(_KEYS[1:])}")
    rows: Rows = []
    for number, line in enumerate(lines[1:], 2):
        if len(line) > len(heading):
            raise SceneError(
                f"{path}:{number}: {len(line)} cells under a heading of {len(heading)}. "
                "Quote cells that contain commas."
            )
        if any(cell.strip() for cell in line):
            values = dict(zip(heading, line, strict=False))
            rows.append((number, values.pop("channel").strip(), values))
    return rows
