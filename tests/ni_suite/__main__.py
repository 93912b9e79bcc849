"""Run NI's own tests of nidaqmx-python against this project's server.

    python -m tests.ni_suite PATH [arguments of pytest]

PATH is a copy of https://github.com/ni/nidaqmx-python (MIT license), which is not part of this project. Those of its
tests that use gRPC run unchanged, against a server of the devices that they expect (see `devices`). They require
pytest-mock and pykka. Tests of features that a vibration rig does not have are not counted, see `OUT_OF_SCOPE`.
"""

import os
import re
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path

from daq.extras.ni_server.client_defaults import SERVER, STARTUP

HERE = Path(__file__).resolve().parent
# Features that a vibration rig does not have, and patterns of the names of their tests.
OUT_OF_SCOPE = {
    "digital lines": r"digital|test_d[io]_|_d[io]_|waveform_d[io]|\bdo_|sim_6535|port|line_|watchdog_line|power_up",
    "counters": r"counter|test_c[io]_|_c[io]_chan|(readers|writers)_c[io]|encoder|pulse_|arm_start|"
    r"handshak|burst|pipelined|change_detection",
    "multiplexed converters": r"with_device_context___returns|sim_9205",
    "power supplies": r"power|pwr",
    "temperature": r"thrmcpl|thermocouple|rtd|thrmstr|thermistor|temp_built|resistance_chan",
    "watchdogs": r"watchdog",
    "bridges": r"bridge|strain|rosette",
    # The only devices with these properties are bridge modules (PXIe-4331); no emulated module has a bridge input.
    "properties of a bridge module": r"test_device_properties.*list_of_(float|uint)_property",
    # Electronic data sheets (TEDS) of template 30; the sensors of the rig have template 25.
    "data sheets of voltage sensors": r"(add|create)_teds_ai_voltage_chan",
    "currents and multimeters": r"current_chan|(current|voltage)_rms",
    "sensors that no emulated module reads": r"4_wire|charge_chan|eddy|lvdt|rvdt|chan_with_excit",
    # The properties are general, but the tests read them from a thermometer, a bridge, a power supply or a counter.
    "properties of other devices": r"test_channel_properties.*_(enum|float|string|boolean|uint32)_property|"
    r"test_channel_properties.*get_physical_channel|constructed_physical_channel___get_property|list_of_floats|"
    r"TestTriggers\.test_|test_int_property|physical_channel___get_bool",
}


def main() -> int:
    """Run the tests and print the number of each outcome by group; return the exit code."""
    if len(sys.argv) < 2:
        print(__doc__)
        return 2
    path = Path(sys.argv[1]).resolve()
    arguments = sys.argv[2:] or ["tests/component", "tests/legacy", "tests/acceptance"]
    with subprocess.Popen([sys.executable, HERE / "serve.py"], stdout=subprocess.PIPE, text=True) as server:
        try:
            with tempfile.TemporaryDirectory() as folder:
                return _run_suite(path, arguments, _read_port(server), Path(folder))
        finally:
            server.terminate()


def _read_port(server: subprocess.Popen[str]) -> int:
    assert server.stdout is not None
    line = server.stdout.readline()
    return int(line.rpartition(" ")[2])


def _run_suite(path: Path, arguments: list[str], port: int, folder: Path) -> int:
    """Run NI's tests in the repository at `path` with the server at a port; return the exit code."""
    server_script, report = folder / "server", folder / "report.xml"
    # NI's fixture starts a server program and reads its port. This program only prints the port of the running server.
    server_script.write_text(f"#!/bin/sh\necho Server listening on port {port}\nexec sleep 86400\n")
    server_script.chmod(0o755)
    environment = os.environ | {
        "NI_SUITE_SERVER": str(server_script),
        # NI's tests also query the system during collection, without their fixture.
        SERVER: f"127.0.0.1:{port}",
        "PYTHONPATH": os.pathsep.join([str(STARTUP), str(HERE), *filter(None, [os.environ.get("PYTHONPATH")])]),
    }
    command = [sys.executable, "-m", "pytest", "-p", "plugin", "-p", "no:cacheprovider", "-q", "-rN"]
    command += ["-k", "grpc_init_kwargs", "--tb=line", f"--junitxml={report}", *arguments]
    subprocess.run(command, cwd=path, env=environment, check=False)
    return _print_report(report)


def _print_report(report: Path) -> int:
    """Print the outcomes in a JUnit report by group, and the failed tests; return exit code 0."""
    groups: dict[str, Counter[str]] = {}
    failed = []
    for case in ET.parse(report).getroot().iter("testcase"):
        name = f"{case.get('classname')}.{case.get('name')}"
        outcome = next((element.tag for element in case if element.tag in ("failure", "error", "skipped")), "passed")
        feature = next(
            (feature for feature, pattern in OUT_OF_SCOPE.items() if re.search(pattern, name, re.IGNORECASE)), None
        )
        group = f"out of scope: {feature}" if feature else ".".join(name.split(".")[1:3])
        groups.setdefault(group, Counter())[outcome] += 1
        if not feature and outcome in ("failure", "error"):
            message = next((element.get("message", "") for element in case if element.tag == outcome), "")
            failed.append(f"{name}: {' '.join(message.split())[:120]}")
    total: Counter[str] = Counter()
    for group, counts in sorted(groups.items()):
        print(f"{group}: {', '.join(f'{count} {outcome}' for outcome, count in sorted(counts.items()))}")
        if not group.startswith("out of scope"):
            total += counts
    applicable = sum(total.values()) - total["skipped"]
    print(f"in scope: {total['passed']} of {applicable} tests pass ({total['passed'] / max(1, applicable):.1%})")
    for name in failed:
        print("FAILED", name)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
