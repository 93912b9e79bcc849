from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

import daq
from analysis.fitting.diagnosis import list_omitted_points
from analysis.fitting.measured import measured
from analysis.fitting.predicted import on_the_bench
from analysis.fitting.steady_tones import SteadyTones
from rig.orbits.orbit import OrbitFamily

DAMPED = Path(__file__).parents[3] / "recordings" / "demo-sweep-three-dampers.mcap"


def nearest(*asked):
    """Curves of the demo, and the frequencies and levels of the points nearest to the requested ones."""
    with daq.open(DAMPED) as recording:
        [curves] = measured(recording, "demo")
    assert curves.level is not None
    point = [int(np.argmin(abs(curves.frequency - frequency))) for frequency in asked]
    return curves, curves.frequency[point], curves.level[point]


def test_failed_trial_returns_to_earlier_motion():
    curves, frequency, level = nearest(49.66)
    tones = SteadyTones(replace(curves, frequency=frequency, level=level))
    bench = on_the_bench(curves.scene, curves)
    before = tones.response(bench, level, frequency)
    assert np.isfinite(before).all() and tones.orbits[0] is not None
    assert np.isnan(tones.response(bench, 10.0 * level, frequency)).all()
    np.testing.assert_allclose(tones.response(bench, level, frequency), before, rtol=1e-9)


def test_followed_table_motions_change_like_corrected_ones():
    curves, frequency, level = nearest(34.4, 48.0, 50.5)
    shaken = curves.scene.replace(shaker={"kind": "electrodynamic", "body": 1, "spring": 6600.0})
    tones = SteadyTones(replace(curves, scene=shaken, frequency=frequency, level=level))
    bench = on_the_bench(shaken, tones.curves)
    here, step = tones.response(bench, level, frequency), 1e-5
    for on_level, on_frequency in ((step, 0.0), (0.0, step)):
        there = level * (1.0 + on_level), frequency * (1.0 + on_frequency)
        followed = tones.response(bench, *there, search=False) - here
        known = list(tones.orbits)
        corrected = tones.response(bench, *there) - here
        tones.orbits = known
        assert np.isfinite(corrected).all() and abs(followed - corrected).max() < 0.01 * abs(corrected).max()


def test_endless_rebounds_are_recorded():
    curves, frequency, level = nearest(49.0)
    dampers = [one.replace(restitution=0.3) for one in curves.scene.dampers]
    bouncy = curves.scene.replace(dampers=dampers)
    one = replace(curves, scene=bouncy, frequency=frequency, level=level)
    tones = SteadyTones(one)
    assert np.isnan(tones.response(on_the_bench(bouncy, one), level, frequency)).all()
    assert "rebounds infinitely often" in tones.uncovered[0]
    [said] = list_omitted_points(one, np.array([False]), tones.uncovered)
    assert "another kind of motion" not in said and "which a fit cannot compute" in said
    assert "of another type than that of the model" in list_omitted_points(one, np.array([False]), {})[0]
    tones.failed.clear()
    assert np.isfinite(tones.response(on_the_bench(curves.scene, curves), level, frequency)).all()
    assert not tones.uncovered


def test_singular_matrix_yields_no_gap(monkeypatch):
    curves, frequency, level = nearest(49.66)
    tones = SteadyTones(replace(curves, frequency=frequency, level=level))
    bench = on_the_bench(curves.scene, curves)
    tones.response(bench, level, frequency)
    assert tones.orbits[0] is not None and tones.largest_gap(bench, level, frequency, 0) > 0.0

    def fail(*_):
        raise np.linalg.LinAlgError

    monkeypatch.setattr(OrbitFamily, "correct", fail)
    assert tones.largest_gap(bench, level, frequency, 0) == 0.0
