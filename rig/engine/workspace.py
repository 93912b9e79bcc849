"""Work space of one running kernel, which itself allocates nothing."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rig.engine.flow import Flow
from rig.numerics.bernstein import BERNSTEIN, DEEPEST, LENGTH
from rig.numerics.complementarity import ContactWork, contact_work
from rig.numerics.simd import padded, zeros


class Workspace(NamedTuple):
    """Work space of one running kernel."""

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
    nothing: np.ndarray
    series: np.ndarray
    work: np.ndarray
    spans: np.ndarray
    bernstein: np.ndarray


def workspace_for(flow: Flow, size: int) -> Workspace:
    """Allocate the work space for a flow and states of a padded size."""
    columns = flow.rates_constant.shape[1]
    tableau = zeros(LENGTH + 1, padded(columns))
    envelope = zeros(padded(columns))
    envelope[columns:] = np.inf
    return Workspace(
        new=zeros(size),
        size=zeros(padded(columns)),
        envelope=envelope,
        margin=zeros(flow.margin_constant.shape[1]),
        tableau=tableau,
        series_rows=tableau[None],
        powers=np.zeros(LENGTH + 1),
        nothing=zeros(1, padded(columns)),
        bound=zeros(flow.bound_constant.shape[1]),
        derivative=zeros(flow.derivative_constant.shape[1]),
        contact=contact_work(flow.neighbour.shape[1], flow.derivative_constant.shape[1]),
        series=zeros(LENGTH),
        work=zeros(DEEPEST + 3, LENGTH),
        spans=np.zeros((DEEPEST + 3, 2)),
        bernstein=BERNSTEIN,
    )
