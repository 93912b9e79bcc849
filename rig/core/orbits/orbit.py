"""A periodic motion (orbit) of a scene, and the family of such motions over one free parameter.

A *plan* is the sequence of contact events in one cycle. A *border* is a limit beyond which this sequence is impossible,
for example where a damper hits a wall early. The *margin* is the distance to the border, negative beyond it.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgeev

from rig.core.base.arrays import Array
from rig.core.base.errors import RunError
from rig.core.base.figure_types import Axes
from rig.core.base.renamed import renamed
from rig.core.engine.trajectory import event_table
from rig.core.laws.events import (
    CEILING_IMPACT,
    CEILING_TOUCH,
    FLOOR_IMPACT,
    FLOOR_TOUCH,
    RELEASE,
    SEPARATION,
    SLIP,
    STOP,
)
from rig.core.orbits import event_kinds as kinds
from rig.core.orbits.admissibility import evaluate_motion
from rig.core.orbits.event_sequence import Plan, slides
from rig.core.orbits.newton import IterationLimits, monodromy, newton_solve
from rig.core.orbits.orbit_equations import EquationDerivatives, Equations
from rig.core.orbits.problem import OperatingPoint, OrbitProblem, vary
from rig.core.orbits.shooting import ShootingResult, shoot
from rig.core.orbits.track import track_orbit
from rig.core.results import Result, complete_style
from rig.core.results.ratio_names import per_force
from rig.core.steady_response.motion_type import combined_type, type_of

# Margins down to minus this value may be rounding errors of zero; below it an orbit is inadmissible.
MARGIN_ROUNDING = 1e-9
# Limits of Newton's iteration from an initial guess.
LIMITS = IterationLimits(corrections=25)
#: Events of contact between a damper and a wall, and their kinds in the engine.
CONTACT_KINDS = {
    kinds.FLOOR: FLOOR_IMPACT,
    kinds.FLOOR_BOUNCE: FLOOR_IMPACT,
    kinds.CEILING: CEILING_IMPACT,
    kinds.CEILING_BOUNCE: CEILING_IMPACT,
    kinds.TOUCH_FLOOR: FLOOR_TOUCH,
    kinds.PRESS_FLOOR: FLOOR_TOUCH,
    kinds.TOUCH_CEILING: CEILING_TOUCH,
    kinds.PRESS_CEILING: CEILING_TOUCH,
}


@dataclass(frozen=True, repr=False)
class Orbit(Result):
    """A periodic motion.

    Attributes
    ----------
    operating_point : OperatingPoint
        Operating point: frequency [Hz], level of the drive, and, if varied, clearance and mass ratio.
    repetition : int
        Number of drive periods after which the motion repeats.
    frf : ndarray of complex, shape (bodies,)
        First harmonic of each displacement, divided by that of the reference [m/N, or m/m].
    reference_amplitude : float
        Amplitude of the reference's first harmonic [N, or m].
    peak : ndarray, shape (bodies,)
        Half the peak-to-peak value of each displacement [m].
    margin : float
        Distance to the nearest border, beyond which the sequence of events is impossible: gaps in g/w^2,
        accelerations in g, times in 1/w, with w = 2 pi frequency. Distances above 1 count as 1.
    residual : float
        Relative difference between the states at the start and the end of the orbit.
    closing : ndarray, shape (events,)
        Closing speed of each event of the plan [m/s].
    period_map : ndarray
        Scaled monodromy matrix, whose eigenvalues are the Floquet multipliers.
    border_index : int
        Index of the nearest border among the borders of the plan.
    unknowns : ndarray
        State at the start, heights and velocities of dampers in flight, and instants of events; see
        `rig.core.orbits.shooting`.
    plan : Plan
        The sequence of events.
    problem : OrbitProblem
        Equations that the orbit solves.
    """

    operating_point: OperatingPoint
    repetition: int
    frf: NDArray[np.complex128]
    reference_amplitude: float
    peak: Array
    margin: float
    border_index: int
    residual: float
    closing: Array = field(repr=False)
    period_map: Array = field(repr=False)
    unknowns: Array = field(repr=False)
    plan: Plan = field(repr=False)
    problem: OrbitProblem = field(repr=False, compare=False)

    setting = renamed("setting", "operating_point")

    def summary(self) -> str:
        """Return the type of motion, its operating point, and its stability in words."""
        stable = "stable" if self.stable else "unstable"
        return (
            f"{self.motion_type}, {self.frequency:.6g} Hz, {len(self.events)} events in {self.repetition} "
            f"period{'s' * (self.repetition > 1)}, {stable} (largest multiplier {np.abs(self.multipliers).max():.4g}), "
            f"margin {self.margin:.2g}"
        )

    def columns(self) -> dict[str, Array]:
        """Return time over a cycle from its first event, displacement of each body, and gap of each moving damper."""
        sequence, system = self.plan.sequence, self.problem.varied_system(self.operating_point)
        family = OrbitFamily(self.problem, self.plan, self.operating_point, "frequency", self.unknowns)
        equations, derivatives = family.equations(self.frequency)
        states = shoot(equations, derivatives, sequence, self.unknowns).states
        instants = self.plan.instants(self.unknowns)
        track = track_orbit(equations, sequence, instants, states)
        wall = sequence.wall[len(sequence.wall) - len(track.times) :, None, :]
        gaps = np.where(wall == kinds.FLYING, np.maximum(track.guards[..., 0], 0.0), 0.0)
        gaps = np.where(wall == kinds.RIDES_CEILING, system.wall_gap[:, 1], gaps)
        for j in np.flatnonzero(~system.detached):
            gaps[..., j] = system.elements[j].along_gap(track.motion)
        motion = track.motion[..., : self.problem.scene.structure.bodies]
        return {
            "time_s": track.times.ravel(),
            **{f"body {j}_m": motion[..., j - 1].ravel() for j in range(1, motion.shape[-1] + 1)},
            **{f"gap {k}_m": gaps[..., k - 1].ravel() for k in range(1, system.dampers + 1)},
            **{f"gap of {system.elements[j].name}_m": gaps[..., j].ravel() for j in range(system.dampers, len(gaps.T))},
        }

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the displacement of each body over a cycle, and the gap below each damper as a dashed line."""
        columns = self.columns()
        time = columns.pop("time_s")
        for name, column in columns.items():
            line_style = "--" if name.startswith("gap") else "-"
            ax.plot(1e3 * time, 1e3 * column, line_style, **complete_style(style, label=name.removesuffix("_m")))
        ax.set(xlabel="time / ms", ylabel="displacement, gap / mm")

    @property
    def reference(self) -> str:
        """Reference of `frf`: "force" on the structure, or "table", its displacement."""
        return self.problem.reference.name

    @property
    def compliance(self) -> NDArray[np.complex128]:
        """`frf` with the force as reference [m/N]; raises `SceneError` with a different reference."""
        return per_force(self.frf, self.reference)

    @property
    def frequency(self) -> float:
        """Frequency of the drive [Hz]."""
        return self.operating_point.frequency

    # Most orbits of a search are rejected by their margin alone, so further quantities are computed when first used.
    @cached_property
    def multipliers(self) -> NDArray[np.complex128]:
        """Floquet multipliers: one for each state and two for each damper in flight at the start."""
        return _eigenvalues(self.period_map)

    @cached_property
    def border(self) -> str:
        """Name of the nearest border, whose distance is `margin`; empty if no border is near."""
        return self.plan.borders[self.border_index] if self.margin < 1 else ""

    @cached_property
    def _event_columns(self) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, Array]:
        """Dampers, kinds, times and closing speeds of the events, as `_events` returns them."""
        return _events(self.problem, self.plan, self.plan.instants(self.unknowns), self.closing)

    @cached_property
    def events(self) -> NDArray[np.void]:
        """Events of one cycle, as in `rig.simulate`.

        `time` [s] from the start of a period of the drive, `damper` (from 1), `kind` (separation, floor, ceiling;
        touch, release with finite-duration contact) and closing `speed` [m/s].
        """
        dampers, engine_kinds, times, speeds = self._event_columns
        return event_table(times, dampers, engine_kinds, speeds, self.problem.varied_system(self.operating_point))

    @cached_property
    def damper_motion(self) -> tuple[str, ...]:
        """Type of motion of each damper that moves, then of each joint."""
        dampers, engine_kinds, times, _ = self._event_columns
        system, cycle = (
            self.problem.varied_system(self.operating_point),
            self.plan.repetition / self.operating_point.frequency,
        )
        return tuple(
            type_of(engine_kinds[is_own], times[is_own], system, j, self.plan.repetition, cycle)
            for j, is_own in enumerate(dampers == np.arange(len(system.elements))[:, None])
        )

    @cached_property
    def motion_type(self) -> str:
        """Types of the dampers, as in `rig.frequency_response`."""
        return combined_type(list(self.damper_motion))

    @property
    def stable(self) -> bool:
        """Whether every Floquet multiplier lies inside the unit circle."""
        return bool((np.abs(self.multipliers) < 1).all())

    @property
    def flaw(self) -> str:
        """Violated border of an inadmissible orbit, to which Newton's method may converge; "" if it is admissible."""
        return self.border if self.margin < -MARGIN_ROUNDING else ""


def solve(
    problem: OrbitProblem, plan: Plan, setting: OperatingPoint, unknowns: Array, limits: IterationLimits = LIMITS
) -> Orbit:
    """Solve the equations of an orbit at one operating point by Newton's iteration, starting from `unknowns`.

    Raises `RunError` if the iteration does not converge.
    """
    family = OrbitFamily(problem, plan, setting, "frequency", unknowns)
    location = f"no orbit with events [{plan.label}] near {setting.frequency:.6g} Hz"
    equations, derivatives = problem.equations(setting, plan, parameter=None)
    try:
        x, _, shooting, size, corrections = newton_solve(
            equations, derivatives, plan.sequence, unknowns, family.scale[:-1], family.residual_scale, limits
        )
    except np.linalg.LinAlgError:
        raise RunError(
            f"{location}: the Jacobian matrix of Newton's method is singular. Start from another orbit."
        ) from None
    if corrections < 0:
        raise RunError(
            f"{location}: Newton's method does not converge (last correction {size:.1e}). Start from an orbit at a "
            "closer frequency."
        )
    return family.make_orbit(setting, x, equations, shooting)


class OrbitFamily:
    """The orbits with one sequence of events over one free parameter: equations for `rig.core.numerics.continuation`.

    `plan`: events of the orbit; `setting`: values of all other parameters; `parameter`: 'frequency', 'force',
    'clearance' or 'mass_ratio'; `unknowns`: initial guess; it also sets the scales.
    """

    def __init__(
        self, problem: OrbitProblem, plan: Plan, setting: OperatingPoint, parameter: str, unknowns: Array
    ) -> None:
        self.problem, self.plan, self.parameter = problem, plan, parameter
        self.setting_at = vary(setting, parameter)
        system = problem.system
        omega, nq = 2 * np.pi * setting.frequency, system.coordinates
        state = unknowns[: system.states]
        length = np.abs(state[:nq]).max(initial=0.0) + np.abs(state[nq : 2 * nq]).max(initial=0.0) / omega
        length += system.gravity / omega**2
        # Further states, such as a coil current, may be zero.
        other_scales = np.abs(state[2 * nq :]) + 1e-3
        first_instant = unknowns.size - len(plan.sequence.kind)
        self.scale = scale = np.full(unknowns.size + 1, 1 / omega)  # scales of the instants
        scale[:nq], scale[nq : 2 * nq], scale[2 * nq : system.states] = length, omega * length, other_scales
        scale[system.states : first_instant : 2] = length  # scales of heights and velocities of dampers in flight
        scale[system.states + 1 : first_instant : 2] = omega * length
        # The motion is more sensitive to frequency than to the other parameters.
        scale[-1] = abs(getattr(setting, parameter)) * (0.02 if parameter == "frequency" else 0.2)
        acceleration = system.gravity or omega**2 * length
        guard_scales = {kinds.INDUCED_SEPARATION: 1 / omega}
        guard_scales |= dict.fromkeys((kinds.SEPARATION, kinds.SLIP_LOW, kinds.SLIP_HIGH), acceleration)
        guard_scales |= dict.fromkeys((kinds.STOP, kinds.REVERSE), omega * length)
        self.residual_scale = scale[:-1].copy()
        with_slider = [element.law.has_slider for element in system.elements]
        self.residual_scale[first_instant:] = [
            length if kind in (kinds.SLIP_LOW, kinds.SLIP_HIGH) and with_slider[j] else guard_scales.get(kind, length)
            for kind, j in zip(plan.sequence.kind.tolist(), plan.sequence.damper.tolist(), strict=True)
        ]
        self.bodies = problem.scene.structure.bodies

    def equations(self, value: float) -> tuple[Equations, EquationDerivatives]:
        """Return the equations at a value of the parameter, and their derivatives."""
        return self.problem.equations(self.setting_at(value), self.plan, self.parameter)

    def correct(
        self, value: float, guess: Array, limits: IterationLimits
    ) -> tuple[Equations, Array, Array, ShootingResult, float, int]:
        """Solve the equations at a value of the parameter; return them, and the results of `newton_solve`."""
        equations, derivatives = self.equations(value)
        scale, sequence = self.scale[:-1], self.plan.sequence
        return equations, *newton_solve(equations, derivatives, sequence, guess, scale, self.residual_scale, limits)

    def __call__(self, x: Array) -> tuple[Array, Array]:
        """Return the scaled residual (unknowns,) and Jacobian (unknowns, unknowns + 1); `x`: unknowns and parameter."""
        shooting = shoot(*self.equations(float(x[-1])), self.plan.sequence, x[:-1])
        return shooting.residual / self.residual_scale, shooting.jacobian / self.residual_scale[:, None]

    def orbit(self, x: Array) -> Orbit:
        """Return the orbit at a solution `x` (unknowns and parameter)."""
        equations, derivatives = self.equations(float(x[-1]))
        shooting = shoot(equations, derivatives, self.plan.sequence, x[:-1])
        return self.make_orbit(self.setting_at(float(x[-1])), x[:-1], equations, shooting)

    def margins(self, x: Array) -> tuple[Array, tuple[str, ...]]:
        """Return the margin at each border and the borders' names, for `rig.core.numerics.continuation.trace`."""
        equations, derivatives = self.equations(float(x[-1]))
        shooting = shoot(equations, derivatives, self.plan.sequence, x[:-1])
        distances = evaluate_motion(equations, self.plan.sequence, shooting, self.plan.instants(x[:-1]))[2]
        # A margin that is zero but for rounding is not yet beyond the border.
        return distances + MARGIN_ROUNDING, self.plan.borders

    def multipliers(self, x: Array) -> NDArray[np.complex128]:
        """Compute the Floquet multipliers at a solution."""
        return _eigenvalues(self._period_map(shoot(*self.equations(float(x[-1])), self.plan.sequence, x[:-1])))

    def _period_map(self, shooting: ShootingResult) -> Array:
        """Return the scaled monodromy matrix; raises `RunError` if the instant of an event is not determined."""
        try:
            return monodromy(shooting, len(self.plan.sequence.kind), self.scale[:-1], self.residual_scale)
        except np.linalg.LinAlgError:
            raise RunError(
                f"orbit with events [{self.plan.label}]: an event touches its threshold without crossing it, so the "
                "stability is not determined. Choose other bounds."
            ) from None

    def make_orbit(
        self, setting: OperatingPoint, unknowns: Array, equations: Equations, shooting: ShootingResult
    ) -> Orbit:
        """Return the orbit of a converged shooting result."""
        problem, plan = self.problem, self.plan
        extremes, integral, distances = evaluate_motion(equations, plan.sequence, shooting, plan.instants(unknowns))
        nearest_border = int(distances.argmin())
        bodies = self.bodies
        harmonic = 2 / equations.period * integral
        amplitude = problem.reference.amplitude(setting.level, harmonic)
        return Orbit(
            operating_point=setting,
            repetition=plan.repetition,
            frf=harmonic[:bodies] / amplitude,
            reference_amplitude=abs(amplitude),
            peak=0.5 * (extremes[:bodies, 1] - extremes[:bodies, 0]),
            margin=float(distances[nearest_border]),
            border_index=nearest_border,
            residual=float(np.abs(shooting.residual / self.residual_scale).max()),
            closing=shooting.closing_speed,
            period_map=self._period_map(shooting),
            unknowns=unknowns.copy(),
            plan=plan,
            problem=problem,
        )


def _eigenvalues(matrix: Array) -> NDArray[np.complex128]:
    """Return the eigenvalues of a real matrix, by LAPACK."""
    real, imaginary, *_ = dgeev(matrix, compute_vl=0, compute_vr=0)
    return np.asarray(real + 1j * imaginary, dtype=np.complex128)


def _events(
    problem: OrbitProblem, plan: Plan, instants: Array, closing: Array
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, Array]:
    """Return dampers (from 0), kinds as in `rig.core.engine.state`, times and closing speeds of the events.

    A bounce without rebound is an impact and a separation at one instant.
    """
    has_friction = slides(problem.system)
    events = []
    for time, damper, kind, speed in zip(instants, plan.sequence.damper, plan.sequence.kind, closing, strict=True):
        if int(kind) in CONTACT_KINDS:
            events.append((damper, CONTACT_KINDS[int(kind)], time, speed))
        if kind == kinds.RELEASE:
            events.append((damper, RELEASE, time, 0.0))
        if kind in (kinds.STOP, kinds.REVERSE):
            events.append((damper, STOP, time, 0.0))
        leaves = kind in (kinds.FLOOR_BOUNCE, kinds.CEILING_BOUNCE) and not problem.system.element_restitution[damper]
        if kind in (kinds.SLIP_LOW, kinds.SLIP_HIGH, kinds.REVERSE) or (leaves and has_friction[damper]):
            events.append((damper, SLIP, time, 0.0))
        elif kind in (kinds.SEPARATION, kinds.INDUCED_SEPARATION) or leaves:
            events.append((damper, SEPARATION, time, 0.0))
    table = np.array(events).reshape(-1, 4)
    return table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), table[:, 2], table[:, 3]
