"""The worked example of the guide on uncertainty, computed again."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rig.core.results.response import Response
from rig.core.results.uncertainty import SENSITIVITY, UncertaintyBudget

GUIDE = Path(__file__).parents[2] / "analysis" / "guide" / "uncertainty.md"
TRANSIENT = "residual transient"


def example(name: str) -> Response:
    """Return the compliance of the example, 50 µm/N, measured with an accelerometer of its own."""
    lines, value = np.array([20.0]), np.array([50e-6 + 0j])
    limits = {SENSITIVITY: 0.05 * abs(value), TRANSIENT: np.array([0.4e-6])}
    sources = {SENSITIVITY: {"force sensor": -0.02 * value, name: 0.03 * value}}
    budget = UncertaintyBudget.of(np.array([0.3e-6]), np.array([8.0]), limits, sources)
    return replace(Response.curve(lines, value, name), uncertainty=budget)


def test_worked_example_is_reproduced() -> None:
    text = GUIDE.read_text(encoding="utf-8")
    table = example("accelerometer").budget("accelerometer", 20.0)
    assert table.combined == pytest.approx(float(re.search(r"\| combined \|.*\| ([\d.]+) \| \|", text)[1]), abs=5e-3)
    assert table.expanded == pytest.approx(float(re.search(r"\*U\* = ([\d.]+) µm/N", text)[1]), abs=5e-3)
    printed = {
        name: (float(standard), float(share))
        for name, standard, share in re.findall(r"\| ([a-z ]+) \| [AB] \|[^|]*\| ([\d.]+) \| ([\d.]+) % \|", text)
    }
    rows = {name: (standard, 100.0 * share) for name, _, standard, share in table.rows}
    # The sensors are one row of the budget: the root sum of squares of two.
    sensors = np.hypot(printed["accelerometer"][0], printed["force sensor"][0])
    assert rows[SENSITIVITY] == pytest.approx(
        (sensors, printed["accelerometer"][1] + printed["force sensor"][1]), abs=0.1
    )
    for name in ("scatter", TRANSIENT):
        assert rows[name] == pytest.approx(printed[name], abs=0.06)


def test_ratio_of_worked_example_is_reproduced() -> None:
    text = GUIDE.read_text(encoding="utf-8")
    ratio = example("first") / example("second")
    combined, expanded = (float(number) for number in re.search(r"= ([\d.]+) %, and \*U\* = ([\d.]+) %", text).groups())
    assert 100.0 * ratio.uncertainty.combined() == pytest.approx(combined, abs=6e-3)
    assert 100.0 * ratio.expanded() == pytest.approx(expanded, abs=0.05)
