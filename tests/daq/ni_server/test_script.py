"""`daq run` executes a client script on a virtual rig: arguments, clock, exit codes, examples and child processes."""

import math
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from nidaqmx.constants import AcquisitionType

import daq.examples
import rig
from daq.core.virtual_bench.bench import Bench
from daq.extras.ni_server.script import run_script
from rig.core.base.errors import SceneError
from tests.daq.client import Task, add_inputs, connect

EXAMPLES = ["finite_read", "continuous_read", "impulse_capture", "log_to_recording", "live_control", "controlled_test"]


@pytest.fixture
def script(tmp_path):
    """Return a function that writes the text of a script and returns its path."""

    def write(text):
        path = tmp_path / "script.py"
        path.write_text(text)
        return path

    return write


# Beginning of a script; the statements that a test appends are indented, within the task.
READING_SCRIPT = """
import sys, nidaqmx
from nidaqmx.constants import AcquisitionType
with nidaqmx.Task() as task:
    task.ai_channels.add_ai_voltage_chan("Dev1/ai0")
    task.timing.cfg_samp_clk_timing(5120.0, sample_mode=AcquisitionType.CONTINUOUS)
    total = 0
"""


def test_script_gets_rig_and_arguments(script, capfd):
    path = script(READING_SCRIPT + "    print(len(task.read(10)), sys.argv[1:], __name__)\n")
    assert run_script(path, ["--fast", "x"], "bare-structure", "fast") == 0
    output = capfd.readouterr()
    assert output.out == "10 ['--fast', 'x'] __main__\n"
    # The test of the scene drives the bench.
    assert "nothing drove the bench" not in output.err


def test_missing_drive_is_reported_at_end(script, capfd):
    path = script(READING_SCRIPT + "    task.read(10)\n")
    assert run_script(path, scene=rig.load("bare-structure", {"test": None}), clock="fast") == 0
    assert "nothing drove the bench" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("changes", "is_driven_by_script", "is_reported"),
    [({"test": None}, False, True), ({"test": None}, True, False), ({}, False, False)],
    ids=["nothing drives", "the script drives", "the test drives"],
)
def test_bench_without_drive_is_detected(changes, is_driven_by_script, is_reported):
    chassis = connect(rig.load("bare-structure", changes))
    with add_inputs(Task(), sample_mode=AcquisitionType.CONTINUOUS) as task, Task() as output:
        task.read(10)
        if is_driven_by_script:
            output.ao_channels.add_ao_voltage_chan("Dev1/ao0")
            output.write(0.1)
    assert chassis.was_read_without_drive is is_reported


@pytest.mark.thorough
def test_clock_advances_while_script_waits_for_enter(script, capfd):
    path = script(
        READING_SCRIPT
        + """
    def count_samples(handle, kind, samples, data):
        global total
        total += len(task.read(samples))
        return 0
    task.register_every_n_samples_acquired_into_buffer_event(512, count_samples)
    task.start()
    input("Press Enter to stop. ")
    import time
    time.sleep(0.2)
    task.stop()
    print(total)
"""
    )
    assert run_script(path, scene="bare-structure", clock="fast") == 0
    assert capfd.readouterr().out.startswith("Press Enter to stop. ")


@pytest.mark.parametrize("ending, code", [("raise SystemExit(3)", 3), ("1 / 0", 1)])
def test_exit_code_of_script_is_kept(script, capfd, ending, code):
    assert run_script(script(ending), scene="bare-structure", clock="fast") == code
    stderr = capfd.readouterr().err
    assert "script.py" in stderr or code == 3
    assert "daq/extras/ni_server" not in stderr


def test_syntax_error_shows_only_the_script(script, capfd):
    path = script("if True:\npass")
    assert run_script(path, scene="bare-structure", clock="fast") == 1
    stderr = capfd.readouterr().err
    assert str(path) in stderr
    assert "Error: " in stderr
    assert "daq/extras/ni_server" not in stderr


def test_unclosed_rig_does_not_block_exit():
    source = """
import daq, nidaqmx
from nidaqmx.constants import AcquisitionType
rig = daq.connect("bare-structure", clock="fast")
task = nidaqmx.Task(grpc_options=rig)
task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0", min_val=-500.0, max_val=500.0)
task.timing.cfg_samp_clk_timing(5120.0, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=100)
task.register_every_n_samples_acquired_into_buffer_event(100, lambda *_: 0)
task.start()
print(len(task.read(100)))
"""
    command = [sys.executable, "-W", "ignore::ResourceWarning", "-c", source]
    result = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (result.returncode, result.stdout.strip()) == (0, "100")
    assert "Traceback" not in result.stderr


def test_error_names_missing_script(tmp_path):
    with pytest.raises(SceneError, match=r"nothing\.py"):
        run_script(tmp_path / "nothing.py")


def test_error_names_unknown_scene(script):
    with pytest.raises(SceneError, match="no-such-scene"):
        run_script(script("pass"), scene="no-such-scene")


@pytest.mark.thorough
@pytest.mark.parametrize("name", EXAMPLES)
def test_example_shows_its_result(name, capfd):
    # Not `run_module`: pytest imports the packages of a plugin's distribution by a loader without the code of modules.
    runpy.run_path(str(Path(daq.examples.__file__).with_name(f"{name}.py")), run_name="__main__")
    stdout = capfd.readouterr().out
    expected_line = {
        "finite_read": "5120 samples per channel at 5120 S/s",
        "continuous_read": "5120 samples per channel",
        "impulse_capture": "first sample above 10 N: index 256",
        "log_to_recording": "table: 2560 samples in m, equal to the samples read",
        "live_control": "5.0 s: 0.4942 m/s^2",
        "controlled_test": "51.50 Hz: 0.2 mm at 3.67",
    }
    assert expected_line[name] in stdout
    assert "NOT" not in stdout


def test_acquisition_source_example_gives_all_samples():
    from daq.examples.acquisition_source import VirtualRig

    source = VirtualRig("bare-structure", clock="fast")
    source.set_data_source()
    blocks = [source.read_data() for _ in range(10)]
    n_samples = math.ceil(source.bench.chassis.elapsed * source.sample_rate)
    source.terminate_data_source()
    assert source.channel_names == ["body1", "body2", "body3", "table"]
    assert all(block.shape[1] == 4 for block in blocks)
    assert sum(len(block) for block in blocks) == n_samples


# The child process drives the shaker; the parent process reads all inputs on the same clock.
TWO_PROCESSES = """
import multiprocessing, sys
import nidaqmx, numpy as np
from nidaqmx.constants import AcquisitionType

def drive(ready, finished):
    with nidaqmx.Task() as task:
        task.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        task.timing.cfg_samp_clk_timing(5120.0, sample_mode=AcquisitionType.FINITE, samps_per_chan=512)
        task.triggers.start_trigger.cfg_dig_edge_start_trig("/cDAQ1/ai/StartTrigger")
        task.write(np.arange(512) / 512)
        task.start()
        ready.set()
        finished.wait(60)

if __name__ == "__main__":
    context = multiprocessing.get_context(sys.argv[1])
    ready, finished = context.Event(), context.Event()
    child = context.Process(target=drive, args=(ready, finished))
    child.start()
    ready.wait(60)
    with nidaqmx.Task() as task:
        task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0:3", min_val=-500, max_val=500)
        task.timing.cfg_samp_clk_timing(5120.0, samps_per_chan=512)
        read = np.array(task.read(512))
    finished.set()
    child.join()
    np.save(sys.argv[2], read)
"""


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["spawn", "fork"])
def test_processes_share_rig_and_clock(script, tmp_path, method):
    path = tmp_path / "read.npy"
    assert run_script(script(TWO_PROCESSES), [method, str(path)], "bare-structure", "fast") == 0
    drive = 1e-3 * np.arange(512) / 512  # m; the table moves 1 mm per V.
    expected = Bench(rig.load("bare-structure")).acquire(drive[None]).samples
    # The bench of the script has more ticks per sample, so that rounding differs.
    np.testing.assert_allclose(np.load(path), expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_duplicate_task_name_gives_drivers_error(script, capfd):
    text = """
import nidaqmx
with nidaqmx.Task("twice"):
    try:
        nidaqmx.Task("twice")
    except nidaqmx.DaqError as error:
        print(error.error_code, [device.name for device in nidaqmx.system.System.local().devices])
"""
    assert run_script(script(text), scene="bare-structure", clock="fast") == 0
    assert capfd.readouterr().out == "-200089 ['cDAQ1', 'cDAQ1Mod1', 'cDAQ1Mod2']\n"
