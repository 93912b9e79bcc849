"""The hybrid system of a scene and its drive, which the engine simulates: linear between contact events.

A damper's *bed* is its particles, modeled as one mass. A damper *rests* while its bed lies on a wall of its
cavity. An *element* is a contact law at one place (`rig.core.laws`): a damper, or a *joint* between two bodies or a
body and the ground. A *configuration* specifies for each element which of the forces of its law acts. It determines the
equations of motion.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import prod
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from rig.core.base.errors import SceneError
from rig.core.laws.landing import duration_and_restitution
from rig.core.laws.law import Law, Row

#: Name of the input for the force of a bed of grains on its body, without the number of the damper.
FORCE_OF_BED = "grains"


@dataclass(frozen=True)
class Element:
    """A contact law at one place: a damper, or a joint.

    `declare`: the law as a function of the clearance [m]. `body`: coordinate of the body to which the gap is measured.
    `gap`: coordinate that is the gap; -1 for a *detached* mass, whose position is not a coordinate, and on which a
    constant force acts between contacts. `mass`: mass of the damper, or the mass that the force of the joint
    accelerates along the gap [kg]. `clearance`: clearance of the damper, or the gap or slip displacement of the joint
    [m]. `restitution`: coefficient in the scene. `number`: number in the scene, from 1. `is_grains`: whether the damper
    is a bed of grains. `is_joint`: whether it is a joint. `base`: coordinate that is subtracted from `gap`; -1 if `gap`
    alone is the gap. `start`: regime at the start; empty: the start regime of the law. `slider`: coordinate that stores
    the displacement of the friction slider, which is constant while the joint sticks; -1 without slider.
    """

    declare: Callable[[float], Law]
    body: int
    gap: int
    mass: float
    clearance: float
    restitution: float
    number: int
    is_grains: bool = False
    is_joint: bool = False
    base: int = -1
    start: str = ""
    slider: int = -1

    @property
    def name(self) -> str:
        """Name for users, such as "damper 2" or "joint 1"."""
        return f"{'joint' if self.is_joint else 'damper'} {self.number}"

    @property
    def direction(self) -> tuple[tuple[int, float], ...]:
        """Coordinates and factors whose sum of products is the gap; empty for a detached mass."""
        ends = ((self.gap, 1.0), (self.base, -1.0))
        return tuple((coordinate, factor) for coordinate, factor in ends if coordinate >= 0)

    def along_gap(self, coordinates: np.ndarray) -> Any:
        """Return the gap from an array of coordinates (last index), or its rate from an array of velocities."""
        return sum(factor * coordinates[..., coordinate] for coordinate, factor in self.direction)

    @property
    def distance(self) -> float:
        """Distance of the gap at rest, which is 0, to the nearest wall or to the displacement at which it slips [m]."""
        if self.slider >= 0:
            return self.clearance
        return min((abs(wall.gap) for wall in self.law.walls), default=np.inf)

    @cached_property
    def law(self) -> Law:
        """Contact law of the element with its present clearance."""
        law = self.declare(self.clearance)
        return law._replace(start=self.start) if self.start else law

    @property
    def key(self) -> tuple[object, ...]:
        """All values that determine the motion of the element, as a hashable tuple."""
        return self.law.key, self.body, self.gap, self.base, self.slider, self.mass


@dataclass(frozen=True)
class HybridSystem:
    """The hybrid linear system of a scene, in SI units.

    The state x is (coordinates q, velocities q', further states r such as the coil current), and u are the inputs. In
    every contact configuration (M + resting damper masses) q'' = F_x x + F_u u + F_1 - (resting dampers' weight) and
    r' = R_x x + R_u u.

    `inputs`, `drive_units`, `drive_limit`: names, units and largest values of the inputs. `gravity`: m/s². `mass`: M,
    without the dampers of instantaneous contact that can move. `force_state`, `force_drive`, `force_constant`: F_x
    (coordinates, states), F_u (coordinates, inputs) and F_1 (coordinates,). `rate_state`, `rate_drive`: R_x (further
    states, states) and R_u (further states, inputs). `state_energy`, `state_loss`: the energy of the further states is
    r^2 state_energy / 2, and their loss is r^2 state_loss. `state_power` (further states, inputs): the drive supplies
    the power r state_power u. `prescribed`, `reaction`: coordinates with prescribed motion, and rows (prescribed,
    states) that give the forces of their actuators [N] from the state. `elements`: the dampers that can move in their
    cavities, then the joints. A bed of grains is here one mass at rest; `rig.extras.grains` computes its motion. Arrays
    with one value for each damper do not include the joints. `initial`: state at t = 0 without drive, with resting
    dampers.
    """

    # names of the coordinates: "body 1" ... "body n", then "table" if the scene has one
    points: tuple[str, ...]
    inputs: tuple[str, ...]
    drive_units: tuple[str, ...]
    drive_limit: np.ndarray
    gravity: float
    mass: np.ndarray
    force_state: np.ndarray
    force_drive: np.ndarray
    force_constant: np.ndarray
    rate_state: np.ndarray
    rate_drive: np.ndarray
    state_energy: np.ndarray
    state_loss: np.ndarray
    state_power: np.ndarray
    prescribed: np.ndarray
    reaction: np.ndarray
    elements: tuple[Element, ...]
    initial: np.ndarray = field(repr=False)

    def __post_init__(self) -> None:
        """Check that each array has an entry for each input and each further state."""
        expected = {
            "drive_limit": (len(self.inputs),),
            "force_drive": (self.coordinates, len(self.inputs)),
            "rate_drive": (len(self.rate_state), len(self.inputs)),
            "state_power": (len(self.rate_state), len(self.inputs)),
            "reaction": (len(self.prescribed), self.states),
        }
        for name, shape in expected.items():
            assert getattr(self, name).shape == shape, f"{name}: {getattr(self, name).shape} instead of {shape}"

    @property
    def coordinates(self) -> int:
        """Number of mechanical coordinates."""
        return self.mass.shape[0]

    @property
    def states(self) -> int:
        """Number of states, without those of the drive and of the dampers in flight."""
        return 2 * self.coordinates + self.rate_state.shape[0]

    @property
    def dampers(self) -> int:
        """Number of dampers that can move in their cavities."""
        return len(self._damper_elements)

    @cached_property
    def _damper_elements(self) -> tuple[Element, ...]:
        return tuple(element for element in self.elements if not element.is_joint)

    @cached_property
    def damper_coordinate(self) -> NDArray[np.intp]:
        """Coordinate of each damper's body."""
        return self.body_coordinate[: self.dampers]

    @cached_property
    def damper_mass(self) -> np.ndarray:
        """Mass of each damper [kg]."""
        return self.element_mass[: self.dampers]

    @cached_property
    def clearance(self) -> np.ndarray:
        """Clearance of each damper [m]."""
        return np.array([element.clearance for element in self._damper_elements], dtype=np.float64)

    @cached_property
    def restitution(self) -> np.ndarray:
        """Coefficient of restitution of each damper."""
        return self.element_restitution[: self.dampers]

    @cached_property
    def damper_number(self) -> NDArray[np.intp]:
        """Number of each damper in the scene, from 1."""
        return np.array([element.number for element in self._damper_elements], dtype=np.intp)

    @cached_property
    def body_coordinate(self) -> NDArray[np.intp]:
        """Coordinate of the body to which the gap of each element is measured."""
        return np.array([element.body for element in self.elements], dtype=np.intp)

    @cached_property
    def element_mass(self) -> np.ndarray:
        """Mass of each element [kg]."""
        return np.array([element.mass for element in self.elements], dtype=np.float64)

    @cached_property
    def element_restitution(self) -> np.ndarray:
        """Coefficient of restitution of each element."""
        return np.array([element.restitution for element in self.elements], dtype=np.float64)

    @cached_property
    def gap_coordinate(self) -> NDArray[np.intp]:
        """Index of the coordinate that is the gap of each element; -1 for a detached mass."""
        return np.array([element.gap for element in self.elements], dtype=np.intp)

    @cached_property
    def base_coordinate(self) -> NDArray[np.intp]:
        """Index of the coordinate that is subtracted from the gap of each element; -1 if none is."""
        return np.array([element.base for element in self.elements], dtype=np.intp)

    @cached_property
    def wall_stiffness(self) -> np.ndarray:
        """Stiffness of both walls of each element with finite-duration contact [N/m], shape (elements, 2)."""
        return self._of_walls("stiffness")

    @cached_property
    def wall_damping(self) -> np.ndarray:
        """Damping of both walls of each element with finite-duration contact [N s/m], shape (elements, 2)."""
        return self._of_walls("damping")

    def _of_walls(self, name: str) -> np.ndarray:
        values = [[getattr(wall, name) for wall in element.law.walls] or [0.0, 0.0] for element in self.elements]
        return np.array(values, dtype=np.float64).reshape(-1, 2)

    @cached_property
    def wall_gap(self) -> np.ndarray:
        """Gap of each element at its lower and its upper wall [m]; infinite without this wall; shape (elements, 2)."""
        gaps = [[wall.gap for wall in element.law.walls] or [-np.inf, np.inf] for element in self.elements]
        return np.array(gaps, dtype=np.float64).reshape(-1, 2)

    @cached_property
    def hold_offset(self) -> np.ndarray:
        """Holding force per mass of each element at each of its walls, with its body at rest; shape (elements, 2)."""
        offsets = [
            [-self.other_acceleration(element, gap) if np.isfinite(gap) else 0.0 for gap in gaps]
            for element, gaps in zip(self.elements, self.wall_gap.tolist(), strict=True)
        ]
        return np.array(offsets, dtype=np.float64).reshape(-1, 2)

    @cached_property
    def grains(self) -> NDArray[np.bool_]:
        """Whether each damper is a bed of grains."""
        return np.array([element.is_grains for element in self._damper_elements], dtype=bool)

    def with_clearance(self, clearance: float) -> Self:
        """Return the system with the same clearance of all dampers that have walls [m]."""
        return replace(
            self,
            elements=tuple(
                replace(element, clearance=clearance) if element.law.walls and not element.is_joint else element
                for element in self.elements
            ),
        )

    def reject_grains(self) -> None:
        """Raise `SceneError` if a damper is a bed of grains, which the engine cannot simulate."""
        if self.grains.any():
            number = self.damper_number[self.grains][0]
            raise SceneError(
                f"dampers[{number}] is a bed of grains, which only `rig simulate`, `rig grains` and `daq record` can "
                "compute. Remove its key `grains` to replace the bed with a single mass."
            )

    @property
    def coupled(self) -> bool:
        """Whether contacts must be solved jointly.

        An impact affects other bodies or dampers at once, or the gap of an element with a rigid wall is a coordinate.
        """
        return self.impacts_interact or any(
            element.gap >= 0 and None in element.law.forces for element in self.elements
        )

    @property
    def impacts_interact(self) -> bool:
        """Whether an impact of a damper instantly affects another damper in the same body, or another body."""
        impacting = [element for element in self.elements if None in element.law.forces]
        coordinates = np.array([element.body for element in impacting], dtype=np.intp)
        gaps = sum(element.gap >= 0 for element in impacting)
        # Otherwise each gap row of the mass matrix belongs to one damper, and couples its gap to its body.
        return bool(np.count_nonzero(self.mass[coordinates]) > np.unique(coordinates).size + gaps)

    @property
    def detached(self) -> NDArray[np.bool_]:
        """Whether each element is detached: its position is not a coordinate; shape (elements,)."""
        return self.gap_coordinate < 0

    @property
    def detached_mass(self) -> np.ndarray:
        """Mass of each detached damper [kg]; 0 for the other dampers."""
        return np.where(self.detached, self.element_mass, 0.0)[: self.dampers]

    @property
    def finite_contact(self) -> np.ndarray:
        """Whether the contacts of each element have a finite duration; shape (elements,)."""
        return np.asarray(self.wall_stiffness.any(axis=1))

    @property
    def separation_acceleration(self) -> np.ndarray:
        """Acceleration [m/s²] of the body at which each damper starts to move; infinite for a damper in motion."""
        return np.array([self._separation_acceleration(element) for element in self._damper_elements], dtype=np.float64)

    def _separation_acceleration(self, element: Element) -> float:
        start = element.law.regimes[element.law.start]
        if not element.law.starts_at_rest or start.force is not None:
            return self.gravity if element.law.starts_at_rest else np.inf
        other = self.other_acceleration(element, start.wall_gap)
        limits = [limit for signal in start.signals for limit, transition in signal.ends if transition is not None]
        return min(abs(limit / element.mass - other) for limit in limits)

    @property
    def reduced_mass(self) -> np.ndarray:
        """Reduced mass of each damper and its body for finite-duration contact [kg]; NaN for instantaneous contact."""
        # The index -1 of a damper with instantaneous contact gives NaN.
        inverse_mass = np.append(np.diag(np.linalg.inv(self.mass)), np.nan)
        return np.asarray(1.0 / inverse_mass[self.gap_coordinate[: self.dampers]])

    def duration_and_restitution(self, damper: int, wall: int) -> tuple[float, float]:
        """Return duration [s] and restitution of the contact of a damper (from 0) with its wall 1 (lower) or 2."""
        stiffness, damping = self.wall_stiffness[damper, wall - 1], self.wall_damping[damper, wall - 1]
        return duration_and_restitution(float(stiffness), float(damping), float(self.reduced_mass[damper]))

    @cached_property
    def strides(self) -> tuple[int, ...]:
        """Stride of each element: a configuration is the sum over elements of stride times index in `Law.forces`."""
        counts = [len(element.law.forces) for element in self.elements]
        return tuple(prod(counts[:j]) for j in range(len(counts)))

    @property
    def configurations(self) -> int:
        """Number of possible configurations."""
        return prod(len(element.law.forces) for element in self.elements)

    def configuration(self, regimes: Sequence[str]) -> int:
        """Return the configuration for the name of each element's regime."""
        laws = (element.law for element in self.elements)
        indices = (law.force_indices[regime] for law, regime in zip(laws, regimes, strict=True))
        return sum(stride * index for stride, index in zip(self.strides, indices, strict=True))

    @property
    def start(self) -> int:
        """Configuration in which every element is in the regime at its start: all dampers rest."""
        return self.configuration([element.law.start for element in self.elements])

    def joint_regimes(self, state: np.ndarray) -> list[int]:
        """Return the number of each joint's regime at a state, shape (states,).

        A joint with a slider sticks. If its force would exceed the limits, its slider displacement in `state` is
        changed.
        """
        regimes = []
        for joint in self.elements[self.dampers :]:
            gap, speed = float(joint.along_gap(state)), float(joint.along_gap(state[self.coordinates :]))
            regime = joint.law.start if joint.slider >= 0 else joint.law.regime_for(gap, speed)
            if joint.slider >= 0:
                state[joint.slider] = np.clip(state[joint.slider], gap - joint.clearance, gap + joint.clearance)
            regimes.append(list(joint.law.regimes).index(regime))
        return regimes

    @property
    def start_regimes(self) -> NDArray[np.int64]:
        """Index of each element's regime at the start, shape (elements,)."""
        return np.array(
            [list(element.law.regimes).index(element.law.start) for element in self.elements], dtype=np.int64
        )

    def force_indices(self, configurations: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the index of each element's force in `Law.forces`, shape of `configurations` and (elements,)."""
        counts = np.array([len(element.law.forces) for element in self.elements], dtype=np.int64)
        return configurations[..., None] // np.array(self.strides, dtype=np.int64) % counts

    def gaps_at_rest(self, configuration: int) -> list[int]:
        """Return the coordinates that are gaps of held elements in a configuration."""
        return [self.elements[j].gap for j in self.held(configuration) if not self.detached[j]]

    def held(self, configuration: int) -> list[int]:
        """Return the elements that are held in a configuration: a holding force keeps their gaps constant."""
        indices = self.force_indices(np.array(configuration)).tolist()
        laws = (element.law for element in self.elements)
        return [j for j, (law, index) in enumerate(zip(laws, indices, strict=True)) if law.forces[index] is None]

    def contact_forces(self, configuration: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the forces of the elements along their gaps in a configuration, without the forces that hold elements.

        Returns the matrix (coordinates, states) that multiplies the state, and constant forces (coordinates,) [N].
        """
        n = self.coordinates
        force, constant = np.zeros((n, self.states)), np.zeros(n)
        for element, index in zip(self.elements, self.force_indices(np.array(configuration)).tolist(), strict=True):
            row = element.law.forces[index] or Row()
            for i, factor in element.direction:
                for column, column_factor in element.direction:
                    force[i, column] += factor * column_factor * row.gap
                    force[i, n + column] += factor * column_factor * row.speed
                if element.slider >= 0:
                    force[i, element.slider] += factor * row.slider
                constant[i] += factor * (row.constant - row.gap * row.rest)
        return force, constant

    def other_acceleration(self, element: Element, gap: float) -> float:
        """Return the acceleration of a mass due to its weight and suspension while it is held at a gap [m], m/s²."""
        if element.gap < 0:
            return -self.gravity
        return float(self.force_state[element.gap, element.gap] * gap + self.force_constant[element.gap]) / element.mass

    def matrix(self, configuration: int = 0) -> np.ndarray:
        """Return the state matrix (states, states) with the forces of a configuration, but without held elements."""
        n, ns = self.coordinates, self.states
        matrix = np.zeros((ns, ns))
        matrix[:n, n : 2 * n] = np.eye(n)
        matrix[n : 2 * n] = np.linalg.solve(self.mass, self.force_state + self.contact_forces(configuration)[0])
        matrix[2 * n :] = self.rate_state
        return matrix

    @property
    def poles(self) -> np.ndarray:
        """Poles while every damper is in flight [rad/s], shape (states,), complex."""
        return np.asarray(np.linalg.eigvals(self.matrix()), dtype=complex)

    @cached_property
    def max_rate(self) -> float:
        """Largest rate (magnitude of a pole) of the system in any configuration [rad/s].

        Held elements are omitted, because they reduce the rates. Forces increase the rates, which are computed for each
        force alone and for the stiffest forces of all elements together.
        """
        changes = [
            [stride * index for index, row in enumerate(element.law.forces) if index and row is not None]
            for element, stride in zip(self.elements, self.strides, strict=True)
        ]
        stiffest = [
            stride * max(range(len(element.law.forces)), key=lambda index: -(element.law.forces[index] or Row()).gap)
            for element, stride in zip(self.elements, self.strides, strict=True)
        ]
        configurations = {0, sum(stiffest), *(change for element in changes for change in element)}
        rates = [
            np.abs(np.linalg.eigvals(self.matrix(configuration))).max(initial=0.0) for configuration in configurations
        ]
        return float(max(rates))


def hold_coordinates(mass: np.ndarray, coordinates: list[int]) -> None:
    """Change a mass matrix in place so that coordinates on which no force acts have no acceleration."""
    mass[coordinates], mass[:, coordinates] = 0.0, 0.0
    mass[coordinates, coordinates] = 1.0
