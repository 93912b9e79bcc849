"""Periodic motions of one mode with a damper: Types I, II and III as conditions over one period.

All quantities are dimensionless: time is tau = w t, the unit of length is g/w^2, so free fall is y'' = -1. With
r = w/w_i the equations of motion of the modal coordinate q are

    flight   q'' + 2 (zeta/r) q' + q/r^2 = a sin(tau) + b cos(tau)            and  y'' = -1
    riding   (1 + mu) q'' + 2 (zeta/r) q' + q/r^2 = a sin(tau) + b cos(tau) - mu

where a riding damper (at rest on a wall) is at y = q (floor) or y = q + clearance (ceiling).

A period begins at tau = 0, just after the floor impact, with the damper riding on the floor. The damper leaves the
floor at tau_0, where the contact force mu (q'' + 1) has decreased to 0 (so q'' = -1). In Type I it falls back to the
floor at 2 pi. In Types II and III it hits the ceiling at tau_1. In Type II it leaves the ceiling immediately with the
common velocity. In Type III it rides on the ceiling until the contact force has decreased to 0 (q'' = -1 again) at
tau_2. All impacts are perfectly plastic.

The force is F sin(tau - phi): a = F cos(phi), b = -F sin(phi). For given instants, all conditions except two are affine
in (q_0, q'_0, a, b). The exceptions are a^2 + b^2 = F^2 and the gap at the ceiling impact.
`rig.studies.single_mode.motion_search` uses this to compute all solutions. Each condition is analytic in every unknown
and parameter, so a complex step gives exact derivatives.

Equation numbers refer to Inoue, Yokomichi and Hiraki (2011). There, flight is Eq. 8 for the mode and Eqs 10 and 11 for
the damper, and riding is Eq. 9. The conditions are Eqs 14-17. The paper reduces them to three transcendental equations
in the instants (18-20) and a linear equation (21). The reduction is valid for Type II only, so the unreduced conditions
are used here.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

MotionType = Literal["I", "II", "III"]
# Number of instants in addition to the floor impact: tau_0, tau_1, tau_2.
INSTANTS: dict[MotionType, int] = {"I": 1, "II": 2, "III": 3}

# Period of the drive in tau.
PERIOD = 2 * np.pi
# Complex or real, of any common shape: the equations are evaluated for all elements of the arrays together.
Array = NDArray[Any]


class MotionParameters(NamedTuple):
    """The dimensionless parameters of a motion."""

    ratio: Any  # r, excitation frequency over the natural frequency of the mode
    damping: Any  # zeta, damping ratio of the mode
    mass_ratio: Any  # mu
    force: Any  # F = phi_k f / (M g)
    clearance: Any
    """In units of g/w_i^2, with the natural frequency w_i, so it does not depend on r."""


class ModeState(NamedTuple):
    """Coordinate q, its velocity u, and the damper's position y and velocity v."""

    q: Array
    u: Array
    y: Array
    v: Array


@dataclass(frozen=True)
class MotionPhase:
    """A phase of the motion between two events; times in tau."""

    riding: bool  # Whether the damper's mass moves with the mode
    start_time: Array
    duration: Array
    initial_state: ModeState  # After the impact if the phase begins with an impact
    riding_gap: Any  # Gap to the floor while riding: 0 or the clearance


class PeriodicMotion:
    """The motion defined by a set of unknowns, whether or not it satisfies the conditions.

    `kind`: type of motion, 'I', 'II' or 'III'; `unknowns`, shape (4 + instants, ...): q_0, q'_0, a, b and the instants,
    which broadcast against each other; `parameters`, which broadcast against unknowns[0].
    """

    def __init__(self, kind: MotionType, unknowns: Array | Sequence[Array], parameters: MotionParameters) -> None:
        self.kind = kind
        self.parameters = parameters
        q, u, self.a, self.b = (np.asarray(value) for value in unknowns[:4])
        self.instants = unknowns[4:]
        take_off = self.instants[0]
        floor = MotionPhase(True, np.zeros_like(take_off), take_off, ModeState(q, u, q, u), 0.0)
        first_flight = self._flight_after(floor)
        self.phases = [floor, first_flight]
        if kind != "I":
            ceiling_impact = self.instants[1]
            self.phases[-1] = replace(first_flight, duration=ceiling_impact - first_flight.start_time)
            self.before_ceiling = self.advance(self.phases[-1], self.phases[-1].duration)
            velocity = self.common_velocity(self.before_ceiling)
            after_ceiling = self.before_ceiling._replace(u=velocity, v=velocity)
            if kind == "III":
                after_ceiling = after_ceiling._replace(y=after_ceiling.q + self.clearance)
                self.phases.append(
                    MotionPhase(True, ceiling_impact, self.instants[2] - ceiling_impact, after_ceiling, self.clearance)
                )
                self.phases.append(self._flight_after(self.phases[-1]))
            else:
                self.phases.append(MotionPhase(False, ceiling_impact, PERIOD - ceiling_impact, after_ceiling, 0.0))
        self.landing = self.advance(self.phases[-1], self.phases[-1].duration)

    def _flight_after(self, phase: MotionPhase) -> MotionPhase:
        """Return the flight that follows a phase without impact, up to the end of the period."""
        start_time = phase.start_time + phase.duration
        return MotionPhase(False, start_time, PERIOD - start_time, self.advance(phase, phase.duration), 0.0)

    @property
    def clearance(self) -> Array:
        """Clearance in units of g/w^2."""
        return np.asarray(self.parameters.clearance * self.parameters.ratio**2)

    def common_velocity(self, state: ModeState) -> Array:
        """Return the velocity after a plastic impact."""
        mu = self.parameters.mass_ratio
        return (state.u + mu * state.v) / (1 + mu)

    def _oscillator(self, phase: MotionPhase) -> tuple[Any, Any, Any]:
        """Return inertia, decay rate, and stiffness per inertia (squared natural frequency) in a phase."""
        r, zeta, mu = self.parameters.ratio, self.parameters.damping, self.parameters.mass_ratio
        inertia = 1 + mu if phase.riding else 1.0
        return inertia, zeta / (r * inertia), 1 / (r * r * inertia)

    def homogeneous(self, phase: MotionPhase, t: Array) -> tuple[Array, Array, Array, Array]:
        """Compute the free response at time `t`: q for unit q and unit q', then q' for unit q and unit q'."""
        inertia, decay, stiffness_per_inertia = self._oscillator(phase)
        # sqrt(stiffness_per_inertia - decay**2); the direct difference may round to zero near critical damping.
        damped_frequency = np.sqrt(inertia - self.parameters.damping**2) / (self.parameters.ratio * inertia)
        envelope = np.exp(-decay * t)
        cosine = envelope * np.cos(damped_frequency * t)
        sine = envelope * np.sin(damped_frequency * t) / damped_frequency
        return cosine + decay * sine, sine, -stiffness_per_inertia * sine, cosine - decay * sine

    def advance(self, phase: MotionPhase, t: Array) -> ModeState:
        """Compute the state at time `t` after the start of a phase of the motion, in closed form."""
        inertia, decay, stiffness_per_inertia = self._oscillator(phase)
        # As in the paper (A_p, beta), the response q_c cos(t) + q_s sin(t) is singular at an undamped resonance.
        d_r, d_i = stiffness_per_inertia - 1, 2 * decay  # real and imaginary parts of the dynamic stiffness per inertia
        squared = inertia * (d_r * d_r + d_i * d_i)
        sin_part, cos_part = self._local_force(phase.start_time)
        q_c, q_s = (cos_part * d_r - sin_part * d_i) / squared, (sin_part * d_r + cos_part * d_i) / squared
        q0, u0, y0, v0 = phase.initial_state
        free_q, free_u = q0 - q_c, u0 - q_s
        rest = 0.0
        if phase.riding:
            # The weight of the riding mass is the constant -gamma_i of Eq. 9; it displaces the position of rest.
            rest = -self.parameters.mass_ratio / (inertia * stiffness_per_inertia)
            free_q = free_q - rest
        # The free response starts with the deviation of the initial state from the steady response.
        q_q, q_u, u_q, u_u = self.homogeneous(phase, t)
        cosine, sine = np.cos(t), np.sin(t)
        q = q_q * free_q + q_u * free_u + q_c * cosine + q_s * sine + rest
        u = u_q * free_q + u_u * free_u + q_s * cosine - q_c * sine
        if phase.riding:
            return ModeState(q, u, q + phase.riding_gap, u)
        return ModeState(q, u, y0 + v0 * t - t * t / 2, v0 - t)

    def acceleration(self, phase: MotionPhase, t: Array, state: ModeState) -> Array:
        """Compute the second derivative of q at time `t` after the start of a phase."""
        r, zeta, mu = self.parameters.ratio, self.parameters.damping, self.parameters.mass_ratio
        sin_part, cos_part = self._local_force(phase.start_time)
        force = sin_part * np.sin(t) + cos_part * np.cos(t) - 2 * zeta / r * state.u - state.q / r**2
        return (force - mu) / (1 + mu) if phase.riding else force

    def jerk(self, phase: MotionPhase, t: Array, state: ModeState) -> Array:
        """Compute the third derivative of q at time `t` after the start of a phase."""
        r, zeta, mu = self.parameters.ratio, self.parameters.damping, self.parameters.mass_ratio
        sin_part, cos_part = self._local_force(phase.start_time)
        acceleration = self.acceleration(phase, t, state)
        force = sin_part * np.cos(t) - cos_part * np.sin(t) - 2 * zeta / r * acceleration - state.u / r**2
        return force / (1 + mu) if phase.riding else force

    def _local_force(self, start_time: Array) -> tuple[Array, Array]:
        """Return the sine and cosine parts of the force for time counted from `start_time`."""
        c, s = np.cos(start_time), np.sin(start_time)
        return self.a * c - self.b * s, self.a * s + self.b * c

    def affine_conditions(self) -> Array:
        """Evaluate the conditions that are affine in (q_0, q'_0, a, b), shape (4 or 5, ...).

        The conditions are: periodicity of q; periodicity of the velocity across the floor impact; zero contact force at
        take-off; damper on the floor at 2 pi; for Type III, zero contact force at the end of the ceiling contact.
        """
        floor, first_flight = self.phases[0], self.phases[1]
        conditions = [
            self.landing.q - floor.initial_state.q,  # Eqs 14 and 17: rho_c1 at both ends of the period
            self.common_velocity(self.landing) - floor.initial_state.u,  # Eq. 14: u_c1 from u_b1 and v_b1
            # Separation: Eq. 15 gives continuity of position and velocity; in addition the contact force must vanish.
            self.acceleration(first_flight, np.zeros_like(first_flight.duration), first_flight.initial_state) + 1,
            self.landing.y - self.landing.q,  # Eq. 17: both at rho_c1
        ]
        if self.kind == "III":
            last_flight = self.phases[-1]
            conditions.append(
                self.acceleration(last_flight, np.zeros_like(last_flight.duration), last_flight.initial_state) + 1
            )
        return np.array(conditions)

    def ceiling_gap(self) -> Array:
        """Compute the gap to the floor at the ceiling impact (Types II and III), which should be the clearance."""
        return self.before_ceiling.y - self.before_ceiling.q

    def conditions(self) -> Array:
        """Evaluate all conditions, shape (4 + instants, ...); the motion is periodic where they are zero."""
        conditions = list(self.affine_conditions())
        if self.kind != "I":
            conditions.append(self.ceiling_gap() - self.clearance)  # Eq. 16: the damper is d_j above the body
        # The force condition is divided by F, so all conditions have similar magnitudes.
        force = self.parameters.force
        conditions.append((self.a**2 + self.b**2) / force - force)
        return np.array(conditions)


def jacobian(kind: MotionType, unknowns: Array, parameters: MotionParameters, parameter: str) -> tuple[Array, Array]:
    """Compute the conditions and their derivatives with respect to the unknowns and one parameter.

    The complex-step derivative Im f(x + i h)/h has no cancellation, so it is exact to rounding error for a very small
    h.

    `kind`: type of motion, 'I', 'II' or 'III'; `unknowns`, shape (n,): q_0, q'_0, a, b and the instants; `parameter`:
    field of `parameters`. Returns the conditions, shape (n,), and their derivatives, shape (n, n + 1), with one column
    for each unknown and the last for the parameter.
    """
    n = len(unknowns)
    step = 1e-40
    shifted = unknowns[:, None] + 1j * step * np.eye(n, n + 1)
    parameter_values = np.full(n + 1, complex(getattr(parameters, parameter)))
    parameter_values[n] += 1j * step
    values = PeriodicMotion(kind, shifted, parameters._replace(**{parameter: parameter_values})).conditions()
    return values[:, 0].real, values.imag / step
