"""A force sensor between shaker and body: frequency responses with it, and messages if the force is not measured."""

import warnings

import numpy as np
import pytest

import daq
import rig
from analysis.core.responses.frequency_responses import frequency_responses
from analysis.studies.cost.variants import expand_chain, without_noise
from daq.core.measurement.run import missing_force_reference
from daq.core.virtual_bench.bench import Bench
from rig.core.base.errors import RecordingError
from rig.core.system.structural_model import receptance

STRUCTURE = """
structure: {masses: [1 kg, 1 kg], springs: [20 kN/m, 20 kN/m], damping: {modal: 5 %}}
shaker: {kind: force, body: 1}
"""
BODY_CHANNEL = "{name: a2, at: body 2, accelerometer: {sensitivity: 100 mV/g}}"
FORCE_CHANNEL = "{name: f, at: shaker, hammer: {sensitivity: 11.2 mV/N, low_cutoff: 0.5 Hz}}"
TABLE_CHANNEL = "{name: x0, at: table}"
STEPPED_TEST = "test: {kind: stepped_sine, frequencies: [12 Hz, 20 Hz], force: 2 N}\n"
RANDOM_TEST = "test: {kind: random, from: 5 Hz, to: 60 Hz, duration: 30 s, force: 2 N}\n"


def scene_of(test: str, *channels: str, shaker: str = "{kind: force, body: 1}") -> rig.Scene:
    """Return a scene of two bodies with this test, these channels and this shaker."""
    text = STRUCTURE.replace("{kind: force, body: 1}", shaker) + test
    return rig.loads(text + f"channels: [{', '.join(channels)}]\n")


def test_responses_are_relative_to_measured_force(tmp_path) -> None:
    scene = scene_of(STEPPED_TEST, BODY_CHANNEL, FORCE_CHANNEL)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path = daq.record(scene, tmp_path / "a.mcap")
    with daq.open(path) as recording:
        info = recording.channels["f"]
        assert (info.at, info.quantity, info.unit, info.sensitivity) == ("shaker", "force", "N", 0.0112)
        ((curve,),) = frequency_responses(recording)
        exact = receptance(scene, curve.frequency)[1]
    np.testing.assert_allclose(curve.value, exact, rtol=2e-3)


def test_random_test_gives_response_to_measured_force(tmp_path) -> None:
    scene = scene_of(RANDOM_TEST, BODY_CHANNEL, FORCE_CHANNEL)
    with daq.open(daq.record(scene, tmp_path / "a.mcap")) as recording:
        ((curve,),) = frequency_responses(recording)
        line = np.argmin(abs(curve.frequency - 25.0))  # Hz
        exact = receptance(scene, curve.frequency)[1]
    assert curve.value[line] == pytest.approx(exact[line], rel=0.1)


def test_missing_force_channel_causes_early_warning(tmp_path) -> None:
    scene = scene_of(STEPPED_TEST, BODY_CHANNEL)
    messages: list[str] = []

    def stop_at_second_message(fraction: float, message: str) -> None:
        messages.append(message)
        if len(messages) == 2:
            raise RecordingError("stopped")

    with (
        pytest.warns(daq.RunWarning, match=r"Add \{name: force, at: shaker\} to the scene's channels"),
        pytest.raises(RecordingError, match="stopped"),
    ):
        daq.record(scene, tmp_path / "a.mcap", progress=stop_at_second_message)
    assert len(messages) == 2


def test_chain_study_expands_force_sensor_preset() -> None:
    scene = scene_of(
        STEPPED_TEST, BODY_CHANNEL, "{name: f, at: shaker, hammer: {preset: PCB 086C03, noise: 1 mN/sqrt(Hz)}}"
    )
    channels = expand_chain(scene).channels
    assert channels is not None and channels[1].hammer is not None
    assert channels[1].hammer.sensitivity_tolerance == 0.15 and channels[1].hammer.preset is None
    noise_free = without_noise(expand_chain(scene)).channels
    assert noise_free is not None and noise_free[1].hammer is not None
    assert noise_free[1].hammer.sensitivity_tolerance is None and noise_free[1].hammer.noise is None
    assert noise_free[1].hammer.sensitivity == channels[1].hammer.sensitivity


@pytest.mark.parametrize(
    ("shaker", "test", "channels", "missing"),
    [
        ("{kind: force, body: 1}", STEPPED_TEST, [BODY_CHANNEL, FORCE_CHANNEL], None),
        ("{kind: force, body: 1}", STEPPED_TEST, [BODY_CHANNEL], "Add {name: force, at: shaker} to"),
        ("{kind: force, body: 1}", "", [BODY_CHANNEL], "Add {name: force, at: shaker} to"),
        ("{kind: force, body: 1}", "test: {kind: free, mode: 1, amplitude: 1 mm}\n", [BODY_CHANNEL], None),
        ("{kind: table, body: 2, spring: 5 kN/m}", "", [BODY_CHANNEL, TABLE_CHANNEL], None),
        ("{kind: table, body: 2, spring: 5 kN/m}", "", [BODY_CHANNEL], "Add {name: table, at: table} to"),
        (
            "{kind: table, body: 1, spring: 5 kN/m}",
            "",
            [BODY_CHANNEL],
            "Add {name: table, at: table} and {name: body1, at: body 1} to",
        ),
    ],
)
def test_message_names_missing_force_channels(shaker, test, channels, missing) -> None:
    bench = Bench(scene_of(test, *channels, shaker=shaker))
    message = missing_force_reference(bench.scene, bench.channels)
    assert message is None if missing is None else missing in message


def test_analysis_names_the_missing_force_channel(tmp_path) -> None:
    with pytest.warns(daq.RunWarning):
        path = daq.record(scene_of(STEPPED_TEST, BODY_CHANNEL), tmp_path / "a.mcap")
    with daq.open(path) as recording, pytest.raises(RecordingError, match=r"Add \{name: force, at: shaker\}"):
        frequency_responses(recording)
