import struct
from xml.etree import ElementTree

import numpy as np
import pytest

import daq
from daq.recording.protobuf import message_class
from daq.recording.recorder import Recorder
from daq.recording.robot_description import TRANSFORMS_SCHEMA
from tests.daq.recording.recordings import ALL, DAMPERS, RATE, channels, messages, motion, scene, write
from tests.daq.recording.recordings import signal as noise


def display_of(tmp_path, samples, topic, **changes):
    path = write(
        tmp_path / "d.mcap", samples, scene(recording={"display": True} | changes.pop("recording", {}), **changes)
    )
    result = messages(path, topic)
    times = np.array([message.log_time for message in result]) * 1e-9
    return times, np.array([struct.unpack_from("<d", message.data, 20)[0] for message in result])


def test_display_keeps_slow_tone_and_rejects_fast(tmp_path):
    t = np.arange(8000) / RATE
    volts = np.sin(2 * np.pi * 30.0 * t) + np.sin(2 * np.pi * 210.0 * t)
    times, values = display_of(tmp_path, np.array([volts, volts]), "/display/body1")
    assert np.diff(times) == pytest.approx(11 / RATE, abs=2e-9)
    # 500 V per m. Where the filter has samples on both sides; 210 Hz would fold to 23 Hz.
    inside = (times > 0.1) & (times < 3.0)
    error = values[inside] - np.sin(2 * np.pi * 30.0 * times[inside]) / 500.0
    assert np.abs(error).max() < 1e-3 / 500.0
    assert times[0] == 0.0
    assert times[-1] > (8000 - 12) / RATE


def test_levels_are_rms_and_peak_of_blocks(tmp_path):
    samples = noise(1000)
    for suffix, expected in (("rms", lambda x: np.sqrt(np.mean(x**2))), ("peak", lambda x: np.abs(x).max())):
        folder = tmp_path / suffix
        folder.mkdir()
        _, values = display_of(folder, samples, f"/display/body2/{suffix}")
        blocks = [samples[1, start : min(start + 256, 1000)] / 0.01 for start in range(0, 1000, 256)]
        assert values == pytest.approx([expected(block) for block in blocks], rel=1e-12)


def test_waveform_restarts_after_a_gap(tmp_path):
    with Recorder(tmp_path / "a.mcap", scene(recording={"display": True}), channels(), RATE) as recorder:
        recorder.write(np.ones((2, 2000)))
        recorder.gap(5000)
        recorder.write(np.full((2, 2000), 3.0))
    result = messages(tmp_path / "a.mcap", "/display/body1")
    samples = np.array([round(message.log_time * 1e-9 * RATE) for message in result])
    assert not ((samples >= 2000) & (samples < 7000)).any()
    values = np.array([struct.unpack_from("<d", message.data, 20)[0] for message in result]) * 500.0
    assert values == pytest.approx(np.where(samples < 2000, 1.0, 3.0), rel=1e-3)


def transforms(path):
    """(times, {child: (parent, heights)}) of the transforms, decoded by protobuf itself."""
    message_type = message_class(TRANSFORMS_SCHEMA.data, TRANSFORMS_SCHEMA.name)
    result = messages(path, "/tf")
    links: dict[str, tuple[str, list[float]]] = {}
    for message in result:
        for transform in message_type.FromString(message.data).transforms:
            assert transform.timestamp.seconds * 10**9 + transform.timestamp.nanos == message.log_time
            assert transform.rotation.w == 1.0
            links.setdefault(transform.child_frame_id, (transform.parent_frame_id, []))[1].append(
                transform.translation.z
            )
    return np.array([message.log_time for message in result]) * 1e-9, links


def test_displacement_channel_moves_its_body(tmp_path):
    t = np.arange(6000) / RATE
    volts = 1e-3 * 500.0 * np.sin(2 * np.pi * 10.0 * t)
    path = write(tmp_path / "a.mcap", np.array([volts, 0 * volts]), scene(recording={"display": True}))
    times, links = transforms(path)
    parent, heights = links["body_1"]
    inside = (times > 0.1) & (times < 2.2)
    expected_shift = 20.0 * 1e-3 * np.sin(2 * np.pi * 10.0 * times[inside])
    assert parent == "world"
    robot = ElementTree.fromstring(messages(path, "/robot_description")[0].data[8:-1])
    assert robot.attrib["name"] == "rig, motion drawn x 20"
    assert {link.attrib["name"] for link in robot.iter("link")} == {*links, "world"}
    joints = {joint.find("child").attrib["link"]: joint for joint in robot.iter("joint")}
    rest = float(joints["body_1"].find("origin").attrib["xyz"].split()[2])
    assert np.array(heights)[inside] - rest == pytest.approx(expected_shift, abs=2e-5)


def test_acceleration_alone_moves_its_body(tmp_path):
    t = np.arange(16000) / RATE
    w = 2 * np.pi * 10.0
    volts = -0.01 * w**2 * 1e-3 * np.sin(w * t)
    path = write(tmp_path / "a.mcap", np.array([0 * volts, volts]), scene(recording={"display": True}))
    times, links = transforms(path)
    is_settled = (times > 4.0) & (times < 6.0)
    heights = np.array(links["body_2"][1])[is_settled]
    assert np.ptp(heights) == pytest.approx(2 * 20.0 * 1e-3, rel=0.05)
    assert links["body_3"][1] == pytest.approx([links["body_3"][1][0]] * times.size)


def test_dampers_rest_on_their_bodies(tmp_path):
    path = write(tmp_path / "a.mcap", noise(3000), scene(recording=ALL, **DAMPERS))
    times, links = transforms(path)
    parent, heights = links["damper_1"]
    samples = np.rint(times * RATE)
    assert parent == "body_2"
    assert np.array(heights) - heights[0] == pytest.approx(20.0 * 1e-9 * samples, abs=1e-12)
    true = 1e-3 * np.sin(0.01 * samples) * 2.0
    assert np.array(links["body_2"][1]) - links["body_2"][1][0] == pytest.approx(20.0 * true, abs=1e-9)


def test_parts_without_truth_keep_their_place(tmp_path):
    path, bench_scene = tmp_path / "a.mcap", scene(recording=ALL, **DAMPERS)
    with Recorder(path, bench_scene, channels(), RATE) as recorder:
        recorder.write_truth(motion(0, 9000, dampers=1))
        for part in (noise(2000), noise(2000)):
            if recorder.position:
                recorder.gap(5000)
            recorder.write(part)
    times, links = transforms(path)
    samples = np.rint(times * RATE)
    gap = np.array(links["damper_1"][1]) - links["damper_1"][1][0]
    # Samples delayed by the anti-aliasing filter arrive when acquisition resumes, long after their truth.
    is_missing = (samples > 2000 - 8 * 11) & (samples < 2000)
    assert np.count_nonzero(is_missing) > 2
    assert gap[is_missing] == pytest.approx(gap[np.flatnonzero(is_missing)[0] - 1], abs=1e-12)
    assert gap[~is_missing] == pytest.approx(20.0 * 1e-9 * samples[~is_missing], abs=1e-12)


def test_wide_cavity_has_smaller_exaggeration(tmp_path):
    wide_cavity = {"dampers": [{"body": 1, "mass_ratio": 0.1, "clearance": 0.02}]}
    path = write(tmp_path / "a.mcap", noise(1500), scene(recording=ALL, **wide_cavity))
    with daq.open(path) as recording:
        assert recording.metadata["display"]["exaggeration"] == "5"


def test_rerun_alone_loads_plots_and_moving_rig(tmp_path):
    from rerun.chunk import McapReader

    path = write(tmp_path / "a.mcap", noise(1500), scene(recording=ALL, **DAMPERS))
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
    with Recorder(path, scene(recording={"display": True}), channels(), RATE):
        pass
    with daq.open(path) as recording:
        assert (recording.samples, recording.status) == (0, "complete")
