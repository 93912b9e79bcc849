"""The engine beside general solvers, in one run: `python -m tests.benchmarks.engine`.

Reference cases A, B and C, warm, one thread. The solvers are used as their users would who have learnt what this
problem needs: DOP853, CVODE and a compiled Dormand-Prince at a relative tolerance of 1e-12, steps of at most T/40,
guards asleep for 20 us after a separation.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable

import numpy as np

import rig
from rig.engine.propagator import tone_propagator
from rig.simulation.plant import Plant
from rig.system.assembly import assemble
from rig.system.hybrid_system import HybridSystem
from rig.system.open_loop_drive import ToneDrive, tone_drive
from rig.work_precision.adaptive_solvers import cvode_leg, follow, scipy_leg
from rig.work_precision.compiled_runge_kutta import DormandPrince
from rig.work_precision.first_order_form import FirstOrderForm

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


def tone_of(scene: rig.Scene) -> tuple[HybridSystem, ToneDrive]:
    """Give the system of a scene and its tone."""
    system = assemble(scene)
    tone = tone_drive(scene, system)
    assert tone is not None
    return system, tone


def engine_period(scene: rig.Scene, periods: int = PERIODS, repeats: int = 200) -> float:
    """Give the engine's CPU time for a period of the drive from rest, s."""
    system, tone = tone_of(scene)
    march, steps = tone_propagator(system, tone.amplitudes, tone.omega)
    march.place(tone.state, np.array([1.0, 0.0]))
    start = march.snapshot()
    lengths, rows, anew = np.full(periods, steps), np.full(periods, -1), np.ones(periods, dtype=bool)

    def run() -> None:
        march.resume(start)
        march.through_marks(lengths, rows, anew)

    run()
    return best(run, repeats) / periods


def peers(scene: rig.Scene) -> dict[str, float]:
    """Give the general solvers' CPU time for a period, s."""
    system, tone = tone_of(scene)
    problem = FirstOrderForm(system, tone, PERIODS)
    longest = 2.0 * np.pi / tone.omega / 40
    legs = {"scipy DOP853": scipy_leg("DOP853", 1e-12, longest)}
    if importlib.util.find_spec("sksundae") is not None:
        legs["CVODE"] = cvode_leg(1e-12, longest)
    compiled = DormandPrince(problem)
    compiled.follow(1e-6, BLIND, longest)
    return {
        "compiled DP5": best(lambda: compiled.follow(1e-12, BLIND, longest), 3) / PERIODS,
        **{
            name: best(lambda leg=leg: follow(problem, leg, BLIND, 600.0), 2) / PERIODS  # type: ignore[misc]
            for name, leg in legs.items()
        },
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


if __name__ == "__main__":
    main()
