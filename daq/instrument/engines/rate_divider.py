"""Samples at a whole fraction of the bench's rate, for a module that runs slower than another."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

# Half length of the low pass, in samples of the slower rate, and its Kaiser window's shape: 100 dB beyond 0.55 of
# the slower rate, flat to 1e-5 up to 0.45 of it.
_HALF_LENGTH, _KAISER, _CORNER = 64, 10.06, 0.5


class RateDivider:
    """Gives every n-th sample of a stream, as a converter at that rate would take it.

    Parameters
    ----------
    channels : int
        Channels of the stream.
    divisor : int
        n.
    kind : {'point', 'average', 'filter'}
        How the converter samples: the instant itself, the average over the interval that ends there, or behind
        a low pass.
    delay : float
        Samples of the slower rate by which its filter's output is to lag, for a converter whose delay is not
        taken out. Stage and stream together then lag by this as the converter's filter would.

    Examples
    --------
    >>> divider = RateDivider(1, 4, "average")
    >>> first, samples, _ = divider.take(0, np.arange(9.0)[None], np.zeros((1, 9), bool))
    >>> first, samples.tolist()
    (0, [[0.0, 2.5, 6.5]])
    """

    def __init__(
        self,
        channels: int,
        divisor: int,
        kind: Literal["point", "average", "filter"],
        delay: float = 0.0,
    ) -> None:
        self.divisor = divisor
        if kind == "filter":
            import scipy.signal

            half = _HALF_LENGTH * divisor
            taps = scipy.signal.firwin(
                2 * half + 1, _CORNER / divisor, window=("kaiser", _KAISER), scale=True, fs=1.0
            )
            # The stream's own filter lags by `delay` of its samples, this stage makes up for the rest.
            late = round(delay * (divisor - 1))
            self._ahead, self._behind = half - late, half + late
        elif kind == "average":
            taps = np.full(divisor, 1.0 / divisor)
            self._ahead, self._behind = 0, divisor - 1
        else:
            taps = np.ones(1)
            self._ahead = self._behind = 0
        self._taps = taps
        self._held = np.zeros((channels, 0))
        self._overload = np.zeros((channels, 0), bool)
        self._first: int | None = None
        self._next = 0

    def take(
        self, first: int, samples: NDArray[Any], overload: NDArray[np.bool_]
    ) -> tuple[int, NDArray[Any], NDArray[np.bool_]]:
        """Take a block of the stream, and give what it completes.

        Parameters
        ----------
        first : int
            Number of the block's first sample; blocks follow each other without a gap.
        samples, overload : ndarray, shape (channels, n)
            The block.

        Returns
        -------
        tuple
            Number of the first slow sample, slow samples and their overload flags; sample k of the slow
            stream is taken at sample k n of the fast one.
        """
        if self._first is None:
            # What came before the first block counts as what the first sample is.
            self._next = -(-first // self.divisor)
            lead = np.repeat(samples[:, :1], self._behind, axis=1)
            self._held, self._first = lead.astype(float), first - self._behind
            self._overload = np.zeros(lead.shape, bool)
        self._held = np.concatenate([self._held, samples], axis=1)
        self._overload = np.concatenate([self._overload, overload], axis=1)
        available = self._first + self._held.shape[1]
        stop = (available - 1 - self._ahead) // self.divisor + 1
        count, begin = max(0, stop - self._next), self._next
        out = np.empty((samples.shape[0], count))
        over = np.zeros(out.shape, bool)
        for index in range(count):
            at = (begin + index) * self.divisor - self._first
            span = slice(at - self._behind, at + self._ahead + 1)
            out[:, index] = self._held[:, span] @ self._taps[::-1]
            over[:, index] = self._overload[:, span].any(axis=1)
        self._next = begin + count
        spent = max(0, self._next * self.divisor - self._behind - self._first)
        self._held, self._overload = self._held[:, spent:], self._overload[:, spent:]
        self._first += spent
        if np.issubdtype(samples.dtype, np.integer):
            out = np.rint(out)
        return begin, out.astype(samples.dtype), over
