"""Removing an effect from a scene changes no bit of the results that it does not influence."""

from pathlib import Path

import numpy as np
import pytest

import daq
import rig
from daq.core.virtual_bench.bench import Bench


def full_scene() -> rig.Scene:
    """Return a scene with three dampers and four measured channels: three bodies and the table."""
    return rig.load("fig8-three-dampers")


def without_sensor_effect(key: str) -> rig.Scene:
    """Return the scene without one effect of the second channel's sensor or integrator."""
    scene = full_scene()
    first, second, *rest = scene.channels
    if key == "integrator":
        second = second.replace(integrator=None)
    else:
        second = second.replace(accelerometer=second.accelerometer.replace(**{key: None}))
    return scene.replace(channels=(first, second, *rest))


def tone(samples: int, rate: float) -> np.ndarray:
    """Return a drive of 8 V at 34.8 Hz, near the second mode: the dampers fly."""
    return 8.0 * np.sin(2 * np.pi * 34.8 * np.arange(samples) / rate)[None]


def acquire_samples(scene: rig.Scene) -> np.ndarray:
    bench = Bench(scene)
    return bench.acquire(tone(800, bench.rate)).samples


@pytest.mark.parametrize("key", ["resonance", "noise", "low_cutoff", "integrator"])
def test_effect_of_one_channel_changes_no_other(key: str) -> None:
    with_effect, without = acquire_samples(full_scene()), acquire_samples(without_sensor_effect(key))
    np.testing.assert_array_equal(without[[0, 2, 3]], with_effect[[0, 2, 3]])
    assert (without[1] != with_effect[1]).any()


def test_removed_channel_changes_no_other() -> None:
    scene = full_scene()
    without_second = scene.replace(channels=(scene.channels[0], *scene.channels[2:]))
    np.testing.assert_array_equal(acquire_samples(without_second), acquire_samples(scene)[[0, 2, 3]])


@pytest.mark.parametrize(
    "changes", [{"channels": None}, {"converter": {"rate": 5120.0}}, {"recording": {"truth": True}}]
)
def test_measurement_settings_do_not_change_motion(changes: dict[str, object]) -> None:
    scenes = full_scene(), full_scene().replace(**changes)
    original, changed = (Bench(scene).acquire(tone(800, 5120.0)).motion for scene in scenes)
    for field in ("displacement", "velocity", "acceleration", "gap", "discontinuity_offset", "events"):
        np.testing.assert_array_equal(getattr(changed, field), getattr(original, field))


@pytest.mark.parametrize("key", ["display", "truth"])
def test_display_and_truth_do_not_change_channels(key: str, tmp_path: Path) -> None:
    scene = full_scene().replace(test={"kind": "sine", "frequency": 34.8, "drive": 8.0, "duration": 0.3})
    recordings = []
    for enabled in (True, False):
        settings = {"display": True, "truth": True} | {key: enabled}
        with daq.open(daq.record(scene.replace(recording=settings), tmp_path / f"{enabled}.mcap")) as recording:
            recordings.append(np.array([recording.read(name) for name in recording.channels]))
    np.testing.assert_array_equal(*recordings)


def test_unreachable_ceiling_does_not_change_motion() -> None:
    scene = full_scene()
    with_ceilings = scene.replace(dampers=[damper.replace(clearance=10.0) for damper in scene.dampers])
    motion, with_motion = (rig.Plant(variant, 5120.0).advance(tone(2000, 5120.0)) for variant in (scene, with_ceilings))
    assert len(motion.events) > 0
    np.testing.assert_array_equal(with_motion.displacement, motion.displacement)
    np.testing.assert_array_equal(with_motion.events, motion.events)
