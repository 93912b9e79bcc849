"""Admissibility and stability of periodic motions: contact conditions between events, and Floquet multipliers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array
from rig.single_mode.periodic_motion import (
    TURN,
    ModeState,
    MotionParameters,
    MotionPhase,
    MotionType,
    PeriodicMotion,
)

# Largest rounding error of a gap in units of g/w^2, and of an acceleration in g.
ROUNDING = 1e-9


@dataclass(frozen=True)
class Batch:
    """Solutions of one motion type, evaluated as a batch."""

    kind: MotionType  # Motion type; {'I', 'II', 'III'}
    unknowns: Array  # shape (4 + instants, solutions)
    setting: MotionParameters  # Fields of shape (solutions,)

    @property
    def motion(self) -> PeriodicMotion:
        """The motions, evaluated together."""
        return PeriodicMotion(self.kind, self.unknowns, self.setting)

    def take(self, which: NDArray[np.int64]) -> PeriodicMotion:
        """Return the motions of selected solutions; indices may repeat."""
        return PeriodicMotion(
            self.kind, self.unknowns[:, which], MotionParameters(*(f[which] for f in self.setting))
        )


Quantity = Callable[[PeriodicMotion, MotionPhase, Array], tuple[Array, Array]]


def _gap(motion: PeriodicMotion, phase: MotionPhase, t: Array) -> tuple[Array, Array]:
    state = motion.advance(phase, t)
    return state.y - state.q, state.v - state.u


def _coordinate(motion: PeriodicMotion, phase: MotionPhase, t: Array) -> tuple[Array, Array]:
    state = motion.advance(phase, t)
    return state.q, state.u


def _contact(motion: PeriodicMotion, phase: MotionPhase, t: Array) -> tuple[Array, Array]:
    """Contact force over mu, q'' + 1 (positive on the floor, negative at the ceiling), and its time derivative."""
    state = motion.advance(phase, t)
    return motion.acceleration(phase, t, state) + 1, motion.jerk(phase, t, state)


def extremes(batch: Batch, index: int, quantity: Quantity) -> tuple[Array, Array]:
    """Compute the smallest and largest value of a quantity in a phase, shape (solutions,) each.

    The quantity is sampled densely; extrema between samples are located by bisection of its derivative.
    """
    motion = batch.motion
    phase = motion.phases[index]
    # At least 24 samples per cycle of the faster oscillation.
    samples = 48 + int(24 * max(1.0, float(np.max(1 / batch.setting.ratio))))
    t = np.linspace(0.0, 1.0, samples)[:, None] * phase.length
    value, slope = quantity(motion, phase, t)
    low, high = value.min(axis=0), value.max(axis=0)
    row, which = np.nonzero(slope[:-1] * slope[1:] < 0)
    if row.size:
        part = batch.take(which)
        piece = part.phases[index]
        left, right = t[row, which], t[row + 1, which]
        rising = slope[row, which] > 0
        for _ in range(48):
            middle = 0.5 * (left + right)
            before = (quantity(part, piece, middle)[1] > 0) == rising
            left, right = np.where(before, middle, left), np.where(before, right, middle)
        turning = quantity(part, piece, left)[0]
        np.minimum.at(low, which, turning)
        np.maximum.at(high, which, turning)
    return low, high


def flaws(batch: Batch) -> NDArray[np.str_]:
    """Return the reason why each solution is inadmissible; "" if it is admissible.

    Returns shape (solutions,), the first violation in time order.
    """
    kind, motion = batch.kind, batch.motion
    found = np.full(batch.unknowns.shape[1], "", dtype="U32")

    def note(bad: Any, text: str) -> None:
        found[(found == "") & bad] = text

    instants = np.concatenate([np.zeros((1, found.size)), motion.instants, np.full((1, found.size), TURN)])
    note((np.diff(instants, axis=0) <= 0).any(axis=0), "events out of order")
    note(extremes(batch, 0, _contact)[0] < -ROUNDING, "leaves the floor early")
    note(_slope_at_start(motion, 1) > ROUNDING, "does not leave the floor")
    low, high = extremes(batch, 1, _gap)
    note(low < -ROUNDING, "hits the floor early")
    note(high > motion.height + ROUNDING, "hits the ceiling early")
    if kind != "I":
        down = motion.phases[-1]
        if kind == "II":
            start = motion.acceleration(down, np.zeros_like(down.length), down.start)
            note(start < -1 - ROUNDING, "stays at the ceiling")
        else:
            note(extremes(batch, 2, _contact)[1] > ROUNDING, "leaves the ceiling early")
            note(_slope_at_start(motion, 3) < -ROUNDING, "does not leave the ceiling")
        low, high = extremes(batch, len(motion.phases) - 1, _gap)
        note(low < -ROUNDING, "hits the floor early")
        note(high > motion.height + ROUNDING, "hits the ceiling again")
    return found


def _slope_at_start(motion: PeriodicMotion, index: int) -> Array:
    phase = motion.phases[index]
    return motion.jerk(phase, np.zeros_like(phase.length), phase.start)


def first_harmonic(batch: Batch) -> NDArray[np.complex128]:
    """Compute the first harmonic Q of the coordinate, q = Re(Q exp(i tau)) + ..., shape (solutions,).

    Each phase is integrated by Gauss-Legendre quadrature with enough nodes for rounding accuracy.
    """
    motion = batch.motion
    fastest = max(1.0, float(np.max(1 / batch.setting.ratio)))
    nodes, weights = np.polynomial.legendre.leggauss(32 + int(8 * fastest))
    total = np.zeros(batch.unknowns.shape[1], dtype=np.complex128)
    for phase in motion.phases:
        t = 0.5 * (nodes[:, None] + 1) * phase.length
        rotated = motion.advance(phase, t).q * np.exp(-1j * (phase.begin + t))
        total += 0.5 * phase.length * (weights @ rotated)
    return np.asarray(total / np.pi, dtype=np.complex128)


def peak_to_peak(batch: Batch) -> Array:
    """Compute the peak-to-peak value of the coordinate over the period, shape (solutions,)."""
    pairs = [extremes(batch, index, _coordinate) for index in range(len(batch.motion.phases))]
    return np.max([high for _, high in pairs], axis=0) - np.min([low for low, _ in pairs], axis=0)


def multipliers(batch: Batch) -> NDArray[np.complex128]:
    """Compute the Floquet multipliers of the map from floor impact to floor impact, shape (2, solutions).

    The state after the impact is (q, q'), because the damper is at rest on the floor. Between events, perturbations
    follow the homogeneous flow. At an impact they are multiplied by the saltation matrix
    R + (f_after - R f_before) n^T / (n^T f_before), with R the linear map of the impact and n the gradient of the
    gap. Take-off is smooth (free fall on both sides), so its saltation matrix is the identity.
    """
    motion = batch.motion
    count = batch.unknowns.shape[1]
    total = np.broadcast_to(np.eye(2), (count, 2, 2))
    for index, phase in enumerate(motion.phases):
        flow = np.moveaxis(np.array(motion.homogeneous(phase, phase.length)), 0, -1).reshape(-1, 2, 2)
        if phase.riding:
            total = flow @ total
            continue
        if total.shape[1] == 2:
            total = np.concatenate([total, total], axis=1)
        free = np.zeros((count, 4, 4))
        free[:, :2, :2] = flow
        free[:, 2:, 2:] = np.eye(2)
        free[:, 2, 3] = phase.length
        after = motion.phases[(index + 1) % len(motion.phases)]
        end = motion.advance(phase, phase.length)
        total = _saltation(motion, phase, end, after) @ free @ total
    return np.asarray(np.linalg.eigvals(total).T, dtype=np.complex128)


def _saltation(motion: PeriodicMotion, before: MotionPhase, end: ModeState, after: MotionPhase) -> Array:
    """Saltation matrix of the impact between two phases, (solutions, 2 if riding follows, else 4, 4)."""
    mu = motion.setting.mass_ratio
    share, one, zero = mu / (1 + mu), np.ones_like(end.q), np.zeros_like(end.q)
    common = [zero, one - share, zero, share]
    keep_q, keep_y = [one, zero, zero, zero], [zero, zero, one, zero]
    reset = np.moveaxis(
        np.array([keep_q, common] if after.riding else [keep_q, common, keep_y, common]), -1, 0
    )
    velocity = after.start.u
    acceleration = motion.acceleration(after, np.zeros_like(after.length), after.start)
    arriving = np.array([end.u, motion.acceleration(before, before.length, end), end.v, -one]).T
    leaving = np.array([velocity, acceleration] + ([] if after.riding else [velocity, -one])).T
    normal = np.array([-1.0, 0.0, 1.0, 0.0])
    mismatch = leaving - np.einsum("nij,nj->ni", reset, arriving)
    return reset + mismatch[:, :, None] * normal / (arriving @ normal)[:, None, None]
