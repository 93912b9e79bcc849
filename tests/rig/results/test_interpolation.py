"""Interpolation of responses between lines, compared with closed form."""

from typing import Any

import numpy as np
import pytest

from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import SceneError
from rig.core.results.interpolation import SPACING
from rig.core.results.response import Response, stack
from rig.core.results.uncertainty import SENSITIVITY, UncertaintyBudget

MODES = ((30.49, 0.0045, 1.0), (48.1, 0.006, -0.7), (68.5, 0.005, 0.5))


def exact(frequency: Array, modes: tuple[tuple[float, float, float], ...] = MODES) -> ComplexArray:
    """Return the compliance of modes with natural frequency, damping ratio and participation."""
    s = 1j * frequency
    return np.sum([part / (f**2 + 2.0 * zeta * f * s + s**2) for f, zeta, part in modes], axis=0)


def measured(spacing: float, noise: float = 0.0, seed: int = 1, start: float = 20.0) -> Response:
    """Return a curve with lines from `start` to 90 Hz and relative random errors."""
    lines = np.arange(start, 90.0, spacing)
    random, error = np.random.default_rng(seed), noise * abs(exact(lines))
    value = exact(lines) + error * (random.normal(size=lines.size) + 1j * random.normal(size=lines.size))
    return Response.curve(lines, value, "board", error=error)


def test_peak_between_coarse_lines_is_interpolated() -> None:
    # The half-power width of 0.27 Hz holds no line.
    frf, peak = measured(0.4, 1e-5, start=20.29), exact(np.array([30.49]))
    assert abs(frf.value).max() < 0.9 * abs(peak[0])
    there = frf.interpolated(30.49)
    assert abs(there.value - peak) < there.bound() < 0.02 * abs(peak)
    assert there.limits[SPACING] > 0.0


def test_unresolved_frequency_is_refused_with_spacing() -> None:
    with pytest.raises(SceneError, match=r"do not resolve the response at 48\.1 Hz.*at most 0\.\d+ Hz apart"):
        measured(5.3, 1e-5).interpolated(48.1)


def test_interpolated_values_lie_within_intervals() -> None:
    inside, at = [], np.linspace(25.0, 85.0, 50)
    for seed in range(40):
        frf = measured(0.3, 1e-3, seed, 20.0 + 0.3 * seed / 40.0).interpolated(at)
        inside.append(abs(abs(frf.value) - abs(exact(at))) <= frf.expanded())
    assert 0.93 < np.mean(inside) < 0.995


def test_value_of_line_is_unchanged() -> None:
    frf = measured(0.3, 1e-3)
    there = frf.interpolated([frf.frequency[7], 30.0, 10.0])
    assert there.value[0] == frf.value[7] and there.bound()[0] == frf.bound()[7]
    assert np.isnan(there.value[2])


def test_frequency_may_have_its_unit() -> None:
    frf = measured(0.3)
    assert frf.interpolated("30.49 Hz").value == frf.interpolated(30.49).value
    assert frf.interpolated(["30.49 Hz", "40 Hz"]).frequency.tolist() == [30.49, 40.0]


@pytest.mark.parametrize("frequency", [None, [20.0, "x"], -3.0, "30.49 m"])
def test_invalid_frequency_is_named(frequency: Any) -> None:
    with pytest.raises(SceneError, match="frequency: "):
        measured(0.3).interpolated(frequency)


def test_interpolated_tolerance_is_that_of_lines() -> None:
    lines = np.arange(20.0, 90.0, 0.3)
    limit = 0.1 / 0.9 * abs(exact(lines))  # a reading that is 10 % too low
    budget = UncertaintyBudget.of(
        np.zeros(lines.size),
        np.full(lines.size, np.inf),
        {SENSITIVITY: limit},
        {SENSITIVITY: {"sensor": 0.1 * exact(lines)}},
    )
    frf = Response.curve(lines, exact(lines), "board", uncertainty=budget).interpolated([40.1, 50.0])
    assert frf.limits[SENSITIVITY] == pytest.approx(0.1 / 0.9 * abs(frf.value), rel=1e-3)


@pytest.mark.parametrize("confidence", [95, 1.0, 0.0, "95 %"])
def test_confidence_must_be_a_fraction(confidence: Any) -> None:
    with pytest.raises(SceneError, match=r"confidence: got .*expected a probability between 0 and 1"):
        measured(0.3, 1e-3).bound(confidence)


def test_budget_states_the_requested_frequency() -> None:
    table = measured(0.3, 1e-4).budget("board", "30.49 Hz")
    assert "30.49 Hz" in table.title and SPACING in [row[0] for row in table.rows]
    assert abs(table.value - 1e6 * abs(exact(np.array([30.49]))[0])) < table.expanded
    with pytest.raises(SceneError, match=r"no value at 5 Hz"):
        measured(0.3).budget("board", 5.0)


def test_ratio_names_lines_that_are_not_resolved() -> None:
    fine, coarse = measured(0.25), measured(5.3)
    ratio = fine / coarse
    assert np.isnan(ratio.value).any() and any("do not resolve" in text for text in ratio.warnings)


def test_matrices_interpolate_each_element() -> None:
    both = stack([measured(0.3), measured(0.3, 1e-3)])
    assert both.interpolated([30.49, 50.0]).bound().shape == (2, 2, 1)
