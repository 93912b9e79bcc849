"""Random test: Gaussian noise in a frequency band, continuous or in bursts."""

from typing import TypeVar

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from daq.core.excitation.controlled import controlled
from daq.core.excitation.procedure import Form, Procedure
from daq.core.excitation.profiles.spectrum_shaping import Lines, equal_amplitudes, equalize, lines_between
from daq.core.excitation.station import Excitation, Station
from rig.core.base.arrays import Array
from rig.core.scene.excitation import Random, RandomControl

NoiseT = TypeVar("NoiseT", bound="Random | RandomControl")

# Length of the shaping filter [s]; its frequency resolution is therefore 0.25 Hz.
_FILTER_S = 4.0
# Length of a block [s]: one burst and the pause after it.
_BLOCK_S = 8.0
# Duration of the rise at the start and of the fall at the end of a burst, and of the test [s].
_EDGE_S = 0.02


def shaping_filter(lines: Lines, amplitudes: Array, gains: Array, level: float, period: int) -> Array:
    """Return the impulse response (period,) from white noise of unit variance to the required drive.

    `amplitudes`: amplitudes of the drive at `lines`; `gains`: ratio of force to drive at `lines`; `level`: required RMS
    force.
    """
    spectrum = np.zeros(period // 2 + 1)
    spectrum[lines] = amplitudes
    # The Hann window smooths the spectrum and changes its level; the level is therefore set after the window.
    hann = (1 + np.cos(np.linspace(-np.pi, np.pi, period, endpoint=False))) / 2
    response = np.fft.fftshift(np.fft.irfft(spectrum, period)) * hann
    force_spectrum = abs(np.fft.rfft(response))[lines] * gains * np.sqrt(2.0 / period)
    return response * (level / np.sqrt(np.sum(force_spectrum**2)))


def _burst_envelope(block: int, burst: float | None, edge: int) -> Array:
    """Return the envelope, 0 to 1, of a block with one burst (fraction of it) and linear edges [samples]; (block,)."""
    if burst is None:
        return np.ones(block)
    n_samples = max(2, round(burst * block))
    edge = max(1, min(edge, n_samples // 2))
    samples_to_end = np.minimum(np.arange(n_samples), n_samples - 1 - np.arange(n_samples))
    envelope = np.zeros(block)
    envelope[:n_samples] = np.minimum(1.0, samples_to_end / edge)
    return envelope


class NoiseProcedure(Procedure[NoiseT]):
    """Gaussian noise of a given duration."""

    # The extremes of different parts of the test differ by about 10 %.
    budget = 4.0

    def extension(self, test: NoiseT, seconds: float) -> float:
        """Return the expected maximum of the whole test over that of its first `seconds`, for Gaussian noise."""
        # The expected maximum grows with sqrt(log(number of zero crossings)).
        crossings_per_s = sum(test.band or ())
        log_whole, log_part = (np.log(max(crossings_per_s * time, 3.0)) for time in (test.duration, seconds))
        return float(max(np.sqrt(log_whole / log_part), 1.0))


class RandomProcedure(NoiseProcedure["Random"]):
    """Gaussian noise in a band."""

    form = Form("random", ("level", "low", "high", "duration"))

    def excite(self, station: Station, test: Random) -> Excitation:
        """Run a random test: white noise, filtered to a flat force spectrum in the band, times the bursts."""
        period = station.samples(_FILTER_S)
        lines = lines_between(test.from_, test.to, period, station.rate)
        level = station.level
        generator = station.generator("random")
        amplitudes, gains = equal_amplitudes(level, lines), np.ones(lines.size)
        force = controlled(station)
        if force is not None:
            phases = generator.uniform(0.0, 2 * np.pi, lines.size)
            amplitudes, gains, wave = yield from equalize(station, force, lines, period, phases)
            yield station.drive(wave * (1 + np.cos(np.pi * np.arange(period) / period)) / 2)
        total = station.samples(test.duration)
        block = min(total, station.samples(_BLOCK_S))
        envelope = _burst_envelope(block, test.burst, station.samples(_EDGE_S))
        first, completed, clipped = station.now, 0, 0
        # For speed, white noise is drawn at less than the drive rate: at least four times the highest frequency.
        max_divisor = max(1, period // (4 * int(lines[-1])))
        rate_divisor = next(divisor for divisor in range(max_divisor, 0, -1) if period % divisor == 0)
        length = rate_divisor * next_fast_len(-(-(2 * period - 1) // rate_divisor), real=True)  # rounded up
        impulse_response = shaping_filter(lines, amplitudes, gains, level, period)
        spectrum = rfft(impulse_response, length)[: length // rate_divisor // 2 + 1] * np.sqrt(rate_divisor)
        sources = [generator, *(station.generator(f"random {number}") for number in station.shakers[1:])]

        def shaped_noise() -> Array:
            """Return a period of noise and its tail, shape (shakers, 2 period - 1)."""
            white = [rfft(source.standard_normal(period // rate_divisor), length // rate_divisor) for source in sources]
            return np.asarray([irfft(source * spectrum, length)[: 2 * period - 1] for source in white])

        tails = shaped_noise()[:, period:]
        fields: dict[str, object] = {"from": test.from_, "to": test.to}
        if test.burst is not None:
            fields |= {"burst": test.burst, "block": block}
        if len(station.shakers) > 1:
            fields["shakers"] = list(station.shakers)
        try:
            while completed < total:
                # Overlap-add convolution makes the noise continuous across windows.
                shaped = shaped_noise()
                shaped[:, : tails.shape[1]] += tails
                wave, tails = shaped[:, :period], shaped[:, period:]
                n_samples = min(period, total - completed)
                samples = np.arange(completed, completed + n_samples)
                wave = wave[:, :n_samples] * envelope[samples % block]
                wave *= np.minimum(1.0, np.minimum(samples, total - 1 - samples) / station.samples(_EDGE_S))
                clipped += int(np.sum((abs(wave) > station.drive_limit).any(axis=0)))
                yield station.drives(np.clip(wave, -station.drive_limit, station.drive_limit))
                completed += n_samples
                station.report(completed / total, f"{completed / station.rate:.0f} s of {test.duration:g} s")
        finally:
            # The measurement is marked even if the test ends early.
            if completed:
                station.mark("measure", first, first + completed, level=level, **fields)
        if clipped:
            station.warn(f"the amplifier's limit clipped {clipped} of {total} drive samples. Lower the level.")

    def snr_gain(self, test: Random, frequency: Array) -> Array:
        """Return the ratio of the densities of drive and noise [sqrt(s)], for unit level and unit noise density."""
        return np.full(frequency.size, 1.0 / np.sqrt(test.to - test.from_))


PROCEDURE = RandomProcedure()
