"""Admissibility of orbits: their distance to the borders beyond which they are impossible as motions.

A solution of the orbit equations is a motion only if no other event occurs between its events: dampers in flight do
not reach the walls, and riding dampers remain pressed on theirs. The distance to each border is the margin. It is
negative beyond the border and smooth across it, so that borders can be located as roots.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array
from rig.numerics.jit import stored
from rig.orbits.orbit_equations import (
    CEILING,
    CEILING_BOUNCE,
    FLOOR,
    FLOOR_BOUNCE,
    FLYING,
    FORCELESS,
    ON_FLOOR,
    PRESS_CEILING,
    PRESS_FLOOR,
    RELEASE,
    RIDES_CEILING,
    RIDES_FLOOR,
    SEPARATION,
    WITH_LAST,
    Equations,
    Sequence,
)
from rig.orbits.shooting import Shot
from rig.orbits.track import Track, follow, turning

# In radians of the drive; for a shorter flight the peak acceleration is within 1e-5 of 1 g.
SHORTEST_FLIGHT = 0.02

# Borders: of events, and of dampers.
ORDER, LET_GO, MISS, FLIGHT_ENDS, HITS_FLOOR, HITS_CEILING, LEAVES, STAYS, KICKED = range(9)
KINDS_OF_BORDERS = 9


@stored
def _dip(track: Track, s: int, j: int, offset: float, sign: float, first: int = 0) -> float:
    """Return the lowest turning point of offset + sign times a guard in a stretch from a point on, or infinity."""
    guard = track.guards[s, :, j]
    step = track.times[s, 1] - track.times[s, 0]
    low = np.inf
    for i in range(first, guard.shape[0] - 1):
        if sign * guard[i, 1] < 0.0 and sign * guard[i + 1, 1] > 0.0:
            slopes = sign * guard[i : i + 2, 1].copy()
            bends = sign * guard[i : i + 2, 2].copy()
            left, right = offset + sign * guard[i, 0], offset + sign * guard[i + 1, 0]
            low = min(low, turning(left, right, slopes, bends, step))
    return low


@stored
def _push(equations: Equations, j: int, ceiling: bool, overlap: float, closing: float) -> float:
    """Return the contact force [N] from overlap and closing speed, or its rate from their rates."""
    wall = 1 if ceiling else 0
    return equations.stiffness[j, wall] * overlap + equations.damping[j, wall] * closing


@stored
def _decided(
    equations: Equations, sequence: Sequence, track: Track, e: int, closing: float, pull: float
) -> float:
    """Return the rate at which a finite-duration contact crosses its event: speed in g/w, or force slope in g w."""
    kind, j, omega = sequence.kind[e], sequence.damper[e], equations.omega
    before = track.guards[e - 1, -1, j]
    if kind == RELEASE:
        return min(1.0, -before[1] / (pull * omega))
    if kind in (PRESS_FLOOR, PRESS_CEILING):
        into = -1.0 if kind == PRESS_FLOOR else 1.0
        rising = _push(equations, j, kind == PRESS_CEILING, into * before[1], into * before[2])
        return min(1.0, rising / (equations.mass[j] * pull * omega))
    return min(1.0, closing * omega / pull)


@stored
def _lasting_margins(
    equations: Equations, sequence: Sequence, track: Track, j: int, size: float, found: Array
) -> None:
    """Compute the margins of a damper with finite-duration contact: pressed, free, or overlapping without force.

    A released bed that still overlaps a wall must not be pressed before it leaves the wall, which is not an event.
    The initial contact of a stretch follows from the previous stretch; for the first stretch, only after one full
    orbit.
    """
    events, pull = sequence.kind.shape[0], size * equations.omega**2
    clearance = equations.clearance[j]
    within = 0
    for visit in range(2 * track.times.shape[0]):
        turn, s = visit // track.times.shape[0], visit % track.times.shape[0]
        k, after = (s + 1, (s + 1) % events) if events > 0 else (0, 0)
        wall, guard = sequence.wall[k, j], track.guards[s, :, j]
        own_begin = events > 0 and sequence.damper[s] == j
        own_end = events > 0 and sequence.damper[after] == j
        if wall >= ON_FLOOR:
            low = _dip(track, s, j, 0.0, 1.0)
            if not own_begin:
                low = min(low, guard[0, 0])
            if not own_end:
                low = min(low, guard[-1, 0])
            if turn == 1:
                found[LEAVES, j] = min(found[LEAVES, j], low / pull)
            continue
        if own_begin:
            within = sequence.wall[s, j]
        first, most, law, risen = 0, -np.inf, np.inf, False
        while within != 0 and first < guard.shape[0]:
            into, height = (-1.0, 0.0) if within == ON_FLOOR else (1.0, clearance)
            overlap, closing = into * (guard[first, 0] - height), into * guard[first, 1]
            if overlap <= 0.0 and first > 0:
                within = 0
                break
            force = _push(equations, j, within != ON_FLOOR, overlap, closing)
            if risen and force < law:
                most = max(most, law / equations.mass[j])
            risen, law = force > law, force
            first += 1
        if turn == 0:
            continue
        found[STAYS, j] = min(found[STAYS, j], -most / pull)
        low, high = np.inf, np.inf
        if first < guard.shape[0]:
            low = _dip(track, s, j, 0.0, 1.0, first)
            high = _dip(track, s, j, clearance, -1.0, first) if np.isfinite(clearance) else np.inf
            if not own_begin and first == 0:
                low, high = min(low, guard[0, 0]), min(high, clearance - guard[0, 0])
        found[HITS_FLOOR, j] = min(found[HITS_FLOOR, j], low / size)
        found[HITS_CEILING, j] = min(found[HITS_CEILING, j], high / size)


@stored
def margins(equations: Equations, sequence: Sequence, track: Track, instants: Array, closing: Array) -> Array:
    """Compute the margin of an orbit at each border beyond which it is impossible as a motion.

    Returns shape (kinds of borders, max(events, dampers)), gaps in g/w^2, accelerations in g, times in 1/w; at most
    1, negative beyond the border. The second index is an event for the kinds ORDER, LET_GO and MISS, else a damper.
    """
    omega, gravity = equations.omega, equations.gravity
    size = gravity / omega**2 if gravity > 0.0 else np.abs(track.reach).max()
    pull = size * omega**2
    events, nd, nq = sequence.kind.shape[0], equations.position.shape[0], equations.inverse_mass.shape[1]
    found = np.ones((KINDS_OF_BORDERS, max(events, nd, 1)))
    for s in range(track.times.shape[0]):
        k = s + 1 if events > 0 else 0
        after = (s + 1) % max(events, 1)
        if events > 0 and sequence.kind[after] != WITH_LAST:
            found[ORDER, s] = min(1.0, (track.times[s, -1] - track.times[s, 0]) * omega)
        for j in range(nd):
            own_begin = events > 0 and sequence.damper[s] == j
            own_end = events > 0 and sequence.damper[after] == j
            wall, guard = sequence.wall[k, j], track.guards[s, :, j]
            if wall >= FORCELESS:
                continue
            if wall == FLYING:
                low = _dip(track, s, j, 0.0, 1.0)
                if not own_begin:
                    low = min(low, guard[0, 0])
                found[HITS_FLOOR, j] = min(found[HITS_FLOOR, j], low / size)
                clearance = equations.clearance[j]
                if np.isfinite(clearance):
                    low = _dip(track, s, j, clearance, -1.0)
                    if not own_begin:
                        low = min(low, clearance - guard[0, 0])
                    found[HITS_CEILING, j] = min(found[HITS_CEILING, j], low / size)
                continue
            sign = 1.0 if wall == RIDES_FLOOR else -1.0
            low = _dip(track, s, j, 0.0, sign)
            low = min(low, sign * guard[0, 0])
            if not own_end:
                low = min(low, sign * guard[-1, 0])
            found[LEAVES, j] = min(found[LEAVES, j], low / pull)
    for e in range(events):
        kind, j = sequence.kind[e], sequence.damper[e]
        if equations.bed[j] >= 0:
            found[MISS if kind != RELEASE else LET_GO, e] = _decided(
                equations, sequence, track, e, closing[e], pull
            )
            continue
        leaves = kind in (SEPARATION, WITH_LAST)
        ceiling = kind in (CEILING, CEILING_BOUNCE) or (leaves and sequence.wall[e, j] == RIDES_CEILING)
        bounces = kind in (CEILING_BOUNCE, FLOOR_BOUNCE)
        away = -1.0 if ceiling else 1.0
        if kind == WITH_LAST or (bounces and equations.restitution[j] == 0.0):
            # The gap's curvature right after the event must lead away from the wall.
            found[STAYS, j] = min(found[STAYS, j], away * track.guards[e, 0, j, 2] / pull)
        if kind == SEPARATION:
            found[LET_GO, e] = min(1.0, -away * track.guards[e - 1, -1, j, 1] / (pull * omega))
        elif kind != WITH_LAST:
            found[MISS, e] = min(1.0, closing[e] * omega / pull)
            # With a full mass matrix, an impact presses riding dampers on their walls or throws them from the walls.
            for i in range(nd):
                body = equations.position[i]
                coupling = equations.inverse_mass[sequence.slot[e], body, equations.position[j]]
                if i != j and sequence.wall[e, i] in (RIDES_FLOOR, RIDES_CEILING) and coupling != 0.0:
                    kick = track.motion[e, 0, nq + body] - track.motion[e - 1, -1, nq + body]
                    sign = 1.0 if sequence.wall[e, i] == RIDES_FLOOR else -1.0
                    found[KICKED, i] = min(found[KICKED, i], sign * kick * omega / pull)
        if leaves:
            # At zero flight time the equations are singular, so a curve ends before.
            landing = (e + 1) % events
            while sequence.damper[landing] != j:
                landing = (landing + 1) % events
            length = instants[landing] - instants[e] + (equations.period if landing <= e else 0.0)
            if sequence.kind[landing] == (CEILING if ceiling else FLOOR):
                found[FLIGHT_ENDS, j] = min(found[FLIGHT_ENDS, j], length * omega - SHORTEST_FLIGHT)
    for j in range(nd):
        if equations.bed[j] >= 0:
            _lasting_margins(equations, sequence, track, j, size, found)
    return found


@stored
def survey(
    equations: Equations, sequence: Sequence, shot: Shot, instants: Array
) -> tuple[Array, NDArray[np.complex128], Array]:
    """Track a converged orbit; return `reach` and `harmonic` as in `Track`, and the flattened `margins`."""
    track = follow(equations, sequence, instants, shot.states)
    return track.reach, track.harmonic, margins(equations, sequence, track, instants, shot.closing).ravel()
