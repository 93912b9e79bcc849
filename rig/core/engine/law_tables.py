"""Contact laws as flat tables for the kernel, and the signals of the present modes.

The modes and exits of all elements are numbered one after another. A *lane* is the place of a signal: an element has as
many lanes as its richest mode has signals. A signal is a sum of factors times entries of the extended state (states,
accelerations, derivatives of the accelerations), plus a constant and, for a flying detached mass, its height. As a
signal, the holding force is divided by the mass of the element: it is the acceleration of the body, minus the
acceleration that gravity and other forces would give the mass.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.core.laws.law import Exit, Mode, Row, Signal
from rig.core.system.hybrid_system import Element, HybridSystem

#: Index of the lower and of the upper end of a signal's interval.
LOW, HIGH = 0, 1
#: Value that marks a missing exit, candidate or restitution.
NONE = -1
#: A gap that is smaller than this fraction of speed times sqrt(mass / stiffness) may be a rounding error of zero.
GAP_ROUNDING_RATIO = 1e-9


#: Columns of `Signals.numbers`: constant part of the signal; gap at which its first term is zero, m; factor of the
#: height of a detached mass; lower and upper limit; from `SCALE` on, the factors of the terms.
OFFSET, REST, FLIES, LOWER, UPPER, SCALE = range(6)
#: Columns of `Signals.indices`: element; 1 if the signal contains accelerations, else 0; row in the
#: tables of bounds; from `ENTRY` on, two indices for each term: its quantity in the extended state, and the rate of
#: this quantity.
ELEMENT, ORDER, BOUND, ENTRY, RATE = range(5)


#: Constants of an element. mass: kg. position_index, velocity_index: indices of the position and velocity of its body
#: in the state. gap_coordinate: index of the gap in the state; -1 for a detached mass. base_coordinate: index of the
#: coordinate that is subtracted from the gap coordinate; -1 if none is. memory_coordinate: index of the memory; -1
#: without memory. first_mode, first_lane: number of its first mode and lane. lanes: their count. stride: see
#: `HybridSystem.strides`.
ELEMENT_FIELDS = np.dtype(
    [
        ("mass", np.float64),
        *((name, np.uintp) for name in ("position_index", "velocity_index")),
        *((name, np.int64) for name in ("gap_coordinate", "base_coordinate", "memory_coordinate")),
        *((name, np.int64) for name in ("first_mode", "first_lane", "lanes", "stride")),
    ]
)
#: Constants of a mode. force_index: see `HybridSystem.strides`. wall: contact in results. push: direction in which this
#: wall pushes, 1 or -1. wall_gap: gap of a held mass, m. transmits: whether the holding force can be an impulse.
#: can_hit: whether the mode can end in an impact. flies: 1 for a detached mass that is not held, else 0. force_gap to
#: force_memory: the force, as in `rig.core.laws.law.Row`.
MODE_FIELDS = np.dtype(
    [
        ("force_index", np.int64),
        ("wall", np.int64),
        *((name, np.float64) for name in ("push", "wall_gap", "flies")),
        *((f"force_{name}", np.float64) for name in Row._fields),
        *((name, np.bool_) for name in ("is_held", "transmits", "can_hit")),
    ]
)
#: Constants of a signal. rounding: largest value of the signal, per unit of speed, that may be a rounding error of the
#: gap. gap_factor, speed_factor: factors of gap and speed in the signal. is_speed: whether the signal is the speed.
SIGNAL_FIELDS = np.dtype(
    [*((name, np.float64) for name in ("rounding", "gap_factor", "speed_factor")), ("is_speed", np.bool_)]
)
#: Constants of an exit. event: its kind. restitution: negative without impact.
EXIT_FIELDS = np.dtype([("event", np.int64), ("restitution", np.float64)])
Records = np.recarray[Any, Any]
Ints = NDArray[np.int64]


def _records(fields: np.dtype[Any], rows: Iterable[tuple[Any, ...]]) -> Records:
    """Return an array of records."""
    return np.array(list(rows), dtype=fields).view(np.recarray)


class LawTables(NamedTuple):
    """The laws of all elements; m is the number of a mode, x of an exit.

    elements[j], modes[m], signals[m, lane of the element], exits[x]:
    records (`ELEMENT_FIELDS` and so on). numbers, indices [m, lane of the element]: see `Signals`.
    exit[m, lane, end]: number of an exit. target[x, candidate]: next mode, as number within the element.
    """

    elements: Records
    modes: Records
    signals: Records
    numbers: np.ndarray
    indices: np.ndarray
    exit: np.ndarray
    exits: Records
    target: np.ndarray


class Signals(NamedTuple):
    """The signals of the present modes, which the kernel reads in every step.

    terms: largest number of terms of a signal. row: row of each lane in `numbers` and `indices`, which contain the
    signals of all modes (columns: see above).
    lowest, highest: limits of each lane with the margins of the envelope (`rig.core.engine.screening`).
    """

    terms: int
    row: np.ndarray
    numbers: np.ndarray
    indices: np.ndarray
    lowest: np.ndarray
    highest: np.ndarray


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
    signals = np.zeros(shape, dtype=SIGNAL_FIELDS).view(np.recarray)
    number[..., LOWER], number[..., UPPER] = -np.inf, np.inf
    for m, (j, element, mode) in enumerate(modes):
        index[m, :, ELEMENT] = j
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
        is_speed = signal.row.speed != 0.0 and signal.row.gap == 0.0
        signals[m, lane] = (_signal_rounding(element, signal), signal.row.gap, signal.row.speed, is_speed)
        for end, (_, exit_) in enumerate(signal.ends):
            if exit_ is not None:
                exit_number[m, lane, end] = len(exits)
                exits.append((element, exit_))
    target = np.full((max(1, len(exits)), max((len(exit_.to) for _, exit_ in exits), default=1)), NONE, dtype=np.int64)
    for x, (element, exit_) in enumerate(exits):
        target[x, : len(exit_.to)] = [list(element.law.modes).index(name) for name in exit_.to]
    first_mode = np.cumsum([0, *(len(element.law.modes) for element in elements)])
    first_lane = np.cumsum([0, *lanes])
    element_rows = [
        (element.mass, element.body, n + element.body, element.gap, element.base, element.memory, *numbers)
        for element, *numbers in zip(elements, first_mode, first_lane, lanes, system.strides, strict=False)
    ]
    mode_rows = [
        (
            *(force, mode.wall, mode.push, mode.wall_gap, element.gap < 0 and mode.force is not None),
            *(mode.force or Row()),
            *(mode.force is None, mode.transmits_impulses, mode.ends_by_impact),
        )
        for force, (_, element, mode) in zip(force_index, modes, strict=True)
    ]
    exit_rows = [(exit_.event, NONE if exit_.restitution is None else exit_.restitution) for _, exit_ in exits]
    return LawTables(
        elements=_records(ELEMENT_FIELDS, element_rows),
        modes=_records(MODE_FIELDS, mode_rows),
        signals=signals,
        numbers=number,
        indices=index,
        exit=exit_number,
        exits=_records(EXIT_FIELDS, exit_rows),
        target=target,
    )


def empty_signals(laws: LawTables) -> Signals:
    """Return the signals of all lanes, whose rows the kernel sets (`load_signals`)."""
    lanes = int(laws.elements.lanes.sum())
    return Signals(
        terms=laws.numbers.shape[2] - SCALE,
        row=np.zeros(lanes, dtype=np.int64),
        numbers=laws.numbers.reshape(-1, laws.numbers.shape[2]),
        indices=laws.indices.reshape(-1, laws.indices.shape[2]),
        lowest=np.zeros(lanes),
        highest=np.zeros(lanes),
    )
