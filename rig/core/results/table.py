"""A table of texts: printed by the commands, and written as HTML for notebooks and for the report page."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from rig.core.base.escaping import escape_html
from rig.core.results.text import table_lines

# A hyphen that is a minus sign.
_HYPHEN = re.compile(r"(?<![\w.-])-(?=\d)")
# Spaces at which a line must not break, such as that between number and unit.
_NO_BREAK = re.compile(
    r" (?==)|(?<==) |(?<=\bk) (?=u\b)|(?<=\bFig) (?=\d)"
    r"|(?<=[\d)]) (?=(?:%|[kM]?Hz|[kmµ]?N|dB|g|kg|m?s|[mµ]?m|m?V|µm/N|m/s²|k?N/m|mm/s)(?![\w/]))| (?=±)|(?<=±) "
    r"|(?<=\d) (?=→)|(?<=→) (?=\d)|(?<=Δf) |(?<=\d) (?=to [+\u2212]?\d)"
    r"|(?<=\d to) (?=[+\u2212]?\d)|(?<=least) (?=\d)|(?<=at) (?=least)|(?<=≥) "
    r"|(?<=\bat) (?=\d)| (?=at [\d.]+ \w+(?: →|$))|(?<=\bbody) (?=\d)"
)
_CODE = re.compile("`([^`]+)`")


def typeset(text: str) -> str:
    """Return text as HTML, with minus signs and without line breaks between numbers and their units.

    >>> typeset("-0.5 Hz (<1 ± 2 %), a-1").replace(chr(160), "_")
    '−0.5_Hz (&lt;1_±_2_%), a-1'
    """
    return _CODE.sub(r"<code>\1</code>", escape_html(_NO_BREAK.sub("\u00a0", _HYPHEN.sub("\u2212", text))))


@dataclass(frozen=True)
class Table:
    """A table of texts; columns that are empty below the heading are omitted.

    `alignment`: ``<`` or ``>`` for each column. A row with one cell is a subheading.
    """

    heading: Sequence[str]
    alignment: str
    rows: Sequence[Sequence[str]]

    def lines(self, indent: str = "") -> list[str]:
        """Return the lines of the table with their heading; no line without rows."""
        lines = table_lines([self.heading, *(row for row in self.rows if len(row) > 1)], self.alignment)
        for k, row in enumerate(self.rows, 1):
            if len(row) == 1:
                lines.insert(k, row[0])
        return [indent + line for line in lines]

    def html(self, caption: str = "") -> str:
        """Return the table as HTML, an empty text without rows."""
        if not self.rows:
            return ""
        filled = [k for k in range(len(self.heading)) if any(len(row) > 1 and row[k] for row in self.rows)]
        names = {k: typeset(self.heading[k].replace(" / ", " /\u00a0")) for k in filled}
        align = {k: ' class="number"' * (self.alignment[k] == ">") for k in filled}
        head = "".join(f"<th{align[k]}>{names[k]}</th>" for k in filled)
        body, is_titled = "", False
        for row in self.rows:
            # A group is not divided between pages: rows without a first cell, and the row below a subheading.
            body += "</tbody><tbody>" * bool(body and row[0] and not is_titled)
            if is_titled := len(row) == 1:
                body += f'<tr><th class="group" colspan="{len(filled)}">{typeset(row[0])}</th></tr>'
                continue
            # Cells name their column, so that programs find them in the page.
            cells = [f'<td{align[k]} data-label="{names[k]}">{typeset(row[k])}</td>' for k in filled]
            body += f"<tr>{''.join(cells)}</tr>"
        kind = "" if self.heading[0] else ' class="matrix"'
        title = f"<caption>{typeset(caption)}</caption>" if caption else ""
        return (
            f'<div class="wide"><table{kind}>{title}<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
        )


def join_tables(tables: Iterable[tuple[str, Table]]) -> Table:
    """Join tables; their titles become subheadings, and cells in columns that a table lacks are empty."""
    columns: dict[tuple[str, int], str] = {}
    rows = list[Sequence[str]]()
    pairs = [(title, table, _numbered(table.heading)) for title, table in tables]
    for _, table, keys in pairs:
        columns |= dict(zip(keys, table.alignment, strict=True))
    for title, table, keys in pairs:
        rows += [(title,)] * bool(title and table.rows)
        for row in table.rows:
            cells = dict(zip(keys, row, strict=False))
            rows.append([cells.get(key, "") for key in columns] if len(row) > 1 else row)
    return Table([name for name, _ in columns], "".join(columns.values()), rows)


def _numbered(heading: Sequence[str]) -> list[tuple[str, int]]:
    """Return each name with its number of earlier occurrences: columns of a table may have the same name."""
    return [(name, list(heading[:k]).count(name)) for k, name in enumerate(heading)]
