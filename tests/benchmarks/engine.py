"""CPU time of the engine: `python -m tests.benchmarks.engine`. `rig cost` compares it with general solvers.

The scenes are the reference cases A, B and C, after compilation, in one thread.
"""

import time
from collections.abc import Callable

import numpy as np

import rig
from rig.core.engine.propagator import tone_propagator
from rig.core.engine.trajectory import Trajectory
from rig.core.simulation.plant import Plant
from rig.core.system.assembly import assemble
from rig.core.system.hybrid_system import HybridSystem
from rig.core.system.open_loop_drive import ToneDrive, tone_drive

# Number of periods; many, because the first periods have few events.
PERIODS = 100
# Number of periods for the parts of the engine's time: the motion of most of them is steady.
LONG_RUN_PERIODS = 1000
# Factor on the drive for which every damper stays on its floor.
WEAK_LEVEL = 0.01
RATE = 51200.0  # samples per second
BLOCK_SAMPLES = 5120


def shortest_time(action: Callable[[], object], repeats: int) -> float:
    """Return the shortest CPU time of several runs, which other programs disturb least, s."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        action()
        times.append(time.process_time() - start)
    return min(times)


def tone_of(scene: rig.Scene) -> tuple[HybridSystem, ToneDrive]:
    """Return the system of a scene and the tone of its drive."""
    system = assemble(scene)
    tone = tone_drive(scene, system)
    assert tone is not None
    return system, tone


def engine_run(scene, periods=PERIODS, repeats=200, level=1.0):
    """Propagate with the engine from rest; return CPU time (s), full steps and events, each for a period of the drive.

    `level`: factor on the amplitude of the drive.
    """
    system, tone = tone_of(scene)
    propagator, steps = tone_propagator(system, tone.amplitudes, tone.omega)
    propagator.set_state(tone.state, np.array([level, 0.0]))
    start = propagator.snapshot()
    # One segment of steps per period; row -1: no state is stored.
    segment_steps, rows, starts_period = np.full(periods, steps), np.full(periods, -1), np.ones(periods, dtype=bool)

    def run() -> Trajectory:
        propagator.resume(start)
        return propagator.propagate_tone(segment_steps, rows, starts_period, level)

    events = len(run().event_segment) / periods
    return shortest_time(run, repeats) / periods, steps, events


def engine_period(scene: rig.Scene, periods: int = PERIODS, repeats: int = 200) -> float:
    """Return the engine's CPU time for a period of the drive, starting from rest, s."""
    return engine_run(scene, periods, repeats)[0]


def print_parts_of_periods() -> None:
    """Print how much of the CPU time of a period is due to steps, and how much to events."""
    print(f"Parts of this time over {LONG_RUN_PERIODS} periods; steps: from the same drive, too weak for events")
    print(f"  {'':4s}{'period/us':>10s}{'steps':>7s}{'ns a step':>11s}{'events':>8s}{'ns an event':>13s}")
    for case in "ABC":
        scene = rig.load(f"reference-{case}")
        period, steps, events = engine_run(scene, LONG_RUN_PERIODS, 30)
        without_events, _, _ = engine_run(scene, LONG_RUN_PERIODS, 30, WEAK_LEVEL)
        step_ns, event_ns = without_events / steps * 1e9, (period - without_events) / events * 1e9
        print(f"  {case:4s}{period * 1e6:10.2f}{steps:7.0f}{step_ns:11.0f}{events:8.2f}{event_ns:13.0f}")


def plant_speed(name: str, amplitude: float, noise: float) -> float:
    """Return the speed of the plant (the simulated rig of a scene) relative to real time, driven at 51.2 kHz.

    `amplitude`: amplitude of a sine at 218.8 rad/s; `noise`: standard deviation of added white noise.
    """
    rng = np.random.default_rng(1)
    time_s = np.arange(10 * BLOCK_SAMPLES) / RATE
    drive = amplitude * np.sin(218.8 * time_s) + noise * rng.standard_normal(len(time_s))
    plant = Plant(rig.load(name), RATE)
    blocks = [drive[None, k : k + BLOCK_SAMPLES] for k in range(0, len(drive), BLOCK_SAMPLES)]
    plant.advance(blocks[0])
    return BLOCK_SAMPLES / RATE / min(shortest_time(lambda b=block: plant.advance(b), 1) for block in blocks * 5)  # type: ignore[misc]


def main() -> None:
    """Print all results."""
    print("CPU time for a period, pure tone, warm, one thread")
    for case in "ABC":
        scene = rig.load(f"reference-{case}")
        print(f"  {case}: {engine_period(scene, repeats=30) * 1e6:6.2f} us", flush=True)
    print_parts_of_periods()
    print("Plant under a drive sampled at 51.2 kHz, in times real time (motion, gaps and breaks included)")
    for name, amplitude in (("reference-A", 2.6), ("reference-C", 10.0), ("fig8-three-dampers", 5.0)):
        sine, noisy = plant_speed(name, amplitude, 0.0), plant_speed(name, amplitude, 0.3 * amplitude)
        print(f"  {name:20s} sine {sine:5.0f} x   sine with white noise {noisy:5.0f} x")


if __name__ == "__main__":
    main()
