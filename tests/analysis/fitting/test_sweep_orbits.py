"""Steady-state motion of dampers during a fit: failed trials, derivatives, motions that cannot be computed."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

import daq
from analysis.core.fitting.diagnosis import list_omitted_points
from analysis.core.fitting.measured import measured_curves
from analysis.core.fitting.predicted import scene_of_test
from analysis.core.fitting.sweep_orbits import SweepOrbits

DAMPED = Path(__file__).parents[3] / "recordings" / "demo-sweep-three-dampers.mcap"


@cache
def curves_of_demo():
    with daq.open(DAMPED) as recording:
        [curves] = measured_curves(recording, "demo")
    return curves


def nearest_points(*requested_frequencies):
    """Return the curves of the demo, and frequency and level of the points nearest to the requested frequencies."""
    curves = curves_of_demo()
    assert curves.level is not None
    indices = [int(np.argmin(abs(curves.frequency - frequency))) for frequency in requested_frequencies]
    return curves, curves.frequency[indices], curves.level[indices]


def test_failed_trial_keeps_previous_motion():
    curves, frequency, level = nearest_points(49.66)
    orbits = SweepOrbits(replace(curves, frequency=frequency, level=level))
    test_scene = scene_of_test(curves.scene, curves)
    expected = orbits.response(test_scene, level, frequency)
    assert np.isfinite(expected).all() and orbits.current[0] is not None
    assert np.isnan(orbits.response(test_scene, 10.0 * level, frequency)).all()
    np.testing.assert_allclose(orbits.response(test_scene, level, frequency), expected, rtol=1e-9)


def test_continued_motions_have_correct_derivatives():
    # With `search=False` the response is extrapolated linearly from the last periodic motion.
    curves, frequency, level = nearest_points(34.4, 48.0, 50.5)
    table_scene = curves.scene.replace(shaker={"kind": "electrodynamic", "body": 1, "spring": 6600.0})
    orbits = SweepOrbits(replace(curves, scene=table_scene, frequency=frequency, level=level))
    test_scene = scene_of_test(table_scene, orbits.curves)
    initial_response, step = orbits.response(test_scene, level, frequency), 1e-5
    for relative_level, relative_frequency in ((step, 0.0), (0.0, step)):
        varied_point = level * (1.0 + relative_level), frequency * (1.0 + relative_frequency)
        predicted_change = orbits.response(test_scene, *varied_point, search=False) - initial_response
        initial_orbits = list(orbits.current)
        corrected_change = orbits.response(test_scene, *varied_point) - initial_response
        orbits.current = initial_orbits
        assert (
            np.isfinite(corrected_change).all()
            and abs(predicted_change - corrected_change).max() < 0.01 * abs(corrected_change).max()
        )


def test_coupled_impacts_are_reported_as_reason():
    curves, frequency, level = nearest_points(49.0)
    halves = [damper.replace(mass_ratio=0.5 * damper.mass_ratio) for damper in curves.scene.dampers]
    coupled_scene = curves.scene.replace(dampers=2 * halves)
    coupled_curves = replace(curves, scene=coupled_scene, frequency=frequency, level=level)
    orbits = SweepOrbits(coupled_curves)
    assert np.isnan(orbits.response(scene_of_test(coupled_scene, coupled_curves), level, frequency)).all()
    assert "at the same instant" in orbits.uncovered[0]
    [message] = list_omitted_points(coupled_curves, np.array([False]), orbits.uncovered)
    assert "another kind of motion" not in message and "which a fit cannot compute" in message
    [message] = list_omitted_points(coupled_curves, np.array([False]), {})
    assert "its type differs from that of the predicted motion" in message
    orbits.failed.clear()
    assert np.isfinite(orbits.response(scene_of_test(curves.scene, curves), level, frequency)).all()
    assert not orbits.uncovered


def test_largest_gap_is_zero_if_matrix_is_singular(monkeypatch):
    curves, frequency, level = nearest_points(49.66)
    orbits = SweepOrbits(replace(curves, frequency=frequency, level=level))
    test_scene = scene_of_test(curves.scene, curves)
    orbits.response(test_scene, level, frequency)
    assert orbits.current[0] is not None and orbits.largest_gap(test_scene, level, frequency, 0) > 0.0

    def raise_singular(*_):
        raise np.linalg.LinAlgError

    monkeypatch.setattr("analysis.core.fitting.sweep_orbits.newton_solve", raise_singular)
    assert orbits.largest_gap(test_scene, level, frequency, 0) == 0.0
