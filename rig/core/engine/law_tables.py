"""Contact laws as flat tables for the kernel, and the signals of the present modes.

The modes and exits of all elements are numbered one after another. A *lane* is the place of a signal: an element has as
many lanes as its richest mode has signals. A signal is a sum of factors times entries of the extended state (states,
accelerations, derivatives of the accelerations), plus a constant and, for a flying detached mass, its height. As a
signal, the holding force is divided by the mass of the element: it is the acceleration of the body, minus the
acceleration that gravity and other forces would give the mass.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rig.core.laws.law import Exit, Mode, Row, Signal
from rig.core.system.hybrid_system import Element, HybridSystem

#: Index of the lower and of the upper end of a signal's interval.
LOW, HIGH = 0, 1
#: Value that marks a missing exit, candidate or restitution.
NONE = -1
#: A gap that is smaller than this fraction of speed times sqrt(mass / stiffness) may be a rounding error of zero.
GAP_ROUNDING_RATIO = 1e-9


#: Columns of `Signals.numbers`: constant part of the signal; gap at which its first term is zero, m; factor of the
#: height of a detached mass; lower and upper limit; both limits with the margins of the envelope
#: (`rig.core.engine.screening`); from `SCALE` on, the factors of the terms.
OFFSET, REST, FLIES, LOWER, UPPER, LOWEST, HIGHEST, SCALE = range(8)
#: Columns of `Signals.indices`: element; number of its mode; 1 if the signal contains accelerations, else 0; row in the
#: tables of bounds; from `ENTRY` on, two indices for each term: its quantity in the extended state, and the rate of
#: this quantity.
ELEMENT, MODE, ORDER, BOUND, ENTRY, RATE = range(6)


class LawTables(NamedTuple):
    """The laws of all elements; m is the number of a mode, x of an exit.

    terms: largest number of terms of a signal. first_mode, first_lane: number of the first mode and lane of each
    element, then their counts. stride (of each element), force_index[m]: see `HybridSystem.strides`.

    wall[m]: contact in results. push[m]: direction in which this wall pushes, 1 or -1. wall_gap[m]: gap of a held mass,
    m. is_held[m]. transmits[m]: whether the holding force can be an impulse. can_hit[m]: whether the mode can end in an
    impact. flies[m]: 1 for a detached mass that is not held, else 0. force[m]: factors of gap and speed, relaxed gap,
    constant part, and factor of the memory.

    numbers, indices [m, lane of the element]: see `Signals`. exit[m, lane, end]. rounding[m, lane]: largest value of
    the signal, per unit of speed, that may be a rounding error of the gap. is_speed[m, lane]: whether the signal is the
    speed. factors[m, lane]: factors of gap and speed in the signal.

    target[x, candidate]: next mode, as number within the element. event[x]: kind. restitution[x].
    """

    terms: int
    first_mode: np.ndarray
    first_lane: np.ndarray
    stride: np.ndarray
    force_index: np.ndarray
    wall: np.ndarray
    push: np.ndarray
    wall_gap: np.ndarray
    is_held: np.ndarray
    transmits: np.ndarray
    can_hit: np.ndarray
    flies: np.ndarray
    force: np.ndarray
    numbers: np.ndarray
    indices: np.ndarray
    exit: np.ndarray
    rounding: np.ndarray
    is_speed: np.ndarray
    factors: np.ndarray
    target: np.ndarray
    event: np.ndarray
    restitution: np.ndarray


class Signals(NamedTuple):
    """The signals of the present modes, one row for each lane, which the kernel reads in every step.

    Each row is copied from the tables of the laws when the mode changes; the columns are the constants above.
    """

    numbers: np.ndarray
    indices: np.ndarray


class SignalTerms(NamedTuple):
    """A signal without limits: entries of the extended state, their factors, order, constant part and relaxed gap."""

    entries: tuple[int, ...]
    factors: tuple[float, ...]
    order: int
    offset: float
    rest: float


def signal_terms(system: HybridSystem, element: Element, mode: Mode, signal: Signal, size: int) -> SignalTerms:
    """Return the terms of a signal; `size`: number of states with the drive."""
    row = signal.row
    if row.hold:
        offset = row.hold * -system.other_acceleration(element, mode.wall_gap)
        return SignalTerms((size + element.body,), (row.hold,), 1, offset, 0.0)
    if element.gap < 0:
        return SignalTerms((element.body,), (-row.gap,), 0, 0.0, 0.0)
    n, direction = system.coordinates, element.direction
    terms = [(i, factor * row.gap) for i, factor in direction] + [
        (n + i, factor * row.speed) for i, factor in direction
    ]
    terms += [(element.memory, row.memory)]
    entries, factors = zip(*(term for term in terms if term[1]), strict=True)
    return SignalTerms(entries, factors, 0, -row.gap * row.rest, row.rest)


class BoundedSignals(NamedTuple):
    """The signals that need bounds: the different signals of every element under each of its forces.

    first_row: first row of each element in the tables of bounds, then the number of rows. signals[element][force
    index]: terms of the signals, with the largest magnitude of their limits and constant parts.
    """

    first_row: list[int]
    signals: list[list[dict[SignalTerms, float]]]


def _limits(element: Element, signal: Signal) -> tuple[float, float]:
    """Return the limits of a signal; limits of a holding force are divided by the mass of the element."""
    unit = element.mass if signal.row.hold else 1.0
    return signal.low / unit, signal.high / unit


def bounded_signals(system: HybridSystem, size: int) -> BoundedSignals:
    """Collect the signals that need bounds; `size`: number of states with the drive."""
    first_row, signals = [0], []
    for element in system.elements:
        by_force: list[dict[SignalTerms, float]] = [{} for _ in element.law.forces]
        for name, mode in element.law.modes.items():
            of_force = by_force[element.law.force_indices[name]]
            for signal in mode.signals:
                terms = signal_terms(system, element, mode, signal, size)
                values = (terms.offset, *_limits(element, signal))
                constants = [abs(value) for value in values if math.isfinite(value)]
                of_force[terms] = max(of_force.get(terms, 0.0), *constants)
        signals.append(by_force)
        first_row.append(first_row[-1] + max(map(len, by_force)))
    return BoundedSignals(first_row, signals)


def _gap_rounding(element: Element) -> float:
    """Return the largest gap, per unit of speed, that may be a rounding error of zero, s; 0 without springs."""
    stiffness = [-mode.force.gap for mode in element.law.modes.values() if mode.force is not None and mode.force.gap]
    return GAP_ROUNDING_RATIO * math.sqrt(element.mass / min(stiffness)) if stiffness else 0.0


def _signal_rounding(element: Element, signal: Signal) -> float:
    """Return the largest value of a signal, per unit of speed, that may be a rounding error of the gap."""
    row, rounding = signal.row, _gap_rounding(element)
    return GAP_ROUNDING_RATIO * math.sqrt(-row.gap * element.mass) if row.gap < 0.0 else rounding


def law_tables(system: HybridSystem, size: int) -> LawTables:
    """Compile the laws of a system; `size`: number of states with the drive."""
    modes: list[tuple[int, Element, Mode]] = [
        (j, element, mode) for j, element in enumerate(system.elements) for mode in element.law.modes.values()
    ]
    force_index = [index for element in system.elements for index in element.law.force_indices.values()]
    elements = system.elements
    lanes = [max(len(mode.signals) for mode in element.law.modes.values()) for element in elements]
    terms = {
        (m, lane): signal_terms(system, element, mode, signal, size)
        for m, (_, element, mode) in enumerate(modes)
        for lane, signal in enumerate(mode.signals)
    }
    width, n_terms = max(lanes, default=1), max((len(signal.entries) for signal in terms.values()), default=1)
    shape, n = (len(modes), width), system.coordinates
    number = np.zeros((*shape, SCALE + n_terms))
    index = np.zeros((*shape, ENTRY + 2 * n_terms), dtype=np.int64)
    rounding, is_speed, row_factors = np.zeros(shape), np.zeros(shape, dtype=bool), np.zeros((*shape, 2))
    number[..., LOWER], number[..., UPPER] = -np.inf, np.inf
    for m, (j, element, mode) in enumerate(modes):
        index[m, :, ELEMENT], index[m, :, MODE] = j, m
        number[m, :, FLIES] = element.gap < 0 and mode.force is not None
    exit_number = np.full((*shape, 2), NONE, dtype=np.int64)
    exits: list[tuple[Element, Exit]] = []
    bounded = bounded_signals(system, size)
    for (m, lane), signal_parts in terms.items():
        j, element, mode = modes[m]
        signal, count = mode.signals[lane], len(signal_parts.entries)
        entry = np.array(signal_parts.entries)
        number[m, lane, [OFFSET, REST]] = signal_parts.offset, signal_parts.rest
        number[m, lane, [LOWER, UPPER]] = _limits(element, signal)
        number[m, lane, SCALE : SCALE + count] = signal_parts.factors
        of_force = bounded.signals[j][force_index[m]]
        bound = bounded.first_row[j] + list(of_force).index(signal_parts)
        index[m, lane, [ORDER, BOUND]] = signal_parts.order, bound
        index[m, lane, ENTRY : ENTRY + 2 * count : 2] = entry
        # The rate of a velocity is stored after the state; that of any other quantity, n entries after it.
        index[m, lane, RATE : RATE + 2 * count : 2] = entry + np.where((n <= entry) & (entry < 2 * n), size - n, n)
        rounding[m, lane] = _signal_rounding(element, signal)
        is_speed[m, lane] = signal.row.speed != 0.0 and signal.row.gap == 0.0
        row_factors[m, lane] = signal.row.gap, signal.row.speed
        for end, (_, exit_) in enumerate(signal.ends):
            if exit_ is not None:
                exit_number[m, lane, end] = len(exits)
                exits.append((element, exit_))
    target = np.full((max(1, len(exits)), max((len(exit_.to) for _, exit_ in exits), default=1)), NONE, dtype=np.int64)
    for x, (element, exit_) in enumerate(exits):
        target[x, : len(exit_.to)] = [list(element.law.modes).index(name) for name in exit_.to]
    forces = [mode.force or Row() for _, _, mode in modes]
    counts = [len(element.law.modes) for element in elements]
    return LawTables(
        terms=n_terms,
        first_mode=np.cumsum([0, *counts], dtype=np.int64),
        first_lane=np.cumsum([0, *lanes], dtype=np.int64),
        stride=np.array(system.strides, dtype=np.int64),
        force_index=np.array(force_index, dtype=np.int64),
        wall=np.array([mode.wall for _, _, mode in modes], dtype=np.int8),
        push=np.array([mode.push for _, _, mode in modes]),
        wall_gap=np.array([mode.wall_gap for _, _, mode in modes]),
        is_held=np.array([mode.force is None for _, _, mode in modes], dtype=bool),
        transmits=np.array([mode.transmits_impulses for _, _, mode in modes], dtype=bool),
        can_hit=np.array([mode.ends_by_impact for _, _, mode in modes], dtype=bool),
        flies=np.array([float(element.gap < 0 and mode.force is not None) for _, element, mode in modes]),
        force=np.array([[row.gap, row.speed, row.rest, row.constant, row.memory] for row in forces]).reshape(-1, 5),
        numbers=number,
        indices=index,
        exit=exit_number,
        rounding=rounding,
        is_speed=is_speed,
        factors=row_factors,
        target=target,
        event=np.array([exit_.event for _, exit_ in exits], dtype=np.int64),
        restitution=np.array([NONE if exit_.restitution is None else exit_.restitution for _, exit_ in exits], float),
    )


def empty_signals(laws: LawTables) -> Signals:
    """Return arrays for the signals of all lanes, to be filled by the kernel (`load_signals`)."""
    counts = np.diff(laws.first_lane)
    index = np.full((int(laws.first_lane[-1]), laws.indices.shape[2]), NONE)
    index[:, ELEMENT] = np.repeat(np.arange(len(counts)), counts)
    return Signals(np.zeros((len(index), laws.numbers.shape[2])), index)
