"""Contact laws as flat tables for the kernel, and the signals of the present regimes.

The regimes and transitions of all elements are numbered one after another. A *slot* is the place of a signal: an
element has as many slots as any of its regimes has signals. A signal is a sum of factors times entries of the extended
state (states, accelerations, derivatives of the accelerations), plus a constant and, for a flying detached mass, its
height. As a signal, the holding force is divided by the mass of the element: it is the acceleration of the body, minus
the acceleration that gravity and other forces would give the mass.
"""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.core.laws.law import Regime, Row, Signal, Transition
from rig.core.system.hybrid_system import Element, HybridSystem

#: Index of the lower and of the upper end of a signal's interval.
LOW, HIGH = 0, 1
#: Value that marks a missing transition, candidate or restitution.
NONE = -1
#: A gap that is smaller than this fraction of speed times sqrt(mass / stiffness) may be a rounding error of zero.
GAP_ROUNDING_RATIO = 1e-9


#: Columns of `Signals.numbers`: constant part of the signal; gap at which its first term is zero [m]; factor of the
#: height of a detached mass; lower and upper limit; from `SCALE` on, the factors of the terms.
OFFSET, REST, FLIES, LOWER, UPPER, SCALE = range(6)
#: Columns of `Signals.indices`: element; 1 if the signal contains accelerations, else 0; row in the
#: tables of bounds; from `ENTRY` on, two indices for each term: its quantity in the extended state, and the rate of
#: this quantity.
ELEMENT, ORDER, BOUND, ENTRY, RATE = range(5)


#: Constants of an element. mass: kg. position_index, velocity_index: indices of the position and velocity of its body
#: in the state. gap_coordinate: index of the gap in the state; -1 for a detached mass. base_coordinate: index of the
#: coordinate that is subtracted from the gap coordinate; -1 if none is. slider_coordinate: index of the slider
#: displacement; -1 without slider. first_regime, first_slot: number of its first regime and slot. slots: their count.
#: stride: see `HybridSystem.strides`.
ELEMENT_FIELDS = np.dtype(
    [
        ("mass", np.float64),
        *((name, np.uintp) for name in ("position_index", "velocity_index")),
        *((name, np.int64) for name in ("gap_coordinate", "base_coordinate", "slider_coordinate")),
        *((name, np.int64) for name in ("first_regime", "first_slot", "slots", "stride")),
    ]
)
#: Constants of a regime. force_index: see `HybridSystem.strides`. wall: contact in results. push: direction in which
#: this wall pushes, 1 or -1. wall_gap: gap of a held mass, m. transmits: whether the holding force can be an impulse.
#: can_hit: whether the regime can end in an impact. flies: 1 for a detached mass that is not held, else 0. force_gap to
#: force_slider: the force, as in `rig.core.laws.law.Row`.
REGIME_FIELDS = np.dtype(
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
#: Constants of a transition. event: its kind. restitution: negative without impact.
TRANSITION_FIELDS = np.dtype([("event", np.int64), ("restitution", np.float64)])
Records = np.recarray[Any, Any]
Ints = NDArray[np.int64]


def _records(fields: np.dtype[Any], rows: Iterable[tuple[Any, ...]]) -> Records:
    """Return an array of records."""
    return np.array(list(rows), dtype=fields).view(np.recarray)


class LawTables(NamedTuple):
    """The laws of all elements; m is the number of a regime, x of a transition.

    elements[j], regimes[m], signals[m, slot of the element], transitions[x]:
    records (`ELEMENT_FIELDS` and so on). numbers, indices [m, slot of the element]: see `Signals`.
    transition[m, slot, end]: number of a transition. target[x, candidate]: next regime, as number within the element.
    """

    elements: Records
    regimes: Records
    signals: Records
    numbers: np.ndarray
    indices: np.ndarray
    transition: np.ndarray
    transitions: Records
    target: np.ndarray


class Signals(NamedTuple):
    """The signals of the present regimes, which the kernel reads in every step.

    terms: largest number of terms of a signal. row: row of each slot in `numbers` and `indices`, which contain the
    signals of all regimes (columns: see above).
    lowest, highest: limits of each slot with the margins of the envelope (`rig.core.engine.screening`).
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


def signal_terms(system: HybridSystem, element: Element, regime: Regime, signal: Signal, size: int) -> SignalTerms:
    """Return the terms of a signal; `size`: number of states with the drive."""
    row = signal.row
    if row.hold:
        offset = row.hold * -system.other_acceleration(element, regime.wall_gap)
        return SignalTerms((size + element.body,), (row.hold,), 1, offset, 0.0)
    if element.gap < 0:
        return SignalTerms((element.body,), (-row.gap,), 0, 0.0, 0.0)
    n, direction = system.coordinates, element.direction
    terms = [(i, factor * row.gap) for i, factor in direction] + [
        (n + i, factor * row.speed) for i, factor in direction
    ]
    terms += [(element.slider, row.slider)]
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
        for name, regime in element.law.regimes.items():
            of_force = by_force[element.law.force_indices[name]]
            for signal in regime.signals:
                terms = signal_terms(system, element, regime, signal, size)
                values = (terms.offset, *_limits(element, signal))
                constants = [abs(value) for value in values if math.isfinite(value)]
                of_force[terms] = max(of_force.get(terms, 0.0), *constants)
        signals.append(by_force)
        first_row.append(first_row[-1] + max(map(len, by_force)))
    return BoundedSignals(first_row, signals)


def _gap_rounding(element: Element) -> float:
    """Return the largest gap, per unit of speed, that may be a rounding error of zero [s]; 0 without springs."""
    stiffness = [
        -regime.force.gap for regime in element.law.regimes.values() if regime.force is not None and regime.force.gap
    ]
    return GAP_ROUNDING_RATIO * math.sqrt(element.mass / min(stiffness)) if stiffness else 0.0


def _signal_rounding(element: Element, signal: Signal) -> float:
    """Return the largest value of a signal, per unit of speed, that may be a rounding error of the gap."""
    row, rounding = signal.row, _gap_rounding(element)
    return GAP_ROUNDING_RATIO * math.sqrt(-row.gap * element.mass) if row.gap < 0.0 else rounding


def law_tables(system: HybridSystem, size: int) -> LawTables:
    """Compile the laws of a system; `size`: number of states with the drive."""
    regimes: list[tuple[int, Element, Regime]] = [
        (j, element, regime) for j, element in enumerate(system.elements) for regime in element.law.regimes.values()
    ]
    force_index = [index for element in system.elements for index in element.law.force_indices.values()]
    elements = system.elements
    slots = [max(len(regime.signals) for regime in element.law.regimes.values()) for element in elements]
    terms = {
        (m, slot): signal_terms(system, element, regime, signal, size)
        for m, (_, element, regime) in enumerate(regimes)
        for slot, signal in enumerate(regime.signals)
    }
    width, n_terms = max(slots, default=1), max((len(signal.entries) for signal in terms.values()), default=1)
    shape, n = (len(regimes), width), system.coordinates
    number = np.zeros((*shape, SCALE + n_terms))
    index = np.zeros((*shape, ENTRY + 2 * n_terms), dtype=np.int64)
    signals = np.zeros(shape, dtype=SIGNAL_FIELDS).view(np.recarray)
    number[..., LOWER], number[..., UPPER] = -np.inf, np.inf
    for m, (j, element, regime) in enumerate(regimes):
        index[m, :, ELEMENT] = j
        number[m, :, FLIES] = element.gap < 0 and regime.force is not None
    transition_number = np.full((*shape, 2), NONE, dtype=np.int64)
    transitions: list[tuple[Element, Transition]] = []
    bounded = bounded_signals(system, size)
    for (m, slot), signal_parts in terms.items():
        j, element, regime = regimes[m]
        signal, count = regime.signals[slot], len(signal_parts.entries)
        entry = np.array(signal_parts.entries)
        number[m, slot, [OFFSET, REST]] = signal_parts.offset, signal_parts.rest
        number[m, slot, [LOWER, UPPER]] = _limits(element, signal)
        number[m, slot, SCALE : SCALE + count] = signal_parts.factors
        of_force = bounded.signals[j][force_index[m]]
        bound = bounded.first_row[j] + list(of_force).index(signal_parts)
        index[m, slot, [ORDER, BOUND]] = signal_parts.order, bound
        index[m, slot, ENTRY : ENTRY + 2 * count : 2] = entry
        # The rate of a velocity is stored after the state; that of any other quantity, n entries after it.
        index[m, slot, RATE : RATE + 2 * count : 2] = entry + np.where((n <= entry) & (entry < 2 * n), size - n, n)
        is_speed = signal.row.speed != 0.0 and signal.row.gap == 0.0
        signals[m, slot] = (_signal_rounding(element, signal), signal.row.gap, signal.row.speed, is_speed)
        for end, (_, transition) in enumerate(signal.ends):
            if transition is not None:
                transition_number[m, slot, end] = len(transitions)
                transitions.append((element, transition))
    n_candidates = max((len(transition.to) for _, transition in transitions), default=1)
    target = np.full((max(1, len(transitions)), n_candidates), NONE, dtype=np.int64)
    for x, (element, transition) in enumerate(transitions):
        target[x, : len(transition.to)] = [list(element.law.regimes).index(name) for name in transition.to]
    first_regime = np.cumsum([0, *(len(element.law.regimes) for element in elements)])
    first_slot = np.cumsum([0, *slots])
    element_rows = [
        (element.mass, element.body, n + element.body, element.gap, element.base, element.slider, *numbers)
        for element, *numbers in zip(elements, first_regime, first_slot, slots, system.strides, strict=False)
    ]
    regime_rows = [
        (
            *(force, regime.wall, regime.push, regime.wall_gap, element.gap < 0 and regime.force is not None),
            *(regime.force or Row()),
            *(regime.force is None, regime.transmits_impulses, regime.ends_by_impact),
        )
        for force, (_, element, regime) in zip(force_index, regimes, strict=True)
    ]
    transition_rows = [(each.event, NONE if each.restitution is None else each.restitution) for _, each in transitions]
    return LawTables(
        elements=_records(ELEMENT_FIELDS, element_rows),
        regimes=_records(REGIME_FIELDS, regime_rows),
        signals=signals,
        numbers=number,
        indices=index,
        transition=transition_number,
        transitions=_records(TRANSITION_FIELDS, transition_rows),
        target=target,
    )


def empty_signals(laws: LawTables) -> Signals:
    """Return the signals of all slots, whose rows the kernel sets (`load_signals`)."""
    slots = int(laws.elements.slots.sum())
    return Signals(
        terms=laws.numbers.shape[2] - SCALE,
        row=np.zeros(slots, dtype=np.int64),
        numbers=laws.numbers.reshape(-1, laws.numbers.shape[2]),
        indices=laws.indices.reshape(-1, laws.indices.shape[2]),
        lowest=np.zeros(slots),
        highest=np.zeros(slots),
    )
