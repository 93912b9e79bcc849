"""Admissibility and stability of the periodic motions of one mode, and their harmonics and extremes.

A solution of the periodicity conditions is admissible if no further contact event occurs between its events. It is
stable if its Floquet multipliers are inside the unit circle. Quantities are dimensionless, as in
`rig.studies.single_mode.periodic_motion`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.studies.single_mode.periodic_motion import (
    PERIOD,
    ModeState,
    MotionParameters,
    MotionPhase,
    MotionType,
    PeriodicMotion,
)

# A gap in units of g/w^2, or an acceleration in g, may be a rounding error of zero up to this value.
MAX_ROUNDING_ERROR = 1e-9
# Number of samples of a phase in addition to those of its cycles; a phase may be shorter than a cycle.
_MIN_SAMPLES = 48
# Number of samples per cycle of the faster oscillation: slopes of opposite sign then enclose each extremum.
_SAMPLES_PER_CYCLE = 24
# Quadrature nodes of a phase, and of each cycle in it. The integrand is analytic, so the error of the quadrature
# decreases exponentially with their number.
_MIN_NODES = 32
_NODES_PER_CYCLE = 8


@dataclass(frozen=True)
class Batch:
    """Solutions of one type of motion, evaluated together in arrays."""

    kind: MotionType  # 'I', 'II' or 'III'
    unknowns: Array  # shape (4 + instants, solutions)
    parameters: MotionParameters  # Fields of shape (solutions,)

    @property
    def motion(self) -> PeriodicMotion:
        """Motions of all solutions of the batch, in arrays."""
        return PeriodicMotion(self.kind, self.unknowns, self.parameters)

    def select(self, indices: NDArray[np.int64]) -> PeriodicMotion:
        """Return the motions of selected solutions; indices may repeat."""
        return PeriodicMotion(
            self.kind, self.unknowns[:, indices], MotionParameters(*(field[indices] for field in self.parameters))
        )


# motion, phase, time after the start of the phase -> value and rate of a quantity
Quantity = Callable[[PeriodicMotion, MotionPhase, Array], tuple[Array, Array]]


def _gap(motion: PeriodicMotion, phase: MotionPhase, t: Array) -> tuple[Array, Array]:
    """Return the gap between damper and floor, and its rate."""
    state = motion.advance(phase, t)
    return state.y - state.q, state.v - state.u


def _coordinate(motion: PeriodicMotion, phase: MotionPhase, t: Array) -> tuple[Array, Array]:
    """Return the modal coordinate, and its rate."""
    state = motion.advance(phase, t)
    return state.q, state.u


def _contact_force(motion: PeriodicMotion, phase: MotionPhase, t: Array) -> tuple[Array, Array]:
    """Return the contact force over the weight of the damper, q'' + 1, and its rate; it is negative at the ceiling."""
    state = motion.advance(phase, t)
    return motion.acceleration(phase, t, state) + 1, motion.jerk(phase, t, state)


def extremes(batch: Batch, index: int, quantity: Quantity) -> tuple[Array, Array]:
    """Compute the smallest and largest value of a quantity in a phase, shape (solutions,) each.

    The quantity is sampled densely; extrema between samples are located by bisection of its derivative.
    """
    motion = batch.motion
    phase = motion.phases[index]
    samples = _MIN_SAMPLES + int(_SAMPLES_PER_CYCLE * max(1.0, float(np.max(1 / batch.parameters.ratio))))
    t = np.linspace(0.0, 1.0, samples)[:, None] * phase.duration
    value, slope = quantity(motion, phase, t)
    low, high = value.min(axis=0), value.max(axis=0)
    row, column = np.nonzero(slope[:-1] * slope[1:] < 0)
    if row.size:
        selected = batch.select(column)
        selected_phase = selected.phases[index]
        left, right = t[row, column], t[row + 1, column]
        is_maximum = slope[row, column] > 0
        # 48 halvings reduce an interval to 4e-15 of its length: rounding.
        for _ in range(48):
            middle = 0.5 * (left + right)
            is_before_extremum = (quantity(selected, selected_phase, middle)[1] > 0) == is_maximum
            left, right = (np.where(is_before_extremum, middle, left), np.where(is_before_extremum, right, middle))
        extremum = quantity(selected, selected_phase, left)[0]
        np.minimum.at(low, column, extremum)
        np.maximum.at(high, column, extremum)
    return low, high


def flaws(batch: Batch) -> NDArray[np.str_]:
    """Return the first violation in each solution that makes it inadmissible, or ""; shape (solutions,)."""
    kind, motion = batch.kind, batch.motion
    reasons = np.full(batch.unknowns.shape[1], "", dtype="U32")

    def record_flaw(is_violated: Any, reason: str) -> None:
        reasons[(reasons == "") & is_violated] = reason

    instants = np.concatenate([np.zeros((1, reasons.size)), motion.instants, np.full((1, reasons.size), PERIOD)])
    record_flaw((np.diff(instants, axis=0) <= 0).any(axis=0), "events out of order")
    record_flaw(extremes(batch, 0, _contact_force)[0] < -MAX_ROUNDING_ERROR, "leaves the floor early")
    record_flaw(_initial_jerk(motion, 1) > MAX_ROUNDING_ERROR, "does not leave the floor")
    low, high = extremes(batch, 1, _gap)
    record_flaw(low < -MAX_ROUNDING_ERROR, "hits the floor early")
    record_flaw(high > motion.clearance + MAX_ROUNDING_ERROR, "hits the ceiling early")
    if kind != "I":
        last_flight = motion.phases[-1]
        if kind == "II":
            acceleration = motion.acceleration(
                last_flight, np.zeros_like(last_flight.duration), last_flight.initial_state
            )
            record_flaw(acceleration < -1 - MAX_ROUNDING_ERROR, "stays at the ceiling")
        else:
            record_flaw(extremes(batch, 2, _contact_force)[1] > MAX_ROUNDING_ERROR, "leaves the ceiling early")
            record_flaw(_initial_jerk(motion, 3) < -MAX_ROUNDING_ERROR, "does not leave the ceiling")
        low, high = extremes(batch, len(motion.phases) - 1, _gap)
        record_flaw(low < -MAX_ROUNDING_ERROR, "hits the floor early")
        record_flaw(high > motion.clearance + MAX_ROUNDING_ERROR, "hits the ceiling again")
    return reasons


def _initial_jerk(motion: PeriodicMotion, index: int) -> Array:
    """Return the third derivative of the modal coordinate at the start of a phase."""
    phase = motion.phases[index]
    return motion.jerk(phase, np.zeros_like(phase.duration), phase.initial_state)


def first_harmonic(batch: Batch) -> NDArray[np.complex128]:
    """Compute the first harmonic Q of the coordinate, q = Re(Q exp(i tau)) + ..., shape (solutions,).

    Each phase is integrated by Gauss-Legendre quadrature with enough nodes for rounding accuracy.
    """
    motion = batch.motion
    fastest = max(1.0, float(np.max(1 / batch.parameters.ratio)))
    nodes, weights = np.polynomial.legendre.leggauss(_MIN_NODES + int(_NODES_PER_CYCLE * fastest))
    total = np.zeros(batch.unknowns.shape[1], dtype=np.complex128)
    for phase in motion.phases:
        t = 0.5 * (nodes[:, None] + 1) * phase.duration
        rotated = motion.advance(phase, t).q * np.exp(-1j * (phase.start_time + t))
        total += 0.5 * phase.duration * (weights @ rotated)
    return np.asarray(total / np.pi, dtype=np.complex128)


def peak_to_peak(batch: Batch) -> Array:
    """Compute the peak-to-peak value of the coordinate over the period, shape (solutions,)."""
    pairs = [extremes(batch, index, _coordinate) for index in range(len(batch.motion.phases))]
    return np.max([high for _, high in pairs], axis=0) - np.min([low for low, _ in pairs], axis=0)


def multipliers(batch: Batch) -> NDArray[np.complex128]:
    """Compute the Floquet multipliers of the map from floor impact to floor impact, shape (2, solutions).

    The state after the impact is (q, q'), because the damper is at rest on the floor. Between events, perturbations
    follow the free response. At an impact they are multiplied by the saltation matrix
    R + (f_after - R f_before) n^T / (n^T f_before), with the rates f of the state, the linear map R of the impact and
    the gradient n of the gap. The rates are continuous at take-off, so the saltation matrix of a take-off is the
    identity.
    """
    motion = batch.motion
    count = batch.unknowns.shape[1]
    monodromy = np.broadcast_to(np.eye(2), (count, 2, 2))
    for index, phase in enumerate(motion.phases):
        flow = np.moveaxis(np.array(motion.homogeneous(phase, phase.duration)), 0, -1).reshape(-1, 2, 2)
        if phase.riding:
            monodromy = flow @ monodromy
            continue
        if monodromy.shape[1] == 2:
            monodromy = np.concatenate([monodromy, monodromy], axis=1)
        flight_flow = np.zeros((count, 4, 4))
        flight_flow[:, :2, :2] = flow
        flight_flow[:, 2:, 2:] = np.eye(2)
        flight_flow[:, 2, 3] = phase.duration
        after = motion.phases[(index + 1) % len(motion.phases)]
        end = motion.advance(phase, phase.duration)
        monodromy = _saltation(motion, phase, end, after) @ flight_flow @ monodromy
    return np.asarray(np.linalg.eigvals(monodromy).T, dtype=np.complex128)


def _saltation(motion: PeriodicMotion, before: MotionPhase, end: ModeState, after: MotionPhase) -> Array:
    """Return the saltation matrix of an impact; (solutions, 4, 4), or (solutions, 2, 4) if a riding phase follows."""
    mu = motion.parameters.mass_ratio
    mass_fraction, ones, zeros = mu / (1 + mu), np.ones_like(end.q), np.zeros_like(end.q)
    # Rows of the reset map on (q, u, y, v): positions are continuous, and both velocities become the common velocity.
    q_row, y_row = [ones, zeros, zeros, zeros], [zeros, zeros, ones, zeros]
    velocity_row = [zeros, ones - mass_fraction, zeros, mass_fraction]
    rows = [q_row, velocity_row] if after.riding else [q_row, velocity_row, y_row, velocity_row]
    reset = np.moveaxis(np.array(rows), -1, 0)
    velocity = after.initial_state.u
    acceleration = motion.acceleration(after, np.zeros_like(after.duration), after.initial_state)
    rate_before = np.array([end.u, motion.acceleration(before, before.duration, end), end.v, -ones]).T
    rate_after = np.array([velocity, acceleration] + ([] if after.riding else [velocity, -ones])).T
    normal = np.array([-1.0, 0.0, 1.0, 0.0])
    rate_jump = rate_after - np.einsum("nij,nj->ni", reset, rate_before)
    return reset + rate_jump[:, :, None] * normal / (rate_before @ normal)[:, None, None]
