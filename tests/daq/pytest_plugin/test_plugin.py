"""Options and fixtures of the pytest plugin, and the examples of its guide, in runs of pytest of their own."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

GUIDE = Path(__file__).parents[3] / "daq" / "guide" / "test-your-code.md"
EXAMPLES = dict(re.findall(r"[Ss]ave this\s+as\s+`(\w+\.py)`.*?:\n\n```py\n(.*?)^```", GUIDE.read_text(), re.S | re.M))
# The plugin, also in an environment in which its entry point is not installed.
PLUGIN = ("-p", "no:shotrig", "-p", "daq.extras.pytest_plugin.plugin")
PLAIN_TEST = """
import nidaqmx, time

NAMES = nidaqmx.system.System.local().devices.device_names

def test_plain_task():
    start = time.monotonic()
    with nidaqmx.Task() as task:
        task.ai_channels.add_ai_voltage_chan(f"{NAMES[-1]}/ai0")
        task.timing.cfg_samp_clk_timing(1000.0, samps_per_chan=1000)
        task.start()
        time.sleep(100.0)
        assert len(task.read(1000)) == 1000
    assert time.monotonic() - start < 100.0
"""


@pytest.fixture
def run_pytest(tmp_path):
    """Return a function that runs pytest on files, with options, and returns the completed process."""

    def run(files, *options, plugin=PLUGIN):
        for name, text in files.items():
            (tmp_path / name).write_text(text)
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *plugin, *options]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    return run


@pytest.mark.thorough
def test_examples_of_guide_pass(run_pytest):
    programs = [text for name, text in EXAMPLES.items() if not name.startswith("test_")]
    assert len(programs) == 3
    assert not any(re.search(r"^(import|from) (daq|rig|analysis)", text, re.MULTILINE) for text in programs)
    result = run_pytest(EXAMPLES)
    assert result.returncode == 0, result.stdout
    assert "8 passed" in result.stdout


@pytest.mark.thorough
def test_option_serves_unchanged_tests(run_pytest):
    result = run_pytest({"test_plain.py": PLAIN_TEST}, "--nidaqmx", "--nidaqmx-bench", "NI 9263, USB-6001")
    assert result.returncode == 0, result.stdout


@pytest.mark.thorough
def test_configuration_file_chooses_bench(run_pytest):
    files = {
        "bench.yaml": "modules: {mine: USB-6001}\n",
        "pytest.ini": "[pytest]\nnidaqmx_bench = bench.yaml\n",
        "test_bench.py": "def test_name(nidaqmx_bench):\n    import nidaqmx\n    nidaqmx_bench()\n"
        "    assert nidaqmx.system.System.local().devices.device_names == ['mine']\n",
    }
    assert run_pytest(files).returncode == 0


@pytest.mark.parametrize(
    ("bench", "message"),
    [("bench.yaml", "bench.yaml:2: modules[2].product_type: no data sheet for 'NI 92345'"), ("fig7", "fig7")],
)
def test_invalid_bench_is_usage_error(run_pytest, bench, message):
    result = run_pytest({"bench.yaml": "modules:\n  [NI 9234, NI 92345]\n"}, "--nidaqmx", "--nidaqmx-bench", bench)
    assert result.returncode == pytest.ExitCode.USAGE_ERROR
    assert message in result.stderr
    assert "Traceback" not in result.stderr


def test_unused_plugin_imports_nothing(run_pytest):
    source = """
import sys

def test_imports(pytestconfig):
    assert pytestconfig.pluginmanager.has_plugin("daq.extras.pytest_plugin.plugin")
    heavy = {"nidaqmx", "numpy", "grpc", "pydantic", "daq.extras.ni_server", "daq.extras.ni_device"}
    assert not heavy & set(sys.modules)
"""
    result = run_pytest({"test_imports.py": source})
    assert result.returncode == 0, result.stdout


@pytest.mark.thorough
def test_client_is_restored_after_test(run_pytest):
    source = """
import os, time
import nidaqmx
import pytest

before = nidaqmx.Task.__init__, nidaqmx.system.System.local, time.sleep, dict(os.environ)

@pytest.mark.parametrize("number", [1, 2])
def test_bench_is_new(nidaqmx_bench, number):
    bench = nidaqmx_bench()
    assert (bench.elapsed, bench.transfers.latest) == (0.0, [])
    task = nidaqmx.Task("left open")
    task.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
    task.write(1.0)
    assert bench.open_tasks == ["left open"]
    assert bench.written("ao0").tolist() == [1.0]
    task.close()

def test_restored():
    for key in ("PYTEST_CURRENT_TEST",):
        os.environ.pop(key, None), before[3].pop(key, None)
    assert (nidaqmx.Task.__init__, nidaqmx.system.System.local, time.sleep, dict(os.environ)) == before
"""
    result = run_pytest({"test_restored.py": source})
    assert result.returncode == 0, result.stdout


@pytest.mark.thorough
def test_failing_test_leaves_session_bench_clean(run_pytest):
    source = """
import nidaqmx
import pytest

tasks = []

@pytest.fixture(scope="session")
def fixture_task():
    with nidaqmx.Task("fixture") as task:
        task.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        yield task

@pytest.mark.parametrize("number", [1, 2])
def test_leak(fixture_task, number):
    tasks.append(nidaqmx.Task("leak"))
    tasks[-1].ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0")
    tasks[-1].timing.cfg_samp_clk_timing(2048.0)
    tasks[-1].start()
    fixture_task.write(1.0)
    assert number == 2

def test_wrong_argument(nidaqmx_bench):
    with pytest.raises(TypeError, match="has no argument source. Choose bench, wires, sources, pulses, clock"):
        nidaqmx_bench(source={})
    nidaqmx_bench().faults.fail("read", -200279)
"""
    result = run_pytest({"test_leak.py": source}, "--nidaqmx")
    assert "1 failed, 2 passed" in result.stdout, result.stdout
    assert "has had no effect" in result.stdout


@pytest.mark.thorough
def test_failing_fixtures_leave_session_bench_clean(run_pytest):
    source = """
import nidaqmx
import pytest

tasks = []

def leave_open():
    tasks.append(nidaqmx.Task())
    tasks[-1].ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0")
    tasks[-1].timing.cfg_samp_clk_timing(2048.0)
    tasks[-1].start()

@pytest.fixture(scope="session")
def bench(nidaqmx_session_bench):
    return nidaqmx_session_bench()

@pytest.fixture
def fails_afterwards(bench):
    yield
    raise RuntimeError

@pytest.fixture
def fails_before(bench):
    leave_open()
    bench.faults.unplug("cDAQ1Mod2")
    raise RuntimeError

@pytest.fixture
def stays_open(bench):
    leave_open()

@pytest.mark.parametrize("fixture", ["fails_afterwards", "fails_before", "stays_open", "bench"])
def test_fixture(request, fixture):
    request.getfixturevalue(fixture)
    if fixture != "stays_open":
        leave_open()
    tasks[-1].read(10)
    assert "cDAQ1Mod2" in nidaqmx.system.System.local().devices.device_names

def test_setup_error(fails_before):
    pass

def test_last(bench):
    leave_open()
    assert "cDAQ1Mod2" in nidaqmx.system.System.local().devices.device_names
"""
    result = run_pytest({"test_fixtures.py": source})
    assert "1 failed, 4 passed, 2 errors" in result.stdout, result.stdout


@pytest.mark.thorough
def test_fixture_requested_late_keeps_task(run_pytest):
    source = """
import nidaqmx
import pytest

@pytest.fixture(scope="session")
def task():
    with nidaqmx.Task("late") as task:
        task.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        yield task

@pytest.mark.parametrize("number", [1, 2, 3])
def test_late(request, number):
    nidaqmx.Task(f"leak {number}")
    request.getfixturevalue("task").write(1.0)

def test_others_are_closed(request):
    assert "late" not in [nidaqmx.Task(name).name for name in ("leak 1", "leak 2", "leak 3")]
"""
    result = run_pytest({"test_late.py": source}, "--nidaqmx")
    assert "4 passed" in result.stdout, result.stdout


@pytest.mark.thorough
def test_child_processes_use_innermost_bench(run_pytest):
    source = """
import multiprocessing, subprocess, sys
import nidaqmx
import pytest

SCRIPT = "import nidaqmx; print(nidaqmx.system.System.local().devices.device_names)"

def names(queue):
    queue.put(nidaqmx.system.System.local().devices.device_names)

@pytest.fixture(scope="session", autouse=True)
def outer(nidaqmx_session_bench):
    return nidaqmx_session_bench({"modules": {"outer": "USB-6001"}})

@pytest.mark.parametrize("method", ["spawn", "fork"])
def test_child_process(nidaqmx_bench, method):
    if method not in multiprocessing.get_all_start_methods():
        pytest.skip("not on this system")
    nidaqmx_bench({"modules": {"inner": "USB-6001"}})
    context = multiprocessing.get_context(method)
    queue = context.Queue()
    process = context.Process(target=names, args=(queue,))
    process.start()
    assert queue.get(timeout=60) == ["inner"]
    process.join()
    assert process.exitcode == 0

def test_script():
    script = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
    assert script.stdout == "['outer']\\n"
"""
    result = run_pytest({"test_child.py": source})
    assert result.returncode == 0, result.stdout
