"""Impact test: frequency responses from hits with a force-measuring hammer."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

from analysis.recordings.channel_delay import arrival
from analysis.recordings.slices import hits
from analysis.responses.estimators import Averages
from analysis.responses.force_pulse import pulse_alone
from rig.errors import RecordingError

if TYPE_CHECKING:
    from daq.recording.recording import Recording

Array = NDArray[np.float64]

# Part of a response that may be left at a block's end unwindowed.
_LEFT_OVER = 5e-4
# Part of a block over which its end is faded out.
FADING = 0.1
# A block begins so long before its hit, s; what then rings from the hit before must be below this part of the
# response that follows.
REST, RINGING = 0.2, 0.01
# The largest force belongs to the hit; where the window leaves less than this part of it, it missed the hit.
MISSED = 0.5
# A rebound is a second peak of at least this part of the first.
REBOUND = 0.1


def rebounds(force: Array, rate: float) -> int:
    """Count the hits beyond the first in a force signal: peaks above a tenth of the largest, 1 ms apart.

    Examples
    --------
    >>> pulse = np.sin(np.linspace(0.0, np.pi, 20))
    >>> rebounds(np.concatenate([np.zeros(50), pulse, np.zeros(80), 0.3 * pulse, np.zeros(50)]), 5120.0)
    1
    """
    highest = float(force.max())
    edges = np.concatenate([[0.0], force, [0.0]])
    peaks, _ = signal.find_peaks(
        edges, height=REBOUND * highest, prominence=REBOUND * highest, distance=max(1, int(1e-3 * rate))
    )
    return max(len(peaks) - 1, 0)


def averages(rec: Recording) -> Averages:
    """Average the spectra of all clean hits.

    A force window keeps the pulse alone, with what the channel's high-passes make of it; where a response has
    not died away at the end of a block, an exponential window takes it and the force down to 0.05 %, and the
    decay rate that adds to every mode is kept as `shift`. Hits with a rebound are left out while clean ones
    remain.
    """
    names = list(rec.channels)
    forces = [i for i, name in enumerate(names) if rec.channels[name].quantity == "force"]
    if not forces:
        raise RecordingError(
            "no force channel: an impact test gives a frequency response only with the hammer recorded; "
            "add {name: hammer, at: hammer} to the scene's channels, or use `analysis decay`"
        )
    marked = hits(rec)
    rest = max(int(REST * rec.rate), 2)
    # First sample in which any channel can hold the hit, but two: a recording may begin with one.
    arrivals = [
        max(min(arrival(info, first, first)[0] for info in rec.channels.values()), 2) for first, _ in marked
    ]
    starts = [max(first - rest, 0) for first in arrivals]
    length = int(min(np.diff([*starts, rec.samples])))
    if length < rec.rate * 0.2:
        raise RecordingError(
            f"blocks of {length / rec.rate:.3g} s between hits are too short: test: interval"
        )
    blocks, notes = [], []
    offset = np.stack([rec.read(name, starts[0], arrivals[0]) for name in names]).mean(axis=1, keepdims=True)
    for index, (start, arrived, (first, last)) in enumerate(zip(starts, arrivals, marked, strict=True), 1):
        block = np.stack([rec.read(name, start, start + length) for name in names]) - offset
        if not np.isfinite(block).all():
            notes.append(f"Hit {index} left out: samples were lost.")
            continue
        before = block[:, : arrived - start].copy()
        ringing = float(
            np.nanmax(np.sqrt(2.0 * np.mean(before**2, axis=1)) / np.maximum(abs(block).max(axis=1), 1e-300))
        )
        if index > 1 and ringing > RINGING:
            notes.append(
                f"Hit {index} left out: {ringing:.1%} of its response still rang from the hit before; wait "
                "longer "
                "between hits (test: interval)."
            )
            continue
        again = rebounds(block[forces[0]], rec.rate)
        if again:
            notes.append(f"Hit {index} left out: the hammer hit {again + 1} times.")
            continue
        raw = float(abs(block[forces[0]]).max())
        for i in forces:
            info = rec.channels[names[i]]
            # What was there before is the tail of earlier hits, which hardly changes while this one lasts.
            begin, end = arrival(info, first, last)
            block[i] = pulse_alone(info, block[i] - before[i].mean(), max(begin - start, 0), end - start)
        inside = float(abs(block[forces[0]]).max())
        if inside < MISSED * raw:
            notes.append(
                f"Hit {index} left out: the force reads {inside:.3g} N at most where the hit is marked, at "
                f"{first / rec.rate:.4g} s, and {raw:.3g} N elsewhere; the marker or the channel's delay is wrong."
            )
            continue
        # What still rings from the hit before is faded in: its sudden beginning would show far below the modes.
        block[:, : arrived - start] *= _rise(arrived - start)
        blocks.append(block)
    if not blocks:
        raise RecordingError("no clean hit: " + " ".join(notes) + " Hit again, more briefly.")
    data = np.stack(blocks)
    shift = _exponential(data, forces, rec.rate)
    if shift:
        notes.append(
            f"Exponential window: {shift:.3g} 1/s were added to the decay of every mode (`modes` takes "
            "them off)."
        )
    spectra = fft.rfft(data, axis=2)
    frequency = fft.rfftfreq(length, 1.0 / rec.rate)
    cross = np.einsum("bin,bjn->nij", spectra, spectra.conj()) / len(blocks)
    power = cross[:, forces[0], forces[0]].real
    # High-passes take the lowest frequencies off the force: its spectrum ends where it falls beyond its highest.
    highest = int(np.argmax(power[: max(2, length // 1000)]))
    reach = np.flatnonzero(power[highest:] < 1e-2 * power[highest])
    stop = highest + int(reach[0]) if reach.size else frequency.size
    keep = slice(max(1, int(np.ceil(length / rec.rate))), min(stop, int(0.4 * length)))
    if len(blocks) == 1:
        notes.append("One hit: no coherence and no error bars; repeat the hit (test: repeats).")
    return Averages(
        channels=tuple(names),
        frequency=frequency[keep],
        cross=cross[keep],
        averages=float(len(blocks)),
        resolution=0.0,
        shift=shift,
        label=rec.scene.name,
        warnings=tuple(notes),
    )


def _exponential(data: Array, forces: list[int], rate: float) -> float:
    """Window all channels in place where responses ring on; return the decay rate, 1/s."""
    others = [i for i in range(data.shape[1]) if i not in forces]
    tail = data[:, others, -max(1, data.shape[2] // 20) :]
    left = float(
        np.max(abs(tail).max(axis=(0, 2)) / np.maximum(abs(data[:, others]).max(axis=(0, 2)), 1e-300))
    )
    # What is left is faded out: were it cut off, its step would outweigh the small acceleration far below the modes.
    fading = max(2, int(FADING * data.shape[2]))
    data[:, :, -fading:] *= _rise(fading)[::-1]
    if left < _LEFT_OVER:
        return 0.0
    duration = data.shape[2] / rate
    shift = float(np.log(left / _LEFT_OVER) / duration)
    data *= np.exp(-shift * np.arange(data.shape[2]) / rate)
    return shift


def _rise(count: int) -> Array:
    """Half a cosine wave from zero to one."""
    return 0.5 - 0.5 * np.cos(np.pi * np.arange(1, count + 1) / (count + 1))
