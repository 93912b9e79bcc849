"""Random: Gaussian noise in a band, continuous or in bursts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.signal.windows import hann

from daq.excitation.spectrum_shaping import Lines, equalise, flat, lines_between
from daq.excitation.station import Excitation, Station
from rig.arrays import Array

if TYPE_CHECKING:
    from rig.scene.excitation import Random


# Length of the shaping filter and of a burst's block, s: the resolution of the filter is 0.25 Hz.
_FILTER, _BLOCK = 4.0, 8.0
_EDGE = 0.02


def excite(station: Station, test: Random) -> Excitation:
    """Run a random test."""
    period = station.samples(_FILTER)
    lines = lines_between(test.from_, test.to, period, station.rate)
    level = station.level
    random = station.generator("random")
    amplitudes, gains = flat(level, lines), np.ones(lines.size)
    if station.controlled:
        phases = random.uniform(0.0, 2 * np.pi, lines.size)
        amplitudes, gains, wave = yield from equalise(station, lines, period, phases)
        yield station.drive(wave * (1 + np.cos(np.pi * np.arange(period) / period)) / 2)
    total = station.samples(test.duration)
    block = min(total, station.samples(_BLOCK))
    gate = _gate(block, test.burst, station.samples(_EDGE))
    first, done, clipped = station.now, 0, 0
    # The rate of the white noise, a divisor of the drive's, is at least four times the highest frequency.
    most = max(1, period // (4 * int(lines[-1])))
    slower = next(times for times in range(most, 0, -1) if period % times == 0)
    length = slower * next_fast_len(-(-(2 * period - 1) // slower), real=True)
    shape = shaping_filter(lines, amplitudes, gains, level, period)
    spectrum = rfft(shape, length)[: length // slower // 2 + 1] * np.sqrt(slower)
    sources = [random, *(station.generator(f"random {number}") for number in station.shakers[1:])]

    def shaped_noise() -> Array:
        white = [rfft(each.standard_normal(period // slower), length // slower) for each in sources]
        return np.asarray([irfft(each * spectrum, length)[: 2 * period - 1] for each in white])

    tails = shaped_noise()[:, period:]
    facts: dict[str, object] = {"from": test.from_, "to": test.to}
    if test.burst is not None:
        facts |= {"burst": test.burst, "block": block}
    if len(station.shakers) > 1:
        facts["shakers"] = list(station.shakers)
    try:
        while done < total:
            # Overlap-add convolution makes the noise continuous across windows.
            pieces = shaped_noise()
            pieces[:, : tails.shape[1]] += tails
            wave, tails = pieces[:, :period], pieces[:, period:]
            size = min(period, total - done)
            places = np.arange(done, done + size)
            wave = wave[:, :size] * gate[places % block]
            wave *= np.minimum(1.0, np.minimum(places, total - 1 - places) / station.samples(_EDGE))
            clipped += int(np.sum(abs(wave) > station.drive_limit))
            yield station.drives(np.clip(wave, -station.drive_limit, station.drive_limit))
            done += size
            station.report(done / total, f"{done / station.rate:.0f} s of {test.duration:g} s")
    finally:
        # A test that ends early has measured up to this sample.
        if done:
            station.mark("measure", first, first + done, level=level, **facts)
    if clipped:
        station.warn(f"the amplifier's limit clipped {clipped} of {total} drive samples. Lower the level.")


def shaping_filter(lines: Lines, amplitudes: Array, gains: Array, level: float, period: int) -> Array:
    """Return the impulse response (period,) from white noise of unit variance to the required drive.

    `amplitudes` of the required spectrum and `gains` per drive are at `lines`; `level` is the RMS of drive times
    gains.
    """
    spectrum = np.zeros(period // 2 + 1)
    spectrum[lines] = amplitudes
    # The window tapers the response and smooths the spectrum slightly: the level is therefore set after the window.
    response = np.fft.fftshift(np.fft.irfft(spectrum, period)) * hann(period, sym=False)
    reached = abs(np.fft.rfft(response))[lines] * gains * np.sqrt(2.0 / period)
    return response * (level / np.sqrt(np.sum(reached**2)))


def _gate(block: int, burst: float | None, edge: int) -> Array:
    """Return the on-off envelope of a block, with smooth edges; shape (block,)."""
    if burst is None:
        return np.ones(block)
    on = max(2, round(burst * block))
    edge = max(1, min(edge, on // 2))
    gate = np.zeros(block)
    gate[:on] = np.minimum(1.0, np.minimum(np.arange(on), on - 1 - np.arange(on)) / edge)
    return gate
