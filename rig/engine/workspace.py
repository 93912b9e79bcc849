"""Work space of the kernel, which itself allocates no memory."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rig.engine.flow import Flow
from rig.numerics.bernstein import BERNSTEIN, MAX_HALVINGS, N_COEFFICIENTS
from rig.numerics.complementarity import ContactWork, allocate_contact_work
from rig.numerics.simd import aligned_zeros, padded_length


class Workspace(NamedTuple):
    """Work space of one running kernel; the fields are scratch arrays."""

    new: np.ndarray
    size: np.ndarray
    envelope: np.ndarray
    margin: np.ndarray
    tableau: np.ndarray
    bound: np.ndarray
    derivative: np.ndarray
    contact: ContactWork
    series_rows: np.ndarray
    powers: np.ndarray
    zero_constant: np.ndarray
    series: np.ndarray
    work: np.ndarray
    spans: np.ndarray
    bernstein: np.ndarray


def workspace_for(flow: Flow, size: int) -> Workspace:
    """Allocate the work space for a flow and states of a padded size."""
    columns = flow.rates_constant.shape[1]
    tableau = aligned_zeros(N_COEFFICIENTS + 1, padded_length(columns))
    envelope = aligned_zeros(padded_length(columns))
    envelope[columns:] = np.inf
    return Workspace(
        new=aligned_zeros(size),
        size=aligned_zeros(padded_length(columns)),
        envelope=envelope,
        margin=aligned_zeros(flow.margin_constant.shape[1]),
        tableau=tableau,
        series_rows=tableau[None],
        powers=np.zeros(N_COEFFICIENTS + 1),
        zero_constant=aligned_zeros(1, padded_length(columns)),
        bound=aligned_zeros(flow.bound_constant.shape[1]),
        derivative=aligned_zeros(flow.derivative_constant.shape[1]),
        contact=allocate_contact_work(flow.neighbor.shape[1], flow.derivative_constant.shape[1]),
        series=aligned_zeros(N_COEFFICIENTS),
        work=aligned_zeros(MAX_HALVINGS + 3, N_COEFFICIENTS),
        spans=np.zeros((MAX_HALVINGS + 3, 2)),
        bernstein=BERNSTEIN,
    )
