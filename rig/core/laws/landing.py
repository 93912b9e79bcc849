"""Impact on a wall with spring and dashpot, without adhesion: stiffness and damping from duration and restitution.

A damper's bed is its particles, modeled as one mass. A bed of mass m_d hits a wall of a body of mass m_b at the
relative speed v; no other force acts on either. The wall has the stiffness k and the damping c. With the reduced mass
m = m_d m_b / (m_d + m_b), omega^2 = k / m and the damping ratio zeta = c / (2 m omega), the wall's force is

    F(t) = m v omega exp(-zeta omega t) sin(omega_d t + 2 b) / cos b,   sin b = zeta,  omega_d = omega cos b

(hyperbolic functions above critical damping). The force jumps to c v at first contact, and returns to zero after

    T = 2 acos(zeta) / (omega sqrt(1 - zeta^2)),     for zeta > 1 with acosh(zeta) and sqrt(zeta^2 - 1),

while the wall is still compressed. At this instant the bed separates. The coefficient of restitution, the ratio of
rebound speed to closing speed, is exp(-zeta omega T).

References
----------
Schwager, T., Poeschel, T., "Coefficient of restitution and linear-dashpot model revisited", Granular Matter 9 (2007)
465-469, Eqs 15-22.
"""

import math

from rig.core.base.roots import bracketed_root

#: Time constant c / k of a wall of restitution 0, s; at least the contact duration is used. After the separation, the
#: compression of the wall decays with this time constant. A contact without adhesion cannot reach restitution 0
#: exactly, because its dashpot would be infinitely strong. With 5 ms the restitution is 5 % for a contact of 2 ms, and
#: 0.15 % for 0.1 ms.
RECOVERY_TIME_S = 5e-3


def _half_phase(zeta: float) -> float:
    """Return omega T / 2 of a contact: acos(zeta) / sqrt(1 - zeta^2), or its hyperbolic form."""
    if zeta == 1.0:
        return 1.0
    root = math.sqrt(abs((1.0 - zeta) * (1.0 + zeta)))
    return (math.acos(zeta) if zeta < 1.0 else math.acosh(zeta)) / root


def damping_ratio(duration: float, restitution: float) -> float:
    """Return the damping ratio of the contact with a duration [s] and a restitution.

    >>> damping_ratio(2e-3, 1.0), round(damping_ratio(2e-3, math.exp(-2.0)), 12), damping_ratio(RECOVERY_TIME_S, 0.0)
    (0.0, 1.0, 1.0)
    """
    if restitution == 0.0:
        # With z for zeta, c / k = 2 z / omega tends to 2 z T / pi for small z and to z^2 T / log(2 z) for large z.
        target = max(RECOVERY_TIME_S / duration, 1.0)
        return bracketed_root(lambda z: z / _half_phase(z) - target, 0.5, 2.0 * target, 1e-15)
    target = -math.log(restitution)
    # zeta omega T tends to z pi for small z and to 2 log(2 z) for large z.
    return bracketed_root(lambda z: 2.0 * z * _half_phase(z) - target, 0.0, 1.0 + math.exp(0.5 * target), 1e-15)


def dashpot(stiffness: float, restitution: float, mass: float) -> float:
    """Return the damping [N s/m] of a wall with a stiffness [N/m], for a restitution above 0 and a reduced mass [kg].

    >>> damping = dashpot(stiffness=1e5, restitution=0.3, mass=0.04)
    >>> round(duration_and_restitution(1e5, damping, mass=0.04)[1], 12)
    0.3
    """
    zeta = damping_ratio(math.inf, restitution)  # the result depends on the duration only for restitution 0
    return 2.0 * zeta * math.sqrt(stiffness * mass)


def spring_damper(duration: float, restitution: float, mass: float) -> tuple[float, float]:
    """Return stiffness [N/m] and damping [N s/m] of the contact with a duration and a restitution.

    `duration`: from first contact to separation if no other force acts [s]; `restitution`: ratio of rebound speed to
    closing speed; 0 gives the lowest restitution that is possible with `RECOVERY_TIME_S`; `mass`: reduced mass of
    damper and body [kg].

    >>> stiffness, damping = spring_damper(duration=2e-3, restitution=0.3, mass=0.04)
    >>> [round(value, 9) for value in duration_and_restitution(stiffness, damping, mass=0.04)]
    [0.002, 0.3]
    """
    zeta = damping_ratio(duration, restitution)
    angular_frequency = 2.0 * _half_phase(zeta) / duration
    return mass * angular_frequency**2, 2.0 * zeta * angular_frequency * mass


def duration_and_restitution(stiffness: float, damping: float, mass: float) -> tuple[float, float]:
    """Return duration [s] and restitution of a contact; the inverse of `spring_damper`.

    `stiffness`: N/m; `damping`: N s/m; `mass`: reduced mass of damper and body [kg].
    """
    angular_frequency = math.sqrt(stiffness / mass)
    zeta = damping / (2.0 * mass * angular_frequency)
    duration = 2.0 * _half_phase(zeta) / angular_frequency
    return duration, math.exp(-zeta * angular_frequency * duration)
