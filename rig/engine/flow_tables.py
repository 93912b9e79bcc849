"""The exact flow: tables for each contact configuration, computed when the configuration is first visited.

The configuration states which dampers are at rest on a wall. With the drive included as states, z' = A z + b, and

    z(t + tau h) = sum_k tau^k (A h)^k / k! z + ...

converges to rounding at degree `rig.numerics.bernstein.DEGREE` because the step is chosen so that h times the largest
rate of the system is at most `MAX_RATE_TIMES_STEP`. There are no eigenvectors and no particular solution, so that
repeated, zero and critically damped eigenvalues, and a drive at exact resonance, are not special cases.

What is tabulated depends on the number of states and of possible configurations. For a small system all matrix powers
are tabulated. For a larger one the matrix of a full step is tabulated; where a contact may change, the series is summed
from the sparse matrix A as A z, A (A z), ..., at a cost proportional to the number of springs. A large system with many
dampers is propagated by this series only.
"""

from __future__ import annotations

from collections import OrderedDict
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.engine.flow import TERMS, Flow, Model
from rig.numerics.bernstein import N_COEFFICIENTS
from rig.numerics.complementarity import ROUNDING
from rig.numerics.simd import SUMS, aligned_zeros, padded_length
from rig.system.hybrid_system import Drive, HybridSystem

#: Largest product of step length and rate; 0.7^16 / 16! is below the rounding of float64.
MAX_RATE_TIMES_STEP = 0.7
#: Largest number of states, drive included, for which the matrix powers are tabulated.
MAX_TABULATED_STATES = 16
#: The same for systems with at most `FEW_DAMPERS`, which have at most eight configurations.
MAX_TABULATED_STATES_FEW_DAMPERS = 40
FEW_DAMPERS = 3  # with 2^3 configurations
#: Largest number of states for which the matrix of a full step is always tabulated.
MAX_STEP_MATRIX_STATES = 400
#: Largest number of dampers for which the matrix of a full step is tabulated.
MAX_STEP_MATRIX_DAMPERS = 6
#: Largest memory of these matrices in a system with more states. They are faster than the series if A is dense (modal
#: damping, given matrices).
MAX_STEP_MATRIX_BYTES = 1 << 29
#: Memory of a matrix element, with its derivatives and bounds.
ELEMENT_BYTES = 20
#: Largest number of bits of a configuration for which slots are found in an array of all configurations.
MAX_DIRECT_BITS = 12
#: Largest phase advance of the drive per step with which the coarse bounds of an envelope are useful.
MAX_ENVELOPE_PHASE_RAD = 0.2
#: Number of systems whose tables are cached for the next run; only those of small systems are.
MAX_CACHED_SYSTEMS = 32

_CACHE: OrderedDict[tuple[Any, ...], FlowTables] = OrderedDict()
_LOCK = Lock()


class FlowTables:
    """The flow of one system under one kind of drive, for all visited configurations.

    `drive`: evolution of the inputs within a segment; `step`: step length h in seconds.
    """

    def __init__(self, system: HybridSystem, drive: Drive, step: float) -> None:
        self.system = system
        self.drive = drive
        self.step = step
        self.size = system.states + drive.states
        self.slots: dict[int, int] = {}
        self._lock = Lock()
        self._toggles = system.toggles
        bits = len(self._toggles)
        self._direct = np.full(1 << bits, -1, dtype=np.int64) if bits <= MAX_DIRECT_BITS else None
        limit = MAX_TABULATED_STATES_FEW_DAMPERS if system.dampers <= FEW_DAMPERS else MAX_TABULATED_STATES
        self.tabulated = self.size <= limit
        # Tables are applied millions of times, so they are computed in extended precision.
        self._precision = np.longdouble if self.tabulated else np.float64
        self._pointer, self._column = self._pattern()
        self.stepping = self.tabulated or (
            system.dampers <= MAX_STEP_MATRIX_DAMPERS and self._step_matrix_is_faster(bits)
        )
        self.model = self._model()
        self.flow = self._empty(4)

    def _step_matrix_is_faster(self, bits: int) -> bool:
        """Return whether the matrix of a full step is faster than the series, within the memory limit."""
        if self.size <= MAX_STEP_MATRIX_STATES:
            return True
        dense = len(self._column) * TERMS > self.size**2
        return dense and self.size**2 * ELEMENT_BYTES << bits <= MAX_STEP_MATRIX_BYTES

    def slot(self, configuration: int) -> int:
        """Return the slot of a configuration (bit j set: damper j in contact); compute its tables if it is new."""
        with self._lock:
            existing = self.slots.get(configuration)
            if existing is not None:
                return existing
            slot = len(self.slots)
            if slot == self.flow.neighbor.shape[0]:
                self._grow()
            self._fill(slot, configuration)
            self.slots[configuration] = slot
            if self._direct is not None:
                self._direct[configuration] = slot
            return slot

    def slots_of(self, configurations: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the slots of many configurations, in their shape; compute the tables of new ones."""
        if not configurations.size:
            return configurations
        if self._direct is None:
            distinct, index = np.unique(configurations, return_inverse=True)
            slots = np.array([self.slot(int(configuration)) for configuration in distinct], dtype=np.int64)
            return slots[index].reshape(configurations.shape)
        slots = self._direct[configurations]
        if (slots < 0).any():
            for configuration in np.unique(configurations[slots < 0]):
                self.slot(int(configuration))
            slots = self._direct[configurations]
        return slots

    def generator(self, configuration: int) -> tuple[np.ndarray, np.ndarray]:
        """Return matrix A (size, size) and vector b (size,) of z' = A z + b in one configuration."""
        system, drive = self.system, self.drive
        nq, ns = system.coordinates, system.states
        dtype = self._precision
        on_floor = [j for j in range(system.dampers) if configuration >> j & 1 and not system.finite_contact[j]]
        contact_matrix, contact_constant = system.contact_forces(configuration)
        mass = system.mass.astype(dtype)
        constant = system.force_constant.astype(dtype) + contact_constant
        for j in on_floor:
            row = system.damper_coordinate[j]
            mass[row, row] += system.damper_mass[j]
            constant[row] -= dtype(system.damper_mass[j]) * dtype(system.gravity)
        matrix = np.zeros((self.size, self.size), dtype=dtype)
        offset = np.zeros(self.size, dtype=dtype)
        matrix[:nq, nq : 2 * nq] = np.eye(nq, dtype=dtype)
        force = np.zeros((nq, self.size), dtype=dtype)
        force[:, :ns] = system.force_state.astype(dtype) + contact_matrix
        force[:, ns:] = system.force_drive.astype(dtype) @ drive.output.astype(dtype)
        matrix[nq : 2 * nq] = _solve(mass, force)
        offset[nq : 2 * nq] = _solve(mass, constant[:, None])[:, 0]
        matrix[2 * nq : ns, :ns] = system.rate_state
        matrix[2 * nq : ns, ns:] = system.rate_drive.astype(dtype) @ drive.output.astype(dtype)
        matrix[ns:, ns:] = drive.generator
        return matrix, offset

    def _model(self) -> Model:
        system, drive = self.system, self.drive
        nq = system.coordinates
        force = np.zeros((1, self.size, padded_length(nq)))
        force[0, : system.states, :nq] = system.force_state.T
        force[0, system.states :, :nq] = (system.force_drive @ drive.output).T
        constant = np.zeros((1, padded_length(nq)))
        constant[0, :nq] = system.force_constant
        return Model(
            gravity=float(system.gravity),
            step=float(self.step),
            mass=system.damper_mass.astype(np.float64),
            clearance=system.clearance.astype(np.float64),
            restitution=system.restitution.astype(np.float64),
            bed=system.bed.astype(np.int64),
            wall_stiffness=system.wall_stiffness.astype(np.float64),
            wall_damping=system.wall_damping.astype(np.float64),
            toggles=np.array(system.toggles, dtype=np.int64),
            position=system.damper_coordinate.astype(np.int64),
            velocity=system.damper_coordinate.astype(np.int64) + nq,
            first_velocity=nq,
            first_acceleration=self.size,
            inverse_mass=np.ascontiguousarray(np.linalg.inv(system.mass)),
            force=force,
            force_constant=constant,
            coupled=bool(system.coupled),
        )

    def _pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the elements of A that may be nonzero in any configuration, as compressed rows."""
        everything = self.generator(0)[0] != 0
        for change in self._toggles if self.system.finite_contact.any() else ():
            everything |= self.generator(change)[0] != 0
        if self.system.coupled:
            n = self.system.coordinates
            everything[n : 2 * n] |= everything[n : 2 * n].any(axis=0)
        pointer = np.concatenate([[0], np.cumsum(everything.sum(axis=1))]).astype(np.int64)
        return pointer, np.nonzero(everything)[1].astype(np.int64)

    def _shapes(self) -> dict[str, tuple[int, ...]]:
        rows = padded_length(self.size)
        shapes: dict[str, tuple[int, ...]] = {}
        widths = {
            "propagate": padded_length(self.size + self.system.coordinates),
            "margin": padded_length(self.system.dampers),
            "series": (N_COEFFICIENTS + 1) * rows,
            "bound": padded_length(2 * self.system.dampers),
            "derivative": padded_length(2 * self.system.coordinates),
        }
        for name, width in widths.items():
            needed = self.tabulated if name == "series" else self.stepping
            # Columns of zeros up to a multiple of SUMS make the product of every step faster.
            columns = -(-self.size // SUMS) * SUMS if name == "propagate" else self.size
            shapes[name] = (columns if needed else 0, width)
            shapes[f"{name}_constant"] = (width,)
        shapes["rates"] = (len(self._column),)
        shapes["rates_constant"] = (self.size,)
        return shapes

    def _empty(self, capacity: int) -> Flow:
        arrays = {name: aligned_zeros(capacity, *shape) for name, shape in self._shapes().items()}
        neighbor = np.full((capacity, max(1, len(self._toggles))), -1, dtype=np.int64)
        return Flow(
            tabulated=self.tabulated,
            stepping=self.stepping,
            smooth=self.drive.max_rate > 0.0,
            enveloping=self.step * self.drive.max_rate < MAX_ENVELOPE_PHASE_RAD,
            pointer=self._pointer,
            column=self._column,
            neighbor=neighbor,
            **arrays,
        )

    def _grow(self) -> None:
        old = self.flow
        self.flow = self._empty(2 * len(old.neighbor))
        for name in (*self._shapes(), "neighbor"):
            source, target = getattr(old, name), getattr(self.flow, name)
            target[: len(source)] = source

    def _fill(self, slot: int, configuration: int) -> None:
        flow = self.flow
        matrix, offset = self.generator(configuration)
        row = np.repeat(np.arange(self.size), np.diff(self._pointer))
        flow.rates[slot] = matrix[row, self._column]
        flow.rates_constant[slot] = offset
        if self.stepping:
            self._tabulate(slot, configuration, matrix, offset)
        for i, change in enumerate(self._toggles):
            other = self.slots.get(configuration ^ change)
            if other is not None:
                flow.neighbor[slot, i] = other
                flow.neighbor[other, i] = slot

    def _tabulate(self, slot: int, configuration: int, matrix: np.ndarray, offset: np.ndarray) -> None:
        flow, system, size = self.flow, self.system, self.size
        nq = system.coordinates
        h = self._precision(self.step)
        scaled = matrix * h
        terms = _power_terms(scaled)
        constants = np.zeros((TERMS, size), dtype=self._precision)
        constants[1:] = terms[:-1] @ offset * h / np.arange(1, TERMS)[:, None]
        rows = slice(0, size)
        # Small terms first, so that the sum is accurate to its last bits.
        step_matrix, step_constant = terms[::-1].sum(axis=0), constants[::-1].sum(axis=0)
        flow.propagate[slot][:size, rows] = step_matrix.T
        flow.propagate_constant[slot][rows] = step_constant
        if self.tabulated:
            series = flow.series[slot].reshape(size, N_COEFFICIENTS + 1, -1)
            series[:, :, rows] = terms[: N_COEFFICIENTS + 1].transpose(2, 0, 1)
            flow.series_constant[slot].reshape(N_COEFFICIENTS + 1, -1)[:, rows] = constants[: N_COEFFICIENTS + 1]
        second = matrix[nq : 2 * nq]
        derivative = np.concatenate([second, second @ scaled])
        constant = np.concatenate([offset[nq : 2 * nq], second @ offset * h])
        following = slice(size, size + 2 * nq)
        room = flow.propagate.shape[2] - size
        flow.propagate[slot][:size, following] = (derivative @ step_matrix).T[:, :room]
        flow.propagate_constant[slot][following] = (derivative @ step_constant + constant)[:room]
        flow.derivative[slot][:, : 2 * nq] = derivative.T
        flow.derivative_constant[slot][: 2 * nq] = constant
        self._fill_bounds(slot, configuration, terms, constants)

    def _fill_bounds(self, slot: int, configuration: int, terms: np.ndarray, constants: np.ndarray) -> None:
        """Fill the tables of bounds and margins, from the series of every guard."""
        flow, system, dampers = self.flow, self.system, self.system.dampers
        at_rest = np.array([configuration >> j & 1 for j in range(dampers)], dtype=bool)
        rows = system.damper_coordinate + system.coordinates * at_rest
        guard_terms, guard_constants = (np.abs(part[:, rows]).astype(np.float64) for part in (terms, constants))
        # The acceleration's series is (k + 1) terms[k + 1] / h.
        k = np.arange(TERMS)[:, None]
        size = np.where(at_rest, k / self.step, 1.0)
        power = np.where(at_rest, k - 1, k)
        fourth = size * np.abs(power * (power - 1) * (power - 2) * (power - 3))
        # Between its values at both ends a guard falls by at most an eighth of its second derivative's bound.
        decrease = size * np.abs(power * (power - 1)) / 8 + 2 * ROUNDING * size
        free_fall = np.where(at_rest, 0.0, float(system.gravity) * self.step**2 / 8)
        for table, constant, weight, columns in (
            (flow.bound, flow.bound_constant, fourth, slice(0, dampers)),
            (flow.bound, flow.bound_constant, size, slice(dampers, 2 * dampers)),
            (flow.margin, flow.margin_constant, decrease, slice(0, dampers)),
        ):
            table[slot][:, columns] = np.einsum("kj,kjc->cj", weight, guard_terms)
            constant[slot][columns] = np.einsum("kj,kj->j", weight, guard_constants)
        flow.margin_constant[slot][:dampers] += free_fall
        for j in np.flatnonzero(system.finite_contact):
            self._fill_finite_contact_bounds(slot, configuration, int(j), terms, constants)

    def _fill_finite_contact_bounds(
        self, slot: int, configuration: int, j: int, terms: np.ndarray, constants: np.ndarray
    ) -> None:
        """Fill bounds and margins of a finite-duration contact: of its gap, or of the force of the touched wall."""
        flow, system = self.flow, self.system
        closed, wall = configuration >> j & 1, configuration >> system.dampers + j & 1
        on_gap, on_speed = (system.wall_stiffness[j, wall], system.wall_damping[j, wall]) if closed else (1.0, 0.0)
        guard = np.zeros(self.size)
        guard[[system.bed[j], system.coordinates + system.bed[j]]] = on_gap, on_speed
        height = system.clearance[j] if wall or not closed else 0.0
        # Terms that cancel in the guard leave their rounding errors.
        rows = terms.swapaxes(1, 2)
        guard_terms, guard_constants = (
            np.abs(rows @ guard).astype(np.float64),
            np.abs(constants @ guard).astype(np.float64),
        )
        magnitude = (np.abs(rows) @ np.abs(guard)).astype(np.float64).sum(axis=0)
        magnitude_constant = float((np.abs(constants) @ np.abs(guard)).sum())
        magnitude_constant += on_gap * height if np.isfinite(height) else 0.0
        k = np.arange(TERMS)
        fourth, second = k * (k - 1) * (k - 2) * (k - 3), k * (k - 1) / 8
        size = system.dampers + j
        flow.bound[slot][:, j], flow.bound_constant[slot][j] = fourth @ guard_terms, fourth @ guard_constants
        flow.bound[slot][:, size], flow.bound_constant[slot][size] = magnitude, magnitude_constant
        flow.margin[slot][:, j] = second @ guard_terms + 2 * ROUNDING * magnitude
        flow.margin_constant[slot][j] = second @ guard_constants + 2 * ROUNDING * magnitude_constant


def tables_for(system: HybridSystem, drive: Drive, step: float) -> FlowTables:
    """Return the tables of a system, from the cache if it was used recently."""
    arrays = [value for part in (system, drive) for value in vars(part).values() if isinstance(value, np.ndarray)]
    key = (step, drive.max_rate, system.gravity, *(array.tobytes() for array in arrays))
    with _LOCK:
        tables = _CACHE.pop(key, None) or FlowTables(system, drive, step)
        if tables.tabulated:
            _CACHE[key] = tables
        while len(_CACHE) > MAX_CACHED_SYSTEMS:
            _CACHE.popitem(last=False)
    return tables


def _power_terms(matrix: np.ndarray) -> np.ndarray:
    """Return matrix^k / k! for k below TERMS, in the precision of the matrix."""
    powers = np.empty((TERMS, *matrix.shape), dtype=matrix.dtype)
    powers[0] = np.eye(len(matrix), dtype=matrix.dtype)
    powers[1] = matrix
    n_computed = 2
    while n_computed < TERMS:
        count = min(n_computed - 1, TERMS - n_computed)
        powers[n_computed : n_computed + count] = powers[n_computed - 1] @ powers[1 : 1 + count]
        n_computed += count
    factorials = np.cumprod(np.maximum(np.arange(TERMS), 1).astype(matrix.dtype))
    return powers / factorials[:, None, None]


def _solve(mass: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve mass x = right in the precision of the arguments (LAPACK has no extended precision)."""
    diagonal = np.diag(mass)
    if np.count_nonzero(mass) == len(diagonal):
        return right / diagonal[:, None]
    if mass.dtype == np.float64:
        return np.linalg.solve(mass, right)
    matrix = mass.copy()
    result = right.copy()
    count = matrix.shape[0]
    for i in range(count):
        for r in range(i + 1, count):
            factor = matrix[r, i] / matrix[i, i]
            if factor != 0:
                matrix[r, i:] -= factor * matrix[i, i:]
                result[r] -= factor * result[i]
    for i in range(count - 1, -1, -1):
        result[i] = (result[i] - matrix[i, i + 1 :] @ result[i + 1 :]) / matrix[i, i]
    return result
