"""Fixture of the engine tests that selects the tables of power series and step matrices."""

from collections import OrderedDict

import pytest

from rig.core.engine import flow_tables


@pytest.fixture(params=["series and steps", "steps", "nothing"])
def each_table_size(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run a test three times: with tables of series and steps, with tables of steps, and without tables.

    The engine uses these tables for small, medium and large structures.
    """
    monkeypatch.setattr(flow_tables, "_CACHE", OrderedDict())
    if request.param != "series and steps":
        monkeypatch.setattr(flow_tables, "MAX_TABULATED_STATES", 0)
        monkeypatch.setattr(flow_tables, "MAX_TABULATED_STATES_FEW_DAMPERS", 0)
    if request.param == "nothing":
        monkeypatch.setattr(flow_tables, "MAX_STEP_MATRIX_STATES", 0)
