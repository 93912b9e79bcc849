"""Faults in the samples of one channel: ``python -m tests.gauntlet.faults --seed 7 --scenes 8``.

The test of each random scene is recorded once and analyzed with each fault in one of its channels: the gain is halved
in the middle of the test, the channel is disconnected there, or its samples are 2 ms late, all of them or from there
on. Printed is a row for each kind of test and fault: in how many scenes the channel is named, nothing is reported, or
the analysis refuses the recording. Exit code 1: an intact channel was blamed.
"""

import argparse
import sys
import tempfile
import warnings
from collections import Counter
from pathlib import Path

import numpy as np

import daq
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array
from rig.core.base.errors import ShotrigError
from tests.gauntlet.checks.channels import blames
from tests.gauntlet.scenes import draw
from tests.gauntlet.two_shakers import MULTISINE, RANDOM, draw_two_shakers

KINDS = (
    "random",
    "burst_random",
    "multisine",
    "impulse",
    "stepped_sine",
    "swept_sine",
    "stepped_sine_dampers",
    "multisine_dampers",
    "swept_sine_dampers",
    RANDOM,
    MULTISINE,
)
# Ratio of the gains after and before the middle of the test, and delays before and after it [s].
FAULTS = {
    "none": (1.0, 0.0, 0.0),
    "gain halved": (0.5, 0.0, 0.0),
    "disconnected": (1e-4, 0.0, 0.0),
    "2 ms late": (1.0, 2e-3, 2e-3),
    "later from the middle": (1.0, 0.0, 2e-3),
}

OUTCOMES = ("named", "silent", "refused", "blamed")


class FaultyRecording(Recording):
    """A recording with a fault in the samples of one channel."""

    def __init__(self, path: Path, channel: str, fault: str) -> None:
        super().__init__(path)
        self._channel, (self._gain, *delays) = channel, FAULTS[fault]
        self._delays = [round(delay * self.rate) for delay in delays]
        # In the middle of the measurement; the last hit ends with the recording.
        starts = [mark.first_sample for mark in self.markers if mark.kind in ("measure", "hit")]
        stops = [mark.last_sample or self.samples for mark in self.markers if mark.kind == "measure"]
        self._middle = (min(starts, default=0) + max(stops, default=self.samples)) // 2

    def read(self, channel: str, start: int = 0, stop: int | None = None) -> Array:
        """Read a channel, with the fault."""
        if channel != self._channel:
            return super().read(channel, start, stop)
        start, stop = self._range(start, stop)
        lost = np.isnan(super().read(channel, start, stop))
        before, after = (self._read_delayed(start, stop, delay) for delay in self._delays)
        samples = np.where(np.arange(start, stop) < self._middle, before, after * self._gain)
        samples[lost] = np.nan
        return samples

    def _read_delayed(self, start: int, stop: int, delay: int) -> Array:
        samples = super().read(self._channel, max(start - delay, 0), max(stop - delay, 0))
        return np.concatenate([np.zeros(stop - start - samples.size), np.nan_to_num(samples)])


def outcome_of(path: Path, channel: str, fault: str) -> tuple[str, str]:
    """Return what the analysis says of a recording with a fault in a channel, and its words."""
    with FaultyRecording(path, channel, fault) as recording:
        is_force = recording.channels[channel].quantity == "force"
        names = {channel.casefold(), *(["the force"] if is_force else [])}
        try:
            texts = blames(recording)
        except ShotrigError as error:
            return "refused", str(error)
    # A message may name two channels of which one is at fault.
    is_named = fault != "none" and all(any(name in text.casefold() for name in names) for text in texts)
    return "silent" if not texts else "named" if is_named else "blamed", f"{channel}: {'; '.join(texts)}"


def run_scene(seed: int, number: int, kind: str) -> list[tuple[str, str, str, str]]:
    """Record a scene; return its kind, each fault, the outcome and the words of the analysis."""
    scene = (draw_two_shakers if kind in (RANDOM, MULTISINE) else draw)(seed, number, kind)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "faults.mcap"
        try:
            daq.record(scene, path)
        except ShotrigError as error:
            return [(kind, "none", "refused", str(error))]
        with daq.open(path) as recording:
            names = list(recording.channels)
        channel = names[np.random.default_rng([seed, number, 9]).integers(len(names))]
        return [(kind, fault, *outcome_of(path, channel, fault)) for fault in FAULTS]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=8, help="scenes of each kind (default: 8)")
    parser.add_argument("--seed", type=int, default=1, help="another seed draws other scenes")
    parser.add_argument("--kind", action="append", choices=KINDS, help="only this kind of test (repeatable)")
    options = parser.parse_args()
    warnings.simplefilter("ignore", daq.RunWarning)
    counts: Counter[tuple[str, str, str]] = Counter()
    for kind in options.kind or KINDS:
        for number in range(options.scenes):
            for _, fault, outcome, words in run_scene(options.seed, number, kind):
                counts[kind, fault, outcome] += 1
                if outcome == "blamed":
                    print(f"{options.seed}/{number} {kind}, {fault}, {words}", flush=True)
        for fault in FAULTS:
            row = [f"{counts[kind, fault, outcome]:3} {outcome:9}" for outcome in OUTCOMES]
            print(f"{kind:24}{fault:23}{''.join(row)}", flush=True)
    return int(any(outcome == "blamed" for _, _, outcome in counts))


if __name__ == "__main__":
    sys.exit(main())
