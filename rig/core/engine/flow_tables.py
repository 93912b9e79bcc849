"""The exact flow: tables for each configuration, computed when the configuration is first visited.

A configuration is one choice of contact force for every element (damper or joint), coded as an integer by
`HybridSystem.strides`. Its table index counts the configurations in the order of their first visit. The state z
includes the drive and obeys z' = A z + b, so the matrix exponential gives

    z(t + tau h) = sum_k tau^k (A h)^k / k! z(t) + terms of b

The series converges to rounding error at degree `rig.core.numerics.bernstein.DEGREE`, because the product of the step h
and the largest rate of the system is at most `MAX_RATE_TIMES_STEP`. Neither eigenvectors nor a particular solution are
needed, so repeated, zero and critically damped eigenvalues, and a drive at exact resonance, are not special cases.

The number of states and of possible configurations determines which tables are computed. For a small system all matrix
powers are tabulated. For a larger system the matrix of a full step is tabulated; where a contact may change, the series
is summed from the sparse matrix A as A z, A (A z), ..., at a cost proportional to the number of springs. A large system
with many dampers is propagated by this series only.

A *signal* is a gap or a force, whose limits are events (`rig.core.engine.law_tables`). Further tables bound the signals
within a step (`rig.core.engine.screening`): bounds of the fourth derivative, sums of the magnitudes of the terms, and
the *margin*: how much closer to its limit a signal can come within a step than at the ends of the step.
"""

from collections import OrderedDict
from dataclasses import fields
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.core.engine.flow import TERMS, Flow, Model
from rig.core.engine.law_tables import SignalTerms, bounded_signals, law_tables
from rig.core.numerics.bernstein import N_COEFFICIENTS
from rig.core.numerics.complementarity import ROUNDING
from rig.core.numerics.simd import SUMS, aligned_zeros, padded_length
from rig.core.system.drive_generator import DriveGenerator
from rig.core.system.hybrid_system import HybridSystem, hold_coordinates

#: The product of step length [s] and largest rate [rad/s] is at most this; 0.7^16 / 16! = 1.6e-16 is below the
#: machine epsilon of float64, 2.2e-16.
MAX_RATE_TIMES_STEP = 0.7
#: Matrix powers are tabulated up to this number of states, including the drive.
MAX_TABULATED_STATES = 16
#: Matrix powers are tabulated up to this number of states if there are at most `FEW_DAMPERS` dampers.
MAX_TABULATED_STATES_FEW_DAMPERS = 40
FEW_DAMPERS = 3  # with instantaneous contact they have 2^3 configurations
#: The matrix of a full step is always tabulated up to this number of states.
MAX_STEP_MATRIX_STATES = 400
#: The matrix of a full step is tabulated up to this number of dampers.
MAX_STEP_MATRIX_DAMPERS = 6
#: For a system with more states, the step matrices of all configurations are tabulated up to this memory, in bytes.
#: Step matrices are faster than the series if A is dense (modal damping, given matrices).
MAX_STEP_MATRIX_BYTES = 1 << 29
#: Memory, in bytes, of an entry of the step matrix, including the tables of derivatives and bounds.
ELEMENT_BYTES = 20
#: Memory, in bytes, of the terms of the matrix exponential for an entry of the matrix. Only the terms of one
#: configuration are stored at a time.
TERM_BYTES = 9 * TERMS
#: An array contains the table index of every possible configuration up to this number of configurations.
MAX_DIRECT_LOOKUP = 4096
#: Envelopes (`rig.core.engine.screening`) save time up to this phase advance of the drive per step [rad].
MAX_ENVELOPE_PHASE_RAD = 0.2
#: Number of small systems whose tables are cached for the next run.
MAX_CACHED_SYSTEMS = 32
# Number of configurations for which memory is first allocated.
_INITIAL_CAPACITY = 4

_CACHE: OrderedDict[tuple[Any, ...], "FlowTables"] = OrderedDict()
_LOCK = Lock()


class FlowTables:
    """The flow of one system under one kind of drive, for all visited configurations.

    `drive`: evolution of the inputs within a segment; `step`: step length h in seconds.
    """

    def __init__(self, system: HybridSystem, drive: DriveGenerator, step: float) -> None:
        self.system = system
        self.drive = drive
        self.step = step
        self.size = system.states + drive.states
        self.indices: dict[int, int] = {}  # table index by configuration
        self._lock = Lock()
        count = system.configurations
        self._direct_lookup = np.full(count, -1, dtype=np.int64) if count <= MAX_DIRECT_LOOKUP else None
        self._bounded_signals = bounded_signals(system, self.size)
        elements = len(system.elements)
        max_states = MAX_TABULATED_STATES_FEW_DAMPERS if elements <= FEW_DAMPERS else MAX_TABULATED_STATES
        self.has_series = self.size <= max_states
        # Tables are applied millions of times, so they are computed in extended precision.
        self._precision = np.longdouble if self.has_series else np.float64
        self._row_pointer, self._column = self._sparsity_pattern()
        self.has_step_matrix = self.has_series or (
            elements <= MAX_STEP_MATRIX_DAMPERS and self._step_matrix_is_faster(count)
        )
        self.model = self._model()
        self.flow = self._allocate(_INITIAL_CAPACITY)

    def _step_matrix_is_faster(self, configurations: int) -> bool:
        """Return whether the matrix of a full step is faster than the series, and fits in the memory limit.

        `configurations`: number of possible configurations.
        """
        if self.size <= MAX_STEP_MATRIX_STATES:
            return True
        dense = len(self._column) * TERMS > self.size**2
        return dense and self.size**2 * (ELEMENT_BYTES * configurations + TERM_BYTES) <= MAX_STEP_MATRIX_BYTES

    def table_index(self, configuration: int) -> int:
        """Return the table index of a configuration; compute its tables if new."""
        with self._lock:
            existing = self.indices.get(configuration)
            if existing is not None:
                return existing
            table_index = len(self.indices)
            if table_index == self.flow.after.shape[0]:
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
        contact_matrix, contact_constant = system.contact_forces(configuration)
        mass = system.mass.astype(dtype)
        constant = system.force_constant.astype(dtype) + contact_constant
        fixed = system.gaps_at_rest(configuration)
        for j in system.held(configuration):
            if not system.detached[j]:
                continue
            row = system.body_coordinate[j]
            mass[row, row] += system.element_mass[j]
            constant[row] -= dtype(system.element_mass[j]) * dtype(system.gravity)
        matrix = np.zeros((self.size, self.size), dtype=dtype)
        offset = np.zeros(self.size, dtype=dtype)
        matrix[:nq, nq : 2 * nq] = np.eye(nq, dtype=dtype)
        force = np.zeros((nq, self.size), dtype=dtype)
        force[:, :ns] = system.force_state.astype(dtype) + contact_matrix
        force[:, ns:] = system.force_drive.astype(dtype) @ drive.output.astype(dtype)
        hold_coordinates(mass, fixed)
        force[fixed], constant[fixed] = 0.0, 0.0
        matrix[nq : 2 * nq] = _solve(mass, force)
        offset[nq : 2 * nq] = _solve(mass, constant[:, None])[:, 0]
        matrix[2 * nq : ns, :ns] = system.rate_state
        matrix[2 * nq : ns, ns:] = system.rate_drive.astype(dtype) @ drive.output.astype(dtype)
        matrix[ns:, ns:] = drive.generator
        return matrix, offset

    def contacts(self, regime: NDArray[np.int64]) -> NDArray[np.int8]:
        """Return the wall that each element touches in its regime (`rig.core.laws.events`), shape (elements,)."""
        laws = self.model.laws
        return np.asarray(laws.regimes.wall[laws.elements.first_regime + regime], dtype=np.int8)

    def _model(self) -> Model:
        """Return the constants of the elements."""
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
            first_velocity=nq,
            first_acceleration=self.size,
            inverse_mass=np.ascontiguousarray(np.linalg.inv(system.mass)),
            force=force,
            force_constant=constant,
            coupled=bool(system.coupled),
            laws=law_tables(system, self.size),
        )

    def _sparsity_pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the entries of A that may be nonzero in any configuration: row pointers (size + 1,) and columns."""
        may_be_nonzero = self.generator(0)[0] != 0
        for element, stride in zip(self.system.elements, self.system.strides, strict=True):
            for index, force in enumerate(element.law.forces):
                if force is not None:
                    may_be_nonzero |= self.generator(stride * index)[0] != 0
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
            "margin": padded_length(self._bounded_signals.first_row[-1]),
            "series": (N_COEFFICIENTS + 1) * rows,
            "bound": padded_length(2 * self._bounded_signals.first_row[-1]),
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
        after = np.full((capacity, max(1, len(self.model.laws.regimes))), -1, dtype=np.int64)
        return Flow(
            has_series=self.has_series,
            has_step_matrix=self.has_step_matrix,
            drive_is_smooth=self.drive.max_rate > 0.0,
            uses_envelope=self.step * self.drive.max_rate < MAX_ENVELOPE_PHASE_RAD,
            row_pointer=self._row_pointer,
            column=self._column,
            after=after,
            **arrays,
        )

    def _double_capacity(self) -> None:
        """Copy the tables into arrays with room for twice the number of configurations."""
        old = self.flow
        self.flow = self._allocate(2 * len(old.after))
        for name in (*self._table_shapes(), "after"):
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
        self._link_neighbors(table_index, configuration)

    def _link_neighbors(self, table_index: int, configuration: int) -> None:
        """Enter in `Flow.after` where each change of one element leads, for a configuration and its known neighbors."""
        laws, after = self.model.laws, self.flow.after
        for j, current in enumerate(self.system.force_indices(np.array(configuration)).tolist()):
            regimes = laws.elements.first_regime[j] + np.arange(len(self.system.elements[j].law.regimes))
            for m in regimes:
                change = int(laws.regimes.force_index[m]) - current
                neighbor = self.indices.get(configuration + self.system.strides[j] * change)
                if change and neighbor is not None:
                    after[table_index, m] = neighbor
                    after[neighbor, regimes[laws.regimes.force_index[regimes] == current]] = table_index

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
        """Fill the tables of bounds and margins, from the series of every signal."""
        current = self.system.force_indices(np.array(configuration)).tolist()
        for j, (by_force, index) in enumerate(zip(self._bounded_signals.signals, current, strict=True)):
            for row, (signal, constant) in enumerate(by_force[index].items(), self._bounded_signals.first_row[j]):
                is_detached = bool(self.system.detached[j])
                self._fill_bound(table_index, row, signal, 0.0 if is_detached else constant, terms, constants)
                if is_detached and signal.order == 0:
                    # A flying mass is accelerated by gravity alone.
                    self.flow.margin_constant[table_index][row] += float(self.system.gravity) * self.step**2 / 8

    def _fill_bound(
        self, table_index: int, row: int, signal: SignalTerms, constant: float, terms: np.ndarray, constants: np.ndarray
    ) -> None:
        """Fill one row of the tables of bounds and margins.

        `constant`: magnitude of the constant part; `terms`, `constants`: series of the state.
        """
        flow, nq = self.flow, self.system.coordinates
        weights = np.zeros(self.size)
        # If a velocity has the terms terms[k] tau^k, the acceleration has the terms k terms[k] / h tau^(k - 1).
        entries = np.array(signal.entries) - (self.size - nq if signal.order else 0)
        weights[entries] = signal.factors
        k = np.arange(TERMS)
        factor, power = (k / self.step, k - 1) if signal.order else (np.ones(TERMS), k)
        fourth_derivative = factor * np.abs(power * (power - 1) * (power - 2) * (power - 3))
        # Within the step a signal exceeds its values at both ends by at most an eighth of its largest second
        # derivative.
        approach = factor * np.abs(power * (power - 1)) / 8
        columns = terms.swapaxes(1, 2)
        sums, sum_constants = (np.abs(part @ weights).astype(np.float64) for part in (columns, constants))
        # The magnitudes bound the rounding errors, also of terms that cancel in the signal.
        magnitudes, magnitude_constants = (
            factor @ (np.abs(part) @ np.abs(weights)).astype(np.float64) for part in (columns, constants)
        )
        magnitude_constants += constant
        middle = flow.bound_constant.shape[1] // 2
        for table, constant_part, index, values, value_constant in (
            (flow.bound, flow.bound_constant, row, fourth_derivative @ sums, fourth_derivative @ sum_constants),
            (flow.bound, flow.bound_constant, middle + row, magnitudes, magnitude_constants),
            (
                flow.margin, flow.margin_constant, row, approach @ sums + 2 * ROUNDING * magnitudes,
                approach @ sum_constants + 2 * ROUNDING * magnitude_constants,
            ),
        ):  # fmt: skip
            table[table_index][:, index] = values
            constant_part[table_index][index] = value_constant


def tables_for(system: HybridSystem, drive: DriveGenerator, step: float) -> FlowTables:
    """Return the tables of a system, from the cache if it was used recently."""
    values = [getattr(part, item.name) for part in (system, drive) for item in fields(part)]
    arrays = [value.tobytes() for value in values if isinstance(value, np.ndarray)]
    key = (step, drive.max_rate, system.gravity, *arrays, *(element.key for element in system.elements))
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
        np.matmul(powers[n_computed - 1], powers[1 : 1 + count], out=powers[n_computed : n_computed + count])
        n_computed += count
    factorials = np.cumprod(np.maximum(np.arange(TERMS), 1).astype(matrix.dtype))
    # In place, because the terms of a structure of hundreds of bodies take hundreds of megabytes.
    powers /= factorials[:, None, None]
    return powers


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
