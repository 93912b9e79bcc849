"""Every picture of the pages has a command that draws it (`python -m tests.pictures`)."""

import re
from pathlib import Path

import pytest

from tests.pictures import FOLDER, PICTURES, ROOT, draw


def test_every_picture_has_a_command() -> None:
    pages = [ROOT / "README.md", *ROOT.glob("*/guide/*.md"), *ROOT.glob(".docs/*.md")]
    used = {
        name for page in pages for name in re.findall(r"recordings/([\w-]+\.png)", page.read_text(encoding="utf-8"))
    }
    assert used == PICTURES.keys() and all((FOLDER / name).is_file() for name in PICTURES)


@pytest.mark.thorough
def test_command_draws_its_picture(tmp_path: Path) -> None:
    assert draw("map.png", tmp_path).read_bytes().startswith(b"\x89PNG")
