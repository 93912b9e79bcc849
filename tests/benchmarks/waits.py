"""What people wait for, each beside a peer: `python -m tests.benchmarks.waits FILE.json`.

Processor time throughout, of children too: a machine that others use as well tells nothing by the clock. A peer is real
time, a Python that only imports numpy, or what the study is to take. With `--quick` the studies are left out, what a
first run has to compile, and the analysis of a long recording.
"""

from __future__ import annotations

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

PLACES = ("body 1", "body 2", "body 3", "table")
PRESETS = {"converter": {"preset": "NI 9234", "rate": "51.2 kHz"}, "accelerometer": {"preset": "PCB 352C33"}}
EVERY_EFFECT = {
    "converter": {
        **PRESETS["converter"], "skew": "1 us", "jitter": "1 ns", "clock_error": "10 ppm", "coupling": "AC",
        "noise": "50 nV/sqrt(Hz)",
    },
    "accelerometer": {
        **PRESETS["accelerometer"], "temperature_drift": "0.05 %/K", "temperature_change": "10 K",
        "overload_recovery": "10 ms",
    },
}  # fmt: skip
# Studies, and the processor time in seconds that they are to take: of both cores together.
STUDIES = {
    "rig map fig9 --points 60 --rows 40": 20.0,
    "rig cost fig9": 20.0,
    "analysis cost fig9": 20.0,
    "analysis paper": 180.0,
}


class Wait(NamedTuple):
    """A figure: what was measured, its processor time, and what that of its peer is; s."""

    name: str
    seconds: float
    peer: str
    peer_seconds: float

    def __str__(self) -> str:
        ratio = self.peer_seconds / self.seconds
        return (
            f"{self.name:52s} {self.seconds:10.4g} s   {ratio:8.3g} x {self.peer} ({self.peer_seconds:.3g} s)"
        )


def spent(*words: str, repeats: int = 1, folder: Path | None = None, **environment: str) -> float:
    """Give the least processor time that a command takes, s."""
    times, there = [], os.environ | environment
    for _ in range(repeats):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, *words], check=True, capture_output=True, cwd=folder, env=there)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        times.append(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
    return min(times)


def at_51_200_hz(parts: dict[str, Any]) -> rig.Scene:
    """Give the rig with three dampers, which land in 2 ms, under random drive, measured with parts like these."""
    channels = [
        {"name": at.replace(" ", ""), "at": at, "accelerometer": parts["accelerometer"]} for at in PLACES
    ]
    damper = {"mass_ratio": 0.1, "clearance": float("inf"), "contact": {"duration": "2 ms"}}
    return rig.load("fig8-three-dampers").replace(
        channels=channels,
        converter=parts["converter"],
        dampers=[{"body": body, **damper} for body in (1, 2, 3)],
        test={"kind": "random", "from": "5 Hz", "to": "100 Hz", "duration": "10 s", "drive": "1 V"},
        recording={"display": True},
    )


def recorded(name: str, scene: rig.Scene, folder: Path) -> Wait:
    """Measure a whole test, everything compiled and imported."""
    best, lasts = float("inf"), 0.0
    for number in range(4):
        path, before = folder / f"{number}.mcap", resource.getrusage(resource.RUSAGE_SELF)
        daq.record(scene, path)
        after = resource.getrusage(resource.RUSAGE_SELF)
        if number:
            best = min(best, after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
        with daq.open(path) as recording:
            lasts = recording.samples / recording.rate
        path.unlink()
    return Wait(name, best, "real time", lasts)


def commands() -> Iterator[Wait]:
    """Measure the start of commands."""
    numpy = spent("-c", "import numpy", repeats=5)
    demo = str(Path("recordings/demo-impulse-no-damper.mcap").absolute())
    for words in ("rig --help", "rig scenes", f"daq info {demo}", "rig simulate reference-A"):
        program, *rest = words.split()
        taken = spent("-m", program, *rest, repeats=5)
        yield Wait(words.replace(demo, "REC"), taken, "import of numpy", numpy)


def whole_tests() -> Iterator[Wait]:
    """Measure whole tests with display."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        fig8 = rig.load("fig8-three-dampers", {"test.points": 12})
        for name, scene in (
            ("Fig 8, three dampers, display", fig8),
            ("4 x 51.2 kS/s, data sheets, random, display", at_51_200_hz(PRESETS)),
            ("4 x 51.2 kS/s, every effect, random, display", at_51_200_hz(EVERY_EFFECT)),
        ):
            yield recorded(name, scene, Path(folder))


def periods() -> Iterator[Wait]:
    """Measure the engine under a tone."""
    for case in "ABC":
        scene = rig.load(f"reference-{case}")
        period = 2 * math.pi / tone_of(scene)[1].omega
        yield Wait(f"period of reference-{case}", engine_period(scene), "real time", period)


def analyses() -> Iterator[Wait]:
    """Measure an analysis of ten minutes."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = at_51_200_hz(PRESETS)
        test = {"kind": "random", "from": "5 Hz", "to": "100 Hz", "duration": "10 min", "drive": "1 V"}
        path = daq.record(scene.replace(test=test), Path(folder) / "long.mcap")
        times = []
        for _ in range(3):
            began = time.process_time()
            with daq.open(path) as recording:
                analysis.frfs(recording)
            times.append(time.process_time() - began)
        yield Wait("FRFs of ten minutes at 4 x 51.2 kS/s", min(times), "what it is to take", 2.0)


def studies() -> Iterator[Wait]:
    """Measure studies that take many motions."""
    with tempfile.TemporaryDirectory() as folder:
        # Elsewhere than in the checkout they find what was computed before.
        for words, asked in STUDIES.items():
            program, *rest = words.split()
            yield Wait(words, spent("-m", program, *rest, folder=Path(folder)), "what it is to take", asked)


def first_runs() -> Iterator[Wait]:
    """Measure a first simulation and a first recording, with all that has to be compiled."""
    with tempfile.TemporaryDirectory() as folder:
        sweep = ("fig8-three-dampers", "--set", "test.points=2", "-o", f"{folder}/sweep.mcap")
        both = (
            spent("-m", *words, NUMBA_CACHE_DIR=folder)
            for words in (("rig", "simulate", "reference-A"), ("daq", "record", *sweep))
        )
        yield Wait("first rig simulate and daq record", sum(both), "what it is to take", 30.0)


def main(words: list[str]) -> None:
    """Print the figures, and write them into a file of JSON."""
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(Path.cwd()), os.environ.get("PYTHONPATH")]))
    found = {}
    for part in (
        commands,
        periods,
        whole_tests,
        *(() if "--quick" in words else (analyses, first_runs, studies)),
    ):
        for wait in part():
            print(wait, flush=True)
            found[wait.name] = wait.seconds
    for path in (word for word in words if word.endswith(".json")):
        Path(path).write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
