"""Headings with a keyword in the first cell of each line, as analyzers export them: names and units of the columns.

Layouts: B&K PULSE (``X-AxisUnit:``, ``AmplitudeUnit:``, ``Data Type: Complex``),
Siemens Testlab (``Function class``, ``Point id``), ME'scope (``Y Axis DOFs``, ``Y Axis Units``) and m+p (``Channel``,
``Unit``). A keyword line has one cell for the file, one per column, or one per pair of columns.
"""

import re
from collections.abc import Mapping, Sequence

# Keywords, in lower case without spaces and punctuation. If several occur in a file, the first is used.
_NAMES = (
    "yaxisdofs", "pointid", "channelname", "channel", "kanalname", "kanal", "signalname", "signal", "name",
    "tracename", "measurementlabel", "title",
)  # fmt: skip
_UNITS = (
    "yaxisunits", "yaxisunit", "amplitudeunit", "channelunit", "units", "unit", "einheit", "vunit", "verticalunits",
)  # fmt: skip
_ABSCISSA_UNITS = ("xaxisunits", "xaxisunit", "xeinheit")
# Keywords of the kind of data. Complex data have two columns for each function.
_KINDS = ("datatype", "yaxistype", "functionclass", "measurementtype")
# Texts of the kind of complex data stored as pairs of real and imaginary parts.
_COMPLEX = re.compile(r"complex|real|frf|frequency response", re.IGNORECASE)
# Texts of the kind of complex data stored as pairs of magnitude and phase.
_POLAR = re.compile(r"magnitude|amplitude|phase", re.IGNORECASE)


def keyed_heading(rows: Sequence[Sequence[str]], column_count: int) -> tuple[list[str], list[str]] | None:
    """Return names and units from the lines of a heading, split into cells; None without a keyword for units.

    >>> keyed_heading([["Channel", "force", "tip"], ["Unit", "N", "g"]], 3)
    (['time', 'force', 'tip'], ['s', 'N', 'g'])
    """
    cells: dict[str, list[str]] = {}
    for row in rows:
        parts = list(row) if len(row) > 1 else [part.strip() for part in "".join(row).split(":", 1)]
        cells.setdefault(re.sub(r"[\W_]", "", parts[0]).lower(), parts[1:])
    count = column_count - 1
    units = _for_columns(cells, _UNITS, count)
    if units is None or count < 1:
        return None
    abscissa = next((text for key in _ABSCISSA_UNITS for text in cells.get(key, []) if text), "s")
    names = _for_columns(cells, _NAMES, count) or [""] * count
    kind = " ".join(text for key in _KINDS for text in cells.get(key, []))
    if count % 2 == 0 and (_COMPLEX.search(kind) or _POLAR.search(kind)):
        suffixes = ("real", "imag") if _COMPLEX.search(kind) else ("magnitude", "phase")
        pairs = zip(names[::2], names[1::2], strict=True)
        # One name of a pair is empty or repeats the other name.
        names = [f"{first or second} {suffix}".strip() for first, second in pairs for suffix in suffixes]
        units = [unit for pair in zip(units[::2], units[1::2], strict=True) for unit in [pair[0] or pair[1]] * 2]
    first = "frequency" if abscissa.lower() == "hz" else "time"
    return [first, *names], [abscissa, *units]


def _for_columns(cells: Mapping[str, Sequence[str]], keys: Sequence[str], count: int) -> list[str] | None:
    """Return one text per column after the first (the abscissa); None if no keyword has this number of texts."""
    for key in keys:
        texts = list(cells.get(key, []))
        stated = [text for text in texts if text]
        # A line of names may end with a delimiter; a further text belongs to the first column, which is then a signal.
        if len(texts) == count + 1 and texts[-1]:
            continue
        if len(texts) in (count, count + 1) and len(stated) > 1:
            return texts[:count]
        if len(stated) == 1:
            return stated * count
        if stated and 2 * len(stated) == count:
            return [text for text in stated for _ in range(2)]
        if len(stated) == count:
            return stated
    return None
