"""The message about every mistake of the catalogue says where it is, what is wrong and what to do."""

from pathlib import Path

import pytest

from tests.mistakes.__main__ import message_of
from tests.mistakes.catalogue import MISTAKES, Mistake


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake.description.replace(" ", "-"))
def test_message_contains_every_fact(mistake: Mistake, tmp_path: Path) -> None:
    code, text = message_of(mistake, tmp_path)
    printed = " ".join(text.split())
    assert code and "Traceback" not in printed
    assert not [fact for fact in mistake.facts if fact not in printed], printed


def test_catalogue_has_forty_different_mistakes() -> None:
    assert len({(mistake.command, *mistake.files.items()) for mistake in MISTAKES}) >= 40
