"""Growth of processor time with the size of a test, as exponents: `python -m tests.benchmarks.growth`.

A chain of bodies under a random force is explained, recorded and analysed with more bodies, dampers, channels or
seconds. An exponent of 1 is a time in proportion; a chain with modal damping has full matrices, whose product with the
state grows with the square of the bodies.
"""

from __future__ import annotations

import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

import analysis
import daq
import rig

# Bodies, dampers, channels and seconds of the smallest test, and the sizes of each that are measured.
SMALLEST = {"bodies": 3, "dampers": 1, "channels": 4, "seconds": 60}
SIZES = {
    "bodies": (3, 30, 300),
    "dampers": (1, 8, 62),
    "channels": (4, 16, 64),
    "seconds": (60, 600, 3600),
}
# Other values where a size is varied: bodies for all dampers, and few seconds for large systems.
BESIDE = {
    "bodies": {"seconds": 5},
    "dampers": {"bodies": 64, "seconds": 5},
    "channels": {"seconds": 20},
    "seconds": {"dampers": 0},
}


def chain(bodies: int, dampers: int, channels: int, seconds: float) -> rig.Scene:
    """Build a chain of bodies with dampers and accelerometers spread over it, and a random force at its end."""
    places = np.linspace(1, bodies, dampers).round().astype(int).tolist()
    return rig.Scene.model_validate(
        {
            "name": f"{bodies} bodies, {dampers} dampers",
            "structure": {
                "masses": [1.0] * bodies,
                "springs": [4e4 * bodies] * bodies,
                "damping": {"modal": 0.01},
            },
            "dampers": [{"body": place, "mass_ratio": 0.02, "clearance": "1 mm"} for place in places],
            "shaker": {"kind": "force", "body": 1},
            "test": {
                "kind": "random",
                "force": "5 N",
                "from": "5 Hz",
                "to": "200 Hz",
                "duration": f"{seconds} s",
            },
            "channels": [
                *(
                    {
                        "name": f"a{k}",
                        "at": f"body {1 + k % bodies}",
                        "accelerometer": {"sensitivity": "100 mV/g"},
                    }
                    for k in range(channels - 1)
                ),
                {"name": "force", "at": "shaker"},
            ],
        }
    )


def measure(scene: rig.Scene, path: Path) -> dict[str, float]:
    """Return the processor time of each call on a scene, s."""
    calls: dict[str, Callable[[], object]] = {
        "rig.explain": lambda: rig.explain(scene),
        "daq.record": lambda: daq.record(scene, path),
        "analysis.frf": lambda: analysis.frf(path),
    }
    times = {}
    for name, call in calls.items():
        begun = time.process_time()
        call()
        times[name] = time.process_time() - begun
    return times


def main() -> None:
    """Print a row for each size and the exponent between the two largest sizes."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # The first test compiles and imports.
        measure(chain(3, 1, 4, 5), Path(folder) / "first.mcap")
        for over, sizes in SIZES.items():
            rows = []
            for size in sizes:
                scene = chain(**{**SMALLEST, **BESIDE[over], over: size})
                rows.append(measure(scene, Path(folder) / f"{over}-{size}.mcap"))
                row = "  ".join(f"{name} {seconds:8.2f} s" for name, seconds in rows[-1].items())
                print(f"{size:6d} {over:10s}{row}", flush=True)
            length = np.log(sizes[-1] / sizes[-2])
            exponents = {name: np.log(rows[-1][name] / rows[-2][name]) / length for name in rows[-1]}
            print(f"       exponents   {'  '.join(f'{name} {e:10.2f}' for name, e in exponents.items())}")


if __name__ == "__main__":
    main()
