"""The periodic-orbit problem of a scene: the equations of motion and their derivatives at any operating point.

A *setting* is an operating point. One of its values is the *parameter*, over which orbits are continued. A contact
*configuration* states which dampers are in contact with which wall (`HybridSystem.strides`). A *resting*
damper is at rest on a wall, so its mass is added to its body. A *plan* is the sequence of contact events in one cycle.
The *mass factor* multiplies the masses of all dampers.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import matrix_balance

from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.laws.law import Regime
from rig.core.orbits.event_sequence import Plan, slides
from rig.core.orbits.orbit_equations import GAP, HIGH, HOLD, LOW, SLIDER, SPEED, EquationDerivatives, Equations
from rig.core.scene.scene import Scene
from rig.core.settings.quantities import FREQUENCY, LENGTH, RATIO, Kind, positive_value, positive_values
from rig.core.system.assembly import assemble
from rig.core.system.hybrid_system import Element, HybridSystem, hold_coordinates
from rig.core.system.open_loop_drive import drive_per_level, level_of, with_ideal_force
from rig.core.system.reference import reference_of

#: Continuation parameters. "force" and "drive" are the level of the drive, in the unit of the scene's test.
Parameter = Literal["frequency", "force", "drive", "clearance", "mass_ratio"]
# Entries in each cache, to limit the memory: matrices by configurations and mass factor, and systems by mass factor.
MAX_CACHED = 200
# Relative step of finite differences.
RELATIVE_STEP = 1e-6


@dataclass(frozen=True)
class Axis:
    """A continuation parameter as an axis: its field in `OperatingPoint`, its name, kind of quantity, and label."""

    field: str
    name: str
    kind: Kind
    label: str
    factor: float = 1.0  # from SI to the unit of the label

    @property
    def column(self) -> str:
        """Name of the parameter's column in tables, such as clearance_m."""
        return f"{self.name}_{self.kind.si}".replace("/", "_per_").replace("^", "").rstrip("_")

    @property
    def unit(self) -> str:
        """SI unit of the parameter, as displayed."""
        return self.kind.si.replace("^2", "²")

    def values(self, values: ArrayLike) -> Array:
        """Convert values, in SI or as text, to an array in SI; raises `SceneError` for an invalid value."""
        return positive_values(values, self.kind, f"values of the {self.name}")


@dataclass(frozen=True)
class OperatingPoint:
    """Values of all continuation parameters."""

    frequency: float  # Hz
    level: float  # Level of the drive, in the unit of the scene's test (N for a force)
    clearance: float = np.nan  # Clearance of all dampers [m]; NaN: the clearances of the scene
    mass_ratio: float = 1.0  # Mass factor: ratio of the damper masses to the masses in the scene


def base_frequency(axis: Axis, frequency: float | str | None, first: float) -> float:
    """Return the frequency at which a parameter is varied, or its first value if it is the frequency.

    Raises `SceneError` if the frequency is missing or invalid.
    """
    if frequency is not None:
        return positive_value(frequency, FREQUENCY, "frequency")
    if axis.field != "frequency":
        raise SceneError(f"frequency: missing. Give the frequency at which the {axis.name} is varied.")
    return first


class _ConfigurationMatrices(NamedTuple):
    """Matrices of configurations; the first index of each array is the configuration.

    `generator`: as in `Equations`, but without drive, upper walls of finite-duration contacts and angular frequency.
    `drive_input`: input matrix B of x' = A x + B u. `clearance_input`: derivative of the accelerations with respect to
    each damper's clearance, nonzero while the damper is pressed on its upper wall. `norm_bound`: upper bound of the
    norm of the state matrix [1/s].
    """

    generator: Array
    drive_input: Array
    inverse_mass: Array
    clearance_input: Array
    norm_bound: Array


class _MatrixDerivatives(NamedTuple):
    """Derivatives of fields of `_ConfigurationMatrices` with respect to the mass factor."""

    generator: Array
    drive_input: Array
    inverse_mass: Array
    clearance_input: Array


class OrbitProblem:
    """The equations of a scene at any operating point; the matrices of contact configurations are cached.

    The scene requires a shaker and a test that gives a level; otherwise `SceneError` is raised.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = with_ideal_force(scene)
        self.system = assemble(self.scene)
        self.level = level_of(self.scene)
        self._body_coordinate = self.system.body_coordinate.astype(np.int64)
        self._gap_coordinate = self.system.gap_coordinate.astype(np.int64)
        self._base_coordinate = self.system.base_coordinate.astype(np.int64)
        self._slider_coordinate = np.array([element.slider for element in self.system.elements], dtype=np.int64)
        self._finite_contact = self.system.finite_contact
        self._driven_input = self.system.inputs.index(self.scene.at_driven("shaker"))
        self.reference = reference_of(self.scene, self.system)
        shaker = self.scene.driven_shaker
        self._is_driven_by_force = shaker is not None and shaker.drive_is_force
        elements = len(self.system.elements)
        self._mass_zeros, self._wall_zeros = np.zeros(elements), np.zeros((elements, 2))
        self._matrices: dict[tuple[tuple[int, ...], float], _ConfigurationMatrices] = {}
        self._derivatives: dict[tuple[tuple[int, ...], float], _MatrixDerivatives] = {}
        self._systems: dict[float, HybridSystem] = {}

    def axis(self, parameter: Parameter) -> Axis:
        """Return a parameter as an axis; raises `SceneError` if it does not exist."""
        shaker = self.scene.driven_shaker
        assert shaker is not None
        name = "force" if shaker.drive_is_force else "drive"
        unit = f"({shaker.drive_unit})" if "/" in shaker.drive_unit else shaker.drive_unit
        level = Axis("level", name, shaker.drive_quantity, f"{name} / {unit}".replace("^2", "²"))
        axes = {
            "frequency": Axis("frequency", "frequency", FREQUENCY, "frequency / Hz"),
            "force": level,
            "drive": level,
            "clearance": Axis("clearance", "clearance", LENGTH, "clearance / mm", 1e3),
            "mass_ratio": Axis("mass_ratio", "mass_ratio", RATIO, "factor on the damper masses"),
        }
        if parameter not in axes:
            raise SceneError(f"parameter: got {parameter!r}; expected one of {', '.join(axes)}")
        return axes[parameter]

    def varied_system(self, setting: OperatingPoint) -> HybridSystem:
        """Return the system with the clearance and mass factor of a setting."""
        system = self._system_at(setting.mass_ratio)
        if np.isnan(setting.clearance):
            return system
        return system.with_clearance(setting.clearance)

    def _system_at(self, mass_factor: float) -> HybridSystem:
        """Return the system with a mass factor."""
        if mass_factor == 1.0:
            return self.system
        if mass_factor not in self._systems:
            if len(self._systems) > MAX_CACHED:
                self._systems.clear()
            self._systems[mass_factor] = self._assemble(mass_factor)
        return self._systems[mass_factor]

    def _assemble(self, mass_factor: float) -> HybridSystem:
        """Assemble the system with a mass factor."""
        if (self.system.gap_coordinate < 0).all():
            elements = [replace(element, mass=mass_factor * element.mass) for element in self.system.elements]
            return replace(self.system, elements=tuple(elements))
        # A damper whose gap is a coordinate is part of the mass matrix, and its mass and contact duration determine the
        # wall stiffness and damping.
        dampers = [
            damper.replace(mass=mass_factor * damper.mass)
            if damper.mass is not None
            else damper.replace(mass_ratio=mass_factor * (damper.mass_ratio or 0.0))
            for damper in self.scene.dampers
        ]
        return assemble(self.scene.replace(dampers=dampers))

    def amplitudes(self, setting: OperatingPoint) -> NDArray[np.complex128]:
        """Return the complex amplitude of each input if the level is a sine with zero phase at t = 0."""
        amplitudes = np.zeros(len(self.system.inputs), dtype=np.complex128)
        gain = drive_per_level(self.scene, self.system, 2 * np.pi * setting.frequency)
        amplitudes[self._driven_input] = -1j * setting.level * gain
        return amplitudes

    def equations(
        self, setting: OperatingPoint, plan: Plan, parameter: str | None = "frequency"
    ) -> tuple[Equations, EquationDerivatives]:
        """Return the equations of motion in a plan's configurations, and their derivatives with respect to a parameter.

        Without a parameter, the derivatives are zero.
        """
        system, mass_factor = self.varied_system(setting), setting.mass_ratio
        # nq coordinates and n states. The augmented state z = (state, cos wt, sin wt, 1) obeys z' = generator z.
        nq, n, omega = system.coordinates, system.states, 2 * np.pi * setting.frequency
        amplitudes = self.amplitudes(setting)
        drive = np.array([amplitudes.real, -amplitudes.imag]).T
        drive_derivative = self._drive_derivative(setting, parameter, drive)
        matrices = self._configurations(plan.configurations, mass_factor)
        generator, generator_derivative = matrices.generator.copy(), np.zeros_like(matrices.generator)
        generator[:, :n, n : n + 2] = matrices.drive_input @ drive
        # Dampers with finite-duration contact that have an upper wall.
        has_upper_wall = self._finite_contact[: system.dampers] & np.isfinite(system.clearance)
        if has_upper_wall.any():
            generator[:, nq : 2 * nq, n + 2] += (
                matrices.clearance_input[:, :, has_upper_wall] @ system.clearance[has_upper_wall]
            )
        generator[:, n, n + 1], generator[:, n + 1, n] = -omega, omega
        inverse_mass_derivative = np.zeros_like(matrices.inverse_mass)
        if parameter == "frequency":
            generator_derivative[:, n, n + 1], generator_derivative[:, n + 1, n] = -2 * np.pi, 2 * np.pi
        if drive_derivative is not None:
            generator_derivative[:, :n, n : n + 2] = matrices.drive_input @ drive_derivative
        if parameter == "mass_ratio":
            by_factor = self._matrix_derivatives(plan.configurations, mass_factor)
            generator_derivative[:] = by_factor.generator
            generator_derivative[:, :n, n : n + 2] = by_factor.drive_input @ drive
            generator_derivative[:, nq : 2 * nq, n + 2] += (
                by_factor.clearance_input[:, :, has_upper_wall] @ system.clearance[has_upper_wall]
            )
            inverse_mass_derivative = by_factor.inverse_mass
        if parameter == "clearance":
            generator_derivative[:, nq : 2 * nq, n + 2] = matrices.clearance_input.sum(axis=2)
        stiffness_derivative = damping_derivative = wall_gap_derivative = hold_offset_derivative = self._wall_zeros
        if parameter == "mass_ratio":
            stiffness_derivative, damping_derivative, hold_offset_derivative = self._wall_derivatives(mass_factor)
        if parameter == "clearance":
            # Wall gaps and holding forces are linear in the clearance.
            wide, none = system.with_clearance(1.0), system.with_clearance(0.0)
            wall_gap_derivative = _finite_difference(wide.wall_gap, none.wall_gap)
            hold_offset_derivative = _finite_difference(wide.hold_offset, none.hold_offset)
        period = plan.repetition / setting.frequency
        first_regime, signals = _sliding_signals(system)
        gaps, is_joint = system.gap_coordinate, np.array([element.is_joint for element in system.elements], dtype=bool)
        # The gap is a coordinate without a spring.
        moves_freely = (gaps >= 0) & ~is_joint & ~system.finite_contact & (system.force_state[gaps, gaps] == 0.0)
        return Equations(
            generator=generator,
            norm_bound=np.maximum(matrices.norm_bound, omega),
            inverse_mass=matrices.inverse_mass,
            body_coordinate=self._body_coordinate,
            mass=system.element_mass,
            restitution=system.element_restitution,
            gap_coordinate=self._gap_coordinate,
            base_coordinate=self._base_coordinate,
            slider_coordinate=self._slider_coordinate,
            wall_gap=system.wall_gap,
            hold_offset=system.hold_offset,
            stiffness=system.wall_stiffness,
            damping=system.wall_damping,
            first_regime=first_regime,
            signals=signals,
            moves_freely=moves_freely,
            gravity=float(system.gravity),
            omega=omega,
            period=period,
        ), EquationDerivatives(
            generator=generator_derivative,
            inverse_mass=inverse_mass_derivative,
            mass=self.system.element_mass if parameter == "mass_ratio" else self._mass_zeros,
            wall_gap=wall_gap_derivative,
            hold_offset=hold_offset_derivative,
            stiffness=stiffness_derivative,
            damping=damping_derivative,
            signals=self._signal_derivatives(setting, parameter, signals),
            omega=2 * np.pi if parameter == "frequency" else 0.0,
            period=-period / setting.frequency if parameter == "frequency" else 0.0,
        )

    def _drive_derivative(self, setting: OperatingPoint, parameter: str | None, drive: Array) -> Array | None:
        """Differentiate the drive amplitudes (cosine, sine); return None if they do not depend on the parameter."""
        if parameter == "level":
            return np.asarray(drive / setting.level)
        if parameter != "frequency" or self._is_driven_by_force:
            return None
        # The servo input is a smooth function of frequency: finite differences are accurate to about 1e-10.
        step = RELATIVE_STEP * setting.frequency
        above, below = (
            self.amplitudes(replace(setting, frequency=setting.frequency + sign * step)) for sign in (1, -1)
        )
        slope = (above - below) / (2 * step)
        return np.column_stack([slope.real, -slope.imag])

    def _configurations(self, configurations: tuple[int, ...], mass_factor: float) -> _ConfigurationMatrices:
        """Return the stacked matrices of several configurations."""
        key = (configurations, mass_factor)
        if key not in self._matrices and len(configurations) == 1:
            self._matrices[key] = self._configuration(configurations[0], mass_factor)
        elif key not in self._matrices:
            # Every step of a continuation over the mass factor has a new value, so the cache must be limited.
            if len(self._matrices) > MAX_CACHED:
                self._matrices.clear()
            single = [self._configurations((configuration,), mass_factor) for configuration in configurations]
            fields = zip(*single, strict=True)
            self._matrices[key] = _ConfigurationMatrices(*(np.concatenate(field) for field in fields))
        return self._matrices[key]

    def _configuration(self, configuration: int, mass_factor: float) -> _ConfigurationMatrices:
        """Compute the matrices of one configuration; the first index of each array has length 1."""
        system = self._system_at(mass_factor)
        nq, n = system.coordinates, system.states
        mass, constant = _riding_mass_and_forces(system, configuration)
        inverse_mass = _inverse_with_fixed(mass, system.gaps_at_rest(configuration))
        wall_force, clearance_force, preload = _finite_contact_forces(system, configuration)
        generator, drive_input = np.zeros((n + 3, n + 3)), np.zeros((n, len(system.inputs)))
        state_matrix = generator[:n, :n]
        state_matrix[:nq, nq : 2 * nq] = np.eye(nq)
        state_matrix[nq : 2 * nq] = inverse_mass @ (system.force_state + wall_force)
        state_matrix[2 * nq :] = system.rate_state
        generator[nq : 2 * nq, n + 2] = inverse_mass @ (constant + preload)
        drive_input[nq : 2 * nq] = inverse_mass @ system.force_drive
        drive_input[2 * nq :] = system.rate_drive
        norm_bound = np.array(float(np.linalg.norm(matrix_balance(state_matrix, permute=False)[0], 1)))
        arrays = generator, drive_input, inverse_mass, inverse_mass @ clearance_force, norm_bound
        return _ConfigurationMatrices(*(array[None] for array in arrays))

    def _matrix_derivatives(self, configurations: tuple[int, ...], mass_factor: float) -> _MatrixDerivatives:
        """Differentiate the stacked matrices of several configurations with respect to the mass factor."""
        key = (configurations, mass_factor)
        if key not in self._derivatives:
            if len(self._derivatives) > MAX_CACHED:
                self._derivatives.clear()
            single = [self._configuration_derivatives(configuration, mass_factor) for configuration in configurations]
            self._derivatives[key] = _MatrixDerivatives(*(np.stack(field) for field in zip(*single, strict=True)))
        return self._derivatives[key]

    def _configuration_derivatives(self, configuration: int, mass_factor: float) -> _MatrixDerivatives:
        """Differentiate the matrices of one configuration; the arrays lack the index of the configuration."""
        system = self._system_at(mass_factor)
        nq, n = system.coordinates, system.states
        # Mass matrix and forces are linear in the mass factor: any two values determine the slope.
        heavier, lighter = (self._system_at(factor * mass_factor) for factor in (1.5, 0.5))
        mass_derivative, constant_derivative = (
            (above - below) / mass_factor
            for above, below in zip(
                _riding_mass_and_forces(heavier, configuration),
                _riding_mass_and_forces(lighter, configuration),
                strict=True,
            )
        )
        constant = _riding_mass_and_forces(system, configuration)[1]
        inverse_mass = self._configurations((configuration,), mass_factor).inverse_mass[0]
        inverse_mass_derivative = -inverse_mass @ mass_derivative @ inverse_mass
        wall_force, clearance_force, preload = _finite_contact_forces(system, configuration)
        above, below, step = self._around(mass_factor)
        wall_force_derivative, clearance_force_derivative, preload_derivative = (
            (force_above - force_below) / step
            for force_above, force_below in zip(
                _finite_contact_forces(above, configuration), _finite_contact_forces(below, configuration), strict=True
            )
        )
        force = system.force_state + wall_force
        generator, drive_input = np.zeros((n + 3, n + 3)), np.zeros((n, len(system.inputs)))
        generator[nq : 2 * nq, :n] = inverse_mass_derivative @ force + inverse_mass @ wall_force_derivative
        generator[nq : 2 * nq, n + 2] = inverse_mass_derivative @ (constant + preload) + inverse_mass @ (
            constant_derivative + preload_derivative
        )
        drive_input[nq : 2 * nq] = inverse_mass_derivative @ system.force_drive
        clearance_input = inverse_mass_derivative @ clearance_force + inverse_mass @ clearance_force_derivative
        return _MatrixDerivatives(generator, drive_input, inverse_mass_derivative, clearance_input)

    def _wall_derivatives(self, mass_factor: float) -> tuple[Array, Array, Array]:
        """Differentiate wall stiffness, wall damping and `hold_offset` with respect to the mass factor.

        The shape is (dampers, 2). The derivatives are not zero if the scene specifies the contact duration instead of
        the stiffness, or a spring pushes a damper against a wall.
        """
        if self.system.detached.all():
            return self._wall_zeros, self._wall_zeros, self._wall_zeros
        above, below, step = self._around(mass_factor)
        return (
            np.asarray((above.wall_stiffness - below.wall_stiffness) / step),
            np.asarray((above.wall_damping - below.wall_damping) / step),
            np.asarray((above.hold_offset - below.hold_offset) / step),
        )

    def _signal_derivatives(self, setting: OperatingPoint, parameter: str | None, signals: Array) -> Array:
        """Return the derivatives of `Equations.signals` with respect to the parameter."""
        if parameter not in ("clearance", "mass_ratio") or not len(signals):
            return np.zeros_like(signals)
        value = getattr(setting, parameter)
        settings = [replace(setting, **{parameter: (1.0 + sign * RELATIVE_STEP) * value}) for sign in (1, -1)]
        above, below = (_sliding_signals(self.varied_system(other))[1] for other in settings)
        # Limits may be infinite.
        difference = np.where(np.isfinite(above), above, 0.0) - np.where(np.isfinite(below), below, 0.0)
        return np.asarray(difference / (2.0 * RELATIVE_STEP * value))

    def _around(self, mass_factor: float) -> tuple[HybridSystem, HybridSystem, float]:
        """Return the systems with a larger and a smaller mass factor, for finite differences, and the difference.

        The functions are smooth: finite differences are accurate to about 1e-10.
        """
        above, below = (self._system_at((1.0 + sign * RELATIVE_STEP) * mass_factor) for sign in (1, -1))
        return above, below, 2.0 * RELATIVE_STEP * mass_factor

    def setting(self, frequency: float) -> OperatingPoint:
        """Return the operating point of the unchanged scene at a frequency [Hz]."""
        return OperatingPoint(frequency, self.level)


def vary(setting: OperatingPoint, parameter: str) -> Callable[[float], OperatingPoint]:
    """Return a function that maps a value of one parameter to the setting with this value."""
    return lambda value: replace(setting, **{parameter: value})


def _riding_mass_and_forces(system: HybridSystem, configuration: int) -> tuple[Array, Array]:
    """Return mass matrix and constant forces, including masses and weights of a configuration's resting dampers."""
    riding = np.array([j for j in system.held(configuration) if system.detached[j]], dtype=np.intp)
    rows, masses = system.body_coordinate[riding], system.element_mass[riding]
    added_mass = np.zeros_like(system.mass)
    np.add.at(added_mass, (rows, rows), masses)
    return system.mass + added_mass, system.force_constant - system.gravity * added_mass.sum(axis=0)


def _sliding_signals(system: HybridSystem) -> tuple[NDArray[np.int64], Array]:
    """Return `first_regime` and `signals` of `Equations`."""
    first_regime = np.full(len(system.elements), -1, dtype=np.int64)
    regimes: list[tuple[Element, Regime]] = []
    for j in np.flatnonzero(slides(system)):
        first_regime[j] = len(regimes)
        regimes += [(system.elements[j], regime) for regime in system.elements[j].law.regimes.values()]
    signals = np.zeros((len(regimes), max((len(regime.signals) for _, regime in regimes), default=0), HIGH + 1))
    for (element, regime), rows in zip(regimes, signals, strict=True):
        for signal, row in zip(regime.signals, rows, strict=False):
            unit = element.mass if signal.row.hold else signal.row.slider or 1.0
            row[[GAP, SPEED, HOLD]] = signal.row.gap, signal.row.speed, signal.row.hold
            if signal.row.slider:
                row[[GAP, SLIDER]] = signal.row.gap / unit, 1.0
            row[[LOW, HIGH]] = signal.low / unit, signal.high / unit
    return first_regime, signals


def _finite_contact_forces(system: HybridSystem, configuration: int) -> tuple[Array, Array, Array]:
    """Return the forces of finite-duration contacts, which are linear in state and clearances.

    Returns their derivatives with respect to the state (coordinates, states) and the clearances (coordinates, dampers),
    and the forces at rest for clearances of zero (coordinates,).
    """
    force, constant = system.with_clearance(1.0).contact_forces(configuration)
    preload = system.with_clearance(0.0).contact_forces(configuration)[1]
    constant -= preload
    clearance_force = np.zeros((system.coordinates, system.dampers))
    finite = np.flatnonzero(system.finite_contact[: system.dampers])
    clearance_force[system.gap_coordinate[finite], finite] = constant[system.gap_coordinate[finite]]
    return force, clearance_force, preload


def _inverse_with_fixed(mass: Array, fixed: list[int]) -> Array:
    """Return the inverse of a mass matrix whose rows and columns of fixed coordinates are zero."""
    mass = mass.copy()
    hold_coordinates(mass, fixed)
    inverse = np.asarray(np.linalg.inv(mass), dtype=np.float64)
    inverse[fixed, fixed] = 0.0
    return inverse


def _finite_difference(first: Array, second: Array) -> Array:
    """Return the difference of two arrays, 0 where a value is infinite."""
    is_finite = np.isfinite(first) & np.isfinite(second)
    return np.subtract(first, second, where=is_finite, out=np.zeros_like(first))
