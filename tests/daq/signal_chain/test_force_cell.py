"""A force cell between a coil spring and its body measures the exact force of the spring, with moving dampers too."""

import numpy as np
import pytest

import daq
import rig
from analysis.core.responses.frequency_responses import frequency_responses
from daq.core.prediction.linear import channel_readings
from daq.core.signal_chain.chain import default_channels
from daq.core.virtual_bench.bench import Bench
from rig.core.system.structural_model import receptance

STRUCTURE = """
structure: {{masses: [1 kg, 1 kg], springs: [20 kN/m, 20 kN/m], damping: {{modal: 5 %}}}}
shaker: {{kind: {kind}, body: 1, spring: {spring}}}
"""
DAMPER = "dampers: [{body: 1, mass: 100 g, clearance: 1 mm}]\n"
SPRING = 6600.0  # N/m


def scene_of(text: str = "", kind: str = "electrodynamic", spring: str = "6.6 kN/m", rate: int = 5120) -> rig.Scene:
    channels = "channels: [{name: f, at: shaker}, {name: a1, at: body 1}, {name: a2, at: body 2}]\n"
    return rig.loads(STRUCTURE.format(kind=kind, spring=spring) + channels + text + f"converter: {{rate: {rate} Hz}}\n")


def point_samples(bench: Bench, drive: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the force and the force that follows from the true motion, at the instants of the samples."""
    block = bench.acquire(drive[None])
    displacement = dict(zip(bench.points, block.motion.displacement, strict=True))
    return bench.to_units(block.samples)[0], SPRING * (displacement["table"] - displacement["body 1"])


@pytest.mark.parametrize("kind", ["electrodynamic", "table"])
@pytest.mark.parametrize("dampers", ["", DAMPER])
def test_samples_are_force_of_spring(kind: str, dampers: str) -> None:
    scene = scene_of(dampers, kind)
    bench = Bench(scene.replace(converter=scene.converter.replace(sampling="point")))
    drive = np.sin(2.0 * np.pi * 20.0 * np.arange(8000) / 5120.0) * (1e-3 if kind == "table" else 20.0)
    for part in np.array_split(drive, 7):
        measured, true = point_samples(bench, part)
        np.testing.assert_allclose(measured, true, atol=1e-10 * abs(true).max())


def test_averages_are_exact_over_impacts() -> None:
    factor = 64
    coarse, fine = (scene_of(DAMPER, rate=rate) for rate in (1024, 1024 * factor))
    fine = fine.replace(converter=fine.converter.replace(sampling="point"))
    drive = 20.0 * np.sin(2.0 * np.pi * 20.0 * np.arange(2048) / 1024.0)
    averages = Bench(coarse, ticks_per_sample=factor).acquire(drive[None]).samples[0]
    bench = Bench(fine, ticks_per_sample=1)
    # The drive is interpolated linearly at both rates.
    instants = np.arange(2047 * factor + 1) / factor
    block = bench.acquire(np.interp(instants, np.arange(2048), drive)[None])
    assert (block.motion.contact == 0).any() and (block.motion.contact == 1).any()
    points = block.samples[0]
    means = (0.5 * (points[:-1] + points[1:])).reshape(-1, factor).mean(axis=1)
    np.testing.assert_allclose(averages[1:], means, atol=1e-6 * abs(means).max())


def test_response_to_measured_force_of_stiff_stinger(tmp_path) -> None:
    # Without a sensor at the table, the controller uses the cell.
    test = "test: {kind: stepped_sine, frequencies: [12 Hz, 20 Hz], force: 2 N}\n"
    with daq.open(daq.record(scene_of(test, spring="1 MN/m"), tmp_path / "a.mcap")) as recording:
        [response] = frequency_responses(recording)
        exact = receptance(recording.scene, response.frequency)
        forces = [mark.fields["force"] for mark in recording.markers if mark.kind == "measure"]
    np.testing.assert_allclose(response.value[:, :, 0].T, exact, rtol=1e-3)
    np.testing.assert_allclose(forces, 2.0, rtol=0.02)


def test_reading_of_cell_is_predicted() -> None:
    scene = scene_of("test: {kind: sine, frequency: 15 Hz, force: 3 N}\n")
    readings = channel_readings(scene, Bench(scene).channels, np.array([5.0, 15.0, 30.0]))
    np.testing.assert_allclose(readings[0], 1.0, rtol=1e-3)


def test_default_channels_of_coil_spring_have_no_cell() -> None:
    scene = rig.loads(STRUCTURE.format(kind="electrodynamic", spring="6.6 kN/m"))
    assert [channel.at for channel in default_channels(scene, ["body 1", "table"])] == ["body 1", "table"]


def test_cell_does_not_replace_controlled_motion() -> None:
    scene = rig.load("continuation")
    assert any(channel.at == "shaker" for channel in scene.channels or ())
    assert all(place.startswith("body") for place in scene.controlled_terms)


def test_swept_force_needs_both_ends_of_spring() -> None:
    test = "test: {kind: swept_sine, from: 10 Hz, to: 30 Hz, duration: 10 s, force: 1 N}\n"
    assert scene_of(test).controlled_terms == {"table": SPRING, "body 1": -SPRING}
    assert scene_of(test.replace("swept", "stepped").replace("duration: 10 s", "points: 5")).controlled_terms == {
        "shaker": 1.0
    }
