"""Periodic motions of one mode with a damper: Types I, II and III as conditions over one period.

Everything is dimensionless: time is tau = w t, length is g/w^2, so that free fall is y'' = -1. With r = w/w_i
the mode's coordinate q moves by

    flight   q'' + 2 (zeta/r) q' + q/r^2 = a sin(tau) + b cos(tau)            and  y'' = -1
    riding   (1 + mu) q'' + 2 (zeta/r) q' + q/r^2 = a sin(tau) + b cos(tau) - mu

where a riding damper is at y = q (floor) or y = q + D (ceiling).

A period begins at tau = 0, just after the impact on the floor, in riding. The damper leaves the floor at
tau_0, where the contact force mu (q'' + 1) has fallen to 0 (so q'' = -1); Type I then falls back to the floor
at 2 pi. In Types II and III it hits the ceiling at tau_1; in Type II it leaves it at once with the common
velocity; in Type III it rides the ceiling until its contact force there has fallen to 0 (q'' = -1 again) at
tau_2. All impacts are perfectly plastic.

The force is F sin(tau - phi): a = F cos(phi), b = -F sin(phi). For given instants every condition but a^2 +
b^2 = F^2 and the ceiling's height is linear in (q_0, q'_0, a, b), which is what
`rig.single_mode.approximate_response` uses to find all solutions; and each condition is analytic in every unknown and
parameter, so that a complex step gives exact derivatives.

In the paper: flight is Eq. 8 for the mode and Eqs 10 and 11 for the damper, riding Eq. 9; the conditions are Eqs
14-17, which it reduces to three transcendental equations in the instants (18-20) and a linear one (21). Here they
stay as they are, because the reduced ones hold for Type II alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

MotionType = Literal["I", "II", "III"]
# How many instants a type has besides the floor impact: tau_0, then tau_1, then tau_2.
INSTANTS: dict[MotionType, int] = {"I": 1, "II": 2, "III": 3}

TURN = 2 * np.pi
# Complex or real, of any common shape: the equations are evaluated on whole batches at once.
Array = NDArray[Any]


class MotionParameters(NamedTuple):
    """The dimensionless parameters of a motion."""

    ratio: Any
    """r, driving frequency over the mode's own."""
    damping: Any
    """zeta, damping ratio of the mode."""
    mass_ratio: Any  # mu
    force: Any  # F = phi_k f / (M g)
    height: Any
    """Clearance in lengths of g/w_i^2 (the mode's own frequency, so that it does not change with r)."""


class ModeState(NamedTuple):
    """Coordinate q, its velocity u, and the damper's position y and velocity v."""

    q: Array
    u: Array
    y: Array
    v: Array


@dataclass(frozen=True)
class MotionPhase:
    """A stretch of motion between two events: how long, how it starts, and whether the damper rides."""

    riding: bool
    """Whether the damper's mass moves with the mode."""
    begin: Array
    length: Array
    """Start and duration in tau."""
    start: ModeState
    """At its begin, after the impact there if one happens."""
    offset: Any
    """Height of the damper over the floor while riding (0 or the clearance)."""


class PeriodicMotion:
    """The motion that a set of unknowns stands for, whether or not it satisfies the conditions.

    Parameters
    ----------
    kind : {'I', 'II', 'III'}
        Motion type.
    unknowns : array, shape (4 + instants, ...), or so many arrays
        q_0, q'_0, a, b and the instants; they broadcast against each other.
    setting : MotionParameters
        Parameters; broadcast against unknowns[0].
    """

    def __init__(
        self, kind: MotionType, unknowns: Array | Sequence[Array], setting: MotionParameters
    ) -> None:
        self.kind = kind
        self.setting = setting
        q, u, self.a, self.b = (np.asarray(each) for each in unknowns[:4])
        self.instants = unknowns[4:]
        leave = self.instants[0]
        floor = MotionPhase(True, np.zeros_like(leave), leave, ModeState(q, u, q, u), 0.0)
        up = self._follow(floor, riding=False)
        self.phases = [floor, up]
        if kind != "I":
            hit = self.instants[1]
            self.phases[-1] = self._until(up, hit)
            self.before_ceiling = self.advance(self.phases[-1], self.phases[-1].length)
            common = self.common_velocity(self.before_ceiling)
            top = self.before_ceiling._replace(u=common, v=common)
            if kind == "III":
                top = top._replace(y=top.q + self.height)
                self.phases.append(MotionPhase(True, hit, self.instants[2] - hit, top, self.height))
                self.phases.append(self._follow(self.phases[-1], riding=False))
            else:
                self.phases.append(MotionPhase(False, hit, TURN - hit, top, 0.0))
        self.landing = self.advance(self.phases[-1], self.phases[-1].length)

    def _follow(self, phase: MotionPhase, riding: bool) -> MotionPhase:
        """Return the phase that starts where one ends, without impact, and lasts to the period's end."""
        begin = phase.begin + phase.length
        return MotionPhase(riding, begin, TURN - begin, self.advance(phase, phase.length), 0.0)

    @property
    def height(self) -> Array:
        """Clearance in lengths of g/w^2."""
        return np.asarray(self.setting.height * self.setting.ratio**2)

    @staticmethod
    def _until(phase: MotionPhase, end: Array) -> MotionPhase:
        return MotionPhase(phase.riding, phase.begin, end - phase.begin, phase.start, phase.offset)

    def common_velocity(self, state: ModeState) -> Array:
        """Velocity after a plastic impact."""
        mu = self.setting.mass_ratio
        return (state.u + mu * state.v) / (1 + mu)

    def _oscillator(self, phase: MotionPhase) -> tuple[Any, Any, Any]:
        """Inertia, decay rate and stiffness over inertia in a phase."""
        r, zeta, mu = self.setting.ratio, self.setting.damping, self.setting.mass_ratio
        inertia = 1 + mu if phase.riding else 1.0
        return inertia, zeta / (r * inertia), 1 / (r * r * inertia)

    def homogeneous(self, phase: MotionPhase, t: Array) -> tuple[Array, Array, Array, Array]:
        """Responses after a time `t`: q to unit q and to unit q', then q' to unit q and to unit q'."""
        inertia, decay, stiffness = self._oscillator(phase)
        # The root of stiffness - decay**2, whose difference may round to zero near critical damping.
        s = np.sqrt(inertia - self.setting.damping**2) / (self.setting.ratio * inertia)
        fading = np.exp(-decay * t)
        c, si = fading * np.cos(s * t), fading * np.sin(s * t) / s
        return c + decay * si, si, -stiffness * si, c - decay * si

    def advance(self, phase: MotionPhase, t: Array) -> ModeState:
        """State a time `t` after a phase's begin (closed form)."""
        inertia, decay, stiffness = self._oscillator(phase)
        q_q, q_u, u_q, u_u = self.homogeneous(phase, t)
        # Responses from rest to cos(t) and sin(t), by taking the homogeneous part off the steady one. The paper keeps
        # the steady part (A_p and beta) as it is; it is singular at resonance without damping, and so is this.
        d_r, d_i = stiffness - 1, 2 * decay
        size = inertia * (d_r**2 + d_i**2)
        nc, ns = np.cos(t) - q_q, np.sin(t) - q_u
        mc, ms = -np.sin(t) - u_q, np.cos(t) - u_u
        q_c, q_s = (nc * d_r + ns * d_i) / size, (ns * d_r - nc * d_i) / size
        u_c, u_s = (mc * d_r + ms * d_i) / size, (ms * d_r - mc * d_i) / size
        sin_part, cos_part = self._local_force(phase.begin)
        q0, u0, y0, v0 = phase.start
        q = q_q * q0 + q_u * u0 + q_c * cos_part + q_s * sin_part
        u = u_q * q0 + u_u * u0 + u_c * cos_part + u_s * sin_part
        if phase.riding:
            # The riding mass adds its weight, the constant -gamma_i of Eq. 9.
            weight = -self.setting.mass_ratio / inertia
            q = q + weight * (1 - q_q) / stiffness
            u = u + weight * q_u
            return ModeState(q, u, q + phase.offset, u)
        return ModeState(q, u, y0 + v0 * t - t * t / 2, v0 - t)

    def acceleration(self, phase: MotionPhase, t: Array, state: ModeState) -> Array:
        """Second derivative of q in a phase, a time `t` after its begin."""
        r, zeta, mu = self.setting.ratio, self.setting.damping, self.setting.mass_ratio
        sin_part, cos_part = self._local_force(phase.begin)
        force = sin_part * np.sin(t) + cos_part * np.cos(t) - 2 * zeta / r * state.u - state.q / r**2
        return (force - mu) / (1 + mu) if phase.riding else force

    def jerk(self, phase: MotionPhase, t: Array, state: ModeState) -> Array:
        """Third derivative of q in a phase, a time `t` after its begin."""
        r, zeta, mu = self.setting.ratio, self.setting.damping, self.setting.mass_ratio
        sin_part, cos_part = self._local_force(phase.begin)
        acceleration = self.acceleration(phase, t, state)
        force = sin_part * np.cos(t) - cos_part * np.sin(t) - 2 * zeta / r * acceleration - state.u / r**2
        return force / (1 + mu) if phase.riding else force

    def _local_force(self, begin: Array) -> tuple[Array, Array]:
        """Sine and cosine parts of the force for time counted from `begin`."""
        c, s = np.cos(begin), np.sin(begin)
        return self.a * c - self.b * s, self.a * s + self.b * c

    def affine_conditions(self) -> Array:
        """Conditions that are affine in (q_0, q'_0, a, b): shape (4 or 5, ...).

        Periodicity of q; of the velocity, through the floor impact; no contact force at take-off; damper on
        the floor at 2 pi; and for Type III no contact force at the end of the stay at the ceiling.
        """
        floor, up = self.phases[0], self.phases[1]
        found = [
            self.landing.q - floor.start.q,  # Eqs 14 and 17: rho_c1 at both ends of the period
            self.common_velocity(self.landing) - floor.start.u,  # Eq. 14: u_c1 from u_b1 and v_b1
            # Separation: Eq. 15 takes over position and velocity; that it happens here needs the force to vanish.
            self.acceleration(up, np.zeros_like(up.length), up.start) + 1,
            self.landing.y - self.landing.q,  # Eq. 17: both at rho_c1
        ]
        if self.kind == "III":
            down = self.phases[-1]
            found.append(self.acceleration(down, np.zeros_like(down.length), down.start) + 1)
        return np.array(found)

    def ceiling_gap(self) -> Array:
        """Gap when the ceiling is hit (Types II and III)."""
        return self.before_ceiling.y - self.before_ceiling.q

    def conditions(self) -> Array:
        """All conditions, shape (4 + instants, ...): the motion is periodic where they vanish."""
        found = list(self.affine_conditions())
        if self.kind != "I":
            found.append(self.ceiling_gap() - self.height)  # Eq. 16: the damper is d_j above the body
        # The force condition is divided by F, which keeps its size like the others'.
        force = self.setting.force
        found.append((self.a**2 + self.b**2) / force - force)
        return np.array(found)


def jacobian(
    kind: MotionType, unknowns: Array, setting: MotionParameters, parameter: str
) -> tuple[Array, Array]:
    """Conditions and their exact derivatives with respect to the unknowns and one parameter of the setting.

    Parameters
    ----------
    kind : {'I', 'II', 'III'}
        Motion type.
    unknowns : ndarray, shape (n,)
        q_0, q'_0, a, b and the instants.
    parameter : str
        The field of `setting` to differentiate by.

    Returns
    -------
    conditions : ndarray, shape (n,)
    derivatives : ndarray, shape (n, n + 1)
        Columns: the unknowns, then the parameter.

    Notes
    -----
    A complex step: Im f(x + i h)/h has no cancellation, so h can be so small that the derivative is exact to
    rounding.
    """
    n = len(unknowns)
    step = 1e-40
    shifted = unknowns[:, None] + 1j * step * np.eye(n, n + 1)
    at = np.full(n + 1, complex(getattr(setting, parameter)))
    at[n] += 1j * step
    values = PeriodicMotion(kind, shifted, setting._replace(**{parameter: at})).conditions()
    return values[:, 0].real, values.imag / step
