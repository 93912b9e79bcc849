"""What a scene names is all that acts: taking an effect away leaves every bit of what it does not touch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import daq
import rig
from daq.signal_chain.bench import Bench


def full() -> rig.Scene:
    return rig.load("fig8-three-dampers")


def without_sensor_effect(key: str) -> rig.Scene:
    """The scene with one effect of the second channel's sensor or amplifier taken away."""
    scene = full()
    first, second, *rest = scene.channels
    if key == "integrator":
        second = second.replace(integrator=None)
    else:
        second = second.replace(accelerometer=second.accelerometer.replace(**{key: None}))
    return scene.replace(channels=(first, second, *rest))


def samples(scene: rig.Scene) -> np.ndarray:
    bench = Bench(scene)
    time = np.arange(800) / bench.rate
    return bench.acquire(8.0 * np.sin(2 * np.pi * 34.8 * time)[None]).samples


@pytest.mark.parametrize("key", ["resonance", "noise", "low_cutoff", "integrator"])
def test_given_an_effect_of_one_channel_when_it_is_taken_away_then_the_other_channels_keep_every_bit(
    key: str,
) -> None:
    with_it, without = samples(full()), samples(without_sensor_effect(key))
    np.testing.assert_array_equal(without[[0, 2, 3]], with_it[[0, 2, 3]])
    assert (without[1] != with_it[1]).any()


def test_given_a_channel_when_it_is_taken_away_then_the_others_keep_every_bit() -> None:
    scene = full()
    fewer = scene.replace(channels=(scene.channels[0], *scene.channels[2:]))
    np.testing.assert_array_equal(samples(fewer), samples(scene)[[0, 2, 3]])


@pytest.mark.parametrize(
    "part", [{"channels": None}, {"converter": {"rate": 5120.0}}, {"recording": {"truth": True}}]
)
def test_given_a_measuring_effect_when_it_is_taken_away_then_the_motion_keeps_every_bit(
    part: dict[str, object],
) -> None:
    time = np.arange(800) / 5120.0
    drive = 8.0 * np.sin(2 * np.pi * 34.8 * time)[None]
    with_it, without = (Bench(scene).acquire(drive).motion for scene in (full(), full().replace(**part)))
    for field in ("displacement", "velocity", "acceleration", "gap", "break_offset", "events"):
        np.testing.assert_array_equal(getattr(without, field), getattr(with_it, field))


@pytest.mark.parametrize("part", ["display", "truth"])
def test_given_something_recorded_beside_the_channels_when_it_is_taken_away_then_they_keep_every_bit(
    part: str, tmp_path: Path
) -> None:
    scene = full().replace(test={"kind": "sine", "frequency": 34.8, "drive": 8.0, "duration": 0.3})
    recorded = []
    for on in (True, False):
        settings = {"display": True, "truth": True} | {part: on}
        with daq.open(daq.record(scene.replace(recording=settings), tmp_path / f"{on}.mcap")) as recording:
            recorded.append(np.array([recording.read(name) for name in recording.channels]))
    np.testing.assert_array_equal(*recorded)


def test_given_a_ceiling_out_of_reach_when_it_is_added_then_the_motion_keeps_every_bit() -> None:
    scene = full()
    ceilings = scene.replace(dampers=[damper.replace(clearance=10.0) for damper in scene.dampers])
    drive = 8.0 * np.sin(2 * np.pi * 34.8 * np.arange(2000) / 5120.0)[None]
    with_them, without = (rig.Plant(one, 5120.0).advance(drive) for one in (ceilings, scene))
    assert len(without.events) > 0
    np.testing.assert_array_equal(with_them.displacement, without.displacement)
    np.testing.assert_array_equal(with_them.events, without.events)
