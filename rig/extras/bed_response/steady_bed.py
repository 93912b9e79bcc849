"""Steady-state motion of a structure and its beds under a tone.

A *bed* is the material of one damper. A bed is simulated as grains, or modeled as one mass. Grains are simulated in
blocks of periods until two successive blocks agree.
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array, ComplexArray
from rig.core.scene.scene import Scene
from rig.core.simulation.simulate import simulate
from rig.core.steady_response.frequency_response import frequency_response
from rig.core.system.assembly import assemble
from rig.core.system.hybrid_system import HybridSystem
from rig.core.system.open_loop_drive import tone_drive, with_ideal_force
from rig.core.system.reference import reference_of
from rig.extras.grains.bed import CEILING, FLOOR
from rig.extras.grains.coupling import CoupledPropagator

#: The motion of grains is sampled this many times in a period of the drive.
_SAMPLES_PER_PERIOD = 50
#: The motion with beds modeled as one mass is sampled this many times in a period of the drive.
_ONE_MASS_SAMPLES_PER_PERIOD = 400
#: Largest relative difference of two successive blocks in steady state: the scatter between blocks.
MAX_STEADY_CHANGE = 0.01
#: A simulation with beds modeled as one mass begins with this number of periods, in which the transient decays.
_SETTLING_PERIODS = 200
#: The results of a simulation with beds modeled as one mass are averages over this number of periods at its end.
_AVERAGED_PERIODS = 100
#: The type of motion neglects flights that take less than this fraction of the time. The same fraction of the weight of
#: the bed limits the wall forces that are neglected.
_MIN_SIGNIFICANT_RATIO = 0.01


@dataclass(frozen=True)
class SteadyBed:
    """Steady-state motion at one frequency.

    `landing`: mean phase of the floor force, weighted by the force, shape (beds,); in degrees after the positive-going
    zero of the driving force.
    """

    # First harmonic of each displacement, divided by the first harmonic of the force [m/N], shape (bodies,).
    compliance: ComplexArray
    floor_impulse: Array  # impulse of the floor on each bed in a period of the drive [N s], shape (beds,)
    ceiling_impulse: Array  # impulse of the ceiling on each bed in a period [N s], shape (beds,)
    energy: Array  # energy that each bed dissipates in a period [J], shape (beds,)
    landing: Array
    flight: Array  # fraction of the time in which the bed touches no wall, shape (beds,)
    motion_type: NDArray[np.str_]  # shape (beds,)
    spread: float  # relative difference between the compliances of the last two blocks
    periods: int  # total number of simulated periods

    @property
    def steady(self) -> bool:
        """Whether the motion is steady: the last two blocks of periods agree."""
        return self.spread < MAX_STEADY_CHANGE


def as_one_mass(scene: Scene) -> Scene:
    """Return the scene with each bed of grains modeled as one mass."""
    return scene.replace(dampers=[damper.replace(grains=None) for damper in scene.dampers])


def steady_grains(scene: Scene, frequency: float, block: int, max_blocks: int, min_blocks: int = 2) -> SteadyBed:
    """Simulate beds of grains under a tone until two blocks of periods agree.

    `scene`: the test of the scene specifies the level; a controlled force acts directly on the body; `frequency`: Hz;
    `block`: number of periods in a block; `max_blocks`, `min_blocks`: largest and smallest number of blocks. The result
    is the average of the last two blocks.
    """
    scene = with_ideal_force(scene)
    coupled = CoupledPropagator(scene, 1.0 / (_SAMPLES_PER_PERIOD * frequency))
    system = coupled.system
    tone = tone_drive(scene, system, frequency)
    assert tone is not None
    steps = block * _SAMPLES_PER_PERIOD * coupled.substeps
    cycles = np.arange(steps + 1) / (_SAMPLES_PER_PERIOD * coupled.substeps)
    phase_factor: ComplexArray = np.exp(2j * np.pi * cycles)
    drive = np.real(tone.amplitudes[:, None] * phase_factor)
    coupled.set_state(_initial_state(scene, system, frequency, tone.state), drive[:, 0])
    blocks: list[SteadyBed] = []
    while len(blocks) < min_blocks or (not blocks[-1].steady and len(blocks) < max_blocks):
        trajectory, beds = coupled.propagate_steps(drive)
        states, conjugate_factor = trajectory.state[:, : system.states], phase_factor[1:].conj()
        harmonics = 2.0 * (states.T @ conjugate_factor) / steps
        # Forces and states are sampled at the ends of the steps. Over a period, sum times step is the integral.
        force = beds.force[:, :, 1:]
        on_body = -force.sum(axis=1)
        velocity = states[:, system.coordinates + coupled.bodies].T
        weight = (system.damper_mass * system.gravity)[system.grains]
        compliance = harmonics[: scene.structure.bodies] / _driving_force(scene, system, harmonics, tone.amplitudes)
        blocks.append(
            SteadyBed(
                compliance=compliance,
                floor_impulse=force[:, FLOOR].sum(axis=1) * coupled.step / block,
                ceiling_impulse=-force[:, CEILING].sum(axis=1) * coupled.step / block,
                energy=-(on_body * velocity).sum(axis=1) * coupled.step / block,
                landing=_phase(force[:, FLOOR] @ phase_factor[1:], tone.amplitudes),
                flight=np.mean((force[:, FLOOR] == 0.0) & (force[:, CEILING] == 0.0), axis=1),
                motion_type=_motion_types(force, weight),
                spread=_relative_change(blocks[-1].compliance if blocks else None, compliance),
                periods=block * (len(blocks) + 1),
            )
        )
    return _mean(blocks[-2], blocks[-1])


def steady_mass(scene: Scene, frequency: float) -> SteadyBed:
    """Compute the steady-state motion with each bed of the scene modeled as one mass."""
    grains = assemble(scene).grains
    scene = with_ideal_force(as_one_mass(scene))
    response = frequency_response(scene, [frequency])
    system = assemble(scene)
    run = simulate(
        scene,
        (_SETTLING_PERIODS + _AVERAGED_PERIODS) / frequency,
        rate=_ONE_MASS_SAMPLES_PER_PERIOD * frequency,
        frequency=frequency,
    )
    averaged = slice(-_AVERAGED_PERIODS * _ONE_MASS_SAMPLES_PER_PERIOD, None)
    phase_factor = np.exp(2j * np.pi * frequency * run.time[averaged])
    tone = tone_drive(scene, system, frequency)
    assert tone is not None
    inverse_mass, bed_rows = np.diag(np.linalg.inv(system.mass)), np.flatnonzero(grains)
    impulse, energy, flight = np.zeros((2, len(bed_rows))), np.zeros(len(bed_rows)), np.empty(len(bed_rows))
    floor_phasor = np.zeros(len(bed_rows), dtype=complex)
    averaging_start = run.time[-1] - _AVERAGED_PERIODS / frequency
    for k, row in enumerate(bed_rows):
        body, mass = system.damper_coordinate[row], system.damper_mass[row]
        reduced_mass, restitution = 1.0 / (1.0 / mass + inverse_mass[body]), system.restitution[row]
        # Impulse of a bed at rest on a wall, in each sample interval.
        sample_impulse = (
            mass * (run.acceleration[body, averaged] + system.gravity) / (_ONE_MASS_SAMPLES_PER_PERIOD * frequency)
        )
        damper_events = run.events[
            (run.events["damper"] == system.damper_number[row]) & (run.events["time"] >= averaging_start)
        ]
        for wall, kind, sign in ((FLOOR, "floor", 1.0), (CEILING, "ceiling", -1.0)):
            impacts = damper_events[damper_events["kind"] == kind]
            impact_impulses = (1.0 + restitution) * reduced_mass * impacts["speed"]
            rest_impulses = np.where(run.contact[row, averaged] == wall + 1, sample_impulse, 0.0)
            impulse[wall, k] = (impact_impulses.sum() + sign * rest_impulses.sum()) / _AVERAGED_PERIODS
            energy[k] += (
                0.5 * reduced_mass * (1.0 - restitution**2) * float((impacts["speed"] ** 2).sum()) / _AVERAGED_PERIODS
            )
            if wall == FLOOR:
                impact_factors = np.exp(2j * np.pi * frequency * impacts["time"])
                floor_phasor[k] = impact_impulses @ impact_factors + rest_impulses @ phase_factor
        flight[k] = np.mean(run.contact[row, averaged] == 0)
    return SteadyBed(
        compliance=response.compliance[:, 0],
        floor_impulse=impulse[FLOOR],
        ceiling_impulse=impulse[CEILING],
        energy=energy,
        landing=_phase(floor_phasor, tone.amplitudes),
        flight=flight,
        motion_type=response.damper_motion[bed_rows, 0],
        spread=0.0 if response.converged[0] else np.inf,
        periods=_SETTLING_PERIODS + _AVERAGED_PERIODS,
    )


def _initial_state(scene: Scene, system: HybridSystem, frequency: float, state: Array) -> Array:
    """Return the state in steady state with each bed modeled as one mass; this initial state shortens the transient."""
    compliance = frequency_response(as_one_mass(scene), [frequency])
    bodies, n = scene.structure.bodies, system.coordinates
    harmonic = -1j * compliance.force[0] * compliance.compliance[:, 0]
    state = state.copy()
    state[:bodies] += harmonic.real
    state[n : n + bodies] += (2j * np.pi * frequency * harmonic).real
    return state


def _driving_force(scene: Scene, system: HybridSystem, harmonics: ComplexArray, amplitudes: ComplexArray) -> complex:
    """Return the first harmonic of the reference: a force, or the motion of the table."""
    row = reference_of(scene, system).row
    return complex(row @ harmonics) if row is not None else complex(amplitudes[np.argmax(np.abs(amplitudes))])


def _phase(phasor: ComplexArray, amplitudes: ComplexArray) -> Array:
    """Return the phase of each wall force (`phasor`) after the upward zero crossing of the drive [degrees]."""
    # The positive-going zero of Re(A e^{i w t}) is at the phase -arg(i A).
    zero_factor = amplitudes[np.argmax(np.abs(amplitudes))] * 1j
    return np.asarray(np.degrees(np.angle(phasor * zero_factor)) % 360.0)


def _motion_types(force: Array, weight: Array) -> NDArray[np.str_]:
    """Classify the motion of each bed by its wall forces, shape (beds, walls, steps), as the motion of one mass."""
    ceiling = -force[:, CEILING].mean(axis=1) > _MIN_SIGNIFICANT_RATIO * weight
    resting = np.mean(force[:, FLOOR] > _MIN_SIGNIFICANT_RATIO * weight[:, None], axis=1) > 1.0 - _MIN_SIGNIFICANT_RATIO
    return np.where(ceiling, "II/III", np.where(resting, "riding", "I"))


def _relative_change(previous: ComplexArray | None, current: ComplexArray) -> float:
    if previous is None:
        return float("inf")
    return float(np.abs(current - previous).max() / np.abs(current).max())


def _mean(first: SteadyBed, second: SteadyBed) -> SteadyBed:
    """Average two blocks; landing phase, type of motion, spread and number of periods are those of the second."""
    mean = {field.name: getattr(second, field.name) for field in fields(SteadyBed)}
    for name in ("compliance", "floor_impulse", "ceiling_impulse", "energy", "flight"):
        mean[name] = 0.5 * (getattr(first, name) + getattr(second, name))
    return SteadyBed(**mean)
