"""Predicted maxima compared with recordings: ``python -m tests.gauntlet.predicted_maxima --scenes 40 --seed 7``.

`daq.foresee` predicts the maximum of each channel before a test. It rehearses the test, completely or in parts. Printed
are a line for each random scene, and the largest relative errors of scenes without and with dampers. Exit code 1: an
error exceeds the documented limit, or a test aborts although no abort was predicted, or the reverse.
"""

import argparse
import sys
import tempfile
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import daq
import rig
from rig.core.base.errors import RunError
from tests.gauntlet.scenes import draw

# Kinds of tests: a selection of those of `tests.gauntlet.scenes`.
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
# Documented largest relative error of a predicted maximum.
MAX_RELATIVE_ERROR = {"linear": 0.05, "with dampers": 0.20}


@dataclass(frozen=True)
class Comparison:
    """Predicted and recorded maxima of the channels of a scene."""

    kind: str
    max_error: float
    """Largest relative error of a predicted maximum."""
    channel: str
    """The channel with the largest error."""
    fully_rehearsed: bool
    overloaded: bool
    """Whether an overload was predicted."""
    abort_agrees: bool
    """Whether the test aborted exactly if that was predicted."""
    seconds: float
    """CPU time of the prediction."""
    duration_error: float
    """Relative error of the predicted duration."""

    @property
    def group(self) -> str:
        return "with dampers" if self.kind.endswith("_dampers") else "linear"

    @property
    def is_accurate(self) -> bool:
        return self.max_error <= MAX_RELATIVE_ERROR[self.group] and self.abort_agrees


def with_long_test(scene: rig.Scene) -> rig.Scene:
    """Return the scene with a test that is too long for a complete rehearsal."""
    test = scene.test
    changes = {
        "random": lambda: {"duration": 10.0 * test.duration},
        "multisine": lambda: {"periods": 20, "realisations": 8},
        "impulse": lambda: {"repeats": 20, "interval": 20.0, "double_hit": None},
        "stepped_sine": lambda: {"points": 60},
        "swept_sine": lambda: {"duration": 15.0 * test.duration},
    }
    return scene.replace(test=test.replace(**changes[test.kind]()))


def compare(scene: rig.Scene, kind: str, folder: Path) -> Comparison:
    """Predict the maxima of a scene, record it, and compare the maxima of every channel."""
    start = time.process_time()
    prediction = daq.foresee(scene)
    seconds = time.process_time() - start
    path, aborted = folder / "recorded.mcap", False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            daq.record(scene, path, overwrite=True)
        except RunError:
            aborted = True
    max_error, channel_name = 0.0, ""
    with daq.open(path) as recording:
        for channel in recording.channels:
            recorded = float(np.nanmax(abs(recording.read(channel))))
            error = abs(prediction[channel].recorded / recorded - 1.0) if recorded else 0.0
            if error > max_error:
                max_error, channel_name = error, channel
        duration = recording.samples / recording.rate
    overloaded = any(expectation.overloaded for expectation in prediction.expectations)
    abort_agrees = aborted == (prediction.aborts is not None)
    return Comparison(
        kind,
        max_error,
        channel_name,
        fully_rehearsed=not prediction.rehearsed,  # it describes the rehearsed part, if there is only a part
        overloaded=overloaded,
        abort_agrees=abort_agrees,
        seconds=seconds,
        duration_error=prediction.seconds / duration - 1.0,
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=40, help="how many scenes (default: 40)")
    parser.add_argument("--seed", type=int, default=1, help="another seed draws other scenes")
    parser.add_argument("--long", action="store_true", help="tests too long for a complete rehearsal")
    options = parser.parse_args()
    comparisons = []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(options.scenes):
            kind = KINDS[number % len(KINDS)]
            scene = draw(options.seed, number, kind)
            if options.long:
                scene = with_long_test(scene)
            comparison = compare(scene, kind, Path(folder))
            comparisons.append(comparison)
            print(
                f"{number:3} {kind:22} {comparison.max_error:7.2%} {comparison.channel:8} "
                f"{'complete' if comparison.fully_rehearsed else 'parts   '} "
                f"{'overload ' if comparison.overloaded else ''}{'' if comparison.abort_agrees else 'ABORT DIFFERS '}"
                f"CPU {comparison.seconds:.2f} s, duration {comparison.duration_error:+.0%}",
                flush=True,
            )
    for group, limit in MAX_RELATIVE_ERROR.items():
        errors = [comparison.max_error for comparison in comparisons if comparison.group == group]
        n_accurate = sum(error <= limit for error in errors)
        print(f"{group}: {n_accurate} of {len(errors)} within {limit:.0%}, largest {max(errors, default=0.0):.2%}")
    return 0 if all(comparison.is_accurate for comparison in comparisons) else 1


if __name__ == "__main__":
    sys.exit(main())
