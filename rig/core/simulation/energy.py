"""The energy balance of a run: work of the drive, stored energy, and dissipated energy.

Power and dissipation are quadratic forms of the state. Both are integrated over every interval between samples and
discontinuities (contact events) by Gauss-Legendre quadrature of the exact flow. Losses in impacts are the jumps of
kinetic energy. No term is computed as the difference of the other terms, so the residual is a test of the engine.

A table index is the position of a contact configuration (which dampers are in contact with which wall) in the flow
tables. A segment is a time interval under one drive, such as a sample interval.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.engine.flow_tables import FlowTables
from rig.core.engine.state import CONFIGURATION, State
from rig.core.engine.trajectory import Trajectory
from rig.core.laws.events import CEILING, FLIGHT
from rig.core.laws.law import Row
from rig.core.numerics.bernstein import N_COEFFICIENTS
from rig.core.system.hybrid_system import FORCE_OF_BED, Element, HybridSystem
from rig.core.system.structural_model import symmetric

#: Gauss-Legendre nodes and weights on [0, 1]: 8 nodes suffice in a step for a product of two solutions.
_GAUSS_RULE = tuple(0.5 * row for row in np.polynomial.legendre.leggauss(8) + np.array([[1.0], [0.0]]))
# Maximum number of values of power series in memory at a time: 16 MB.
_MAX_VALUES = 1 << 21


@dataclass(frozen=True)
class Energy:
    """Energy balance over a run [J].

    `stored`, `stored_before`: kinetic, elastic (including contacts), gravitational (dampers) and magnetic energy at
    the end and at the start. `contacts`: energy lost in finite-duration contacts, by dashpots and by contact springs
    that are still compressed at release.
    """

    work: float  # work of the drive: by the force, by the table on the coil spring, or by the amplifier on the coil
    stored: float
    stored_before: float
    dissipated: float  # energy dissipated in structural damping, tuned mass dampers, friction, suspension, coil
    impacts: float  # energy lost in impacts
    contacts: float
    grains: float  # energy transferred to beds of grains: stored in their motion, and dissipated

    @property
    def residual(self) -> float:
        """Work minus all stored, dissipated, lost and transferred energy; zero within rounding error."""
        lost = self.dissipated + self.impacts + self.contacts + self.grains
        return self.work - (self.stored - self.stored_before) - lost


def total_energy(balances: Sequence[Energy]) -> Energy:
    """Add the energy balances of successive sections of a run."""
    sums = {
        name: sum(getattr(balance, name) for balance in balances)
        for name in ("work", "dissipated", "impacts", "contacts", "grains")
    }
    return Energy(stored=balances[-1].stored, stored_before=balances[0].stored_before, **sums)


@dataclass(frozen=True)
class QuadraticForms:
    """Quadratic forms of the augmented state z (states, then drive), as symmetric matrices (size, size)."""

    stored: Array  # z' stored z: energy [J]
    dissipated: Array  # dissipated power [W]
    power: Array  # power of the drive [W]
    to_grains: Array  # power into beds of grains [W]


def quadratic_forms(system: HybridSystem, output: Array) -> QuadraticForms:
    """Return stored energy, dissipated power, power of the drive, and power into grains as quadratic forms.

    `output`: matrix with u = output @ p, for the inputs u of the system and the states p of the drive's generator.
    """
    n, ns = system.coordinates, system.states
    size = ns + output.shape[1]
    mass = system.mass.copy()
    stiffness = -system.force_state[:, :n]
    damping = -system.force_state[:, n : 2 * n]
    # A coordinate with prescribed motion has no mass. Its actuator does work on the structure.
    prescribed = system.prescribed
    mass[prescribed] = 0.0
    stiffness[prescribed], damping[prescribed] = system.reaction[:, :n], system.reaction[:, n : 2 * n]
    input_force = np.zeros((n, size))
    is_bed_input = np.array([name.startswith(f"{FORCE_OF_BED} ") for name in system.inputs], dtype=bool)
    input_force[:, ns:] = system.force_drive[:, ~is_bed_input] @ output[~is_bed_input]
    input_force[prescribed] = 0.0
    input_force[prescribed, :ns] = system.reaction
    to_grains = np.zeros((size, size))
    to_grains[n : 2 * n, ns:] = -system.force_drive[:, is_bed_input] @ output[is_bed_input]
    further = np.arange(2 * n, ns)
    power = np.zeros((size, size))
    power[n : 2 * n] = input_force
    power[2 * n : ns, ns:] = system.state_power @ output
    stored = np.zeros((size, size))
    stored[:n, :n] = stiffness
    stored[n : 2 * n, n : 2 * n] = mass
    stored[further, further] = system.state_energy
    dissipated = np.zeros((size, size))
    dissipated[n : 2 * n, n : 2 * n] = damping
    dissipated[further, further] = system.state_loss
    return QuadraticForms(0.5 * symmetric(stored), symmetric(dissipated), symmetric(power), symmetric(to_grains))


def _quadratic(form: Array, states: Array) -> Array:
    """Return z' form z for each state z."""
    return ((states @ form) * states).sum(axis=-1)


def energy_balance(
    tables: FlowTables, start: State, end: State, trajectory: Trajectory, segment_states: Array, durations: Array
) -> Energy:
    """Compute the energy balance of a simulated motion.

    `tables`: flow tables of the simulation; `start`, `end`: states before and after the motion; `segment_states`:
    states at the starts of the segments; `durations`: durations of the segments [s].
    """
    forms = quadratic_forms(tables.system, tables.drive.output)
    intervals = _intervals(tables, trajectory, segment_states, durations)
    work, to_grains, lost = _integrate(tables, forms, *intervals)
    return Energy(
        work=work,
        stored=_stored_energy(tables, forms, end),
        stored_before=_stored_energy(tables, forms, start),
        dissipated=lost["dissipated"],
        impacts=_impact_losses(tables.system, trajectory),
        contacts=lost["contacts"] + _release_losses(tables, trajectory),
        grains=to_grains,
    )


def fourier_integral(
    tables: FlowTables, trajectory: Trajectory, segment_states: Array, durations: Array, omega: float
) -> NDArray[np.complex128]:
    """Integrate z(t) e^{-i omega t} over a motion, shape (size,).

    `segment_states`, `durations`: as for `energy_balance`; `omega`: rad/s.
    Intervals end at discontinuities, so the quadrature has its full order.
    """
    total = np.zeros(tables.size, dtype=np.complex128)
    nodes, node_weights = _GAUSS_RULE
    powers = np.vander(nodes, N_COEFFICIENTS + 1, increasing=True).T * node_weights
    for _, terms, lengths, starts in _steps(tables, *_intervals(tables, trajectory, segment_states, durations)):
        # Sum over the nodes first, because the series has many terms but few weights.
        phase_factors = np.exp(-1j * omega * (starts + nodes[:, None] * lengths))
        weights = (powers @ phase_factors) * (
            np.vander(lengths / tables.step, N_COEFFICIENTS + 1, increasing=True).T * lengths
        )
        integrals = np.stack([weights.real, weights.imag], axis=1) @ terms
        total += [1.0, 1.0j] @ integrals.sum(axis=0)
    return total


def _intervals(
    tables: FlowTables, trajectory: Trajectory, segment_states: Array, durations: Array
) -> tuple[Array, NDArray[np.int64], Array, Array]:
    """Divide the motion at segment ends and discontinuities: initial state, table index, duration and start [s]."""
    size = tables.size
    segments = len(durations)
    # An interval begins with each segment, at offset 0, and at each discontinuity in a segment.
    segment = np.concatenate([np.arange(segments), trajectory.discontinuity_segment])
    offset = np.concatenate([np.zeros(segments), trajectory.discontinuity_offset])
    states = np.concatenate([segment_states[:, :size], trajectory.state_after[:, :size]])
    # Preserve the order of discontinuities, because several may occur at one instant.
    order = np.lexsort((np.arange(len(segment)), offset, segment))
    segment, offset = segment[order], offset[order]
    first_index = trajectory.table_index_before[0] if len(trajectory.table_index_before) else trajectory.table_index[0]
    # Only discontinuities change the table index (-1: unchanged); other intervals have the index of the previous
    # interval.
    new_indices = np.concatenate([np.full(segments, -1), trajectory.table_index_after])[order]
    new_indices[0] = first_index if new_indices[0] < 0 else new_indices[0]
    last_change = np.maximum.accumulate(np.where(new_indices >= 0, np.arange(len(new_indices)), 0))
    table_indices = new_indices[last_change]
    next_offset = np.append(offset[1:], 0.0)
    has_next = np.append(segment[1:] == segment[:-1], False)
    lengths = np.where(has_next, next_offset, durations[segment]) - offset
    segment_starts = np.concatenate([[0.0], np.cumsum(durations)[:-1]])
    return states[order], table_indices, np.maximum(lengths, 0.0), segment_starts[segment] + offset


def _steps(
    tables: FlowTables, states: Array, table_indices: NDArray[np.int64], lengths: Array, starts: Array
) -> Iterator[tuple[int, Array, Array, Array]]:
    """Split intervals into parts no longer than a step; yield groups of parts in the same contact configuration.

    Yields the table index, the power series (terms, parts, size), the durations and the start times [s].
    """
    step, max_rows = tables.step, max(1, _MAX_VALUES // (tables.size * (N_COEFFICIENTS + 1)))
    while len(states):
        continues = lengths > step * (1.0 + 1e-12)
        part_lengths, ends = np.where(continues, step, lengths), np.empty_like(states)
        for table_index in np.unique(table_indices).tolist():
            indices = np.flatnonzero(table_indices == table_index)
            for rows in np.split(indices, range(max_rows, indices.size, max_rows)):
                terms = _series(tables, table_index, states[rows])
                yield table_index, terms, part_lengths[rows], starts[rows]
                unfinished = continues[rows]
                ends[rows[unfinished]] = _sum_series(terms[:, unfinished], np.ones(int(unfinished.sum())))
        states, table_indices = ends[continues], table_indices[continues]
        lengths, starts = lengths[continues] - step, starts[continues] + step


def _integrate(
    tables: FlowTables,
    forms: QuadraticForms,
    states: Array,
    table_indices: NDArray[np.int64],
    lengths: Array,
    starts: Array,
) -> tuple[float, float, dict[str, float]]:
    """Return work of the drive, energy transferred to grains, and losses in structure and in each element [J]."""
    work = to_grains = 0.0
    lost = {"dissipated": 0.0, "contacts": 0.0}
    system = tables.system
    forces = _force_numbers(tables)
    for table_index, terms, durations, _ in _steps(tables, states, table_indices, lengths, starts):
        fractions = durations / tables.step
        dashpots = _dashpots(system, forces[table_index])
        friction = _constant_forces(system, forces[table_index])
        for node, weight in zip(*_GAUSS_RULE, strict=True):
            at_node = _sum_series(terms, fractions * node)
            node_weights = weight * durations
            work += float(node_weights @ _quadratic(forms.power, at_node))
            lost["dissipated"] += float(node_weights @ _quadratic(forms.dissipated, at_node))
            if forms.to_grains.any():
                to_grains += float(node_weights @ _quadratic(forms.to_grains, at_node))
            speeds = at_node[:, system.coordinates : 2 * system.coordinates]
            lost["contacts"] += float(node_weights @ _dashpot_power(dashpots, speeds))
            if friction.any():
                lost["dissipated"] -= float(node_weights @ (speeds @ friction))
    return work, to_grains, lost


def _dashpots(system: HybridSystem, forces: NDArray[np.int64]) -> list[tuple[Element, float]]:
    """Return the elements whose dashpots act, with their damping [N s/m].

    `forces`: index of each force in `Law.forces`.
    """
    present = [element.law.forces[index] for element, index in zip(system.elements, forces.tolist(), strict=True)]
    return [
        (element, -force.speed)
        for element, force in zip(system.elements, present, strict=True)
        if force is not None and force.gap
    ]


def _dashpot_power(dashpots: list[tuple[Element, float]], speeds: Array) -> Array:
    """Return the power that dashpots dissipate at velocities of the coordinates [W]; shape (states,)."""
    gap_speeds = np.array([element.along_gap(speeds) for element, _ in dashpots]).reshape(len(dashpots), len(speeds))
    return np.asarray(gap_speeds.T**2 @ np.array([damping for _, damping in dashpots]))


def _constant_forces(system: HybridSystem, forces: NDArray[np.int64]) -> Array:
    """Return the constant forces [N] of the elements, such as friction, on every coordinate; `forces`: numbers."""
    constant = np.zeros(system.coordinates)
    for element, index in zip(system.elements, forces.tolist(), strict=True):
        for i, factor in element.direction:
            constant[i] += factor * (element.law.forces[index] or Row()).constant
    return constant


def _force_numbers(tables: FlowTables) -> NDArray[np.int64]:
    """Return the index of the force of each element in `Law.forces`; shape (configurations, elements)."""
    configurations = np.array(sorted(tables.indices, key=tables.indices.__getitem__), dtype=np.int64)
    return tables.system.force_indices(configurations)


def _spring_energy(system: HybridSystem, numbers: NDArray[np.int64], states: Array) -> Array:
    """Return the energy in the springs of the elements [J]; `numbers`: `_force_numbers` of each state."""
    energy = np.zeros(len(states))
    for element, number in zip(system.elements, numbers.T, strict=True):
        if element.gap < 0:
            continue
        forces = [force or Row() for force in element.law.forces]
        stiffness = np.array([-force.gap for force in forces])[number]
        rest = np.array([force.rest for force in forces])[number]
        if element.slider < 0:
            energy += 0.5 * stiffness * (element.along_gap(states) - rest) ** 2
            continue
        # The spring in series with a slider has the same force as the slider.
        constant = np.array([force.constant for force in forces])[number]
        force_on_gap = constant - stiffness * (element.along_gap(states) - states[:, element.slider])
        energy += 0.5 * force_on_gap**2 / max(-force.gap for force in forces)
    return energy


def _release_losses(tables: FlowTables, trajectory: Trajectory) -> float:
    """Return the energy [J] of contact springs that are still compressed at release: they recover without force."""
    numbers = _force_numbers(tables)
    before = _spring_energy(tables.system, numbers[trajectory.table_index_before], trajectory.state_before)
    after = _spring_energy(tables.system, numbers[trajectory.table_index_after], trajectory.state_after)
    return float((before - after).sum())


def _series(tables: FlowTables, table_index: int, states: Array) -> Array:
    """Return the power series of states over a step, shape (terms, states, size)."""
    flow, size = tables.flow, tables.size
    if tables.has_series:
        matrix = flow.series[table_index].reshape(size, N_COEFFICIENTS + 1, -1)[:, :, :size]
        constant = flow.series_constant[table_index].reshape(N_COEFFICIENTS + 1, -1)[:, :size]
        return np.tensordot(states, matrix, 1).transpose(1, 0, 2) + constant[:, None]
    from scipy.sparse import csr_array

    rates = csr_array((flow.rates[table_index], flow.column, flow.row_pointer), shape=(size, size))
    terms = np.empty((N_COEFFICIENTS + 1, len(states), size))
    terms[0] = states
    for k in range(N_COEFFICIENTS):
        terms[k + 1] = (rates @ terms[k].T).T * (tables.step / (k + 1))
        if k == 0:
            terms[1] += flow.rates_constant[table_index] * tables.step
    return terms


def _sum_series(terms: Array, tau: Array) -> Array:
    """Return the states at the fractions `tau` of a step, shape (states, size), by Horner's method."""
    total = terms[-1].copy()
    for term in terms[-2::-1]:
        total *= tau[:, None]
        total += term
    return total


def _stored_energy(tables: FlowTables, forms: QuadraticForms, state: State) -> float:
    """Return the stored energy of structure, dampers and contact springs in a state [J]."""
    system = tables.system
    n, body = system.coordinates, system.damper_coordinate
    z = state.z[: tables.size]
    contact = tables.contacts(state.regime)[: system.dampers]
    is_flying = contact == FLIGHT
    wall_height = z[body] + np.where(contact == CEILING, system.clearance, 0.0)
    height = np.where(is_flying, state.height[: system.dampers], wall_height)
    velocity = np.where(is_flying, state.velocity[: system.dampers], z[n + body])
    energy = float(_quadratic(forms.stored, z)) - float(system.force_constant @ z[:n])
    numbers = system.force_indices(np.array(state.counters[CONFIGURATION]))
    energy += float(_spring_energy(system, numbers[None], z[None])[0])
    # Dampers whose gap is a coordinate are part of the mass matrix.
    return energy + float(system.detached_mass @ (system.gravity * height + 0.5 * velocity**2))


def _impact_losses(system: HybridSystem, trajectory: Trajectory) -> float:
    """Return the kinetic energy lost at the discontinuities [J], summed over the jumps of velocity."""
    # The difference of the total energies before and after each discontinuity would add a rounding error for every
    # discontinuity.
    n = system.coordinates
    before, after = trajectory.state_before[:, n : 2 * n], trajectory.state_after[:, n : 2 * n]
    damper_before, damper_after = trajectory.damper_velocity_before, trajectory.damper_velocity_after
    loss = np.einsum("bi,ij,bj->", before - after, system.mass, before + after)
    return 0.5 * float(
        loss + (((damper_before - damper_after) * (damper_before + damper_after)) @ system.detached_mass).sum()
    )
