"""Impulse: half-sine hits of a hammer on a body, the shaker at rest, the free decay recorded."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from daq.excitation.station import Excitation, Station
from rig.errors import SceneError

if TYPE_CHECKING:
    from rig.scene.excitation import Impulse

Array = NDArray[np.float64]

# Recorded before the first hit, so that offsets and noise can be seen, s.
QUIET = 0.25
_WINDOW = 0.1


def excite(station: Station, test: Impulse) -> Excitation:
    """Run the hits of an impulse test."""
    clean = half_sine(test.peak, test.width, station.rate)
    doubled = clean
    if test.double_hit is not None:
        second = half_sine(test.peak * test.double_hit.ratio, test.width, station.rate)
        after = station.samples(test.double_hit.after)
        doubled = np.zeros(after + second.size)
        doubled[: clean.size] += clean
        doubled[after:] += second
    bounces = set(range(1, test.repeats + 1)) if test.double_hit is not None else set()
    if test.double_hit is not None and test.double_hit.hits is not None:
        bounces = set(test.double_hit.hits)
    return _run(station, test, clean, doubled, bounces)


def _run(station: Station, test: Impulse, clean: Array, doubled: Array, bounces: set[int]) -> Excitation:
    quiet, interval, window = (station.samples(time) for time in (QUIET, test.interval, _WINDOW))
    yield station.quiet(quiet)
    for hit in range(1, test.repeats + 1):
        pulse = doubled if hit in bounces else clean
        wave = np.zeros(interval)
        wave[: pulse.size] = pulse
        first = station.now
        # The pulse comes in one piece, so that it is marked as soon as it has passed.
        edges = [0, *range(max(window, pulse.size), interval, window), interval]
        for start, stop in pairwise(edges):
            yield station.drive(wave[start:stop], "hammer")
            if start == 0:
                station.mark(
                    "hit",
                    first,
                    first + pulse.size,
                    number=hit,
                    body=test.body,
                    peak=test.peak,
                    width=test.width,
                    double=hit in bounces,
                )
            station.report((hit - 1 + stop / interval) / test.repeats, f"hit {hit} of {test.repeats}")


def half_sine(peak: float, width: float, rate: float) -> Array:
    """Sample a half-sine pulse so that, joined by straight lines, it has the peak and the area asked for.

    Straight lines between samples cut the corners of the sine and would lose area; the sampled half sine is
    made longer by just so much, with a sample on its peak.

    Parameters
    ----------
    peak : float
        N.
    width : float
        Length of the half sine, s; two samples at least.

    Returns
    -------
    ndarray, shape (samples,)
        Force in N; first and last sample are zero.

    Raises
    ------
    SceneError
        If the samples are too far apart for the pulse.

    Examples
    --------
    >>> pulse = half_sine(50.0, 4e-3, 5120.0)
    >>> float(pulse.max()), float(round(pulse.sum() / 5120.0 / (50.0 * 4e-3 * 2 / np.pi), 9))
    (50.0, 1.0)
    """
    wanted = 2 * width * rate / np.pi
    if wanted < 1.2:
        raise SceneError(
            f"test.width: a pulse of {width * 1e3:g} ms has no two samples at {rate:g} Hz; expected at least "
            f"{2.0 / rate * 1e3:.3g} ms: widen the pulse (a softer tip) or raise converter.rate"
        )

    def pulse(length: float) -> Array:
        half = int(np.ceil(length / 2))
        offset = np.arange(-half, half + 1)
        return np.where(abs(offset) < length / 2, np.cos(np.pi * offset / length), 0.0)

    length = brentq(lambda samples: pulse(samples).sum() - wanted, 1.0, 2.0 * width * rate + 4.0, xtol=1e-13)
    return peak * pulse(length)
