"""Cost and error of models of a bed of grains: one mass, finite-duration contact, longer time steps, and softer grains.

The reference is the steady-state motion with the grains of the scene, a mean over chaotic motion. The deviation of
another packing of the same grains from this reference is the smallest significant error.
"""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from rig.core.base.errors import ShotrigError
from rig.core.results import format_percent
from rig.core.scene.damper import Grains, TimedContact
from rig.core.scene.scene import Scene
from rig.core.steady_response.frequency_response import frequency_response
from rig.core.system.open_loop_drive import with_ideal_force
from rig.core.system.spheres import rayleigh_time, spheres_of
from rig.extras.bed_response.steady_bed import as_one_mass, steady_grains
from rig.extras.grains.packing import settled_positions
from rig.studies.cost.motion_study import Point, failure_reason, timed
from rig.studies.cost.steady_study import OTHER_PACKING, SteadyStudy

#: Contact durations [s].
CONTACT_DURATIONS_S = (1e-3, 2e-3, 4e-3, 8e-3)
#: Restitution of these contacts.
CONTACT_RESTITUTION = 0.05
#: Longer time steps of the grains, relative to Rayleigh's time (`rayleigh_time`).
STEP_RATIOS = (0.1, 0.19)
#: Ratio of the modulus of the grains to the modulus of softer grains.
SOFTENING_RATIO = 10.0
#: Number of periods over which the motion of grains is averaged (a block).
PERIODS = 20
#: The simulation ends after this number of blocks, even if the motion is not in steady state.
MAX_BLOCKS = 5

Compliance = NDArray[np.complex128]


def bed_models(scene: Scene, frequency: float, progress: Callable[[str], None] | None = None) -> SteadyStudy:
    """Measure cost and error of models of a scene's beds of grains at one frequency.

    `scene`: has beds of grains that can move. If its test controls the amplitude of the spring force, that force acts
    on the body as a pure sinusoid; `frequency`: excitation frequency [Hz]. Raises `SceneError` if LAMMPS is not
    installed.
    """
    report = progress if progress is not None else lambda name: None
    report("packing")
    # Packings are stored in the cache, so they are not part of the cost of the motion.
    for packing in (scene, with_other_packing(scene), with_softer_grains(scene)):
        for spheres in spheres_of(packing).values():
            settled_positions(spheres)
    report("reference: grains")
    cpu, reference = timed(partial(steady_grains, scene, frequency, PERIODS, MAX_BLOCKS))
    points = []
    for model, setting, compute in _models(scene, frequency):
        report(f"{model}, {setting}")
        points.append(_point(model, setting, compute, reference.compliance))
    count = sum(spheres.count for spheres in spheres_of(scene).values())
    steady = "" if reference.steady else ", so the motion is not steady yet"
    return SteadyStudy(
        tuple(points),
        frequency,
        str(reference.motion_type[0]),
        f"{count} grains simulated for {reference.periods} periods, in {cpu:.3g} s of CPU time. The last two averages "
        f"over {PERIODS} periods\n           differ by {format_percent(reference.spread)}{steady}. Errors below this "
        "difference, or below the error of a different packing, are not significant.",
    )


Models = Iterator[tuple[str, str, Callable[[], Compliance]]]


def _models(scene: Scene, frequency: float) -> Models:
    mass = with_ideal_force(as_one_mass(scene))
    yield "one mass", "instantaneous contact", partial(_one_mass_compliance, mass, frequency)
    for duration in CONTACT_DURATIONS_S:
        compute = partial(_one_mass_compliance, with_ideal_force(with_finite_contact(scene, duration)), frequency)
        yield "finite-duration contact", f"{1e3 * duration:g} ms", compute
    for step in STEP_RATIOS:
        longer_step = with_time_step(scene, step)
        if longer_step is not None:
            yield "grains", f"step {step:g} Rayleigh", partial(_grains_compliance, longer_step, frequency)
    longest_step_scene = with_time_step(scene, STEP_RATIOS[-1]) or scene
    yield (
        OTHER_PACKING,
        f"step {STEP_RATIOS[-1]:g} Rayleigh",
        partial(_grains_compliance, with_other_packing(longest_step_scene), frequency),
    )
    softer = with_time_step(with_softer_grains(scene), STEP_RATIOS[-1])
    if softer is not None:
        yield ("grains, softer", f"modulus / {SOFTENING_RATIO:g}", partial(_grains_compliance, softer, frequency))


def with_finite_contact(scene: Scene, duration: float) -> Scene:
    """Return the scene with each bed of grains modeled as one mass with finite-duration contact."""
    wall = TimedContact(duration=duration)
    return scene.replace(
        dampers=[
            damper.replace(grains=None, contact=wall, restitution=CONTACT_RESTITUTION) if damper.grains else damper
            for damper in scene.dampers
        ]
    )


def with_softer_grains(scene: Scene) -> Scene:
    """Return the scene with softer grains."""
    return _with_grains(scene, lambda grains: grains.replace(modulus=grains.modulus / SOFTENING_RATIO, time_step=None))


def with_other_packing(scene: Scene) -> Scene:
    """Return the scene with a different packing of its grains."""
    return scene.replace(seed=scene.seed + len(scene.dampers))


def with_time_step(scene: Scene, step: float) -> Scene | None:
    """Return the scene with a time step relative to Rayleigh's time; None if the scene's step is not shorter."""
    if all(
        spheres.longest_step() >= step * rayleigh_time(spheres.settings, spheres.density())
        for spheres in spheres_of(scene).values()
    ):
        return None
    return _with_grains(scene, lambda grains: grains.replace(time_step=step * rayleigh_time(grains, grains.density)))


def _with_grains(scene: Scene, change: Callable[[Grains], Grains]) -> Scene:
    dampers = [
        damper if damper.grains is None else damper.replace(grains=change(damper.grains)) for damper in scene.dampers
    ]
    return scene.replace(dampers=dampers)


def _point(model: str, setting: str, compute: Callable[[], Compliance], reference: Compliance) -> Point:
    try:
        cpu, compliance = timed(compute)
    except ShotrigError as failure:
        return Point(model, setting, np.nan, np.nan, is_correct=False, note=failure_reason(failure))
    error = float(np.abs(compliance - reference).max() / np.abs(reference).max())
    return Point(model, setting, cpu, error)


def _one_mass_compliance(scene: Scene, frequency: float) -> Compliance:
    return np.asarray(frequency_response(scene, [frequency]).compliance[:, 0])


def _grains_compliance(scene: Scene, frequency: float) -> Compliance:
    return steady_grains(scene, frequency, PERIODS, MAX_BLOCKS).compliance
