"""Foreseen and recorded maxima on random scenes: ``python -m tests.gauntlet.foresights --scenes 40 --seed 7``.

Prints a line for each scene and the largest relative difference of linear scenes and of scenes with dampers. Exit
code 1 where a channel is beyond what is promised.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import daq
import rig
from rig.errors import RunError
from tests.gauntlet.scenes import draw

KINDS = (
    "random",
    "multisine",
    "impulse",
    "stepped_sine",
    "swept_sine",
    "burst_random",
    "stepped_sine_dampers",
    "multisine_dampers",
    "swept_sine_dampers",
    "impulse_dampers",
)
# Largest relative difference of a foreseen maximum.
PROMISED = {"linear": 0.05, "with dampers": 0.20}


@dataclass(frozen=True)
class Comparison:
    """Foreseen maxima of the channels of a scene against those that were recorded."""

    kind: str
    worst: float
    channel: str
    whole: bool
    overloaded: bool
    abort_agrees: bool
    seconds: float
    duration_error: float

    @property
    def group(self) -> str:
        return "with dampers" if self.kind.endswith("_dampers") else "linear"

    @property
    def kept(self) -> bool:
        return self.worst <= PROMISED[self.group] and self.abort_agrees


def lengthened(scene: rig.Scene) -> rig.Scene:
    """Give a scene a test that is too long to be rehearsed whole."""
    test = scene.test
    changes = {
        "random": lambda: {"duration": 10.0 * test.duration},
        "multisine": lambda: {"periods": 20, "realisations": 8},
        "impulse": lambda: {"repeats": 20, "interval": 20.0, "double_hit": None},
        "stepped_sine": lambda: {"points": 100},
        "swept_sine": lambda: {"duration": 15.0 * test.duration},
    }
    return scene.replace(test=test.replace(**changes[test.kind]()))


def compare(scene: rig.Scene, kind: str, folder: Path) -> Comparison:
    """Foresee a scene, record it, and compare the maxima of every channel."""
    started = time.process_time()
    foreseen = daq.foresee(scene)
    seconds = time.process_time() - started
    path, aborted = folder / "recorded.mcap", False
    with warnings.catch_warnings(), suppress(RunError):
        warnings.simplefilter("ignore")
        aborted = True
        daq.record(scene, path, overwrite=True)
        aborted = False
    worst, name = 0.0, ""
    with daq.open(path) as recording:
        for channel in recording.channels:
            recorded = float(np.nanmax(abs(recording.read(channel))))
            differs = abs(foreseen[channel].recorded / recorded - 1.0) if recorded else 0.0
            if differs > worst:
                worst, name = differs, channel
        duration = recording.samples / recording.rate
    overloaded = any(each.overloaded for each in foreseen.expectations)
    agrees = aborted == (foreseen.aborts is not None)
    return Comparison(
        kind,
        worst,
        name,
        not foreseen.rehearsed,
        overloaded,
        agrees,
        seconds,
        foreseen.seconds / duration - 1.0,
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=40, help="how many scenes (default: 40)")
    parser.add_argument("--seed", type=int, default=1, help="another seed draws other scenes")
    parser.add_argument("--long", action="store_true", help="tests too long to be rehearsed whole")
    given = parser.parse_args()
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(given.scenes):
            kind = KINDS[number % len(KINDS)]
            scene = draw(given.seed, number, kind)
            if given.long:
                scene = lengthened(scene)
            each = compare(scene, kind, Path(folder))
            found.append(each)
            print(
                f"{number:3} {kind:22} {each.worst:7.2%} {each.channel:8} {'whole' if each.whole else 'parts'} "
                f"{'overload ' if each.overloaded else ''}{'' if each.abort_agrees else 'ABORT DIFFERS '}"
                f"CPU {each.seconds:.2f} s, duration {each.duration_error:+.0%}",
                flush=True,
            )
    for group, most in PROMISED.items():
        errors = [each.worst for each in found if each.group == group]
        inside = sum(error <= most for error in errors)
        print(f"{group}: {inside} of {len(errors)} within {most:.0%}, largest {max(errors, default=0.0):.2%}")
    return 0 if all(each.kept for each in found) else 1


if __name__ == "__main__":
    sys.exit(main())
