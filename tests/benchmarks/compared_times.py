"""Processor times of tasks next to reference times: `python -m tests.benchmarks.compared_times [--quick] FILE.json`.

Measured times are processor times, including child processes, because elapsed times on a shared machine depend on its
load. The reference is the duration of the test (real time), the import of numpy, or an acceptable time. `--quick` omits
the analysis of a long recording. `command_times` measures studies, and first runs that compile.
"""

import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import analysis
import daq
import rig
from tests.benchmarks.engine import engine_period, tone_of

# Locations of the four accelerometers.
LOCATIONS = ("body 1", "body 2", "body 3", "table")
# Converter and accelerometers: presets from data sheets; and the same with all other simulated imperfections.
DATA_SHEET_PARTS = {"converter": {"preset": "NI 9234", "rate": "51.2 kHz"}, "accelerometer": {"preset": "PCB 352C33"}}
PARTS_WITH_ALL_EFFECTS = {
    "converter": {
        **DATA_SHEET_PARTS["converter"], "skew": "1 us", "jitter": "1 ns", "clock_error": "10 ppm", "coupling": "AC",
        "noise": "50 nV/sqrt(Hz)",
    },
    "accelerometer": {
        **DATA_SHEET_PARTS["accelerometer"], "temperature_drift": "0.05 %/K", "temperature_change": "10 K",
        "overload_recovery": "10 ms",
    },
}  # fmt: skip


class ComparedTime(NamedTuple):
    """Name and processor time of a task, and name and time of its reference."""

    name: str
    seconds: float
    reference: str
    reference_seconds: float

    def __str__(self) -> str:
        ratio = self.reference_seconds / self.seconds
        return (
            f"{self.name:52s} {self.seconds:10.4g} s   {ratio:8.3g} x {self.reference} ({self.reference_seconds:.3g} s)"
        )


def command_time(*arguments: str) -> float:
    """Return the shortest processor time of five runs of a Python command, s."""
    times = []
    for _ in range(5):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, *arguments], check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        times.append(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
    return min(times)


def random_test(parts: dict[str, Any]) -> rig.Scene:
    """Return a random test at 51.2 kS/s of three dampers with 2 ms contact; `parts`: converter and accelerometer."""
    channels = [{"name": at.replace(" ", ""), "at": at, "accelerometer": parts["accelerometer"]} for at in LOCATIONS]
    damper = {"mass_ratio": 0.1, "clearance": float("inf"), "contact": {"duration": "2 ms"}}
    return rig.load("fig8-three-dampers").replace(
        channels=channels,
        converter=parts["converter"],
        dampers=[{"body": body, **damper} for body in (1, 2, 3)],
        test={"kind": "random", "from": "5 Hz", "to": "100 Hz", "duration": "10 s", "drive": "1 V"},
        recording={"display": True},
    )


def recording_time(name: str, scene: rig.Scene, folder: Path) -> ComparedTime:
    """Measure the recording of a test; the first of four runs imports and compiles, and does not count."""
    shortest, duration = float("inf"), 0.0
    for number in range(4):
        path, before = folder / f"{number}.mcap", resource.getrusage(resource.RUSAGE_SELF)
        daq.record(scene, path)
        after = resource.getrusage(resource.RUSAGE_SELF)
        if number:
            shortest = min(shortest, after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
        with daq.open(path) as recording:
            duration = recording.samples / recording.rate
        path.unlink()
    return ComparedTime(name, shortest, "real time", duration)


def command_startups() -> Iterator[ComparedTime]:
    """Measure the start of commands."""
    numpy_import = command_time("-c", "import numpy")
    demo = str(Path("recordings/demo-impulse-no-damper.mcap").absolute())
    for command in ("rig --help", "rig scenes", f"daq info {demo}", "rig simulate reference-A"):
        program, *arguments = command.split()
        seconds = command_time("-m", program, *arguments)
        yield ComparedTime(command.replace(demo, "REC"), seconds, "import of numpy", numpy_import)


def complete_tests() -> Iterator[ComparedTime]:
    """Measure complete tests with display."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fig8 = rig.load("fig8-three-dampers", {"test.points": 12})
        for name, scene in (
            ("Fig 8, three dampers, display", fig8),
            ("4 x 51.2 kS/s, data sheets, random, display", random_test(DATA_SHEET_PARTS)),
            ("4 x 51.2 kS/s, every effect, random, display", random_test(PARTS_WITH_ALL_EFFECTS)),
        ):
            yield recording_time(name, scene, Path(folder))


def engine_periods() -> Iterator[ComparedTime]:
    """Measure the engine's time for a period of a sinusoidal drive."""
    for case in "ABC":
        scene = rig.load(f"reference-{case}")
        period = 2 * math.pi / tone_of(scene)[1].omega
        yield ComparedTime(f"period of reference-{case}", engine_period(scene), "real time", period)


def analyses() -> Iterator[ComparedTime]:
    """Measure the analysis of a recording of ten minutes."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = random_test(DATA_SHEET_PARTS)
        test = {"kind": "random", "from": "5 Hz", "to": "100 Hz", "duration": "10 min", "drive": "1 V"}
        path = daq.record(scene.replace(test=test), Path(folder) / "long.mcap")
        times = []
        for _ in range(3):
            start = time.process_time()
            with daq.open(path) as recording:
                analysis.frfs(recording)
            times.append(time.process_time() - start)
        yield ComparedTime("FRFs of ten minutes at 4 x 51.2 kS/s", min(times), "acceptable time", 2.0)


def main(arguments: list[str]) -> None:
    """Print the times, and write them into a JSON file."""
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(Path.cwd()), os.environ.get("PYTHONPATH")]))
    seconds = {}
    for measure in (command_startups, engine_periods, complete_tests, *(() if "--quick" in arguments else (analyses,))):
        for compared in measure():
            print(compared, flush=True)
            seconds[compared.name] = compared.seconds
    for path in (argument for argument in arguments if argument.endswith(".json")):
        Path(path).write_text(json.dumps(seconds, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
