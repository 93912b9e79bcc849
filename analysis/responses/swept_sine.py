"""Swept sine: a tracking filter follows the tone, several tapers give coherence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.recordings.slices import read_slices
from analysis.responses.clean_stretches import flaws, told
from analysis.responses.estimators import Averages
from rig.errors import RecordingError

if TYPE_CHECKING:
    from daq.recording.markers import Marker
    from daq.recording.recording import Recording

Array = NDArray[np.float64]

TAPERS = 3
# The filter's window lasts while the tone passes this ratio of frequencies: narrow enough for the second
# harmonic, and the third, to stay out.
_RATIO = 1.35
_POINTS = 400


def averages(
    rec: Recording,
    marker: Marker,
    channels: Sequence[str],
    progress: Callable[[int, int], None] | None = None,
) -> Averages:
    """Track the tone of a sweep.

    At each frequency the spectra are taken over the time in which the tone is near it, through orthogonal
    sine tapers [1]_, and averaged over the tapers. Reference and response pass the same tapers, so that
    what limits the resolution is the length of the window and not the rate of the sweep; a fast sweep has
    short windows, and `resolution` says what that means.

    Parameters
    ----------
    marker : daq.marker.Marker
        Its ``measure`` marker: from, to, duration, spacing.
    channels : sequence of str
        Names of the channels to track.
    progress : callable, optional
        Called with (frequencies done, frequencies in all).

    References
    ----------
    .. [1] K. S. Riedel, A. Sidorenko, Minimum bias multiple taper spectral estimation, IEEE Trans. Signal
    Process.
       43 (1995) 188-195.
    """
    low, high = (float(marker.fields[key]) for key in ("from", "to"))
    linear = marker.fields.get("spacing") == "linear"
    stop = min(rec.samples, rec.samples if marker.last_sample is None else marker.last_sample + 1)
    duration = float(marker.fields["duration"])
    bottom, top = min(low, high), max(low, high)
    edge = _RATIO ** (0.1 if top / bottom > _RATIO**0.3 else 0.0)
    if duration * bottom < 20.0:
        raise RecordingError(
            f"a sweep of {duration:g} s is too short to track; sweep for at least {20 / bottom:.3g} s"
        )
    frequency = np.geomspace(bottom * edge, top / edge, _POINTS)
    names = list(channels)
    found = flaws(rec, names, marker.first_sample, stop)
    edges = np.array([[flaw.first, flaw.stop] for flaw in found]).reshape(-1, 2)
    cross = np.zeros((frequency.size, len(names), len(names)), dtype=complex)
    widths = np.empty(frequency.size)
    gone = 0
    bounds = []
    for f in frequency:
        near = (f / _RATIO**0.5, f * _RATIO**0.5)
        ends = sorted(_sample(value, low, high, duration, linear, rec.rate) for value in near)
        bounds.append(
            (marker.first_sample + max(0, int(ends[0])), min(stop, marker.first_sample + int(ends[1])))
        )
    order = sorted(range(frequency.size), key=lambda index: bounds[index])
    blocks = read_slices(rec, names, [bounds[index] for index in order])
    for done, (index, block) in enumerate(zip(order, blocks, strict=True), 1):
        if progress is not None:
            progress(done, frequency.size)
        size = block.shape[1]
        widths[index] = (TAPERS + 1.0) * rec.rate / max(size, 1)
        begin, end = bounds[index]
        if np.any((edges[:, 0] < end) & (edges[:, 1] > begin)) or not np.isfinite(block).all():
            gone += 1
            cross[index] = np.nan
            continue
        at = np.arange(1, size + 1)
        turn = np.exp(-2j * np.pi * frequency[index] / rec.rate * at)
        tapers = np.sin(np.pi * np.arange(1, TAPERS + 1)[:, None] * at / (size + 1.0))
        spectra = (block - block.mean(axis=1, keepdims=True)) @ (tapers * turn).T / np.sqrt(size)
        cross[index] = spectra @ spectra.conj().T / TAPERS
    keep = np.isfinite(cross[:, 0, 0])
    notes = []
    if gone:
        notes.append(f"{gone} of {frequency.size} frequencies left out: {told(rec, found)}.")
    if not keep.any():
        raise RecordingError(
            f"nothing is left of the sweep to track: {told(rec, found)}; lower the level or widen the range "
            "(converter: range)"
        )
    if marker.fields.get("settled") is False:
        notes.append("The sweep began before its first frequency had become steady.")
    return Averages(
        channels=tuple(names),
        frequency=frequency[keep],
        cross=cross[keep],
        averages=float(TAPERS),
        resolution=float(np.max(widths)),
        label=rec.scene.name,
        warnings=tuple(notes),
    )


def _sample(frequency: float, low: float, high: float, duration: float, linear: bool, rate: float) -> float:
    """Sample at which the sweep passes a frequency, counted from its beginning."""
    if linear:
        return (frequency - low) / (high - low) * duration * rate
    return float(np.log(frequency / low) / np.log(high / low) * duration * rate)
