"""Scaling of processor time with the size of a test, as exponents: `python -m tests.benchmarks.scaling`.

A chain of bodies under a random force is explained, recorded and analyzed with increasing numbers of bodies, dampers,
channels or seconds. The exponent is the slope of log time over log size; 1 means a proportional time. A chain with
modal damping has full matrices: the time of a matrix-vector product grows with the square of the number of bodies.
"""

from __future__ import annotations

import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import analysis
import daq
import rig
from tests.benchmarks.engine import engine_period

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Bodies, dampers, channels and seconds of the smallest test.
SMALLEST = {"bodies": 3, "dampers": 1, "channels": 4, "seconds": 60}
# Sizes of each quantity, which is varied alone.
SIZES = {"bodies": (3, 30, 300), "dampers": (1, 8, 62), "channels": (4, 16, 64), "seconds": (60, 600, 3600)}
# While a quantity is varied, these values replace the smallest ones of others: enough bodies for all dampers, and few
# seconds for large systems.
OTHER_VALUES = {
    "bodies": {"seconds": 5},
    "dampers": {"bodies": 64, "seconds": 5},
    "channels": {"seconds": 20},
    "seconds": {"dampers": 0},
}


def chain(bodies: int, dampers: int, spring: float, damping: dict[str, Any], **settings: Any) -> rig.Scene:
    """Build a chain of equal bodies with dampers spread over it; `spring`: stiffness of each spring, N/m."""
    damper_bodies = np.unique(np.linspace(1, bodies, dampers).round().astype(int)).tolist() if dampers else []
    return rig.Scene.model_validate(
        {
            "name": f"{bodies} bodies, {dampers} dampers",
            "structure": {"masses": [0.7] * bodies, "springs": [spring] * bodies, "damping": damping},
            "dampers": [{"body": body, "mass_ratio": 0.1, "clearance": "1 mm"} for body in damper_bodies],
            **settings,
        }
    )


def tone_chain(bodies: int, dampers: int) -> rig.Scene:
    """Build a chain with sparse matrices, driven near a low mode."""
    return chain(
        bodies,
        dampers,
        2e4,
        {"rayleigh": {"beta": 1e-4}},
        shaker={"kind": "force", "body": list(range(1, bodies + 1))},
        test={"kind": "sine", "frequency": 20.0, "force": 9.0, "start": "empty"},
    )


def random_force_chain(bodies: int, dampers: int, channels: int, seconds: float) -> rig.Scene:
    """Build a chain with full matrices, accelerometers spread over it, and a random force at its end."""
    accelerometer = {"sensitivity": "100 mV/g"}
    return chain(
        bodies,
        dampers,
        4e4 * bodies,
        {"modal": 0.01},
        shaker={"kind": "force", "body": 1},
        test={"kind": "random", "force": "5 N", "from": "5 Hz", "to": "200 Hz", "duration": f"{seconds} s"},
        channels=[
            *(
                {"name": f"a{k}", "at": f"body {1 + k % bodies}", "accelerometer": accelerometer}
                for k in range(channels - 1)
            ),
            {"name": "force", "at": "shaker"},
        ],
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
        start = time.process_time()
        call()
        times[name] = time.process_time() - start
    return times


def engine_scaling(quantity: str, sizes: list[tuple[int, int]], size_index: int, axes: Axes) -> None:
    """Print and plot the engine's time per period, and the exponent fitted to the larger half of the sizes.

    `sizes`: numbers of bodies and dampers; `size_index`: which of them `quantity` is.
    """
    values = np.array([size[size_index] for size in sizes], dtype=float)
    times = np.array([engine_period(tone_chain(*size), 40, 5) for size in sizes])
    for (bodies, dampers), seconds in zip(sizes, times, strict=True):
        print(f"  {bodies:4d} bodies {dampers:3d} dampers  {seconds * 1e6:9.1f} us a period")
    larger_half = slice(len(sizes) // 2, None)
    exponent, intercept = np.polyfit(np.log(values[larger_half]), np.log(times[larger_half]), 1)
    print(f"  over {quantity}: exponent {exponent:.2f}")
    axes.loglog(values, times * 1e6, "o-", color="black", label="measured")
    fitted = np.exp(intercept) * values[larger_half] ** exponent
    axes.loglog(values[larger_half], fitted * 1e6, "--", color="tab:red", label=f"exponent {exponent:.2f}")
    axes.set(xlabel=f"Number of {quantity}", ylabel="CPU time a period, \u00b5s")
    axes.grid(True, which="both", alpha=0.3)
    axes.legend()


def plot_engine_scaling(path: Path) -> None:
    """Print and plot the engine's time per period over the numbers of bodies and dampers."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.8), layout="constrained")
    bodies, dampers = figure.subplots(1, 2)
    engine_scaling("bodies", [(n, 0) for n in (3, 6, 12, 25, 50, 100, 150)], 0, bodies)
    bodies.set_title("Chain without dampers")
    engine_scaling("dampers", [(40, n) for n in (1, 2, 4, 6, 8, 12, 20)], 1, dampers)
    dampers.set_title("Chain of 40 bodies")
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=130)
    print(f"  {path}")


def main() -> None:
    """Print a row for each size and the exponent between the two largest sizes."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # The first test includes compilation and imports.
        measure(random_force_chain(3, 1, 4, 5), Path(folder) / "first.mcap")
        for quantity, sizes in SIZES.items():
            rows = []
            for size in sizes:
                scene = random_force_chain(**{**SMALLEST, **OTHER_VALUES[quantity], quantity: size})
                rows.append(measure(scene, Path(folder) / f"{quantity}-{size}.mcap"))
                row = "  ".join(f"{name} {seconds:8.2f} s" for name, seconds in rows[-1].items())
                print(f"{size:6d} {quantity:10s}{row}", flush=True)
            log_ratio = np.log(sizes[-1] / sizes[-2])
            exponents = {name: np.log(rows[-1][name] / rows[-2][name]) / log_ratio for name in rows[-1]}
            print(f"       exponents   {'  '.join(f'{name} {e:10.2f}' for name, e in exponents.items())}")
    print("CPU time of the engine for a period of a tone")
    plot_engine_scaling(Path("recordings/engine-growth.png"))


if __name__ == "__main__":
    main()
