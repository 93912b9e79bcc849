"""The table of an import, a YAML or CSV file: the column of each channel in the files, and its unit."""

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from rig.core.base.errors import SceneError, suggestion
from rig.core.base.input_files import read_file
from rig.core.scene.yaml_reader import read_yaml
from rig.core.settings.quantities import SAMPLE_RATE, TIME, expected_quantity, parse

EXAMPLE = "body1: {column: ai0, unit: g, sign: -1}"
PYTHON_EXAMPLE = '{"body1": {"column": "ai0", "unit": "g", "sign": -1}}'
# Place for messages, name of the channel, and its keys or its column.
TableRows = list[tuple[str, str, Any]]


@dataclass(frozen=True)
class Column:
    """One line of the table.

    `unit`: unit of the numbers in the file, or the quantity that the number 1 represents, such as ``5 V``; None: as the
    file states. `sensitivity`: sensitivity of the sensor, such as ``100 mV/g``, if the numbers are volts; None: as the
    scene states.
    """

    column: str  # name of a signal in the files, or its number from 1
    file: str | None = None  # name of the file, if several files have a signal of this name
    unit: str | None = None
    sensitivity: str | None = None
    sign: int = 1  # -1 reverses a sensor that was mounted upside down
    offset: float = 0.0  # reading at rest, in the file's unit
    delay: float | None = None  # delay of the signal [s]; None: as the file's start times state
    rate: float | None = None  # sample rate [Hz], if the file states no rate or a wrong rate


_KEYS = [field.name for field in fields(Column)]


def columns_of(table: Any) -> dict[str, Column]:
    """Return the column of each channel of a table, which is a mapping in Python, or a YAML or CSV file.

    A channel's value in a mapping is a `Column`, a mapping with the keys of a line in a file, or the column alone.
    Raises one `SceneError` with all problems.

    >>> columns_of({"body1": {"column": "ai0", "unit": "g"}, "body2": 3})["body2"].column
    '3'
    """
    if table is None:
        return {}
    if isinstance(table, str | Path):
        rows = _rows_of_file(Path(table))
    elif isinstance(table, Mapping):
        rows = [("table", str(name), values) for name, values in table.items()]
    else:
        raise SceneError(f"table: got {table!r:.60}; expected a file or a mapping such as {PYTHON_EXAMPLE}")
    columns: dict[str, Column] = {}
    problems = []
    for place, name, values in rows:
        try:
            if name in columns:
                raise ValueError("a second line for this channel. Remove one of them.")
            columns[name] = values if isinstance(values, Column) else column(_keys_of(values))
        except ValueError as error:
            problems.append(f"{place}: {name}: {error}")
    if problems:
        raise SceneError("\n".join(problems))
    return columns


def _rows_of_file(path: Path) -> TableRows:
    try:
        text = read_file(path).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(
            f"cannot read {path}: {getattr(error, 'strerror', None) or error}. Give a YAML or CSV file."
        ) from None
    rows = _from_csv(path, text) if path.suffix.lower() == ".csv" else _from_yaml(path, text)
    if not rows:
        raise SceneError(f"{path} names no channel; expected lines such as {EXAMPLE}")
    return rows


def _keys_of(values: Any) -> Mapping[str, Any]:
    """Return the keys of a channel; its column may be stated alone, such as `body1: ai0`."""
    if isinstance(values, Mapping):
        return values
    if isinstance(values, bool) or not isinstance(values, str | int):
        raise ValueError(f"got {values!r:.60}; expected a column or a mapping such as {PYTHON_EXAMPLE}")
    return {"column": values}


def column(settings: Mapping[str, Any]) -> Column:
    """Check and convert the keys of one channel; raise `ValueError` for the first problem.

    >>> column({"column": "ai0", "unit": "g", "sign": "-1", "delay": "2 us"})
    Column(column='ai0', file=None, unit='g', sensitivity=None, sign=-1, offset=0.0, delay=2e-06, rate=None)
    """
    cell_texts = {key: text for key, value in settings.items() if value is not None and (text := str(value).strip())}
    for key in cell_texts:
        if key not in _KEYS:
            hint = suggestion(key, _KEYS)
            raise ValueError(f"unknown key {key!r}; expected one of {', '.join(_KEYS)}{hint and '. ' + hint}")
    if "column" not in cell_texts:
        raise ValueError("column missing; expected the name of a signal in the files, or its number from 1")
    values: dict[str, Any] = dict(cell_texts)
    if "sign" in cell_texts:
        if cell_texts["sign"] not in ("1", "+1", "-1", "+", "-"):
            raise ValueError(f"sign: got {cell_texts['sign']!r}; expected 1 or -1")
        values["sign"] = -1 if cell_texts["sign"].startswith("-") else 1
    for key, kind in (("delay", TIME), ("rate", SAMPLE_RATE)):
        if key in cell_texts:
            try:
                values[key] = parse(cell_texts[key], kind)
            except ValueError as error:
                raise ValueError(f"{key}: {error}; expected {expected_quantity(cell_texts[key], [kind])}") from None
            if not math.isfinite(values[key]) or (key == "rate" and values[key] <= 0):
                raise ValueError(f"{key}: got {cell_texts[key]!r}; expected {kind.noun} such as {kind.example}")
    if "offset" in cell_texts:
        try:
            values["offset"] = float(cell_texts["offset"])
        except ValueError:
            values["offset"] = math.nan
        if not math.isfinite(values["offset"]):
            raise ValueError(f"offset: got {cell_texts['offset']!r}; expected a number, in the file's unit")
    return Column(**values)


def _from_yaml(path: Path, text: str) -> TableRows:
    document = read_yaml(text)
    if document.problems:
        line, problem = document.problems[0]
        raise SceneError(f"{path}:{line}: {problem.message}")
    content = document.content if document.content is not None else {}
    if not isinstance(content, dict):
        raise SceneError(f"{path}: expected a line for each channel, such as {EXAMPLE}")
    return [(f"{path}:{document.line((name,))}", name, values) for name, values in content.items()]


def _from_csv(path: Path, text: str) -> TableRows:
    try:
        lines = list(csv.reader(text.splitlines()))
    except csv.Error as error:
        raise SceneError(f"{path} is not a table of channels: {error}. Save it as CSV.") from None
    if not lines or "channel" not in (column_names := [cell.strip() for cell in lines[0]]):
        raise SceneError(
            f"{path}:1: the heading has no column channel; expected channel,column and any of {','.join(_KEYS[1:])}."
        )
    rows: TableRows = []
    for number, line in enumerate(lines[1:], 2):
        if len(line) > len(column_names):
            raise SceneError(
                f"{path}:{number}: {len(line)} cells, but the heading has {len(column_names)}. Put cells that contain "
                "commas in double quotes."
            )
        if any(cell.strip() for cell in line):
            values = dict(zip(column_names, line, strict=False))
            rows.append((f"{path}:{number}", values.pop("channel").strip(), values))
    return rows
