"""Random test with profile control: noise at rising levels; its spectrum is corrected from averaged densities.

The terms are those of IEC 60068-2-64. Limits of other channels reduce the drive in their bands (notching).
"""

from collections.abc import Generator, Iterable, Sequence

import numpy as np
from scipy.special import erfc

from daq.core.excitation.procedure import Form
from daq.core.excitation.profiles.identification import EXPECTED_PERIODS, identify
from daq.core.excitation.profiles.profile_checks import line_warnings
from daq.core.excitation.profiles.spectrum_control import SCATTER_DB, AveragedSpectra, NoiseSource, updated
from daq.core.excitation.profiles.spectrum_shaping import lines_between
from daq.core.excitation.random import NoiseProcedure
from daq.core.excitation.station import AbortedTest, Excitation, Station
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array
from rig.core.scene.excitation import RandomControl
from rig.core.scene.excitation.profile import limits_drive
from rig.core.scene.scene import Scene

# Number of averaged spectra for the first update at a level, and for the levels of the ramp: a scatter of about 1 dB.
_FIRST_AVERAGES = 16
# Fraction of lines within the tolerance that continues the ramp: with few averages, the other lines are outside by
# chance.
_MIN_WITHIN = 0.9
# Maximum number of updates at a level of the ramp; more are needed only if the spectrum cannot be reached.
_MAX_UPDATES = 12
# Largest fraction of the drive samples that the output may clip.
_MAX_CLIPPED = 0.01
# A line is outside its limit if it exceeds it by this number of standard deviations of its averaged density; a line at
# the limit does so by chance with a probability of 2 %.
_OUTSIDE_SIGMAS = 2.0


class SpectrumControl:
    """Drive density of a test, and its corrections; all densities refer to the full level."""

    def __init__(self, station: Station, test: RandomControl) -> None:
        self.station, self.test, rate = station, test, station.rate
        self.period = 2 * max(2, round(rate / test.resolution / 2.0))
        self.lines = lines_between(*test.band, self.period, rate)
        self.frequency = self.lines * rate / self.period
        self.rows = [station.row_of(name) for _, name in test.named_channels]
        factors = np.array([abs(station.acceleration_factor(row, self.frequency)) ** 2 for row in self.rows])
        self.spectra = AveragedSpectra(factors, self.lines, self.period, rate)
        self.drive = np.zeros(self.lines.size)
        self.source = NoiseSource(station.generator("random control"), self.lines, self.period, rate)
        self.clipped = self.total = 0
        self.outside, self.worst = 0, 0.0  # lines outside the tolerance, and largest deviation [dB]

    def identify(self) -> Generator[Array, Array, None]:
        """Identify the responses to the drive; the drive then follows from the profile and the limits."""
        test, resolution = self.test, self.station.rate / self.period
        required = np.sqrt(2.0 * test.profile.at(self.frequency) * resolution)
        sums = [float(np.nansum(limit.at(self.frequency))) for limit in test.limits]
        largest = np.sqrt([np.inf] * len(test.control.channels) + [s * resolution if s > 0.0 else np.inf for s in sums])
        gain, _ = yield from identify(
            self.station, self.rows, self.lines, self.period, required, largest, "random control identification"
        )
        self.drive = self._correction(np.abs(gain) ** 2)
        rms = self._rms(1.0)
        share = float(erfc(self.station.output_limit / (rms * np.sqrt(2.0)))) if rms > 0.0 else 0.0
        if share > _MAX_CLIPPED:
            raise AbortedTest(
                f"at full level, {100 * share:.0f} % of the drive samples are clipped by the output. Lower the profile."
            )

    def _rms(self, gain: float) -> float:
        """Return the root mean square of the drive, whose density is multiplied by `gain`."""
        return float(np.sqrt(np.sum(self.drive) * gain * self.station.rate / self.period))

    def run(self, level: float, averages: int) -> Generator[Array, Array, Array]:
        """Output noise at a level in dB for a number of spectra; return the densities, scaled to full level."""
        gain = 10.0 ** (level / 10.0)
        limit = min(self.test.clip * self._rms(gain), self.station.output_limit)
        self.spectra.restart()
        while self.spectra.count < averages:
            wave = self.source.next_half(gain * self.drive)
            self.clipped += int(np.sum(abs(wave) > self.station.output_limit))
            self.total += wave.size
            self.spectra.add((yield self.station.drive(np.clip(wave, -limit, limit)))[self.rows])
        return self.spectra.density / gain

    def step(self, level: float, averages: int) -> Generator[Array, Array, float]:
        """Output noise as `run`, and correct the drive; return the fraction of lines within the tolerance."""
        share_run = self.station.now / self.station.rate / max(self.test.shortest, 1e-9)
        self.station.report(min(share_run, 1.0), f"level {level:g} dB")
        density = yield from self.run(level, averages)
        share_within = self._assess(density, level)
        self.drive = updated(self.drive, self._correction(density), self.test.speed, self.spectra.count)
        return share_within

    def _assess(self, density: Array, level: float) -> float:
        """Abort if too many lines exceed the abort limit; return the fraction of lines within the tolerance."""
        test, margin = self.test, _OUTSIDE_SIGMAS * SCATTER_DB / np.sqrt(self.spectra.count)
        required = test.decibels(test.required(density, self.frequency))
        deviation = -required[0]
        above = deviation > test.abort + margin
        worst = int(np.argmax(deviation))
        if np.mean(above) > test.abort_lines:
            peak = f"{deviation[worst]:.1f} dB at {self.frequency[worst]:.4g} Hz"
            raise AbortedTest(
                f"aborted at a level of {level:g} dB: {100 * np.mean(above):.0f} % of the lines exceed the profile by "
                f"more than {test.abort:g} dB plus twice the scatter of the averages ({margin:.1f} dB); the largest "
                f"excess is {peak}. Lower test.speed, or limit the response of a channel."
            )
        is_notched = limits_drive(required[0], required[1:], test.tolerance + margin).any(axis=0)
        within = (abs(deviation) <= test.tolerance + margin) | is_notched
        self.outside = int(np.sum(~within))
        self.worst = float(deviation[int(np.argmax(np.where(is_notched, 0.0, abs(deviation))))])
        return float(np.mean(within))

    def _correction(self, density: Array) -> Array:
        """Return the required change of the drive density."""
        # Limits are reduced by the standard deviation of densities averaged over the test: few lines then exceed them.
        spectra = max(2.0 * self.test.duration * self.station.rate / self.period, 1.0)
        required = self.test.required(density, self.frequency)
        required[1:] *= 10.0 ** (-SCATTER_DB / np.sqrt(spectra) / 10.0)
        return np.asarray(required.min(axis=0))


class RandomControlProcedure(NoiseProcedure["RandomControl"]):
    """Noise with profile control."""

    form = Form("random control of the scene", ())
    waits_for_sensors = True

    def excite(self, station: Station, test: RandomControl) -> Excitation:
        """Run the levels of the ramp (marked `ramp`), and the full level (marked `measure` and `tolerance`)."""
        for message in line_warnings(test, station.scene, station.channels):
            station.warn(message)
        control = SpectrumControl(station, test)
        yield from control.identify()
        averages = min(_FIRST_AVERAGES, test.averages)
        for level in test.ramp:
            first, updates = station.now, 0
            while True:
                share = yield from control.step(level, averages)
                updates += 1
                if share >= _MIN_WITHIN and station.now - first >= station.samples(test.hold):
                    break
                if updates >= _MAX_UPDATES and share < _MIN_WITHIN:
                    raise AbortedTest(
                        f"at {level:g} dB only {100 * share:.0f} % of the lines are within {test.tolerance:g} dB after "
                        f"{updates} updates. Increase test.lines or test.tolerance."
                    )
            station.mark("ramp", first, station.now, level=level, within=round(share, 3))
        first, end, count = station.now, station.now + station.samples(test.duration), averages
        try:
            while station.now < end:
                start, remaining = station.now, -(-(end - station.now) // (control.period // 2))
                if remaining < _FIRST_AVERAGES:
                    yield from control.run(0.0, remaining)
                    break
                yield from control.step(0.0, min(count, remaining))
                station.mark("tolerance", start, station.now, outside=control.outside, worst=round(control.worst, 2))
                count = min(2 * count, test.averages)
        finally:
            # The measurement is marked even if the test ends early.
            if station.now > first:
                band = {"from": test.band[0], "to": test.band[1]}
                station.mark("measure", first, station.now, **band, level=test.rms())
        yield station.drive(control.source.next_half(0.0 * control.drive))
        if control.outside:
            station.warn(
                f"{control.outside} of {control.lines.size} lines are outside the tolerance of {test.tolerance:g} dB "
                f"(largest deviation {control.worst:+.1f} dB). Increase test.lines or test.duration."
            )
        if control.clipped > 1e-4 * control.total:
            station.warn(f"the output clipped {control.clipped} drive samples. Lower the profile.")

    def check(self, test: RandomControl, scene: Scene, channels: Sequence[ChannelInfo]) -> Iterable[str]:
        """Report a spacing of lines that is too wide, limits that end early, and the levels before the full level."""
        yield from line_warnings(test, scene, channels)
        levels = f" and levels of {', '.join(f'{level:g}' for level in test.ramp)} dB" * bool(test.ramp)
        yield f"{test.duration:g} s at full level, after the identification{levels}"

    def waits(self, test: RandomControl, scene: Scene) -> float:
        """Return the expected time of the identification, and of the averages beyond the times of the levels [s]."""
        average = _FIRST_AVERAGES / 2.0 / test.resolution
        return EXPECTED_PERIODS / test.resolution + (len(test.ramp) + 1) * average

    def stored(self, test: RandomControl) -> float:
        """Return the length of a frame [s]."""
        return 1.0 / test.resolution

    def part(self, test: RandomControl, seconds: float, scene: Scene) -> RandomControl:
        """Return a test with the full level only, and a shorter duration."""
        return test.replace(ramp=(), duration=min(test.duration, max(seconds, 1.0 / test.resolution)))


PROCEDURE = RandomControlProcedure()
