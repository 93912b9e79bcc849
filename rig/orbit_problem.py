"""The periodic-orbit problem of a scene: its equations for any value of the parameter that is followed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rig.assembly import assemble
from rig.contact import CEILING_IMPACT, FLIGHT, FLOOR_IMPACT
from rig.course import Course
from rig.errors import SceneError
from rig.open_loop import drive_per_level, level_of
from rig.scene import Scene
from rig.shaker_settings import ForceShaker
from rig.shooting import (
    CEILING,
    CEILING_BOUNCE,
    FLOOR,
    FLOOR_BOUNCE,
    SEPARATION,
    WITH_LAST,
    Equations,
    Sequence,
)
from rig.system import System

Array = NDArray[np.float64]
Parameter = Literal["frequency", "force", "clearance", "mass_ratio"]
PARAMETERS: tuple[Parameter, ...] = ("frequency", "force", "clearance", "mass_ratio")


def pure_force(scene: Scene) -> Scene:
    """Put the force itself on the driven body where the test holds the amplitude of the spring force.

    A spring force that is a pure tone is what an ideal controller holds; table and coil spring then have no
    influence on the structure and drop out.
    """
    if (
        scene.shaker is None
        or isinstance(scene.shaker, ForceShaker)
        or getattr(scene.test, "force", None) is None
    ):
        return scene
    kept = [c for c in scene.channels or () if c.at != "table"]
    shaker = {"kind": "force", "body": scene.shaker.body}
    return scene.replace(shaker=shaker, channels=kept or None)


@dataclass(frozen=True)
class Setting:
    """Values of what can be followed.

    Attributes
    ----------
    frequency : float
        Hz.
    force : float
        Level of the drive, in the unit of the scene's test (N for a force).
    clearance : float
        Of all dampers [m], or NaN: as in the scene.
    mass_ratio : float
        Factor on all damper masses of the scene.
    """

    frequency: float
    force: float
    clearance: float = np.nan
    mass_ratio: float = 1.0


class Problem:
    """A scene's equations for any setting, with tables of the configurations visited.

    Parameters
    ----------
    scene : Scene
        With a shaker and a test that gives a level.

    Raises
    ------
    SceneError
        If nothing drives the scene, a damper has restitution, or the mass matrix couples dampers at an
        impact.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = pure_force(scene)
        self.system = assemble(self.scene)
        self.level = level_of(self.scene)
        if self.system.coupled:
            raise SceneError(
                f"scene {scene.name!r}: its mass matrix lets one damper's impact lift another one; periodic "
                "orbits are computed for structures whose damped bodies the mass matrix does not couple"
            )
        bouncing = self.system.damper_number[self.system.restitution > 0]
        if len(bouncing):
            raise SceneError(
                f"scene {scene.name!r}: damper {bouncing[0]} has restitution; periodic orbits "
                "are computed for plastic impacts, restitution: 0"
            )
        self._linear: dict[tuple[int, float], tuple[Array, Array, Array]] = {}

    def changed(self, setting: Setting) -> System:
        """Return the compiled scene with the setting's clearance and mass ratio."""
        system = self.system
        if not np.isnan(setting.clearance):
            system = replace(system, clearance=np.full(system.dampers, setting.clearance))
        if setting.mass_ratio != 1.0:
            system = replace(system, damper_mass=setting.mass_ratio * system.damper_mass)
        return system

    def amplitudes(self, setting: Setting) -> NDArray[np.complex128]:
        """Complex amplitude of each input; the level is that of a sine that starts at zero."""
        found = np.zeros(len(self.system.inputs), dtype=np.complex128)
        gain = drive_per_level(self.scene, self.system, 2 * np.pi * setting.frequency)
        found[self.system.inputs.index("shaker")] = -1j * setting.force * gain
        return found

    def equations(self, setting: Setting, configurations: tuple[int, ...]) -> Equations:
        """Equations of motion in some configurations (bit j set: damper j rides)."""
        system = self.changed(setting)
        n, omega = system.states, 2 * np.pi * setting.frequency
        amplitudes = self.amplitudes(setting)
        drive = np.column_stack([amplitudes.real, -amplitudes.imag])
        generator = np.zeros((len(configurations), n + 3, n + 3))
        inverse_mass = np.zeros((len(configurations), system.coordinates, system.coordinates))
        for slot, configuration in enumerate(configurations):
            matrix, inflow, inverse_mass[slot] = self._matrices(system, configuration, setting.mass_ratio)
            generator[slot, :n, :n] = matrix
            generator[slot, :n, n : n + 2] = inflow[:, :-1] @ drive
            generator[slot, :n, n + 2] = inflow[:, -1]
            generator[slot, n, n + 1], generator[slot, n + 1, n] = -omega, omega
        return Equations(
            generator=generator,
            inverse_mass=inverse_mass,
            position=system.damper_coordinate.astype(np.int64),
            mass=system.damper_mass.astype(np.float64),
            clearance=system.clearance.astype(np.float64),
            gravity=float(system.gravity),
            omega=omega,
        )

    def _matrices(self, system: System, configuration: int, mass_ratio: float) -> tuple[Array, Array, Array]:
        """State matrix, inflow of inputs and (last column) of constant forces, and inverse mass matrix."""
        key = (configuration, mass_ratio)
        if key not in self._linear:
            nq, n = system.coordinates, system.states
            riding = [j for j in range(system.dampers) if configuration >> j & 1]
            mass, constant = system.mass.copy(), system.force_constant.copy()
            for j in riding:
                row = system.damper_coordinate[j]
                mass[row, row] += system.damper_mass[j]
                constant[row] -= system.damper_mass[j] * system.gravity
            inverse = np.linalg.inv(mass)
            matrix, inflow = np.zeros((n, n)), np.zeros((n, len(system.inputs) + 1))
            matrix[:nq, nq : 2 * nq] = np.eye(nq)
            matrix[nq : 2 * nq] = inverse @ system.force_state
            matrix[2 * nq :] = system.rate_state
            inflow[nq : 2 * nq, :-1] = inverse @ system.force_drive
            inflow[2 * nq :, :-1] = system.rate_drive
            inflow[nq : 2 * nq, -1] = inverse @ constant
            self._linear[key] = (matrix, inflow, inverse)
        return self._linear[key]

    def setting(self, frequency: float) -> Setting:
        """Return the scene's own setting at a frequency."""
        return Setting(frequency, self.level)


def vary(setting: Setting, parameter: Parameter) -> Callable[[float], Setting]:
    """Return the setting as a function of one parameter."""
    return lambda value: replace(setting, **{parameter: value})


@dataclass(frozen=True)
class Plan:
    """An orbit's sequence of events, with the configurations behind its slots.

    Attributes
    ----------
    sequence : Sequence
    configurations : tuple of int
        Bit j set: damper j rides.
    repetition : int
        Length in periods of the drive.
    """

    sequence: Sequence
    configurations: tuple[int, ...]
    repetition: int

    @property
    def flying(self) -> NDArray[np.int64]:
        """Dampers in flight at the start."""
        return np.flatnonzero(self.sequence.wall[0] == 0)

    @property
    def label(self) -> str:
        """The events in short, e.g. ``"2^ 2- 2_"``: damper 2 separates, bounces off the ceiling, lands."""
        signs = {
            SEPARATION: "^",
            FLOOR: "_",
            CEILING: "=",
            FLOOR_BOUNCE: "v",
            CEILING_BOUNCE: "-",
            WITH_LAST: "~",
        }
        pairs = zip(self.sequence.damper, self.sequence.kind, strict=True)
        return " ".join(f"{d + 1}{signs[int(k)]}" for d, k in pairs)

    def same_cycle(self, other: Plan) -> bool:
        """Whether the events are the same in the same cyclic order."""
        own, others = self.label.split(), other.label.split()
        return len(own) == len(others) and (own == others or " ".join(own) in " ".join(others + others))


def plan_from(course: Course, start: NDArray[np.int8], repetition: int) -> tuple[Plan, Array]:
    """Read the sequence of events off a simulated cycle.

    Parameters
    ----------
    course : Course
        Events of the cycle.
    start : ndarray of int8, shape (dampers,)
        Walls at its start.
    repetition : int
        Periods in the cycle.

    Returns
    -------
    plan : Plan
    order : ndarray
        Positions of the plan's events among the course's.
    """
    kinds: list[int] = []
    dampers: list[int] = []
    walls = [start.astype(np.int64)]
    order: list[int] = []
    instants = list(zip(course.event_segment.tolist(), course.event_offset.tolist(), strict=True))
    for k, (damper, kind) in enumerate(
        zip(course.event_damper.tolist(), course.event_kind.tolist(), strict=True)
    ):
        wall = walls[-1].copy()
        now = [i for i in range(len(order)) if instants[order[i]] == instants[k]]
        hit = [i for i in now if dampers[i] == damper and kinds[i] in (FLOOR, CEILING)]
        if kind in (FLOOR_IMPACT, CEILING_IMPACT):
            landed = FLOOR if kind == FLOOR_IMPACT else CEILING
            wall[damper] = landed
            kinds.append(landed)
        elif hit:
            # It hit in this very instant: one event, a bounce, and no stay in between.
            kinds[hit[-1]] = FLOOR_BOUNCE if kinds[hit[-1]] == FLOOR else CEILING_BOUNCE
            for later in walls[hit[-1] + 1 :]:
                later[damper] = FLIGHT
            continue
        else:
            wall[damper] = FLIGHT
            kinds.append(WITH_LAST if now else SEPARATION)
        dampers.append(damper)
        walls.append(wall)
        order.append(k)
    return make_plan(kinds, dampers, walls[0], repetition), np.array(order, dtype=np.int64)


def make_plan(kinds: list[int], dampers: list[int], start: NDArray[Any], repetition: int) -> Plan:
    """Build a plan from events and the walls at the start."""
    walls = [np.asarray(start, dtype=np.int64)]
    after = {SEPARATION: 0, WITH_LAST: 0, FLOOR: 1, CEILING: 2, FLOOR_BOUNCE: 0, CEILING_BOUNCE: 0}
    for kind, damper in zip(kinds, dampers, strict=True):
        wall = walls[-1].copy()
        wall[damper] = after[kind]
        walls.append(wall)
    masks = [int(sum(1 << j for j in np.flatnonzero(wall))) for wall in walls]
    configurations = tuple(dict.fromkeys(masks))
    sequence = Sequence(
        np.array(kinds, dtype=np.int64),
        np.array(dampers, dtype=np.int64),
        np.array([configurations.index(mask) for mask in masks], dtype=np.int64),
        np.array(walls, dtype=np.int64),
    )
    return Plan(sequence, configurations, repetition)
