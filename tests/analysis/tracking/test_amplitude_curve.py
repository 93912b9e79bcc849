"""`analysis.continuation`: texts of a measured curve."""

import numpy as np

from analysis.commands.presentation.continuation_findings import fold_lines
from analysis.core.tracking.continuation import AmplitudeCurve
from rig.core.base.figure_style import new_figure


def curve_of(settled: bool) -> AmplitudeCurve:
    """Return a curve of three points at one level."""
    ones = np.ones(3)
    return AmplitudeCurve(
        "test", "body 1", "N", (9.0, 10.5), level=ones, force=ones, frequency=np.array([10.0, 10.2, 10.5]),
        frequency_expanded=0.01 * ones, amplitude=1e-3 * ones, amplitude_expanded=1e-5 * ones,
        amplitude_own=4e-6 * ones, stable=np.full(3, True), settled=np.full(3, settled), folds=(),
    )  # fmt: skip


def test_level_without_steady_state_resolves_nothing() -> None:
    curve = curve_of(settled=False)
    assert curve.resolution(1.0) == np.inf
    assert curve.level_points()[0].note.startswith("no steady state") and fold_lines(curve, []) == []


def test_part_of_band_without_points_is_reported() -> None:
    assert curve_of(settled=True).omissions() == ["1 N: not followed below 10.00 Hz, where amplitudes may be larger"]


def test_bars_omit_the_common_error() -> None:
    with new_figure(3.0) as figure:
        axes = figure.subplots()
        curve_of(settled=True).draw(axes)
        [bars] = axes.containers[0].lines[2]
    np.testing.assert_allclose(np.ptp(bars.get_segments(), axis=1)[:, 1], 2e3 * 4e-6)


def test_widest_step_limits_resolved_folds() -> None:
    curve = curve_of(settled=True)
    assert np.isclose(curve.resolution(1.0), 0.3)
    assert fold_lines(curve, []) == ["  Steps do not resolve folds closer than 0.3 Hz at 1 N."]
