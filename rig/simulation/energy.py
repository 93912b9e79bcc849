"""The energy balance of a run: work of the drive, stored energy, and dissipated energy.

Work and dissipation are quadratic forms of the state, integrated over every stretch between samples and breaks
by Gauss-Legendre quadrature of the exact flow; losses in impacts are the jumps of kinetic energy. No
term is computed as the difference of the others, so the residual is a test of the engine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array
from rig.engine.flow_tables import FlowTables
from rig.engine.propagator import Propagator
from rig.engine.state import CEILING, FLIGHT, FLOOR
from rig.engine.trajectory import Trajectory
from rig.numerics.bernstein import LENGTH
from rig.scene.scene import Scene
from rig.scene.shaker import ElectrodynamicShaker, TableShaker, at_shaker
from rig.system.hybrid_system import FORCE_OF_BED, HybridSystem

#: Gauss-Legendre nodes and weights on [0, 1]; within a step 8 of them integrate a product of two solutions to
#: rounding.
_GAUSS = tuple(0.5 * part for part in np.polynomial.legendre.leggauss(8) + np.array([[1.0], [0.0]]))
# Numbers of a power series in memory at a time.
_NUMBERS = 1 << 21


@dataclass(frozen=True)
class Energy:
    """Energy balance over a run, J.

    `stored`, `stored_before`: kinetic, elastic (including contacts), gravitational (dampers) and magnetic energy at
    the end and at the start.

    `contacts`: energy lost in finite-duration contacts: in dashpots, and remaining in contact springs at release.
    """

    work: float  # work of the drive: of the force, of the table on the coil spring, or of the amplifier on the coil
    stored: float
    stored_before: float
    dissipated: float  # energy dissipated in structural damping, suspension and coil resistance
    impacts: float  # energy lost in impacts
    contacts: float
    grains: float  # energy transferred to beds of grains: stored in their motion, and dissipated

    @property
    def residual(self) -> float:
        """Work minus all stored, dissipated, lost and transferred energy; zero within rounding."""
        lost = self.dissipated + self.impacts + self.contacts + self.grains
        return self.work - (self.stored - self.stored_before) - lost


def total(stretches: Sequence[Energy]) -> Energy:
    """Add the energy balances of successive stretches."""
    flows = ("work", "dissipated", "impacts", "contacts", "grains")
    ends = {"stored": stretches[-1].stored, "stored_before": stretches[0].stored_before}
    return Energy(**ends, **{name: sum(getattr(each, name) for each in stretches) for name in flows})


@dataclass(frozen=True)
class Forms:
    """Quadratic forms of the augmented state z (states, then drive), as symmetric matrices."""

    stored: Array
    dissipated: Array
    power: Array
    to_grains: Array


def forms(scene: Scene, system: HybridSystem, output: Array) -> Forms:
    """Return stored energy, dissipation, and power of the drive and into beds of grains as quadratic forms.

    `output`: u = output p.
    """
    n, ns = system.coordinates, system.states
    size = ns + output.shape[1]
    mass = system.mass.copy()
    stiffness = -system.force_state[:, :n]
    damping = -system.force_state[:, n : 2 * n]
    push = np.zeros((n, size))
    beds = np.array([name.startswith(f"{FORCE_OF_BED} ") for name in system.inputs], dtype=bool)
    push[:, ns:] = system.force_drive[:, ~beds] @ output[~beds]
    to_grains = np.zeros((size, size))
    to_grains[n : 2 * n, ns:] = -system.force_drive[:, beds] @ output[beds]
    power = np.zeros((size, size))
    for number, shaker in enumerate(scene.shakers, 1):
        if isinstance(shaker, TableShaker):
            # The table motion is prescribed: it does work on the coil spring, and its own energy is not included.
            table = system.points.index(at_shaker("table", number, len(scene.shakers)))
            body = shaker.body - 1
            mass[table, table] = damping[table, table] = 0.0
            push[table] = 0.0
            stiffness[table, table] = shaker.spring
            stiffness[table, body] = -shaker.spring
            force = np.zeros(size)
            force[table], force[body] = shaker.spring, -shaker.spring
            power[n + table] += force
    power[n : 2 * n] += push
    stored = np.zeros((size, size))
    stored[:n, :n] = stiffness
    stored[n : 2 * n, n : 2 * n] = mass
    dissipated = np.zeros((size, size))
    dissipated[n : 2 * n, n : 2 * n] = damping
    current = 2 * n
    for number, shaker in enumerate(scene.shakers, 1):
        if isinstance(shaker, ElectrodynamicShaker) and shaker.amplifier.mode == "voltage":
            stored[current, current] = shaker.coil.inductance
            dissipated[current, current] = shaker.coil.resistance
            drive = output[system.inputs.index(at_shaker("shaker", number, len(scene.shakers)))]
            power[current, ns:] = shaker.amplifier.gain * drive
            current += 1
    return Forms(0.5 * _symmetric(stored), _symmetric(dissipated), _symmetric(power), _symmetric(to_grains))


def _symmetric(matrix: Array) -> Array:
    return 0.5 * (matrix + matrix.T)


def _quadratic(form: Array, states: Array) -> Array:
    return ((states @ form) * states).sum(axis=-1)


@dataclass(frozen=True)
class Ends:
    """Complete state at one instant: augmented state, and height, velocity and mode of every damper."""

    state: Array
    height: Array
    speed: Array
    mode: NDArray[Any]


def ends_of(propagator: Propagator) -> Ends:
    """Copy the complete state of a propagator."""
    state = propagator.state
    return Ends(state.z.copy(), state.height.copy(), state.speed.copy(), state.mode.copy())


def ledger(
    scene: Scene,
    tables: FlowTables,
    start: Ends,
    end: Ends,
    trajectory: Trajectory,
    begins: Array,
    durations: Array,
) -> Energy:
    """Compute the energy balance of a simulated motion.

    `scene`, `tables`: the scene and the flow tables of its simulation; `start`, `end`: the complete state before and
    after; `begins`: states at which the segments begin; `durations`: lengths of the segments, s.
    """
    quadratic = forms(scene, tables.system, tables.drive.output)
    states, slots, lengths, _ = _stretches(tables, trajectory, begins, durations)
    work, dissipated, dashpots, to_grains = _integrals(tables, quadratic, states, slots, lengths)
    return Energy(
        work=work,
        stored=_stored(tables, quadratic, end),
        stored_before=_stored(tables, quadratic, start),
        dissipated=dissipated,
        impacts=_impact_losses(tables.system, trajectory),
        contacts=dashpots + _relaxed(tables, trajectory),
        grains=to_grains,
    )


def fourier(
    tables: FlowTables, trajectory: Trajectory, begins: Array, durations: Array, omega: float
) -> NDArray[np.complex128]:
    """Integrate z(t) e^{-i omega t} over a motion with segments no longer than a step, shape (size,).

    Kinks at impacts are boundaries of stretches, so quadrature has its full order.
    """
    states, slots, lengths, starts = _stretches(tables, trajectory, begins, durations)
    total = np.zeros(tables.size, dtype=np.complex128)
    nodes, at_nodes = _GAUSS
    powers = np.vander(nodes, LENGTH + 1, increasing=True).T * at_nodes
    part, most = lengths / tables.step, max(1, _NUMBERS // (tables.size * (LENGTH + 1)))
    for slot in np.unique(slots):
        every = np.flatnonzero(slots == slot)
        for rows in np.split(every, range(most, every.size, most)):
            # Sum over the nodes first, because the series has many terms but few weights.
            turns = np.exp(-1j * omega * (starts[rows] + nodes[:, None] * lengths[rows]))
            weights = (powers @ turns) * (
                np.vander(part[rows], LENGTH + 1, increasing=True).T * lengths[rows]
            )
            both = np.stack([weights.real, weights.imag], axis=1) @ _series(tables, int(slot), states[rows])
            total += [1.0, 1.0j] @ both.sum(axis=0)
    return total


def _stretches(
    tables: FlowTables, trajectory: Trajectory, begins: Array, durations: Array
) -> tuple[Array, NDArray[np.int64], Array, Array]:
    """Return start states, slots, lengths and start times of the stretches between segment ends and breaks."""
    size = tables.size
    segments = len(durations)
    segment = np.concatenate([np.arange(segments), trajectory.break_segment])
    offset = np.concatenate([np.zeros(segments), trajectory.break_offset])
    states = np.concatenate([begins[:, :size], trajectory.after[:, :size]])
    # Preserve the order of breaks, because several may occur at one instant.
    order = np.lexsort((np.arange(len(segment)), offset, segment))
    segment, offset = segment[order], offset[order]
    first_slot = trajectory.before_slot[0] if len(trajectory.before_slot) else trajectory.slot[0]
    known = np.concatenate([np.full(segments, -1), trajectory.after_slot])[order]
    known[0] = first_slot if known[0] < 0 else known[0]
    slots = known[np.maximum.accumulate(np.where(known >= 0, np.arange(len(known)), 0))]
    following = np.append(offset[1:], 0.0)
    same = np.append(segment[1:] == segment[:-1], False)
    lengths = np.where(same, following, durations[segment]) - offset
    begin = np.concatenate([[0.0], np.cumsum(durations)[:-1]])
    return states[order], slots, np.maximum(lengths, 0.0), begin[segment] + offset


def _integrals(
    tables: FlowTables, quadratic: Forms, states: Array, slots: NDArray[np.int64], lengths: Array
) -> tuple[float, float, float, float]:
    """Integrate power, dissipation in structure and contacts, and power into grains over stretches."""
    h = tables.step
    # Split stretches that are longer than a step, and propagate the state.
    work = dissipated = dashpots = to_grains = 0.0
    system = tables.system
    walls = _walls(tables)
    while len(states):
        part = np.minimum(lengths, h) / h
        ends = np.empty_like(states)
        for slot in np.unique(slots):
            rows = slots == slot
            terms = _series(tables, int(slot), states[rows])
            closed = np.flatnonzero(system.lasting & (walls[slot] != FLIGHT))
            damping = system.wall_damping[closed, walls[slot, closed] - 1]
            for node, weight in zip(*_GAUSS, strict=True):
                at_node = _sum_series(terms, part[rows] * node)
                share = weight * part[rows] * h
                work += float(share @ _quadratic(quadratic.power, at_node))
                dissipated += float(share @ _quadratic(quadratic.dissipated, at_node))
                if quadratic.to_grains.any():
                    to_grains += float(share @ _quadratic(quadratic.to_grains, at_node))
                dashpots += float(
                    share @ (at_node[:, system.coordinates + system.bed[closed]] ** 2 @ damping)
                )
            ends[rows] = _sum_series(terms, part[rows])
        more = lengths > h * (1.0 + 1e-12)
        states, slots, lengths = ends[more], slots[more], lengths[more] - h
    return work, dissipated, dashpots, to_grains


def _walls(tables: FlowTables) -> NDArray[np.int64]:
    """Return each damper's finite-duration contact (slots, dampers): FLIGHT, FLOOR or CEILING."""
    system = tables.system
    configurations = np.array(sorted(tables.slots, key=lambda each: tables.slots[each]), dtype=np.int64)[
        :, None
    ]
    bits = np.arange(system.dampers)
    closed = configurations >> bits & 1
    if not system.lasting.any():
        return closed
    return np.asarray(closed * np.where(configurations >> system.dampers + bits & 1, CEILING, FLOOR))


def _elastic(system: HybridSystem, walls: NDArray[Any], states: Array) -> Array:
    """Return the energy in contact springs, J; walls (states, dampers) as in `_walls`."""
    energy = np.zeros(len(states))
    for j in np.flatnonzero(system.lasting):
        stiffness = np.append(0.0, system.wall_stiffness[j])[walls[:, j]]
        overlap = states[:, system.bed[j]] - np.where(walls[:, j] == CEILING, system.clearance[j], 0.0)
        energy += 0.5 * stiffness * overlap**2
    return energy


def _relaxed(tables: FlowTables, trajectory: Trajectory) -> float:
    """Return the energy that contact springs lose at breaks, J: after release a wall recovers without force."""
    walls = _walls(tables)
    before = _elastic(tables.system, walls[trajectory.before_slot], trajectory.before)
    after = _elastic(tables.system, walls[trajectory.after_slot], trajectory.after)
    return float((before - after).sum())


def _series(tables: FlowTables, slot: int, states: Array) -> Array:
    """Return the power series of states over a step, shape (terms, states, size)."""
    flow, size = tables.flow, tables.size
    if tables.tabulated:
        matrix = flow.series[slot].reshape(size, LENGTH + 1, -1)[:, :, :size]
        constant = flow.series_constant[slot].reshape(LENGTH + 1, -1)[:, :size]
        return np.tensordot(states, matrix, 1).transpose(1, 0, 2) + constant[:, None]
    from scipy.sparse import csr_array

    rates = csr_array((flow.rates[slot], flow.column, flow.pointer), shape=(size, size))
    terms = np.empty((LENGTH + 1, len(states), size))
    terms[0] = states
    for k in range(LENGTH):
        terms[k + 1] = (rates @ terms[k].T).T * (tables.step / (k + 1))
        if k == 0:
            terms[1] += flow.rates_constant[slot] * tables.step
    return terms


def _sum_series(terms: Array, tau: Array) -> Array:
    total = terms[-1].copy()
    for term in terms[-2::-1]:
        total *= tau[:, None]
        total += term
    return total


def _stored(tables: FlowTables, quadratic: Forms, ends: Ends) -> float:
    """Return the energy stored in one state of the whole system, J."""
    system = tables.system
    n, body = system.coordinates, system.damper_coordinate
    state = ends.state[: tables.size]
    flying = ends.mode == FLIGHT
    position = state[body] + np.where(ends.mode == CEILING, system.clearance, 0.0)
    height = np.where(flying, ends.height, position)
    speed = np.where(flying, ends.speed, state[n + body])
    energy = float(_quadratic(quadratic.stored, state)) - float(system.force_constant @ state[:n])
    energy += float(_elastic(system, ends.mode[None], state[None])[0])
    # Beds with finite-duration contact are part of the mass matrix.
    own = np.where(system.lasting, 0.0, system.damper_mass)
    return energy + float(own @ (system.gravity * height + 0.5 * speed**2))


def _impact_losses(system: HybridSystem, trajectory: Trajectory) -> float:
    """Return the kinetic energy lost at the breaks, J."""
    n = system.coordinates
    bed_mass = np.where(system.lasting, 0.0, system.damper_mass)
    loss = 0.0
    for sign, states, own in (
        (1.0, trajectory.before, trajectory.speed_before),
        (-1.0, trajectory.after, trajectory.speed_after),
    ):
        velocity = states[:, n : 2 * n]
        loss += sign * 0.5 * float(np.einsum("bi,ij,bj->", velocity, system.mass, velocity))
        loss += sign * 0.5 * float((own**2 @ bed_mass).sum())
    return loss
