"""A force sensor between shaker and body: its reading, and messages if the force is not measured."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import daq
import rig
from analysis.chain_cost.variants import expand_chain, without_noise
from analysis.responses.frequency_responses import frequency_responses
from daq.measurement.run import missing_force_reference
from daq.virtual_bench.bench import Bench
from rig.errors import RecordingError
from rig.system.structural_model import receptance

STRUCTURE = """
structure: {masses: [1 kg, 1 kg], springs: [20 kN/m, 20 kN/m], damping: {modal: 5 %}}
shaker: {kind: force, body: 1}
"""
BODY = "{name: a2, at: body 2, accelerometer: {sensitivity: 100 mV/g}}"
FORCE = "{name: f, at: shaker, hammer: {sensitivity: 11.2 mV/N, low_cutoff: 0.5 Hz}}"
TABLE = "{name: x0, at: table}"
STEPS = "test: {kind: stepped_sine, frequencies: [12 Hz, 20 Hz], force: 2 N}\n"
NOISE = "test: {kind: random, from: 5 Hz, to: 60 Hz, duration: 30 s, force: 2 N}\n"


def scene_of(test: str, *channels: str, shaker: str = "{kind: force, body: 1}") -> rig.Scene:
    text = STRUCTURE.replace("{kind: force, body: 1}", shaker) + test
    return rig.loads(text + f"channels: [{', '.join(channels)}]\n")


def test_measured_force_divides_the_responses(tmp_path) -> None:
    scene = scene_of(STEPS, BODY, FORCE)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path = daq.record(scene, tmp_path / "a.mcap")
    with daq.open(path) as recording:
        info = recording.channels["f"]
        assert (info.at, info.quantity, info.unit, info.sensitivity) == ("shaker", "force", "N", 0.0112)
        ((curve,),) = frequency_responses(recording)
        exact = receptance(scene, curve.frequency)[1]
    np.testing.assert_allclose(curve.value, exact, rtol=2e-3)


def test_force_noise_keeps_coherence(tmp_path) -> None:
    scene = scene_of(NOISE, BODY, FORCE)
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as recording:
        ((curve,),) = frequency_responses(recording)
        near = np.argmin(abs(curve.frequency - 25.0))
        exact = receptance(scene, curve.frequency)[1]
    assert curve.value[near] == pytest.approx(exact[near], rel=0.1)


def test_missing_force_channel_is_announced(tmp_path) -> None:
    scene = scene_of(STEPS, BODY)
    reported: list[str] = []

    def progress(fraction: float, message: str) -> None:
        reported.append(message)
        if len(reported) == 2:
            raise RecordingError("seen enough")

    with (
        pytest.warns(daq.RunWarning, match=r"Add \{name: force, at: shaker\} to the scene's channels"),
        pytest.raises(RecordingError, match="seen enough"),
    ):
        daq.record(scene, tmp_path / "a.mcap", progress=progress)
    assert len(reported) == 2


def test_chain_study_corrects_force_sensor_preset() -> None:
    scene = scene_of(STEPS, BODY, "{name: f, at: shaker, hammer: {preset: PCB 086C03, noise: 1 mN/sqrt(Hz)}}")
    written = expand_chain(scene).channels
    assert written is not None and written[1].hammer is not None
    assert written[1].hammer.sensitivity_tolerance == 0.15 and written[1].hammer.preset is None
    silent = without_noise(expand_chain(scene)).channels
    assert silent is not None and silent[1].hammer is not None
    assert silent[1].hammer.sensitivity_tolerance is None and silent[1].hammer.noise is None
    assert silent[1].hammer.sensitivity == written[1].hammer.sensitivity


@pytest.mark.parametrize(
    ("shaker", "test", "channels", "missing"),
    [
        ("{kind: force, body: 1}", STEPS, [BODY, FORCE], None),
        ("{kind: force, body: 1}", STEPS, [BODY], "Add {name: force, at: shaker} to"),
        ("{kind: force, body: 1}", "", [BODY], "Add {name: force, at: shaker} to"),
        ("{kind: force, body: 1}", "test: {kind: free, mode: 1, amplitude: 1 mm}\n", [BODY], None),
        ("{kind: table, body: 2, spring: 5 kN/m}", "", [BODY, TABLE], None),
        ("{kind: table, body: 2, spring: 5 kN/m}", "", [BODY], "Add {name: table, at: table} to"),
        (
            "{kind: table, body: 1, spring: 5 kN/m}",
            "",
            [BODY],
            "Add {name: table, at: table} and {name: body1, at: body 1} to",
        ),
    ],
)
def test_missing_force_settings_are_named(shaker, test, channels, missing) -> None:
    bench = Bench(scene_of(test, *channels, shaker=shaker))
    message = missing_force_reference(bench.scene, bench.channels)
    assert message is None if missing is None else missing in message


def test_analysis_names_the_missing_force_channel(tmp_path) -> None:
    with pytest.warns(daq.RunWarning):
        path = daq.record(scene_of(STEPS, BODY), tmp_path / "a.mcap")
    with daq.open(path) as recording, pytest.raises(RecordingError, match=r"Add \{name: force, at: shaker\}"):
        frequency_responses(recording)
