"""The log of a task: its files contain all samples, gaps, triggers and errors."""

import numpy as np
import pytest
from nidaqmx.constants import READ_ALL_AVAILABLE, AcquisitionType, LoggingMode, LoggingOperation, OverwriteMode, Slope
from nidaqmx.error_codes import DAQmxErrors as Code
from nidaqmx.errors import DaqError, DaqReadError

import daq
import rig
from daq.extras.ni_device.clock import ManualClock
from tests.daq.client import RATE, Task, connect, pass_samples, raises_code
from tests.daq.recording.recordings import file_size_limit


@pytest.fixture
def chassis():
    return connect("fig8-three-dampers", ManualClock())


def configure_logging_task(task, path, mode=LoggingMode.LOG_AND_READ, operation=LoggingOperation.CREATE, **timing):
    """Add two inputs to a task, continuous by default, and log them into a file; return the task."""
    task.ai_channels.add_ai_voltage_chan("Dev1/ai0:1")
    task.timing.cfg_samp_clk_timing(RATE, **(timing or {"sample_mode": AcquisitionType.CONTINUOUS}))
    task.in_stream.configure_logging(path, mode, operation=operation)
    return task


def test_log_contains_all_samples(chassis, tmp_path):
    path = tmp_path / "task.mcap"
    with Task() as task:
        configure_logging_task(task, path)
        task.start()
        pass_samples(chassis, 700)
        readings = np.array(task.read(300))
        task.stop()
    with daq.open(path) as recording:
        assert list(recording.channels) == ["body1", "body2"]
        assert recording.samples == 700
        volts = np.array([recording.read(name) * info.sensitivity for name, info in recording.channels.items()])
        np.testing.assert_allclose(volts[:, :300], readings, rtol=1e-12)
        assert recording.gaps == []


def test_log_marks_overrun_as_gap(chassis, tmp_path):
    path = tmp_path / "overrun.mcap"
    with Task() as task:
        configure_logging_task(task, path)
        task.in_stream.input_buf_size = 500
        task.start()
        pass_samples(chassis, 200)
        task.read(200)
        pass_samples(chassis, 800)
        # Of the 800 unread samples, the buffer contains the last 500.
        with raises_code(Code.SAMPLES_NO_LONGER_AVAILABLE, kind=DaqReadError):
            task.read(100)
        later = np.array(task.read(500))
        task.stop()
    with daq.open(path) as recording:
        (gap,) = recording.gaps
        assert (gap.first_sample, gap.last_sample) == (200, 499)
        volts = recording.read("body1") * recording.channels["body1"].sensitivity
        assert np.isnan(volts[200:500]).all()
        np.testing.assert_allclose(volts[500:1000], later[0], rtol=1e-12)


def test_log_after_overrun_is_complete(chassis, tmp_path):
    path = tmp_path / "overrun.mcap"
    with Task() as task:
        configure_logging_task(task, path)
        task.in_stream.input_buf_size = 500
        task.start()
        pass_samples(chassis, 900)
        with pytest.raises(DaqReadError):
            task.read(100)
        later = []
        for _ in range(5):
            later.append(task.read(100))
            pass_samples(chassis, 100)
        task.stop()
    with daq.open(path) as recording:
        (gap,) = recording.gaps
        assert (gap.first_sample, gap.last_sample) == (0, 399)
        volts = recording.read("body1") * recording.channels["body1"].sensitivity
        np.testing.assert_allclose(volts[400:900], np.concatenate(later, axis=1)[0], rtol=1e-12)


def test_log_names_modules_with_shared_sensors(tmp_path):
    chassis = connect("fig8-three-dampers", ManualClock())
    path = tmp_path / "modules.mcap"
    with Task() as task:
        task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0:2,Dev2/ai0:1")
        task.ai_channels.add_ai_voltage_chan("Dev2/ai2", "third")
        task.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.CONTINUOUS)
        task.in_stream.configure_logging(path, operation=LoggingOperation.CREATE)
        task.start()
        pass_samples(chassis, 300)
        readings = np.array(task.read(300))
        task.stop()
        assert [device.name for device in task.devices] == ["cDAQ1Mod1", "Dev2"]
    assert np.array_equal(readings[:3], readings[3:])
    with daq.open(path) as recording:
        assert [*recording.channels] == [*("body1", "body2", "body3"), *("body1 on Dev2", "body2 on Dev2", "third")]
        assert np.array_equal(recording.read("third"), recording.read("body3"))


def test_task_that_only_logs_rejects_reads(chassis, tmp_path):
    path = tmp_path / "only_logged.mcap"
    with Task() as task:
        configure_logging_task(task, path, LoggingMode.LOG)
        task.in_stream.input_buf_size = 500
        task.start()
        for _ in range(20):
            pass_samples(chassis, 100)
        with raises_code(Code.READ_NOT_SUPPORTED_FOR_LOGGING_MODE, "LOG_AND_READ"):
            task.read(1)
        task.stop()
    with daq.open(path) as recording:
        assert recording.samples == 2000
        assert recording.gaps == []


@pytest.mark.parametrize("overwrite", OverwriteMode)
def test_log_is_complete_despite_small_buffer(chassis, tmp_path, overwrite):
    path = tmp_path / "at_once.mcap"
    with Task() as task:
        configure_logging_task(task, path, LoggingMode.LOG, samps_per_chan=3000)
        task.in_stream.input_buf_size = 500
        task.in_stream.overwrite = overwrite
        task.start()
        pass_samples(chassis, 4000)
        assert task.is_task_done()
        task.stop()
    with daq.open(path) as recording:
        assert (recording.samples, recording.gaps, recording.status) == (3000, [], "complete")


def test_log_contains_record_of_reference_trigger(tmp_path):
    connect("fig10b-no-damper", "fast")
    path = tmp_path / "hit.mcap"
    with Task() as task:
        task.ai_channels.add_ai_force_iepe_chan("Dev1/ai3", "force")
        task.timing.cfg_samp_clk_timing(RATE, samps_per_chan=400)
        task.triggers.reference_trigger.cfg_anlg_edge_ref_trig("force", 100, Slope.RISING, 10.0)
        task.in_stream.configure_logging(path, operation=LoggingOperation.CREATE)
        readings = np.array(task.read(READ_ALL_AVAILABLE, timeout=20.0))
    with daq.open(path) as recording:
        np.testing.assert_allclose(recording.read("force"), readings, rtol=1e-12)
        assert [mark.first_sample for mark in recording.markers if mark.kind == "trigger"] == [100]


@pytest.mark.parametrize("mode", [LoggingMode.LOG, LoggingMode.LOG_AND_READ])
@pytest.mark.parametrize("name", ["dropped.mcap", "dropped.tdms"])
def test_log_marks_lost_samples(tmp_path, mode, name):
    scene = rig.load("fig8-three-dampers")
    dropped = {"at": "0.1 s", "samples": 256}  # from sample 512 at 5120 S/s
    scene = scene.replace(converter=scene.converter.replace(dropped_blocks=[dropped]))
    chassis = connect(scene, ManualClock())
    path = tmp_path / name
    with Task("lossy") as task:
        configure_logging_task(task, path, mode)
        task.start()
        pass_samples(chassis, 1000)
        with pytest.raises(DaqError, match="lost after the converter"):
            task.stop()
    if name.endswith(".tdms"):
        import nptdms

        assert "lost after the converter" in nptdms.TdmsFile.read(path)["lossy"]["Dev1/ai1"].properties["error"]
        return
    with daq.open(path) as recording:
        assert (recording.status, recording.samples) == ("failed", 512)
        (abort,) = [mark for mark in recording.markers if mark.kind == "abort"]
        assert abort.first_sample == 512
        assert "lost after the converter" in abort.fields["reason"]
        assert recording.metadata["outcome"]["reason"] == abort.fields["reason"]


@pytest.mark.parametrize(
    "name, operation, hint",
    [
        ("old.mcap", LoggingOperation.CREATE, "CREATE_OR_REPLACE"),
        ("old.mcap", LoggingOperation.OPEN, "cannot be appended"),
        ("old.mcap", LoggingOperation.OPEN_OR_CREATE, "cannot be appended"),
        ("new.mcap", LoggingOperation.OPEN, "does not exist"),
        ("new.csv", LoggingOperation.CREATE, r"\.mcap"),
        ("nowhere/new.mcap", LoggingOperation.CREATE, "nowhere"),
    ],
)
def test_error_of_impossible_log_file_names_remedy(chassis, tmp_path, name, operation, hint):
    (tmp_path / "old.mcap").write_bytes(b"something")
    with Task() as task:
        configure_logging_task(task, tmp_path / name, operation=operation)
        with pytest.raises(DaqError, match=hint):
            task.start()
        assert (tmp_path / "old.mcap").read_bytes() == b"something"


def test_tdms_log_contains_readings(chassis, tmp_path):
    import nptdms

    path = tmp_path / "task.tdms"
    for _ in range(2):
        with Task("logged") as task:
            configure_logging_task(task, path, operation=LoggingOperation.OPEN_OR_CREATE, samps_per_chan=50)
            task.start()
            pass_samples(chassis, 50)
            readings = np.array(task.read(READ_ALL_AVAILABLE))
    file = nptdms.TdmsFile.read(path)
    assert [group.name for group in file.groups()] == ["logged", "logged #1"]
    channel = file["logged #1"]["Dev1/ai1"]
    assert np.array_equal(channel[:], readings[1])
    assert channel.properties["wf_increment"] == 1 / RATE


def test_full_disk_ends_only_the_logging_task(chassis, tmp_path):
    path = tmp_path / "full.mcap"
    with Task() as task:
        configure_logging_task(task, path, LoggingMode.LOG)
        task.in_stream.input_buf_size = 500
        task.start()
        pass_samples(chassis, 500)
        with file_size_limit(path.stat().st_size):
            pass_samples(chassis, round(RATE))
        position = chassis.position
        pass_samples(chassis, 100)
        assert chassis.position > position
        with pytest.raises(DaqError, match=r"the log has ended.*full\.mcap.*daq recover"):
            task.stop()


@pytest.mark.parametrize("suffix", [".mcap", ".tdms"])
def test_full_disk_is_reported_by_the_read(chassis, tmp_path, suffix):
    path = tmp_path / f"full{suffix}"
    with Task() as task:
        configure_logging_task(task, path)
        task.start()
        pass_samples(chassis, round(RATE))
        with file_size_limit(path.stat().st_size), pytest.raises(DaqError, match=r"the log has ended.*full"):
            task.read(round(RATE))
        pass_samples(chassis, 100)
        assert len(task.read(100)) == 2
