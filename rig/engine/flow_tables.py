"""The exact flow: tables for each contact configuration, computed when the configuration is first visited.

The configuration specifies which dampers are in contact with which wall. Its table index counts the configurations in
the order of their first visit. The state z includes the drive and obeys z' = A z + b, so the matrix exponential gives

    z(t + tau h) = sum_k tau^k (A h)^k / k! z(t) + terms of b

The series converges to rounding error at degree `rig.numerics.bernstein.DEGREE`, because the product of the step h and
the largest rate of the system is at most `MAX_RATE_TIMES_STEP`. Neither eigenvectors nor a particular solution are
needed, so that repeated, zero and critically damped eigenvalues, and a drive at exact resonance, are not special cases.

The number of states and of possible configurations determines which tables are computed. For a small system all matrix
powers are tabulated. For a larger system the matrix of a full step is tabulated; where a contact may change, the series
is summed from the sparse matrix A as A z, A (A z), ..., at a cost proportional to the number of springs. A large system
with many dampers is propagated by this series only.

A *guard* is a gap or a contact force, whose zero is a contact event. Further tables bound the guards within a step
(`rig.engine.screening`): bounds of the fourth derivative, sums of the magnitudes of the terms, and the *margin*, the
largest decrease within a step below the values at both ends.
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

#: The product of step length (s) and largest rate (rad/s) is at most this; 0.7^16 / 16! is below the rounding of
#: float64.
MAX_RATE_TIMES_STEP = 0.7
#: Matrix powers are tabulated up to this number of states, including the drive.
MAX_TABULATED_STATES = 16
#: Matrix powers are tabulated up to this number of states if there are at most `FEW_DAMPERS` dampers.
MAX_TABULATED_STATES_FEW_DAMPERS = 40
FEW_DAMPERS = 3  # with instant contact they have 2^3 configurations
#: The matrix of a full step is always tabulated up to this number of states.
MAX_STEP_MATRIX_STATES = 400
#: The matrix of a full step is tabulated up to this number of dampers.
MAX_STEP_MATRIX_DAMPERS = 6
#: For a system with more states, the step matrices of all configurations are tabulated up to this memory, in bytes.
#: Step matrices are faster than the series if A is dense (modal damping, given matrices).
MAX_STEP_MATRIX_BYTES = 1 << 29
#: Memory, in bytes, of an element of the step matrix, including the tables of derivatives and bounds.
ELEMENT_BYTES = 20
#: An array contains the table index of every possible configuration up to this number of configuration bits.
MAX_DIRECT_LOOKUP_BITS = 12
#: Envelopes (`rig.engine.screening`) save time up to this phase advance of the drive per step.
MAX_ENVELOPE_PHASE_RAD = 0.2
#: Number of small systems whose tables are cached for the next run.
MAX_CACHED_SYSTEMS = 32
# Number of configurations for which memory is first allocated.
_INITIAL_CAPACITY = 4

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
        self.indices: dict[int, int] = {}  # table index by configuration bits
        self._lock = Lock()
        self._toggles = system.toggles
        n_bits = len(self._toggles)  # of a configuration
        self._direct_lookup = np.full(1 << n_bits, -1, dtype=np.int64) if n_bits <= MAX_DIRECT_LOOKUP_BITS else None
        max_states = MAX_TABULATED_STATES_FEW_DAMPERS if system.dampers <= FEW_DAMPERS else MAX_TABULATED_STATES
        self.has_series = self.size <= max_states
        # Tables are applied millions of times, so they are computed in extended precision.
        self._precision = np.longdouble if self.has_series else np.float64
        self._row_pointer, self._column = self._sparsity_pattern()
        self.has_step_matrix = self.has_series or (
            system.dampers <= MAX_STEP_MATRIX_DAMPERS and self._step_matrix_is_faster(n_bits)
        )
        self.model = self._model()
        self.flow = self._allocate(_INITIAL_CAPACITY)

    def _step_matrix_is_faster(self, n_bits: int) -> bool:
        """Return whether the matrix of a full step is faster than the series, within the memory limit.

        `n_bits`: number of bits of a configuration.
        """
        if self.size <= MAX_STEP_MATRIX_STATES:
            return True
        dense = len(self._column) * TERMS > self.size**2
        return dense and self.size**2 * ELEMENT_BYTES << n_bits <= MAX_STEP_MATRIX_BYTES

    def table_index(self, configuration: int) -> int:
        """Return the table index of a configuration (its bits: `HybridSystem.toggles`); compute its tables if new."""
        with self._lock:
            existing = self.indices.get(configuration)
            if existing is not None:
                return existing
            table_index = len(self.indices)
            if table_index == self.flow.after_toggle.shape[0]:
                self._double_capacity()
            self._fill(table_index, configuration)
            self.indices[configuration] = table_index
            if self._direct_lookup is not None:
                self._direct_lookup[configuration] = table_index
            return table_index

    def table_indices(self, configurations: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the table indices of many configurations, in their shape; compute the tables of new configurations."""
        if not configurations.size:
            return configurations
        if self._direct_lookup is None:
            distinct, index = np.unique(configurations, return_inverse=True)
            table_indices = np.array(
                [self.table_index(int(configuration)) for configuration in distinct], dtype=np.int64
            )
            return table_indices[index].reshape(configurations.shape)
        table_indices = self._direct_lookup[configurations]
        if (table_indices < 0).any():
            for configuration in np.unique(configurations[table_indices < 0]):
                self.table_index(int(configuration))
            table_indices = self._direct_lookup[configurations]
        return table_indices

    def generator(self, configuration: int) -> tuple[np.ndarray, np.ndarray]:
        """Return matrix A (size, size) and vector b (size,) of z' = A z + b in one configuration."""
        system, drive = self.system, self.drive
        nq, ns = system.coordinates, system.states
        dtype = self._precision
        at_rest = [j for j in range(system.dampers) if configuration >> j & 1 and not system.finite_contact[j]]
        contact_matrix, contact_constant = system.contact_forces(configuration)
        mass = system.mass.astype(dtype)
        constant = system.force_constant.astype(dtype) + contact_constant
        for j in at_rest:
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
        """Return the constants of the contact laws and guards."""
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
            gap_coordinate=system.gap_coordinate.astype(np.int64),
            wall_stiffness=system.wall_stiffness.astype(np.float64),
            wall_damping=system.wall_damping.astype(np.float64),
            toggles=np.array(system.toggles, dtype=np.int64),
            position_index=system.damper_coordinate.astype(np.int64),
            velocity_index=system.damper_coordinate.astype(np.int64) + nq,
            first_velocity=nq,
            first_acceleration=self.size,
            inverse_mass=np.ascontiguousarray(np.linalg.inv(system.mass)),
            force=force,
            force_constant=constant,
            coupled=bool(system.coupled),
        )

    def _sparsity_pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the elements of A that may be nonzero in any configuration: row pointers (size + 1,) and columns."""
        may_be_nonzero = self.generator(0)[0] != 0
        for toggle in self._toggles if self.system.finite_contact.any() else ():
            may_be_nonzero |= self.generator(toggle)[0] != 0
        if self.system.coupled:
            n = self.system.coordinates
            may_be_nonzero[n : 2 * n] |= may_be_nonzero[n : 2 * n].any(axis=0)
        row_pointer = np.concatenate([[0], np.cumsum(may_be_nonzero.sum(axis=1))]).astype(np.int64)
        return row_pointer, np.nonzero(may_be_nonzero)[1].astype(np.int64)

    def _table_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of each table of `Flow` for one configuration."""
        rows = padded_length(self.size)
        shapes: dict[str, tuple[int, ...]] = {}
        widths = {
            "step_matrix": padded_length(self.size + self.system.coordinates),
            "margin": padded_length(self.system.dampers),
            "series": (N_COEFFICIENTS + 1) * rows,
            "bound": padded_length(2 * self.system.dampers),
            "derivative": padded_length(2 * self.system.coordinates),
        }
        for name, width in widths.items():
            needed = self.has_series if name == "series" else self.has_step_matrix
            # The product of every step is faster with columns of zeros up to a multiple of SUMS.
            columns = -(-self.size // SUMS) * SUMS if name == "step_matrix" else self.size  # rounded up
            shapes[name] = (columns if needed else 0, width)
            shapes[f"{name}_constant"] = (width,)
        shapes["rates"] = (len(self._column),)
        shapes["rates_constant"] = (self.size,)
        return shapes

    def _allocate(self, capacity: int) -> Flow:
        """Return tables of zeros with room for a number of configurations."""
        arrays = {name: aligned_zeros(capacity, *shape) for name, shape in self._table_shapes().items()}
        after_toggle = np.full((capacity, max(1, len(self._toggles))), -1, dtype=np.int64)
        return Flow(
            has_series=self.has_series,
            has_step_matrix=self.has_step_matrix,
            drive_is_smooth=self.drive.max_rate > 0.0,
            uses_envelope=self.step * self.drive.max_rate < MAX_ENVELOPE_PHASE_RAD,
            row_pointer=self._row_pointer,
            column=self._column,
            after_toggle=after_toggle,
            **arrays,
        )

    def _double_capacity(self) -> None:
        """Replace the tables with tables with the same content and room for twice the number of configurations."""
        old = self.flow
        self.flow = self._allocate(2 * len(old.after_toggle))
        for name in (*self._table_shapes(), "after_toggle"):
            source, target = getattr(old, name), getattr(self.flow, name)
            target[: len(source)] = source

    def _fill(self, table_index: int, configuration: int) -> None:
        """Compute all tables of a configuration."""
        flow = self.flow
        matrix, offset = self.generator(configuration)
        row = np.repeat(np.arange(self.size), np.diff(self._row_pointer))
        flow.rates[table_index] = matrix[row, self._column]
        flow.rates_constant[table_index] = offset
        if self.has_step_matrix:
            self._fill_step_tables(table_index, configuration, matrix, offset)
        for i, toggle in enumerate(self._toggles):
            neighbor = self.indices.get(configuration ^ toggle)
            if neighbor is not None:
                flow.after_toggle[table_index, i] = neighbor
                flow.after_toggle[neighbor, i] = table_index

    def _fill_step_tables(self, table_index: int, configuration: int, matrix: np.ndarray, offset: np.ndarray) -> None:
        """Compute step matrix, series, derivatives and bounds from A (`matrix`) and b (`offset`)."""
        flow, system, size = self.flow, self.system, self.size
        nq = system.coordinates
        h = self._precision(self.step)
        step_generator = matrix * h  # A h
        terms = _exponential_terms(step_generator)
        constants = np.zeros((TERMS, size), dtype=self._precision)
        constants[1:] = terms[:-1] @ offset * h / np.arange(1, TERMS)[:, None]
        # The tables are stored [column, row]. The state is followed by the accelerations and their derivatives.
        state_rows, after_state = slice(0, size), slice(size, size + 2 * nq)
        # Small terms first, so that the sum is accurate to its last bits.
        step_matrix, step_constant = terms[::-1].sum(axis=0), constants[::-1].sum(axis=0)
        flow.step_matrix[table_index][:size, state_rows] = step_matrix.T
        flow.step_matrix_constant[table_index][state_rows] = step_constant
        if self.has_series:
            series = flow.series[table_index].reshape(size, N_COEFFICIENTS + 1, -1)
            series[:, :, state_rows] = terms[: N_COEFFICIENTS + 1].transpose(2, 0, 1)
            flow.series_constant[table_index].reshape(N_COEFFICIENTS + 1, -1)[:, state_rows] = constants[
                : N_COEFFICIENTS + 1
            ]
        acceleration = matrix[nq : 2 * nq]
        derivative = np.concatenate([acceleration, acceleration @ step_generator])
        derivative_constant = np.concatenate([offset[nq : 2 * nq], acceleration @ offset * h])
        n_rows = flow.step_matrix.shape[2] - size  # rows after those of the state
        flow.step_matrix[table_index][:size, after_state] = (derivative @ step_matrix).T[:, :n_rows]
        flow.step_matrix_constant[table_index][after_state] = (derivative @ step_constant + derivative_constant)[
            :n_rows
        ]
        flow.derivative[table_index][:, : 2 * nq] = derivative.T
        flow.derivative_constant[table_index][: 2 * nq] = derivative_constant
        self._fill_bounds(table_index, configuration, terms, constants)

    def _fill_bounds(self, table_index: int, configuration: int, terms: np.ndarray, constants: np.ndarray) -> None:
        """Fill the tables of bounds and margins, from the series of every guard."""
        flow, system, dampers = self.flow, self.system, self.system.dampers
        at_rest = np.array([configuration >> j & 1 for j in range(dampers)], dtype=bool)
        rows = system.damper_coordinate + system.coordinates * at_rest
        guard_terms, guard_constants = (np.abs(part[:, rows]).astype(np.float64) for part in (terms, constants))
        # The guard at rest is an acceleration, whose series in tau has the terms k terms[k] / h at the power k - 1.
        k = np.arange(TERMS)[:, None]
        magnitude = np.where(at_rest, k / self.step, 1.0)
        power = np.where(at_rest, k - 1, k)
        fourth_derivative = magnitude * np.abs(power * (power - 1) * (power - 2) * (power - 3))
        # Between the ends of the step a guard falls by at most an eighth of its second derivative's bound.
        decrease = magnitude * np.abs(power * (power - 1)) / 8 + 2 * ROUNDING * magnitude
        free_fall = np.where(at_rest, 0.0, float(system.gravity) * self.step**2 / 8)
        for table, constant, weight, columns in (
            (flow.bound, flow.bound_constant, fourth_derivative, slice(0, dampers)),
            (flow.bound, flow.bound_constant, magnitude, slice(dampers, 2 * dampers)),
            (flow.margin, flow.margin_constant, decrease, slice(0, dampers)),
        ):
            table[table_index][:, columns] = np.einsum("kj,kjc->cj", weight, guard_terms)
            constant[table_index][columns] = np.einsum("kj,kj->j", weight, guard_constants)
        flow.margin_constant[table_index][:dampers] += free_fall
        for j in np.flatnonzero(system.finite_contact):
            self._fill_finite_contact_bounds(table_index, configuration, int(j), terms, constants)

    def _fill_finite_contact_bounds(
        self, table_index: int, configuration: int, j: int, terms: np.ndarray, constants: np.ndarray
    ) -> None:
        """Fill bounds and margins of a finite-duration contact: of the gap in flight, or of the force of a wall."""
        flow, system = self.flow, self.system
        # `wall`: 0 floor, 1 ceiling.
        closed, wall = configuration >> j & 1, configuration >> system.dampers + j & 1
        gap_factor, speed_factor = 1.0, 0.0
        if closed:
            gap_factor, speed_factor = system.wall_stiffness[j, wall], system.wall_damping[j, wall]
        guard = np.zeros(self.size)
        guard[[system.gap_coordinate[j], system.coordinates + system.gap_coordinate[j]]] = gap_factor, speed_factor
        wall_height = system.clearance[j] if wall or not closed else 0.0
        # The magnitudes bound the rounding errors, also of terms that cancel in the guard.
        terms_by_column = terms.swapaxes(1, 2)
        guard_terms, guard_constants = (
            np.abs(terms_by_column @ guard).astype(np.float64),
            np.abs(constants @ guard).astype(np.float64),
        )
        magnitude = (np.abs(terms_by_column) @ np.abs(guard)).astype(np.float64).sum(axis=0)
        magnitude_constant = float((np.abs(constants) @ np.abs(guard)).sum())
        magnitude_constant += gap_factor * wall_height if np.isfinite(wall_height) else 0.0
        k = np.arange(TERMS)
        fourth_derivative, decrease = k * (k - 1) * (k - 2) * (k - 3), k * (k - 1) / 8
        flow.bound[table_index][:, j] = fourth_derivative @ guard_terms
        flow.bound_constant[table_index][j] = fourth_derivative @ guard_constants
        flow.bound[table_index][:, system.dampers + j] = magnitude
        flow.bound_constant[table_index][system.dampers + j] = magnitude_constant
        flow.margin[table_index][:, j] = decrease @ guard_terms + 2 * ROUNDING * magnitude
        flow.margin_constant[table_index][j] = decrease @ guard_constants + 2 * ROUNDING * magnitude_constant


def tables_for(system: HybridSystem, drive: Drive, step: float) -> FlowTables:
    """Return the tables of a system, from the cache if it was used recently."""
    arrays = [value for part in (system, drive) for value in vars(part).values() if isinstance(value, np.ndarray)]
    key = (step, drive.max_rate, system.gravity, *(array.tobytes() for array in arrays))
    with _LOCK:
        tables = _CACHE.pop(key, None) or FlowTables(system, drive, step)
        if tables.has_series:
            _CACHE[key] = tables
        while len(_CACHE) > MAX_CACHED_SYSTEMS:
            _CACHE.popitem(last=False)
    return tables


def _exponential_terms(matrix: np.ndarray) -> np.ndarray:
    """Return the terms matrix^k / k! of the exponential, shape (TERMS, n, n), in the precision of the matrix."""
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
    size = matrix.shape[0]
    for i in range(size):
        for row in range(i + 1, size):
            factor = matrix[row, i] / matrix[i, i]
            if factor != 0:
                matrix[row, i:] -= factor * matrix[i, i:]
                result[row] -= factor * result[i]
    for i in range(size - 1, -1, -1):
        result[i] = (result[i] - matrix[i, i + 1 :] @ result[i + 1 :]) / matrix[i, i]
    return result
