"""Harmonic force surfaces, and the responses at constant force that follow from them."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike
from typer.testing import CliRunner

import analysis
import daq
import rig
from analysis.commands.cli import app
from analysis.commands.presentation.surface_findings import response_lines
from analysis.core.tracking.force_surface import ForceSurface, largest_slopes
from rig.core.base.errors import RecordingError
from rig.core.base.figure_style import new_figure
from rig.core.base.palette import RECORDINGS


def surface(frequencies: ArrayLike = (0.95, 1.1, 1.3)) -> ForceSurface:
    """Return the surface of a hardening spring."""
    frequency, amplitude = (grid.ravel() for grid in np.meshgrid(frequencies, np.linspace(0.05, 2.0, 40)))
    stiffness = 1.0 + amplitude**2 - frequency**2 + 0.05j * frequency
    force = abs(stiffness) * amplitude
    return ForceSurface("spring", "body 1", frequency, amplitude, stiffness, force, 0.01 * force, 0.0 * force)


def test_constant_force_has_all_branches() -> None:
    curve = surface().at_force(0.2)
    at_last = curve["frequency_Hz"] == 1.3
    roots = np.roots([1.0, 2.0 * (1.0 - 1.69), (1.0 - 1.69) ** 2 + (0.05 * 1.3) ** 2, -0.04])
    exact = np.sort(np.sqrt(roots[abs(roots.imag) < 1e-9].real))
    assert curve["amplitude_m"][at_last] == pytest.approx(exact, abs=0.01)
    assert curve["stable"][at_last].tolist() == [True, False, True]


def test_fold_is_where_the_force_is_extreme() -> None:
    [(fold, _)] = surface(np.linspace(1.0, 1.5, 21)).folds(0.2)
    # Without damping, force = (f^2 - 1 - a^2) a is largest at a^2 = (f^2 - 1) / 3.
    exact = np.sqrt(1.0 + 3.0 * 0.1 ** (2 / 3))
    assert fold == pytest.approx(exact, abs=0.003)


def test_levels_have_colors_of_the_palette() -> None:
    with new_figure(3.0) as figure:
        axes = figure.subplots()
        surface().draw(axes)
    assert {line.get_color() for line in axes.lines} <= set(RECORDINGS)


def test_force_outside_surface_has_no_points() -> None:
    assert surface().at_force(1e3)["frequency_Hz"].size == 0


def test_linear_surface_gives_the_compliance(tmp_path: Path) -> None:
    levels = ["0.1 mm", "0.2 mm"]
    test = {"kind": "constant_response", "at": "body 2", "displacement": levels, "frequencies": [20.0, 48.0, 52.0]}
    scene = rig.load("held-response").replace(test=test, dampers=[])
    measured = analysis.force_surface(daq.record(scene, tmp_path / "held.mcap"))
    theory = scene.replace(test={"kind": "sine", "frequency": 20.0, "force": 1.0})
    frequencies, line = np.unique(measured.frequency, return_inverse=True)
    exact = abs(rig.frequency_response(theory, frequencies).compliance[1])[line]
    assert (abs(measured.amplitude / measured.force / exact - 1.0) < measured.force_expanded / measured.force).all()
    assert "6 points, 20 to 52 Hz" in measured.summary()
    result = CliRunner().invoke(app, ["surface", str(tmp_path / "held.mcap"), "--force", "1", "-o", str(tmp_path)])
    assert result.exit_code == 0 and len([*tmp_path.iterdir()]) == 4


def test_slope_includes_the_curvature() -> None:
    # The force of a hardening spring, with the slope (1 + 3 a^2) / (1 + a^2); 1.001 and 2.001 repeat levels.
    amplitude = np.array([1.0, 2.0, 1.001, 2.001, 0.5])
    frequency = np.array([1.0, 1.0, 1.0, 1.0, 2.0])
    largest = largest_slopes(frequency, amplitude, amplitude + amplitude**3)
    exact = (1.0 + 3.0 * amplitude**2) / (1.0 + amplitude**2)
    assert (largest[:4] >= exact[:4]).all() and (largest[:4] < 1.5 * exact[:4]).all()
    assert largest[4] == 1.0  # one level


def test_other_test_has_no_surface(tmp_path: Path) -> None:
    scene = rig.load("held-response").replace(test={"kind": "sine", "frequency": 20.0, "force": 0.5, "duration": 1.0})
    with pytest.raises(RecordingError, match="held no amplitude of a motion constant"):
        analysis.force_surface(daq.record(scene, tmp_path / "sine.mcap"))


def test_table_contains_highest_point_and_folds() -> None:
    result = surface(np.linspace(1.0, 1.5, 21))
    lines = response_lines(result, [0.2, 1e6])
    assert len(lines) == 3 and "0.2 N" in lines[1] and "1.28" in lines[1] and "not measured" in lines[2]
    assert lines[1].split()[2:4] == ["1180", "±"]
    assert result.at_force(0.2)["amplitude_m"].max() == pytest.approx(1.18, abs=0.01)


def test_levels_near_each_other_are_one_curve() -> None:
    amplitude = np.array([0.10000, 0.20000, 0.10049, 0.20199])
    result = ForceSurface("a", "body 1", np.array([1.0, 1.0, 2.0, 2.0]), amplitude, np.ones(4) + 0j, *(np.ones(4),) * 3)
    with new_figure(2.0) as figure:
        axes = figure.add_subplot()
        result.draw(axes)
    assert axes.get_legend_handles_labels()[1] == ["100 mm", "201 mm"]
