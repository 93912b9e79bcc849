"""Tables show any text of a recording unchanged."""

from __future__ import annotations

import csv
from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import given, settings
from hypothesis import strategies as st

from analysis.presentation.tables import write_table
from rig.escaping import escape_terminal


@settings(max_examples=25)
@given(st.text(st.characters(codec=None), max_size=20))
def test_any_text_survives_table(text: str) -> None:
    with TemporaryDirectory() as folder:
        path = write_table(Path(folder) / "a.csv", ["label", "x"], [(text, 1.0)])
        with path.open(newline="", encoding="utf-8") as file:
            assert list(csv.reader(file)) == [["label", "x"], [escape_terminal(text), "1"]]
