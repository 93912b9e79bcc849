"""Run NI's analog examples with the pytest plugin: `python -m tests.plugin_suites.ni_examples PATH`.

PATH is a copy of https://github.com/ni/nidaqmx-python (MIT license), which is not part of this project. An example
passes if it ends without an error; one that runs until Ctrl-C is interrupted after some seconds. The reason of each
failure is printed: it must be a kind of device that the guide names as missing.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

FOLDER = "SHOTRIG_NI_EXAMPLES"
BENCH = """
chassis: cDAQ-9174
modules:
  {Dev1: PCIe-6363, Dev2: PCIe-6363, PXI1Slot3: PCIe-6363, PXI1Slot7: PCIe-6363, cDAQ1Mod1: NI 9215, cDAQ1Mod2: NI 9263}
wires: [Dev1/ao0 -> Dev1/ai0]
sources: {Dev1/ai1: {amplitude: 1 V, frequency: 20 Hz}}
pulses: {PFI0: 1 Hz, PFI8: 1 Hz}
"""
TESTS = f"""
import _thread, builtins, os, runpy, sys, threading, time
from pathlib import Path
import pytest

FOLDER = Path(os.environ["{FOLDER}"])
SCRIPTS = sorted([*FOLDER.glob("analog_*/*.py"), *FOLDER.glob("*.py"), *FOLDER.glob("synchronization/**/*.py")])

@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: str(path.relative_to(FOLDER)))
def test_example(path, monkeypatch, tmp_path):
    prompts = []

    def press_enter(*text):
        time.sleep(1.0)
        prompts.append(text)
        if len(prompts) > 1:
            raise KeyboardInterrupt
        return ""

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(path)])
    monkeypatch.setattr(builtins, "input", press_enter)
    timer = threading.Timer(8.0, _thread.interrupt_main)
    timer.start()
    try:
        runpy.run_path(str(path), run_name="__main__")
    except KeyboardInterrupt:
        pass
    finally:
        timer.cancel()
"""


def main() -> int:
    """Run the examples; return the exit code of pytest."""
    if len(sys.argv) < 2:
        print(__doc__)
        return 2
    examples = Path(sys.argv[1]).resolve() / "examples"
    root = str(Path(__file__).parents[2])
    environment = os.environ | {FOLDER: str(examples), "PYTHONPATH": root, "MPLBACKEND": "agg"}
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "test_examples.py").write_text(TESTS)
        Path(folder, "bench.yaml").write_text(BENCH)
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:shotrig", "-p", "daq.extras.pytest_plugin.plugin"]
        command += ["--tb=line", "-p", "no:cacheprovider", "--nidaqmx", "--nidaqmx-bench=bench.yaml"]
        return subprocess.run(command, cwd=folder, env=environment, check=False).returncode


if __name__ == "__main__":
    raise SystemExit(main())
