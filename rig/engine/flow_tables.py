"""The exact flow, one set of numbers per contact configuration, made when a configuration is first visited.

The configuration says which dampers ride. With the drive included as states, z' = A z + b, and

    z(t + tau h) = sum_k tau^k (A h)^k / k! z + ...

converges to rounding at degree `rig.numerics.bernstein.DEGREE` because the step is chosen so that h times the fastest
rate of the system is at most `REACH`. No eigenvectors are formed and no particular solution is subtracted:
repeated, zero and critically damped eigenvalues, and a drive at exact resonance, are cases like any other.

How much is tabulated for a configuration goes with the system's size and with the number of configurations it can
be in. A small system has all its matrix powers tabulated. A larger one has the matrix of a whole step, and its
series is summed from the sparse matrix A when a contact has to be looked for: A z, A (A z), ..., at a cost in
proportion to the number of springs. A large system with many dampers does every step that way.
"""

from __future__ import annotations

from collections import OrderedDict
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.engine.flow import TERMS, Flow, Model
from rig.numerics.bernstein import LENGTH
from rig.numerics.complementarity import ROUNDING
from rig.numerics.simd import SUMS, padded, zeros
from rig.system.hybrid_system import Drive, HybridSystem

#: Step length times the fastest rate; 0.7^16 / 16! is below the rounding of float64.
REACH = 0.7
#: States, drive included, up to which the matrix powers are tabulated; and up to which they are if there are so
#: few dampers that the configurations can be counted on two hands.
TABULATED_UP_TO = 16
TABULATED_WITH_FEW = 40
FEW_DAMPERS = 3
#: States and dampers up to which the matrix of a whole step is tabulated.
STEPS_UP_TO = 400
STEPS_WITH_DAMPERS = 6
#: Bytes that these matrices may occupy in a larger system whose series would take longer than a product, because A is
#: dense (modal damping, given matrices); and the bytes of an element, with those of the derivatives and bounds.
STEPS_BYTES = 1 << 29
ELEMENT_BYTES = 20
#: Bits of a configuration up to which slots are looked up in an array of all configurations.
DIRECT_UP_TO = 12
#: Steps that turn a tone by less than this are seldom near a contact, on an envelope's coarse view too.
FINE = 0.2
#: Systems whose tables are kept for the next run; only small ones are.
RECENT = 32

_RECENT: OrderedDict[tuple[Any, ...], FlowTables] = OrderedDict()
_LOCK = Lock()


class FlowTables:
    """The flow of one system under one kind of drive, for as many configurations as have been visited.

    `drive`: how the inputs evolve inside a segment; `step`: step length h in seconds.
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
        self._direct = np.full(1 << bits, -1, dtype=np.int64) if bits <= DIRECT_UP_TO else None
        most = TABULATED_WITH_FEW if system.dampers <= FEW_DAMPERS else TABULATED_UP_TO
        self.tabulated = self.size <= most
        # What is tabulated is used a million times over: it is computed with digits to spare.
        self._precision = np.longdouble if self.tabulated else np.float64
        self._pointer, self._column = self._pattern()
        self.stepping = self.tabulated or (system.dampers <= STEPS_WITH_DAMPERS and self._steps_pay(bits))
        self.model = self._model()
        self.flow = self._empty(4)

    def _steps_pay(self, bits: int) -> bool:
        """Whether the matrix of a whole step is quicker than the series of the sparse matrix, within the memory."""
        if self.size <= STEPS_UP_TO:
            return True
        dense = len(self._column) * TERMS > self.size**2
        return dense and self.size**2 * ELEMENT_BYTES << bits <= STEPS_BYTES

    def slot(self, configuration: int) -> int:
        """Slot of a configuration (bit j set: damper j at rest), made now if it is new."""
        with self._lock:
            known = self.slots.get(configuration)
            if known is not None:
                return known
            slot = len(self.slots)
            if slot == self.flow.neighbour.shape[0]:
                self._grow()
            self._fill(slot, configuration)
            self.slots[configuration] = slot
            if self._direct is not None:
                self._direct[configuration] = slot
            return slot

    def slots_of(self, configurations: NDArray[np.int64]) -> NDArray[np.int64]:
        """Slots of many configurations, shape as given; new ones are made."""
        if not configurations.size:
            return configurations
        if self._direct is None:
            visited, place = np.unique(configurations, return_inverse=True)
            known = np.array([self.slot(int(configuration)) for configuration in visited], dtype=np.int64)
            return known[place].reshape(configurations.shape)
        slots = self._direct[configurations]
        if (slots < 0).any():
            for configuration in np.unique(configurations[slots < 0]):
                self.slot(int(configuration))
            slots = self._direct[configurations]
        return slots

    def generator(self, configuration: int) -> tuple[np.ndarray, np.ndarray]:
        """Matrix A (size, size) and vector b (size,) of z' = A z + b in one configuration."""
        system, drive = self.system, self.drive
        nq, ns = system.coordinates, system.states
        kind = self._precision
        riding = [j for j in range(system.dampers) if configuration >> j & 1 and not system.lasting[j]]
        pushes, offsets = system.contact_forces(configuration)
        mass = system.mass.astype(kind)
        constant = system.force_constant.astype(kind) + offsets
        for j in riding:
            row = system.damper_coordinate[j]
            mass[row, row] += system.damper_mass[j]
            constant[row] -= kind(system.damper_mass[j]) * kind(system.gravity)
        matrix = np.zeros((self.size, self.size), dtype=kind)
        offset = np.zeros(self.size, dtype=kind)
        matrix[:nq, nq : 2 * nq] = np.eye(nq, dtype=kind)
        force = np.zeros((nq, self.size), dtype=kind)
        force[:, :ns] = system.force_state.astype(kind) + pushes
        force[:, ns:] = system.force_drive.astype(kind) @ drive.output.astype(kind)
        matrix[nq : 2 * nq] = _solve(mass, force)
        offset[nq : 2 * nq] = _solve(mass, constant[:, None])[:, 0]
        matrix[2 * nq : ns, :ns] = system.rate_state
        matrix[2 * nq : ns, ns:] = system.rate_drive.astype(kind) @ drive.output.astype(kind)
        matrix[ns:, ns:] = drive.generator
        return matrix, offset

    def _model(self) -> Model:
        system, drive = self.system, self.drive
        nq = system.coordinates
        force = np.zeros((1, self.size, padded(nq)))
        force[0, : system.states, :nq] = system.force_state.T
        force[0, system.states :, :nq] = (system.force_drive @ drive.output).T
        constant = np.zeros((1, padded(nq)))
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
            behind=self.size,
            inverse_mass=np.ascontiguousarray(np.linalg.inv(system.mass)),
            force=force,
            force_constant=constant,
            coupled=bool(system.coupled),
        )

    def _pattern(self) -> tuple[np.ndarray, np.ndarray]:
        """Compressed rows of A: where elements may be nonzero in any configuration."""
        everything = self.generator(0)[0] != 0
        for change in self._toggles if self.system.lasting.any() else ():
            everything |= self.generator(change)[0] != 0
        if self.system.coupled:
            n = self.system.coordinates
            everything[n : 2 * n] |= everything[n : 2 * n].any(axis=0)
        pointer = np.concatenate([[0], np.cumsum(everything.sum(axis=1))]).astype(np.int64)
        return pointer, np.nonzero(everything)[1].astype(np.int64)

    def _shapes(self) -> dict[str, tuple[int, ...]]:
        rows = padded(self.size)
        shapes: dict[str, tuple[int, ...]] = {}
        widths = {
            "propagate": padded(self.size + self.system.coordinates),
            "margin": padded(self.system.dampers),
            "series": (LENGTH + 1) * rows,
            "bound": padded(2 * self.system.dampers),
            "derivative": padded(2 * self.system.coordinates),
        }
        for name, width in widths.items():
            filled = self.tabulated if name == "series" else self.stepping
            # With columns of zeros up to a full number of sums the product of every step is quicker.
            columns = -(-self.size // SUMS) * SUMS if name == "propagate" else self.size
            shapes[name] = (columns if filled else 0, width)
            shapes[f"{name}_constant"] = (width,)
        shapes["rates"] = (len(self._column),)
        shapes["rates_constant"] = (self.size,)
        return shapes

    def _empty(self, capacity: int) -> Flow:
        arrays = {name: zeros(capacity, *shape) for name, shape in self._shapes().items()}
        neighbour = np.full((capacity, max(1, len(self._toggles))), -1, dtype=np.int64)
        return Flow(
            tabulated=self.tabulated,
            stepping=self.stepping,
            smooth=self.drive.fastest > 0.0,
            enveloping=self.step * self.drive.fastest < FINE,
            pointer=self._pointer,
            column=self._column,
            neighbour=neighbour,
            **arrays,
        )

    def _grow(self) -> None:
        old = self.flow
        self.flow = self._empty(2 * len(old.neighbour))
        for name in (*self._shapes(), "neighbour"):
            before, after = getattr(old, name), getattr(self.flow, name)
            after[: len(before)] = before

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
                flow.neighbour[slot, i] = other
                flow.neighbour[other, i] = slot

    def _tabulate(self, slot: int, configuration: int, matrix: np.ndarray, offset: np.ndarray) -> None:
        flow, system, size = self.flow, self.system, self.size
        nq = system.coordinates
        h = self._precision(self.step)
        scaled = matrix * h
        terms = _power_terms(scaled)
        constants = np.zeros((TERMS, size), dtype=self._precision)
        constants[1:] = terms[:-1] @ offset * h / np.arange(1, TERMS)[:, None]
        rows = slice(0, size)
        # Small terms first, so that the sum keeps its last bits.
        over, over_constant = terms[::-1].sum(axis=0), constants[::-1].sum(axis=0)
        flow.propagate[slot][:size, rows] = over.T
        flow.propagate_constant[slot][rows] = over_constant
        if self.tabulated:
            series = flow.series[slot].reshape(size, LENGTH + 1, -1)
            series[:, :, rows] = terms[: LENGTH + 1].transpose(2, 0, 1)
            flow.series_constant[slot].reshape(LENGTH + 1, -1)[:, rows] = constants[: LENGTH + 1]
        second = matrix[nq : 2 * nq]
        derivative = np.concatenate([second, second @ scaled])
        constant = np.concatenate([offset[nq : 2 * nq], second @ offset * h])
        behind = slice(size, size + 2 * nq)
        room = flow.propagate.shape[2] - size
        flow.propagate[slot][:size, behind] = (derivative @ over).T[:, :room]
        flow.propagate_constant[slot][behind] = (derivative @ over_constant + constant)[:room]
        flow.derivative[slot][:, : 2 * nq] = derivative.T
        flow.derivative_constant[slot][: 2 * nq] = constant
        self._fill_bounds(slot, configuration, terms, constants)

    def _fill_bounds(self, slot: int, configuration: int, terms: np.ndarray, constants: np.ndarray) -> None:
        """Bound and margin tables, from the series of every guard."""
        flow, system, dampers = self.flow, self.system, self.system.dampers
        at_rest = np.array([configuration >> j & 1 for j in range(dampers)], dtype=bool)
        rows = system.damper_coordinate + system.coordinates * at_rest
        used, used_constant = (np.abs(part[:, rows]).astype(np.float64) for part in (terms, constants))
        # The acceleration's series is (k + 1) terms[k + 1] / h.
        k = np.arange(TERMS)[:, None]
        size = np.where(at_rest, k / self.step, 1.0)
        power = np.where(at_rest, k - 1, k)
        fourth = size * np.abs(power * (power - 1) * (power - 2) * (power - 3))
        # Between its values at both ends a guard sags by at most an eighth of its second derivative's bound.
        sag = size * np.abs(power * (power - 1)) / 8 + 2 * ROUNDING * size
        fall = np.where(at_rest, 0.0, float(system.gravity) * self.step**2 / 8)
        for table, constant, weight, place in (
            (flow.bound, flow.bound_constant, fourth, slice(0, dampers)),
            (flow.bound, flow.bound_constant, size, slice(dampers, 2 * dampers)),
            (flow.margin, flow.margin_constant, sag, slice(0, dampers)),
        ):
            table[slot][:, place] = np.einsum("kj,kjc->cj", weight, used)
            constant[slot][place] = np.einsum("kj,kj->j", weight, used_constant)
        flow.margin_constant[slot][:dampers] += fall
        for j in np.flatnonzero(system.lasting):
            self._fill_lasting_bounds(slot, configuration, int(j), terms, constants)

    def _fill_lasting_bounds(
        self, slot: int, configuration: int, j: int, terms: np.ndarray, constants: np.ndarray
    ) -> None:
        """Do the same for the gap of a finite-duration contact, or for the force of the wall that it touches."""
        flow, system = self.flow, self.system
        closed, wall = configuration >> j & 1, configuration >> system.dampers + j & 1
        on_gap, on_speed = (
            (system.wall_stiffness[j, wall], system.wall_damping[j, wall]) if closed else (1.0, 0.0)
        )
        guard = np.zeros(self.size)
        guard[[system.bed[j], system.coordinates + system.bed[j]]] = on_gap, on_speed
        height = system.clearance[j] if wall or not closed else 0.0
        # What cancels in the guard leaves its rounding.
        rows = terms.swapaxes(1, 2)
        used, used_constant = (
            np.abs(rows @ guard).astype(np.float64),
            np.abs(constants @ guard).astype(np.float64),
        )
        whole = (np.abs(rows) @ np.abs(guard)).astype(np.float64).sum(axis=0)
        whole_constant = float((np.abs(constants) @ np.abs(guard)).sum())
        whole_constant += on_gap * height if np.isfinite(height) else 0.0
        k = np.arange(TERMS)
        fourth, second = k * (k - 1) * (k - 2) * (k - 3), k * (k - 1) / 8
        size = system.dampers + j
        flow.bound[slot][:, j], flow.bound_constant[slot][j] = fourth @ used, fourth @ used_constant
        flow.bound[slot][:, size], flow.bound_constant[slot][size] = whole, whole_constant
        flow.margin[slot][:, j] = second @ used + 2 * ROUNDING * whole
        flow.margin_constant[slot][j] = second @ used_constant + 2 * ROUNDING * whole_constant


def tables_for(system: HybridSystem, drive: Drive, step: float) -> FlowTables:
    """Give the tables of a system: those made for it the last time, if that is not long ago."""
    arrays = [
        value for part in (system, drive) for value in vars(part).values() if isinstance(value, np.ndarray)
    ]
    key = (step, drive.fastest, system.gravity, *(array.tobytes() for array in arrays))
    with _LOCK:
        tables = _RECENT.pop(key, None) or FlowTables(system, drive, step)
        if tables.tabulated:
            _RECENT[key] = tables
        while len(_RECENT) > RECENT:
            _RECENT.popitem(last=False)
    return tables


def _power_terms(matrix: np.ndarray) -> np.ndarray:
    """matrix^k / k! for k below TERMS, in the precision of the matrix."""
    powers = np.empty((TERMS, *matrix.shape), dtype=matrix.dtype)
    powers[0] = np.eye(len(matrix), dtype=matrix.dtype)
    powers[1] = matrix
    known = 2
    while known < TERMS:
        more = min(known - 1, TERMS - known)
        powers[known : known + more] = powers[known - 1] @ powers[1 : 1 + more]
        known += more
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
