"""The engine beside general solvers, in one run: `python -m tests.benchmarks.engine`.

Reference cases A, B and C, warm, one thread. The solvers are used as their users would who have learnt what this
problem needs: DOP853 and CVODE at a relative tolerance of 1e-12, steps of at most T/40, guards asleep for 20 us
after a separation.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable

import numpy as np

import rig
from rig.assembly import assemble
from rig.march import tone_march
from rig.open_loop import ToneDrive, tone_drive
from rig.plant import Plant
from rig.schemes import Problem
from rig.schemes_adaptive import cvode_leg, follow, scipy_leg
from rig.system import System

# The same motion for the engine and its peers: events are rare in the first periods, so fewer would not compare.
PERIODS, BLIND = 100, 2e-5
RATE, BLOCK = 51200.0, 5120


def best(action: Callable[[], object], repeats: int) -> float:
    """Shortest CPU time of several runs, s: the one least disturbed by others on the machine."""
    times = []
    for _ in range(repeats):
        begun = time.process_time()
        action()
        times.append(time.process_time() - begun)
    return min(times)


def tone_of(scene: rig.Scene) -> tuple[System, ToneDrive]:
    """Give the system of a scene and its tone."""
    system = assemble(scene)
    tone = tone_drive(scene, system)
    assert tone is not None
    return system, tone


def engine_period(scene: rig.Scene, periods: int = PERIODS, repeats: int = 200) -> float:
    """Give the engine's CPU time for a period of the drive from rest, s."""
    system, tone = tone_of(scene)
    march, steps = tone_march(system, tone.amplitudes, tone.omega)
    march.place(tone.state, np.array([1.0, 0.0]))
    start = march.snapshot()
    lengths, rows, anew = np.full(periods, steps), np.full(periods, -1), np.ones(periods, dtype=bool)

    def run() -> None:
        march.resume(start)
        march.over_marks(lengths, rows, anew)

    run()
    return best(run, repeats) / periods


def peers(scene: rig.Scene) -> dict[str, float]:
    """Give the general solvers' CPU time for a period, s."""
    system, tone = tone_of(scene)
    problem = Problem(system, tone, PERIODS)
    longest = 2.0 * np.pi / tone.omega / 40
    legs = {"scipy DOP853": scipy_leg("DOP853", 1e-12, longest)}
    if importlib.util.find_spec("sksundae") is not None:
        legs["CVODE"] = cvode_leg(1e-12, longest)
    return {
        name: best(lambda leg=leg: follow(problem, leg, BLIND, 600.0), 2) / PERIODS  # type: ignore[misc]
        for name, leg in legs.items()
    }


def sampled(name: str, amplitude: float, noise: float) -> float:
    """How many times real time the plant runs under a drive sampled at 51.2 kHz."""
    rng = np.random.default_rng(1)
    time_s = np.arange(10 * BLOCK) / RATE
    drive = amplitude * np.sin(218.8 * time_s) + noise * rng.standard_normal(len(time_s))
    plant = Plant(rig.load(name), RATE)
    blocks = [drive[None, k : k + BLOCK] for k in range(0, len(drive), BLOCK)]
    plant.advance(blocks[0])
    return BLOCK / RATE / min(best(lambda b=block: plant.advance(b), 1) for block in blocks * 5)  # type: ignore[misc]


def chain_of(bodies: int, dampers: int) -> rig.Scene:
    """Give a chain of equal bodies with dampers spread over it, driven near a low mode."""
    places = np.unique(np.linspace(1, bodies, dampers).round().astype(int)) if dampers else []
    return rig.Scene.model_validate(
        {
            "name": f"{bodies} bodies, {dampers} dampers",
            "structure": {
                "masses": [0.7] * bodies,
                "springs": [2e4] * bodies,
                "damping": {"rayleigh": {"beta": 1e-4}},
            },
            "dampers": [{"body": int(b), "mass_ratio": 0.1, "clearance": 1e-3} for b in places],
            "shaker": {"kind": "force", "body": list(range(1, bodies + 1))},
            "test": {"kind": "sine", "frequency": 20.0, "force": 9.0, "start": "empty"},
        }
    )


def growth(title: str, sizes: list[tuple[int, int]], at: int) -> None:
    """Print the time per period over a size, and the exponent between the last two."""
    times = [engine_period(chain_of(*size), 40, 5) for size in sizes]
    for size, seconds in zip(sizes, times, strict=True):
        print(f"  {size[0]:4d} bodies {size[1]:3d} dampers  {seconds * 1e6:9.1f} us a period")
    exponent = np.log(times[-1] / times[-2]) / np.log(sizes[-1][at] / sizes[-2][at])
    print(f"  {title}: exponent {exponent:.2f} at the end")


def main() -> None:
    """Print everything."""
    print("CPU time for a period, pure tone, warm, one thread")
    for case in "ABC":
        scene = rig.load(f"reference-{case}")
        own = engine_period(scene, repeats=30)
        print(f"  {case}: engine {own * 1e6:6.2f} us", end="")
        for name, seconds in peers(scene).items():
            print(f"   {name} {seconds * 1e3:6.2f} ms = {seconds / own:6.0f} x", end="", flush=True)
        print()
    print("Plant under a drive sampled at 51.2 kHz, in times real time (motion, gaps and breaks included)")
    for name, amplitude in (("reference-A", 2.6), ("reference-C", 10.0), ("fig8-three-dampers", 5.0)):
        tone, broad = sampled(name, amplitude, 0.0), sampled(name, amplitude, 0.3 * amplitude)
        print(f"  {name:20s} sine {tone:5.0f} x   sine with broadband noise {broad:5.0f} x")
    print("Growth")
    growth("bodies", [(3, 0), (7, 0), (12, 0), (25, 0), (50, 0), (100, 0)], 0)
    growth("dampers", [(40, 1), (40, 5), (40, 10), (40, 20)], 1)


if __name__ == "__main__":
    main()
