"""Scratch arrays of the kernel, which itself allocates no memory."""

from typing import NamedTuple

import numpy as np

from rig.core.engine.flow import Flow
from rig.core.engine.law_tables import LawTables, Signals, empty_signals
from rig.core.numerics.bernstein import BERNSTEIN, MAX_HALVINGS, N_COEFFICIENTS
from rig.core.numerics.complementarity import ContactWorkspace, allocate_contact_workspace
from rig.core.numerics.simd import aligned_zeros, padded_length


class Workspace(NamedTuple):
    """Scratch arrays of one running kernel. z: state; tau: time relative to a step."""

    end_state: np.ndarray  # State at the end of a step
    magnitude: np.ndarray  # |z|
    envelope: np.ndarray  # Upper bound of |z|
    # Sufficient distance of each signal from its limits: a signal that is farther away at both ends of a step cannot
    # reach a limit within the step (`rig.core.engine.screening`)
    margin: np.ndarray
    signals: Signals  # Signals of the present regimes
    state_series: np.ndarray  # Power series of z in tau, shape (terms, states)
    bound: np.ndarray  # Result of the table `bound` of `Flow`
    derivative: np.ndarray  # Result of the table `derivative` of `Flow`
    contact: ContactWorkspace
    series_matrix: np.ndarray  # `state_series` as a table with one matrix; its constant part is `zero_constant`
    powers: np.ndarray  # Powers of tau, by which `series_matrix` is multiplied
    zero_constant: np.ndarray
    guard_series: np.ndarray  # Power series of a signal's distance from a limit
    subdivision: np.ndarray  # As in `rig.core.numerics.bernstein.first_crossing`, like the next two
    spans: np.ndarray
    bernstein: np.ndarray


def workspace_for(flow: Flow, laws: LawTables, size: int) -> Workspace:
    """Return new scratch arrays for a flow and laws; `size`: padded length of a state with its accelerations."""
    columns = flow.rates_constant.shape[1]
    state_series = aligned_zeros(N_COEFFICIENTS + 1, padded_length(columns))
    envelope = aligned_zeros(padded_length(columns))
    envelope[columns:] = np.inf
    return Workspace(
        end_state=aligned_zeros(size),
        magnitude=aligned_zeros(padded_length(columns)),
        envelope=envelope,
        margin=aligned_zeros(flow.margin_constant.shape[1]),
        signals=empty_signals(laws),
        state_series=state_series,
        series_matrix=state_series[None],
        powers=np.zeros(N_COEFFICIENTS + 1),
        zero_constant=aligned_zeros(1, padded_length(columns)),
        bound=aligned_zeros(flow.bound_constant.shape[1]),
        derivative=aligned_zeros(flow.derivative_constant.shape[1]),
        contact=allocate_contact_workspace(len(laws.elements), flow.derivative_constant.shape[1]),
        guard_series=aligned_zeros(N_COEFFICIENTS),
        subdivision=aligned_zeros(MAX_HALVINGS + 3, N_COEFFICIENTS),
        spans=np.zeros((MAX_HALVINGS + 3, 2)),
        bernstein=BERNSTEIN,
    )
