"""CPU time of the effects of a scene, for `rig explain SCENE --measure`.

The simulation is measured with the structure alone, and again after each further effect of the scene is added.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import numpy as np

from rig.arrays import Array
from rig.effects.explanation import motion_effects
from rig.effects.extensions import registered_functions
from rig.scene.excitation import Impulse, Test
from rig.scene.scene import Scene
from rig.scene.shaker import ForceShaker
from rig.simulation.plant import Plant
from rig.system.assembly import assemble
from rig.system.open_loop_drive import drive_per_level, level_of, sampled_drive
from rig.system.structural_model import structural_model

#: Number of simulated seconds that are measured, each separately, after one second of warm-up.
SECONDS = 3
#: Repetitions of every measurement; the shortest time counts, because other processes disturb some of them.
REPEATS = 3


@dataclass(frozen=True)
class EffectStep:
    """A simulation to be measured: the effects of the previous step, and one more."""

    name: str
    """The added effect."""
    states: int  # Total number of states
    start: Callable[[], AbstractContextManager[Callable[[Array], object]]]
    """Returns a context manager. On entry it starts the simulation and returns a function that advances it by the given
    drive samples, shape (inputs, samples)."""
    drive: Array
    """`SECONDS` + 1 seconds of drive at `rate`; shape (inputs, samples)."""
    rate: float  # Sample rate [Hz]


@dataclass(frozen=True)
class EffectCost:
    """Measured cost of an effect."""

    name: str
    states: int  # Number of added states
    total: float  # CPU time per simulated second with this and all previous effects [s]
    added: float  # Difference of `total` from the `total` of the previous effect [s]
    scatter: float  # Repeatability of `added`: a smaller difference is not significant [s]


def effect_costs(scene: Scene, progress: Callable[[str], None] | None = None) -> tuple[EffectCost, ...]:
    """Measure the CPU time of a scene's effects, which are added one at a time.

    The order is that of the signal path: motion, measurement channels, recording. `progress`: receives the name of the
    simulation that is measured next.
    """
    steps: list[EffectStep] = list(motion_steps(scene))
    for registered_steps in registered_functions("shotrig.effect_costs"):
        steps += registered_steps(scene)
    times = np.empty((REPEATS, len(steps)))
    for repeat in range(REPEATS):
        for k, step in enumerate(steps):
            if progress is not None:
                progress(f"{step.name} ({repeat + 1} of {REPEATS})")
            times[repeat, k] = measure_cpu_time(step)
    return differences(steps, times)


def differences(steps: Sequence[EffectStep], times: Array) -> tuple[EffectCost, ...]:
    """Return the cost of each step from its CPU times per simulated second, s; shape (repetitions, steps)."""
    states = [0, *(step.states for step in steps)]
    ascending = np.sort(times, axis=0)
    totals = [0.0, *ascending[0].tolist()]
    # The shortest time is about as repeatable as the distance to the next.
    scatters = [0.0, *(ascending[:2].max(axis=0) - ascending[0]).tolist()]
    return tuple(
        EffectCost(
            step.name,
            states[k + 1] - states[k],
            totals[k + 1],
            totals[k + 1] - totals[k],
            scatters[k + 1] + scatters[k],
        )
        for k, step in enumerate(steps)
    )


def text(costs: tuple[EffectCost, ...]) -> str:
    """Format a table of the costs; percentages refer to the CPU time with all effects.

    An effect has no share if its difference is within the scatter of the measurement, or if the simulation is faster
    with it.
    """
    total = costs[-1].total
    width = max(len(cost.name) for cost in costs) + 2
    lines = [f"{'effect':{width}}{'states':>7}{'ms per simulated s':>20}{'added':>9}{'share':>8}"]
    for cost in costs:
        share = f"{100 * cost.added / total:.1f}%" if cost.added > cost.scatter else "-"
        lines.append(
            f"{cost.name:{width}}{cost.states or '-':>7}{1e3 * cost.total:20.3f}{1e3 * cost.added:9.3f}{share:>8}"
        )
    within_scatter = [cost.name for cost in costs if abs(cost.added) <= cost.scatter]
    faster = [cost.name for cost in costs if cost.added < -cost.scatter]
    if within_scatter:
        lines.append(f"added time within the scatter of the measurement: {', '.join(within_scatter)}")
    if faster:
        lines.append(f"the simulation is faster with: {', '.join(faster)}")
    lines.append(f"with all effects, one core simulates {1 / total:.3g} s of the test in 1 s")
    return "\n".join(lines)


def measure_cpu_time(step: EffectStep) -> float:
    """Return the shortest CPU time of one of `SECONDS` simulated seconds, s."""
    samples_per_s = round(step.rate)
    times = []
    with step.start() as advance:
        advance(step.drive[:, :samples_per_s])
        for second in range(1, SECONDS + 1):
            drive = step.drive[:, second * samples_per_s : (second + 1) * samples_per_s]
            start_s = time.process_time()
            advance(drive)
            times.append(time.process_time() - start_s)
    return min(times)


def motion_steps(scene: Scene) -> Iterator[EffectStep]:
    """Yield the steps of the motion: structure, shaker, dampers, ceilings, restitution, finite-duration contact.

    Ceilings are those of the dampers' cavities (finite clearance).
    """
    no_channels = {"channels": None}
    shaker = scene.driven_shaker
    without_dampers = scene.replace(dampers=(), **no_channels)
    if shaker is not None and (len(scene.shakers) > 1 or not isinstance(shaker, ForceShaker)):
        test = scene.test if isinstance(scene.test, Impulse) else None
        yield _motion_step(
            "structure",
            without_dampers.replace(shaker=ForceShaker(body=shaker.bodies[0]), test=_without_shaker_number(test)),
        )
        yield _motion_step("shaker", without_dampers)
    else:
        yield _motion_step("structure", without_dampers)
    if not scene.dampers:
        return
    # For each step: the settings of the dampers that switch off the effects not yet added.
    settings_without_later_effects: dict[str, dict[str, object]] = {
        "particle dampers": {"clearance": np.inf, "restitution": 0.0, "contact": None},
        "ceilings": {"restitution": 0.0, "contact": None},
        "restitution": {"contact": None},
        "finite-duration contact": {},
    }
    previous: tuple[object, ...] = ()
    for name, settings in settings_without_later_effects.items():
        dampers = tuple(damper.replace(**settings) for damper in scene.dampers)
        if dampers != previous:
            yield _motion_step(name, scene.replace(dampers=dampers, **no_channels))
        previous = dampers


def _without_shaker_number(test: Test | None) -> Test | None:
    """Remove the shaker number from a test with only one shaker."""
    return test if getattr(test, "shaker", None) is None else test.replace(shaker=None)  # type: ignore[union-attr]


def _motion_step(name: str, scene: Scene) -> EffectStep:
    """Return the step that simulates the motion of a scene; `name`: the effect that this scene adds."""
    rate = scene.converter.sample_rate

    def start() -> AbstractContextManager[Callable[[Array], object]]:
        return nullcontext(Plant(scene, rate).advance)

    return EffectStep(
        name, sum(effect.states for effect in motion_effects(scene)), start, bench_drive(scene, rate), rate
    )


def bench_drive(scene: Scene, rate: float) -> Array:
    """Return `SECONDS` + 1 seconds of drive: a tone at the test's level, or the test's hammer hits, one a second.

    The tone has the highest natural frequency of the structure. `rate`: sample rate, Hz. Shape (inputs, samples).
    """
    system = assemble(scene)
    samples = (SECONDS + 1) * round(rate)
    if isinstance(scene.test, Impulse):
        return sampled_drive(
            scene.replace(test=scene.test.replace(interval=1.0, repeats=SECONDS + 1)), system, samples, rate
        )
    drive = np.zeros((len(system.inputs), samples))
    if scene.driven is None:
        return drive
    omega = float(structural_model(scene).modes.omega[-1])
    given_level = getattr(scene.test, "force", None) or getattr(scene.test, "drive", None)
    level = level_of(scene) if given_level is not None else 1.0
    amplitude = level * (drive_per_level(scene, system, omega) if scene.test is not None else 1.0)
    drive[system.inputs.index(scene.at_driven("shaker"))] = np.imag(
        amplitude * np.exp(1j * omega * np.arange(samples) / rate)
    )
    return drive
