"""The periodic-orbit problem of a scene: its equations for any value of the continuation parameter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import matrix_balance

from rig.arrays import Array
from rig.errors import SceneError
from rig.orbits.event_sequence import Plan
from rig.orbits.orbit_equations import Change, Equations
from rig.scene.quantities import FORCE, FREQUENCY, LENGTH, RATIO, Kind, positives
from rig.scene.scene import Scene
from rig.scene.shaker import ForceShaker
from rig.system.assembly import assemble
from rig.system.hybrid_system import HybridSystem
from rig.system.open_loop_drive import drive_per_level, level_of, with_ideal_force

Parameter = Literal["frequency", "force", "clearance", "mass_ratio"]
#: Continuation parameters, with their kinds of quantity.
PARAMETERS: dict[str, Kind] = {
    "frequency": FREQUENCY,
    "force": FORCE,
    "clearance": LENGTH,
    "mass_ratio": RATIO,
}
#: Axis label of each parameter, and number of its units per SI unit.
AXES = {
    "frequency": ("frequency / Hz", 1.0),
    "force": ("force / N", 1.0),
    "clearance": ("clearance / mm", 1e3),
    "mass_ratio": ("factor on the damper masses", 1.0),
}
# Largest number of configuration sets in the cache.
KEPT = 200
# Relative step of finite differences.
_ASIDE = 1e-6


@dataclass(frozen=True)
class OperatingPoint:
    """Values of the continuation parameters."""

    frequency: float  # Hz
    force: float
    """Level of the drive, in the unit of the scene's test (N for a force)."""
    clearance: float = np.nan
    """Clearance of all dampers [m], or NaN: as in the scene."""
    mass_ratio: float = 1.0
    """Factor on all damper masses of the scene."""


def column_name(parameter: Parameter) -> str:
    """Return the column name of a parameter, such as clearance_m."""
    return f"{parameter}_{PARAMETERS[parameter].si}".rstrip("_")


def parameter_values(parameter: Parameter, values: ArrayLike) -> Array:
    """Convert values of a parameter, in SI or as text, to an array in SI.

    Raises `SceneError` if the parameter does not exist or a value is invalid.
    """
    if parameter not in PARAMETERS:
        raise SceneError(f"parameter {parameter!r}: expected one of {', '.join(PARAMETERS)}")
    return positives(values, PARAMETERS[parameter], f"values of the {parameter}")


def base_frequency(parameter: Parameter, frequency: float | str | None, first: float) -> float:
    """Return the frequency at which a parameter is varied, or its first value if it is the frequency.

    Raises `SceneError` if the frequency is missing or invalid.
    """
    if frequency is not None:
        return float(positives(frequency, FREQUENCY, "frequency")[0])
    if parameter != "frequency":
        raise SceneError(f"following the {parameter} needs a frequency")
    return first


class _Linear(NamedTuple):
    """State matrices of configurations, with input matrices whose last column is the constant forces.

    `inverse` is the inverse mass matrix. `raised` is the derivative of the constant input with respect to each
    damper's clearance while the damper is pressed on its ceiling. `rate` bounds the norm of the state matrix. The
    last four fields are derivatives with respect to the factor on the damper masses.
    """

    matrix: Array
    inflow: Array
    inverse: Array
    raised: Array
    rate: Array
    matrix_change: Array
    inflow_change: Array
    inverse_change: Array
    raised_change: Array


class OrbitProblem:
    """A scene's equations for any setting, with tables of the configurations visited.

    `scene`: with a shaker and a test that gives a level. Raises `SceneError` if the scene has no excitation.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = with_ideal_force(scene)
        self.system = assemble(self.scene)
        self.level = level_of(self.scene)
        self._position = self.system.damper_coordinate.astype(np.int64)
        self._bed = self.system.bed.astype(np.int64)
        self._linear: dict[tuple[tuple[int, ...], float], _Linear] = {}
        self._of_masses: dict[float, HybridSystem] = {}

    def changed(self, setting: OperatingPoint) -> HybridSystem:
        """Return the compiled scene with the setting's clearance and mass ratio."""
        system = self._of_mass(setting.mass_ratio)
        if np.isnan(setting.clearance):
            return system
        return replace(system, clearance=np.full(system.dampers, setting.clearance))

    def _of_mass(self, ratio: float) -> HybridSystem:
        """Return the compiled scene with a factor on the damper masses."""
        if ratio == 1.0:
            return self.system
        if ratio not in self._of_masses:
            if len(self._of_masses) > KEPT:
                self._of_masses.clear()
            self._of_masses[ratio] = self._assembled(ratio)
        return self._of_masses[ratio]

    def _assembled(self, ratio: float) -> HybridSystem:
        if not self.system.lasting.any():
            return replace(self.system, damper_mass=ratio * self.system.damper_mass)
        # A bed with its own coordinate is part of the mass matrix; a contact duration determines the wall parameters.
        dampers = [
            damper.replace(mass=ratio * damper.mass)
            if damper.mass is not None
            else damper.replace(mass_ratio=ratio * (damper.mass_ratio or 0.0))
            for damper in self.scene.dampers
        ]
        return assemble(self.scene.replace(dampers=dampers))

    def amplitudes(self, setting: OperatingPoint) -> NDArray[np.complex128]:
        """Return the complex amplitude of each input for a sine with zero phase at t = 0."""
        found = np.zeros(len(self.system.inputs), dtype=np.complex128)
        gain = drive_per_level(self.scene, self.system, 2 * np.pi * setting.frequency)
        found[self.system.inputs.index(self.scene.at_driven("shaker"))] = -1j * setting.force * gain
        return found

    def equations(
        self, setting: OperatingPoint, plan: Plan, parameter: Parameter = "frequency"
    ) -> tuple[Equations, Change]:
        """Return the equations of motion in a plan's configurations, and their derivatives."""
        system, ratio = self.changed(setting), setting.mass_ratio
        nq, n, omega = system.coordinates, system.states, 2 * np.pi * setting.frequency
        amplitudes = self.amplitudes(setting)
        drive = np.column_stack([amplitudes.real, -amplitudes.imag])
        drive_change = self._drive_change(setting, parameter, drive)
        linear = self._configurations(plan.configurations, ratio)
        generator, change = np.zeros((2, len(plan.configurations), n + 3, n + 3))
        generator[:, :n, :n] = linear.matrix
        generator[:, :n, n : n + 2] = linear.inflow[:, :, :-1] @ drive
        pressable = system.lasting & np.isfinite(system.clearance)
        generator[:, :n, n + 2] = linear.inflow[:, :, -1]
        generator[:, nq : 2 * nq, n + 2] += linear.raised[:, :, pressable] @ system.clearance[pressable]
        generator[:, n, n + 1], generator[:, n + 1, n] = -omega, omega
        inverse_change = np.zeros_like(linear.inverse)
        if parameter == "frequency":
            change[:, n, n + 1], change[:, n + 1, n] = -2 * np.pi, 2 * np.pi
        if drive_change is not None:
            change[:, :n, n : n + 2] = linear.inflow[:, :, :-1] @ drive_change
        if parameter == "mass_ratio":
            change[:, :n, :n] = linear.matrix_change
            change[:, :n, n : n + 2] = linear.inflow_change[:, :, :-1] @ drive
            change[:, :n, n + 2] = linear.inflow_change[:, :, -1]
            change[:, nq : 2 * nq, n + 2] += (
                linear.raised_change[:, :, pressable] @ system.clearance[pressable]
            )
            inverse_change = linear.inverse_change
        if parameter == "clearance":
            change[:, nq : 2 * nq, n + 2] = linear.raised.sum(axis=2)
        nothing, walls = np.zeros(system.dampers), np.zeros((system.dampers, 2))
        stiffness_change, damping_change = (
            self._wall_changes(ratio) if parameter == "mass_ratio" else (walls, walls)
        )
        period = plan.repetition / setting.frequency
        return Equations(
            generator=generator,
            rate=np.maximum(linear.rate, omega),
            inverse_mass=linear.inverse,
            position=self._position,
            mass=system.damper_mass,
            clearance=system.clearance,
            restitution=system.restitution,
            bed=self._bed,
            stiffness=system.wall_stiffness,
            damping=system.wall_damping,
            gravity=float(system.gravity),
            omega=omega,
            period=period,
        ), Change(
            generator=change,
            inverse_mass=inverse_change,
            mass=self.system.damper_mass if parameter == "mass_ratio" else nothing,
            clearance=np.ones(system.dampers) if parameter == "clearance" else nothing,
            stiffness=stiffness_change,
            damping=damping_change,
            omega=2 * np.pi if parameter == "frequency" else 0.0,
            period=-period / setting.frequency if parameter == "frequency" else 0.0,
        )

    def _drive_change(self, setting: OperatingPoint, parameter: Parameter, drive: Array) -> Array | None:
        """Differentiate the drive's amplitudes (cosine, sine); None if they do not depend on the parameter."""
        if parameter == "force":
            return np.asarray(drive / setting.force)
        if parameter != "frequency" or isinstance(self.scene.driven_shaker, ForceShaker):
            return None
        # The servo input is a smooth function of frequency: differences are accurate to about 1e-10.
        step = _ASIDE * setting.frequency
        sides = (replace(setting, frequency=setting.frequency + sign * step) for sign in (1, -1))
        above, below = (self.amplitudes(side) for side in sides)
        slope = (above - below) / (2 * step)
        return np.column_stack([slope.real, -slope.imag])

    def _configurations(self, configurations: tuple[int, ...], mass_ratio: float) -> _Linear:
        """Return the stacked equations of configurations (bit j set: damper j rides)."""
        key = (configurations, mass_ratio)
        if key not in self._linear and len(configurations) == 1:
            self._linear[key] = self._configuration(configurations[0], mass_ratio)
        elif key not in self._linear:
            # During continuation in mass ratio every step has a new value: limit the size of the cache.
            if len(self._linear) > KEPT:
                self._linear.clear()
            each = [self._configurations((one,), mass_ratio) for one in configurations]
            self._linear[key] = _Linear(*(np.concatenate(parts) for parts in zip(*each, strict=True)))
        return self._linear[key]

    def _configuration(self, configuration: int, mass_ratio: float) -> _Linear:
        system = self._of_mass(mass_ratio)
        nq, n = system.coordinates, system.states
        mass, constant = _loaded(system, configuration)
        # The matrices are linear in the factor: any two values determine the slope.
        heavy, light = (_loaded(self._of_mass(side * mass_ratio), configuration) for side in (1.5, 0.5))
        mass_change, constant_change = (
            (more - less) / mass_ratio for more, less in zip(heavy, light, strict=True)
        )
        inverse = np.asarray(np.linalg.inv(mass), dtype=np.float64)
        inverse_change = -inverse @ mass_change @ inverse
        walls, raised = _pressed(system, configuration)
        stiffness_change, damping_change = self._wall_changes(mass_ratio)
        changes = replace(system, wall_stiffness=stiffness_change, wall_damping=damping_change)
        walls_change, raised_change = _pressed(changes, configuration)
        force = system.force_state + walls
        matrix, inflow = np.zeros((n, n)), np.zeros((n, len(system.inputs) + 1))
        matrix_change, inflow_change = np.zeros_like(matrix), np.zeros_like(inflow)
        matrix[:nq, nq : 2 * nq] = np.eye(nq)
        matrix[nq : 2 * nq] = inverse @ force
        matrix[2 * nq :] = system.rate_state
        inflow[nq : 2 * nq, :-1] = inverse @ system.force_drive
        inflow[2 * nq :, :-1] = system.rate_drive
        inflow[nq : 2 * nq, -1] = inverse @ constant
        matrix_change[nq : 2 * nq] = inverse_change @ force + inverse @ walls_change
        inflow_change[nq : 2 * nq, :-1] = inverse_change @ system.force_drive
        inflow_change[nq : 2 * nq, -1] = inverse_change @ constant + inverse @ constant_change
        rate = np.array(float(np.linalg.norm(matrix_balance(matrix, permute=False)[0], 1)))
        parts = (
            matrix, inflow, inverse, inverse @ raised, rate,
            matrix_change, inflow_change, inverse_change, inverse_change @ raised + inverse @ raised_change,
        )  # fmt: skip
        return _Linear(*(part[None] for part in parts))

    def _wall_changes(self, mass_ratio: float) -> tuple[Array, Array]:
        """Differentiate wall stiffness and damping, which a given contact duration makes dependent on mass."""
        if not self.system.lasting.any():
            return np.zeros((self.system.dampers, 2)), np.zeros((self.system.dampers, 2))
        # The functions are smooth: differences are accurate to about 1e-10.
        more, less = (self._of_mass(side * mass_ratio) for side in (1.0 + _ASIDE, 1.0 - _ASIDE))
        step = 2.0 * _ASIDE * mass_ratio
        return (
            np.asarray((more.wall_stiffness - less.wall_stiffness) / step),
            np.asarray((more.wall_damping - less.wall_damping) / step),
        )

    def setting(self, frequency: float) -> OperatingPoint:
        """Return the scene's own setting at a frequency."""
        return OperatingPoint(frequency, self.level)


def vary(setting: OperatingPoint, parameter: Parameter) -> Callable[[float], OperatingPoint]:
    """Return the setting as a function of one parameter."""
    return lambda value: replace(setting, **{parameter: value})


def _loaded(system: HybridSystem, configuration: int) -> tuple[Array, Array]:
    """Return the mass matrix with the riding dampers of a configuration, and constant forces with their weight."""
    riding = np.array(
        [j for j in range(system.dampers) if configuration >> j & 1 and not system.lasting[j]], dtype=np.intp
    )
    rows, masses = system.damper_coordinate[riding], system.damper_mass[riding]
    added = np.zeros_like(system.mass)
    np.add.at(added, (rows, rows), masses)
    return system.mass + added, system.force_constant - system.gravity * added.sum(axis=0)


def _pressed(system: HybridSystem, configuration: int) -> tuple[Array, Array]:
    """Return the forces of finite-duration contacts: rows for the state, and derivatives by clearance."""
    force, constant = replace(system, clearance=np.ones(system.dampers)).contact_forces(configuration)
    raised, lasting = np.zeros((system.coordinates, system.dampers)), np.flatnonzero(system.lasting)
    raised[system.bed[lasting], lasting] = constant[system.bed[lasting]]
    return force, raised
