"""Display topics of a recording: filtered waveforms, levels of blocks, and the moving rig, for viewers."""

import struct
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.signal import bilinear_zpk, sosfilt, zpk2sos

import daq
from daq.core.mcap_file.protobuf import message_class
from daq.core.recording.displacement import HIGH_PASS_HZ, DisplacementFilter
from daq.core.recording.recorder import Recorder
from daq.core.recording.robot_description import TRANSFORMS_SCHEMA
from tests.daq.recording.recordings import (
    DISPLAY_AND_TRUTH,
    ONE_DAMPER,
    RATE,
    VOLTS_PER_ACCELERATION,
    VOLTS_PER_METER,
    make_scene,
    messages_of,
    random_volts,
    true_motion,
    two_channels,
    write_recording,
)

EXAGGERATION = 20.0  # factor on the drawn motion in these scenes
# Samples per display sample: at 2560 Hz, every 11th sample gives the largest display rate below 250 Hz.
DISPLAY_STEP = 11
HALF_FILTER_LENGTH = 8 * DISPLAY_STEP  # of the anti-aliasing filter, samples
DISPLAY_SCENE = make_scene(recording={"display": True})
DAMPER_SCENE = make_scene(recording=DISPLAY_AND_TRUTH, **ONE_DAMPER)


def number_of(message):
    """Return the number in a display message, after its header of 20 bytes."""
    return struct.unpack_from("<d", message.data, 20)[0]


def display_of(path, samples, topic):
    """Record samples; return the times in s and the values of a display topic."""
    messages = messages_of(write_recording(path, samples, DISPLAY_SCENE), topic)
    times = np.array([message.log_time for message in messages]) * 1e-9
    return times, np.array([number_of(message) for message in messages])


def test_waveform_is_filtered_against_aliasing(tmp_path):
    t = np.arange(8000) / RATE
    volts = np.sin(2 * np.pi * 30.0 * t) + np.sin(2 * np.pi * 210.0 * t)
    times, values = display_of(tmp_path / "a.mcap", np.array([volts, volts]), "/display/body1")
    assert np.diff(times) == pytest.approx(DISPLAY_STEP / RATE, abs=2e-9)
    # The display rate is 233 Hz, so that 210 Hz would be aliased to 23 Hz.
    has_full_filter = (times > 0.1) & (times < 3.0)
    error = values[has_full_filter] - np.sin(2 * np.pi * 30.0 * times[has_full_filter]) / VOLTS_PER_METER
    assert np.abs(error).max() < 1e-3 / VOLTS_PER_METER
    assert times[0] == 0.0
    assert times[-1] > (8000 - DISPLAY_STEP - 1) / RATE


def test_levels_are_rms_and_peak_of_blocks(tmp_path):
    samples = random_volts(1000)
    for suffix, expected in (("rms", lambda x: np.sqrt(np.mean(x**2))), ("peak", lambda x: np.abs(x).max())):
        _, values = display_of(tmp_path / suffix, samples, f"/display/body2/{suffix}")
        blocks = [samples[1, start : min(start + 256, 1000)] / VOLTS_PER_ACCELERATION for start in range(0, 1000, 256)]
        assert values == pytest.approx([expected(block) for block in blocks], rel=1e-12)


def test_waveform_restarts_after_a_gap(tmp_path):
    with Recorder(tmp_path / "a.mcap", DISPLAY_SCENE, two_channels(), RATE) as recorder:
        recorder.write(np.ones((2, 2000)))
        recorder.gap(5000)
        recorder.write(np.full((2, 2000), 3.0))
    messages = messages_of(tmp_path / "a.mcap", "/display/body1")
    samples = np.array([round(message.log_time * 1e-9 * RATE) for message in messages])
    assert not ((samples >= 2000) & (samples < 7000)).any()
    volts = np.array([number_of(message) for message in messages]) * VOLTS_PER_METER
    assert volts == pytest.approx(np.where(samples < 2000, 1.0, 3.0), rel=1e-3)


def transforms(path):
    """Return times in s and, for each moving part, its parent and its heights above it in m, decoded by protobuf."""
    message_type = message_class(TRANSFORMS_SCHEMA.data, TRANSFORMS_SCHEMA.name)
    messages = messages_of(path, "/tf")
    links: dict[str, tuple[str, list[float]]] = {}
    for message in messages:
        for transform in message_type.FromString(message.data).transforms:
            assert transform.timestamp.seconds * 10**9 + transform.timestamp.nanos == message.log_time
            assert transform.rotation.w == 1.0
            links.setdefault(transform.child_frame_id, (transform.parent_frame_id, []))[1].append(
                transform.translation.z
            )
    return np.array([message.log_time for message in messages]) * 1e-9, links


def test_displacement_channel_moves_its_body(tmp_path):
    t = np.arange(6000) / RATE
    volts = 1e-3 * VOLTS_PER_METER * np.sin(2 * np.pi * 10.0 * t)
    path = write_recording(tmp_path / "a.mcap", np.array([volts, 0 * volts]), DISPLAY_SCENE)
    times, links = transforms(path)
    parent, heights = links["body_1"]
    has_full_filter = (times > 0.1) & (times < 2.2)
    expected_motion = EXAGGERATION * 1e-3 * np.sin(2 * np.pi * 10.0 * times[has_full_filter])
    assert parent == "world"
    robot = ElementTree.fromstring(messages_of(path, "/robot_description")[0].data[8:-1])
    assert robot.attrib["name"] == "rig, motion drawn x 20"
    assert {link.attrib["name"] for link in robot.iter("link")} == {*links, "world"}
    joints = {joint.find("child").attrib["link"]: joint for joint in robot.iter("joint")}
    height_at_rest = float(joints["body_1"].find("origin").attrib["xyz"].split()[2])
    assert np.array(heights)[has_full_filter] - height_at_rest == pytest.approx(expected_motion, abs=2e-5)


def test_acceleration_alone_moves_its_body(tmp_path):
    t = np.arange(16000) / RATE
    omega = 2 * np.pi * 10.0  # rad/s
    volts = -VOLTS_PER_ACCELERATION * omega**2 * 1e-3 * np.sin(omega * t)  # A displacement amplitude of 1 mm.
    path = write_recording(tmp_path / "a.mcap", np.array([0 * volts, volts]), DISPLAY_SCENE)
    times, links = transforms(path)
    is_settled = (times > 4.0) & (times < 6.0)
    heights = np.array(links["body_2"][1])[is_settled]
    assert np.ptp(heights) == pytest.approx(2 * EXAGGERATION * 1e-3, rel=0.05)
    assert links["body_3"][1] == pytest.approx([links["body_3"][1][0]] * times.size)


def test_dampers_move_relative_to_their_bodies(tmp_path):
    path = write_recording(tmp_path / "a.mcap", random_volts(3000), DAMPER_SCENE)
    times, links = transforms(path)
    parent, heights = links["damper_1"]
    samples = np.rint(times * RATE)
    assert parent == "body_2"
    assert np.array(heights) - heights[0] == pytest.approx(EXAGGERATION * 1e-9 * samples, abs=1e-12)
    true_displacement = 1e-3 * np.sin(0.01 * samples) * 2.0
    body_heights = np.array(links["body_2"][1])
    assert body_heights - body_heights[0] == pytest.approx(EXAGGERATION * true_displacement, abs=1e-9)


def test_damper_without_truth_keeps_its_position(tmp_path):
    path = tmp_path / "a.mcap"
    with Recorder(path, DAMPER_SCENE, two_channels(), RATE) as recorder:
        recorder.write_truth(true_motion(0, 17_000, dampers=1))
        for part in (random_volts(2000), random_volts(2000)):
            if recorder.position:
                recorder.gap(13_000)
            recorder.write(part)
    times, links = transforms(path)
    samples = np.rint(times * RATE)
    gap = np.array(links["damper_1"][1]) - links["damper_1"][1][0]
    # The anti-aliasing filter returns its last samples only when acquisition resumes, long after their truth.
    is_missing = (samples > 2000 - HALF_FILTER_LENGTH) & (samples < 2000)
    assert np.count_nonzero(is_missing) > 2
    assert gap[is_missing] == pytest.approx(gap[np.flatnonzero(is_missing)[0] - 1], abs=1e-12)
    assert gap[~is_missing] == pytest.approx(EXAGGERATION * 1e-9 * samples[~is_missing], abs=1e-12)


def test_wide_cavity_has_smaller_exaggeration(tmp_path):
    damper = {"body": 1, "mass_ratio": 0.1, "clearance": 0.02}
    scene = make_scene(recording=DISPLAY_AND_TRUTH, dampers=[damper])
    path = write_recording(tmp_path / "a.mcap", random_volts(1500), scene)
    with daq.open(path) as recording:
        assert recording.metadata["display"]["exaggeration"] == "5"


def test_rerun_alone_loads_plots_and_moving_rig(tmp_path):
    from rerun.chunk import McapReader

    path = write_recording(tmp_path / "a.mcap", random_volts(1500), DAMPER_SCENE)
    series_by_entity = {}
    for chunk in McapReader(str(path)).stream():
        names = series_by_entity.setdefault(str(chunk.entity_path), set())
        names.update(str(name) for name in chunk.to_record_batch().schema.names)
    for name in ("/display/body1", "/display/body1/rms", "/display/body2/peak"):
        assert "Scalars:scalars" in series_by_entity[name]
    assert any(name.startswith("Transform3D") for name in series_by_entity["/tf"])
    shapes = {entity.split("/")[-2] for entity, names in series_by_entity.items() if "Boxes3D:half_sizes" in names}
    assert shapes == {"world", "body_1", "body_2", "body_3", "table", "damper_1"}


def test_recording_without_samples_has_no_display(tmp_path):
    path = tmp_path / "empty.mcap"
    with Recorder(path, DISPLAY_SCENE, two_channels(), RATE):
        pass
    with daq.open(path) as recording:
        assert (recording.samples, recording.status) == (0, "complete")


@pytest.mark.parametrize(("quantity", "order"), [("velocity", 1), ("acceleration", 2)])
def test_displacement_filter_is_that_of_scipy(quantity: str, order: int) -> None:
    samples, rate = np.random.default_rng(1).standard_normal(500), 232.7
    corners = 2 * np.pi * HIGH_PASS_HZ * np.exp(1j * np.pi * np.array([0.75, -0.75]))
    sections = zpk2sos(*bilinear_zpk(np.zeros(order), np.tile(corners, order), 1.0, fs=rate))
    displacement_filter = DisplacementFilter(quantity, rate)
    displacement = [displacement_filter.run(part) for part in (samples[:200], samples[200:])]
    np.testing.assert_array_equal(np.concatenate(displacement), sosfilt(sections, samples))
