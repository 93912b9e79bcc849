import runpy
import sys

import nidaqmx
import pytest

import daq
from daq.server.script import run_script
from rig.errors import SceneError

EXAMPLES = ["finite_read", "continuous_read", "impulse_capture", "log_to_recording", "live_control"]


@pytest.fixture
def script(tmp_path, monkeypatch):
    monkeypatch.setattr("nidaqmx.utils._select_interpreter", nidaqmx.utils._select_interpreter)

    def write(text):
        path = tmp_path / "script.py"
        path.write_text(text)
        return path

    return write


READ = """
import sys, nidaqmx
from nidaqmx.constants import AcquisitionType
with nidaqmx.Task() as task:
    task.ai_channels.add_ai_voltage_chan("Dev1/ai0")
    task.timing.cfg_samp_clk_timing(5120.0, sample_mode=AcquisitionType.CONTINUOUS)
    total = 0
"""


def test_given_a_script_for_the_package_when_run_then_it_has_the_rig_and_its_arguments(script, capsys):
    path = script(READ + "    print(len(task.read(10)), sys.argv[1:], __name__)\n")
    assert run_script(path, ["--fast", "x"], "bare-structure", "fast") == 0
    assert capsys.readouterr().out == "10 ['--fast', 'x'] __main__\n"


def test_given_an_endless_script_when_its_seconds_are_over_then_it_gets_a_ctrl_c(script, capsys):
    path = script(
        READ
        + """
    try:
        while True:
            total += len(task.read(512))
    except KeyboardInterrupt:
        print(total)
"""
    )
    assert run_script(path, scene="bare-structure", clock="fast", seconds=1.0) == 0
    assert capsys.readouterr().out == "4608\n"


def test_given_a_script_that_waits_for_enter_when_run_fast_then_bench_time_passes_meanwhile(script, capsys):
    path = script(
        READ
        + """
    def look(handle, kind, samples, data):
        global total
        total += len(task.read(samples))
        return 0
    task.register_every_n_samples_acquired_into_buffer_event(512, look)
    task.start()
    input("Press Enter to stop. ")
    import time
    time.sleep(0.5)
    task.stop()
    print(total)
"""
    )
    assert run_script(path, scene="bare-structure", clock="fast", seconds=2.0) == 0
    assert capsys.readouterr().out == f"Press Enter to stop. {int(2.5 * 5120)}\n"


@pytest.mark.parametrize(
    "end, code", [("raise SystemExit(3)", 3), ("raise SystemExit('why')", 1), ("1 / 0", 1)]
)
def test_given_a_script_when_it_ends_in_its_own_way_then_the_exit_code_is_its_own(script, capsys, end, code):
    assert run_script(script(end), scene="bare-structure", clock="fast") == code
    shown = capsys.readouterr().err
    assert "script.py" in shown or code == 3 or "why" in shown
    assert "daq" not in shown.replace(str(script("")), "")


@pytest.mark.parametrize("source", ["x = (", "x = 1\0", "if True:\npass"])
def test_given_a_script_that_cannot_be_compiled_when_run_then_only_the_script_is_shown(
    script, capsys, source
):
    path = script(source)
    assert run_script(path, scene="bare-structure", clock="fast") == 1
    shown = capsys.readouterr().err
    assert str(path) in shown
    assert "Error: " in shown
    assert "runpy" not in shown and "daq/script.py" not in shown


@pytest.mark.parametrize("seconds", [-1.0, 0.0, float("nan"), float("inf")])
def test_given_seconds_that_are_no_time_when_run_then_they_are_refused_before_the_script(
    script, capsys, seconds
):
    with pytest.raises(SceneError, match="seconds") as caught:
        run_script(script("print('ran')"), scene="bare-structure", clock="fast", seconds=seconds)
    assert caught.value.exit_code == 2
    assert capsys.readouterr().out == ""


def test_given_no_script_when_run_then_the_error_names_it(tmp_path):
    with pytest.raises(SceneError, match=r"nothing\.py"):
        run_script(tmp_path / "nothing.py")


def test_given_an_unknown_scene_when_a_script_is_run_then_the_error_names_it(script):
    with pytest.raises(SceneError, match="no-such-scene"):
        run_script(script("pass"), scene="no-such-scene")


@pytest.mark.parametrize("name", EXAMPLES)
def test_given_an_example_when_run_then_it_shows_what_it_promises(name, capsys, monkeypatch):
    # The doctests may have imported it already.
    monkeypatch.delitem(sys.modules, f"daq.examples.{name}", raising=False)
    runpy.run_module(f"daq.examples.{name}", run_name="__main__")
    shown = capsys.readouterr().out
    promised = {
        "finite_read": "5120 samples per channel at 5120 S/s",
        "continuous_read": "5120 samples per channel",
        "impulse_capture": "first sample above 10 N: index 256",
        "log_to_recording": "table: 2560 samples in m, as read",
        "live_control": "5.0 s: 0.4942 m/s^2",
    }
    assert promised[name] in shown
    assert "NOT" not in shown


def test_given_the_source_recipe_when_polled_then_it_gives_all_samples_in_order():
    from daq.examples.acquisition_source import VirtualRig

    source = VirtualRig("bare-structure", clock="fast")
    source.set_data_source()
    blocks = [source.read_data() for _ in range(10)]
    source.terminate_data_source()
    assert source.channel_names == ["body1", "body2", "body3", "table"]
    assert all(block.shape[1] == 4 for block in blocks)
    assert sum(len(block) for block in blocks) == source.chassis.position
    daq.connect("bare-structure", clock="fast")
