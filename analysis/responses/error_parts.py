"""Random errors of a response as its estimator knows them: of means, or of local fits."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Lines = NDArray[np.bool_] | NDArray[np.intp]


@dataclass(frozen=True)
class MeanErrors:
    """Errors of quotients of means, independent from line to line: `weights` times those of the channels."""

    weights: ComplexArray
    """Shape (lines, channels)."""
    covariance: ComplexArray
    """Of the channels' means; shape (lines, channels, channels)."""

    def at(self, lines: Lines) -> MeanErrors:
        """Keep some lines."""
        return MeanErrors(self.weights[lines], self.covariance[lines])

    def scaled(self, factor: ComplexArray) -> MeanErrors:
        """Multiply by a factor at each line."""
        return replace(self, weights=self.weights * factor[:, None])


@dataclass(frozen=True)
class LocalErrors:
    """Errors of local fits to spectra: sums over bins, of which neighbouring lines share most."""

    influence: ComplexArray
    """Of the error at each bin of the reading in the response; shape (lines, stretches, width)."""
    first: NDArray[np.int64]
    """First bin of each line's fit; shape (lines,)."""
    residual: ComplexArray
    """What the fit left of the reading; shape (lines, stretches, width)."""
    curve: ComplexArray
    """Reading per unit of the reference, as fitted; shape (lines, 1, width)."""
    drive: Array
    """Mean square of the reference over the bins of each fit; shape (lines,)."""
    free: float
    """Complex degrees of freedom of each fit."""
    used: float
    """Share of the samples behind the spectra that was measured, as in `local_fit`."""
    one_reference: bool
    """Whether one channel alone is the reference, and not part of the response."""
    common: ComplexArray
    """Error that all lines have alike, one standard deviation in either quadrature; shape (lines,)."""
    shared: float = 1.0
    """How many neighbouring lines have one error although their bins are different."""

    def at(self, lines: Lines) -> LocalErrors:
        """Keep some lines."""
        names = ("influence", "first", "residual", "curve", "drive", "common")
        return replace(self, **{name: getattr(self, name)[lines] for name in names})

    def scaled(self, factor: ComplexArray) -> LocalErrors:
        """Multiply by a factor at each line."""
        return replace(self, influence=self.influence * factor[:, None, None], common=self.common * factor)
