"""Fixture of tests whose subject is the text or the tables of a command."""

from __future__ import annotations

import pytest


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write no figures, which takes most of the time of a command."""
    monkeypatch.setattr("rig.figure_style.save_figure", lambda figure, stem: [])
