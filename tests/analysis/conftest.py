"""Fixture of tests whose subject is the text, the tables or the files of a command, but not the look of its figures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from rig.core.base.output_files import atomic_write

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@pytest.fixture
def undrawn_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write the texts of figures, as in an SVG file, without drawing, which takes most of the time of a command."""
    from matplotlib.text import Text

    def save_texts(figure: Figure, stem: Path) -> list[Path]:
        paths = [stem.with_name(f"{stem.name}.{ending}") for ending in ("png", "svg")]
        for path in paths:
            with atomic_write(path) as temporary:
                temporary.write_text("\n".join(f">{text.get_text()}<" for text in figure.findobj(Text)), "utf-8")
        return paths

    monkeypatch.setattr("rig.core.base.figure_style.save_figure", save_texts)
