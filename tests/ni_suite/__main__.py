"""Runs NI's own tests of nidaqmx-python against this project's server.

Usage: python -m tests.ni_suite PATH [arguments of pytest]

PATH is a copy of https://github.com/ni/nidaqmx-python (MIT), which this project does not hold. Its tests run as
they are, against a server of the devices that they expect (see `devices`), those parametrized for gRPC. What
concerns no vibration rig is left out by file or by name, see `LEFT_OUT`.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path

from daq.server.client_defaults import SERVER
from daq.server.script import STARTUP

HERE = Path(__file__).resolve().parent
# Parts of test names, by why they concern no vibration rig.
LEFT_OUT = {
    "digital lines": r"digital|test_d[io]_|_d[io]_|waveform_d[io]|\bdo_|sim_6535|port|line_|watchdog_line|power_up",
    "counters": r"counter|test_c[io]_|_c[io]_chan|(readers|writers)_c[io]|encoder|pulse_|arm_start|"
    r"handshak|burst|pipelined|change_detection",
    "converters that take turns": r"with_device_context___returns|sim_9205",
    "power supplies": r"power|pwr",
    "temperature": r"thrmcpl|thermocouple|rtd|thrmstr|thermistor|temp_built|resistance_chan",
    "watchdogs": r"watchdog",
    "bridges": r"bridge|strain|rosette",
    # The only devices with these properties are bridge modules (PXIe-4331); no emulated module has a bridge input.
    "properties of a bridge module": r"test_device_properties.*list_of_(float|uint)_property",
    # Sheets of template 30; the rig's sensors have sheets of template 25.
    "data sheets of voltage sensors": r"(add|create)_teds_ai_voltage_chan",
    "currents and multimeters": r"current_chan|(current|voltage)_rms",
    "sensors that no emulated module reads": r"4_wire|charge_chan|eddy|lvdt|rvdt|chan_with_excit",
    # The properties are general, but the tests read them from a thermometer, a bridge, a power supply or a counter.
    "properties of other devices": r"test_channel_properties.*_(enum|float|string|boolean|uint32)_property|"
    r"test_channel_properties.*get_physical_channel|constructed_physical_channel___get_property|list_of_floats|"
    r"TestTriggers\.test_|test_int_property|physical_channel___get_bool",
}


def main() -> int:
    """Run the tests and print what passes, by group."""
    if len(sys.argv) < 2:
        print(__doc__)
        return 2
    path = Path(sys.argv[1]).resolve()
    given = sys.argv[2:] or ["tests/component", "tests/legacy", "tests/acceptance"]
    with subprocess.Popen([sys.executable, HERE / "serve.py"], stdout=subprocess.PIPE, text=True) as server:
        try:
            with tempfile.TemporaryDirectory() as folder:
                return _run(path, given, _port(server), Path(folder))
        finally:
            server.terminate()


def _port(server: subprocess.Popen[str]) -> int:
    assert server.stdout is not None
    line = server.stdout.readline()
    return int(line.rpartition(" ")[2])


def _run(path: Path, given: list[str], port: int, folder: Path) -> int:
    starter, report = folder / "server", folder / "report.xml"
    # NI's fixture starts a server and reads its port: this script only prints the port of the running server.
    starter.write_text(f"#!/bin/sh\necho Server listening on port {port}\nexec sleep 86400\n")
    starter.chmod(0o755)
    environment = os.environ | {
        "NI_SUITE_SERVER": str(starter),
        # Also for the data of NI's tests, which query the system during collection.
        SERVER: f"127.0.0.1:{port}",
        "PYTHONPATH": os.pathsep.join([str(STARTUP), str(HERE)]),
    }
    command = [sys.executable, "-m", "pytest", "-p", "plugin", "-p", "no:cacheprovider", "-q", "-rN"]
    command += ["-k", "grpc_init_kwargs", "--tb=line", f"--junitxml={report}", *given]
    subprocess.run(command, cwd=path, env=environment, check=False)
    return _print_report(report)


def _print_report(report: Path) -> int:
    groups: dict[str, Counter[str]] = {}
    failed = []
    for case in ET.parse(report).getroot().iter("testcase"):
        name = f"{case.get('classname')}.{case.get('name')}"
        outcome = next((each.tag for each in case if each.tag in ("failure", "error", "skipped")), "passed")
        reason = next((why for why, pattern in LEFT_OUT.items() if re.search(pattern, name, re.IGNORECASE)), None)
        group = f"left out: {reason}" if reason else ".".join(name.split(".")[1:3])
        groups.setdefault(group, Counter())[outcome] += 1
        if not reason and outcome in ("failure", "error"):
            message = next((each.get("message", "") for each in case if each.tag == outcome), "")
            failed.append(f"{name}: {' '.join(message.split())[:120]}")
    total: Counter[str] = Counter()
    for group, counts in sorted(groups.items()):
        print(f"{group}: {', '.join(f'{count} {outcome}' for outcome, count in sorted(counts.items()))}")
        if not group.startswith("left out"):
            total += counts
    applicable = sum(total.values()) - total["skipped"]
    print(
        f"concern a vibration rig: {total['passed']} of {applicable} pass ({total['passed'] / max(1, applicable):.1%})"
    )
    for name in failed:
        print("FAILED", name)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
