"""Shared fixtures of the engine tests."""

from __future__ import annotations

from collections import OrderedDict

import pytest

from rig.engine import flow_tables


@pytest.fixture(params=["series and steps", "steps", "nothing"])
def tabulated(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Settings of the engine's tables, which are smaller for larger structures."""
    monkeypatch.setattr(flow_tables, "_RECENT", OrderedDict())
    if request.param != "series and steps":
        monkeypatch.setattr(flow_tables, "TABULATED_UP_TO", 0)
        monkeypatch.setattr(flow_tables, "TABULATED_WITH_FEW", 0)
    if request.param == "nothing":
        monkeypatch.setattr(flow_tables, "STEPS_UP_TO", 0)
