"""Frequency responses during a test: H1 and coherence, averaged over impacts or over Hann-windowed blocks.

Successive blocks overlap by half. A line is estimated from the blocks in which the test excited it; other lines remain
empty. The estimate is a quick view for the operator. `analysis frf` estimates the response from the recording, with its
uncertainty.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from daq.core.excitation import Station
from daq.core.excitation.controlled import spring_force
from daq.core.signal_chain.channel import ChannelInfo
from daq.extras.bench_page.impacts import Impact
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import SceneError
from rig.core.scene.scene import Scene

# A line is excited if it is at least this fraction of the largest line of the force's auto-spectrum; at other lines,
# noise dominates.
_EXCITED_RATIO = 1e-3
# Half width of the main lobe of the Hann window, spectral lines: a tone excites this number of lines on either side.
_LOBE_LINES = 2.0
# Minimum number of averages for a coherence; with a single average it is 1 for any data.
_MIN_COHERENCE_AVERAGES = 2
# A response with a smaller coherence is uncertain, ...
_MIN_COHERENCE = 0.7
# ... as is a response whose coherence unrelated signals exceed with at least this probability.
_SIGNIFICANCE = 0.05
# Below its first determined line, the response to impacts is omitted: there the end of the window, which cuts the decay
# of the resonances, contributes more than this fraction of the spectrum. This error is coherent among impacts.
_MAX_TRUNCATION_RATIO = 0.5
# The contribution of the end is the scatter of the spectrum over ends in the last part of the window: at least a period
# of the lowest resonance, and short enough that the decay is nearly constant.
_END_RATIOS = np.linspace(0.9, 1.0, 9)
# Number of lines over which power and error are averaged.
_AVERAGED_LINES = 5
# Relation of the true magnitude to the estimate: equal; higher, because the response clipped; lower, because the force
# clipped; unknown, because both clipped.
RELATIONS = "", "≥", "≤", "?"


@dataclass(frozen=True)
class LiveCurves:
    """Estimated frequency responses of the channels on bodies; NaN at lines that were not excited."""

    names: list[str]  # names of the channels
    frequency: Array  # Hz; (frequencies,)
    value: ComplexArray  # compliance (displacement over force) [m/N]; (channels, frequencies)
    coherence: Array  # (channels, frequencies)
    relation: NDArray[np.intp]  # Index in `RELATIONS`; (channels, frequencies)
    force: Array  # rms of a tone, or of the force in the blocks that excited a line [N]; NaN: impacts; (frequencies,)
    count: NDArray[np.intp]  # averaged blocks or impacts of each line; (frequencies,)

    @property
    def averages(self) -> int:
        """Largest number of averaged blocks or impacts of a line."""
        return int(self.count.max())

    @property
    def coherence_limit(self) -> Array:
        """Coherence below which a line is uncertain; NaN at lines of a single average.

        Unrelated Gaussian signals exceed a coherence c of n averages with probability (1 - c)^(n - 1) (Bendat and
        Piersol, Random Data, chapter 9). Overlapping blocks count as independent: with a Hann window and an overlap of
        one half, the variance is larger by less than 6 %.
        """
        averages = np.where(self.count < _MIN_COHERENCE_AVERAGES, np.nan, self.count)
        return np.asarray(np.maximum(_MIN_COHERENCE, 1.0 - _SIGNIFICANCE ** (1.0 / (averages - 1.0))))


class _SpectrumSums:
    """Sums of the auto- and cross-spectra of force (lines,) and motion (channels, lines) over blocks or impacts."""

    def __init__(self, channels: int, lines: int) -> None:
        self.force = np.zeros(lines)
        self.motion = np.zeros((channels, lines))
        self.cross = np.zeros((channels, lines), complex)
        self.count = np.zeros(lines, int)
        self.force_power = np.zeros(lines)  # N²
        self.relation = np.zeros((channels, lines), int)

    def add(
        self,
        force: ComplexArray,
        motion: ComplexArray,
        relation: NDArray[np.intp],
        excited: NDArray[np.bool_] | bool = True,
        force_power: float = np.nan,
    ) -> None:
        self.force_power += np.where(excited, force_power, 0.0)
        self.relation |= excited * relation
        self.force += excited * np.abs(force) ** 2
        self.motion += excited * np.abs(motion) ** 2
        self.cross += excited * motion * force.conj()
        self.count += excited


class LiveFrf:
    """Estimates the responses of all channels on bodies to the force on the structure.

    `scene` contains the test; `block` is the duration of a block, or of the window of an impact, in s; `band` contains
    the lowest and the highest frequency [Hz]. Raises `SceneError` if no channel measures the force.
    """

    def __init__(
        self, scene: Scene, channels: Sequence[ChannelInfo], rate: float, block: float, band: tuple[float, float]
    ) -> None:
        self._block_samples, self._rate = round(block * rate), rate
        frequency = np.fft.rfftfreq(self._block_samples, 1.0 / rate)
        self._line_indices = np.flatnonzero((frequency >= max(band[0], 1.0 / block)) & (frequency <= band[1]))
        self.frequency = np.asarray(frequency[self._line_indices], dtype=float)
        station = Station(scene, channels, (), rate, mark=lambda *arguments, **fields: None)
        self._channel_weights = _force_weights(station, self.frequency)
        self._rows = [row for row, info in enumerate(channels) if info.body and info.quantity != "force"]
        self.names = [channels[row].name for row in self._rows]
        self._displacement_factors = np.array([station.displacement_factor(row, self.frequency) for row in self._rows])
        self._hann_window = np.hanning(self._block_samples)
        self._pending = np.zeros((len(channels), 0))
        self._pending_overload = np.zeros((len(channels), 0), bool)
        # Lowest and highest excited frequency at each pending sample [Hz].
        self._pending_band = np.zeros((2, 0))
        # RMS of the force in the last block [N]; None before the first block, or if the force clipped.
        self.force_rms: float | None = None
        self._block_sums = _SpectrumSums(len(self._rows), self._line_indices.size)
        # Impact, spectra of all channels, and power of the truncation error of each response (responses, lines).
        self._impacts: list[tuple[Impact, ComplexArray, Array]] = []

    def add(self, readings: Array, overload: NDArray[np.bool_], band: tuple[float, float] | None) -> None:
        """Add the next readings of a continuous test, and their overloads, both of shape (channels, samples).

        `band`: lowest and highest frequency [Hz] that the test excites in these samples, equal for a tone; None before
        the measurement.
        """
        limits = np.full((2, readings.shape[1]), np.nan) if band is None else np.tile(band, (readings.shape[1], 1)).T
        if band is not None and np.isnan(self._pending_band).any():
            # The measurement begins with a new block.
            self._drop(self._pending.shape[1])
        self._pending = np.concatenate([self._pending, readings], axis=1)
        self._pending_overload = np.concatenate([self._pending_overload, overload], axis=1)
        self._pending_band = np.concatenate([self._pending_band, limits], axis=1)
        while self._pending.shape[1] >= self._block_samples:
            block, limits = self._pending[:, : self._block_samples], self._pending_band[:, : self._block_samples]
            spectra = self._spectra((block - block.mean(axis=1, keepdims=True)) * self._hann_window)
            force, motion = self._force_and_motion(spectra)
            power = self._power(np.sum(np.abs(force) ** 2))
            # Before the measurement the limits are NaN; comparisons with NaN are false.
            lobe = _LOBE_LINES / (self._block_samples / self._rate)
            low, high = limits[0].min() - lobe, limits[1].max() + lobe
            relation = self._relation(
                np.flatnonzero(self._pending_overload[:, : self._block_samples].any(axis=1)).tolist()
            )
            force_is_clipped = bool((relation >= RELATIONS.index("≤")).any())
            self.force_rms = None if force_is_clipped else float(np.sqrt(power))
            excited = (self.frequency >= low) & (self.frequency <= high)
            self._block_sums.add(force, motion, relation, excited, power)
            self._drop(self._block_samples // 2)

    def add_impact(self, impact: Impact) -> None:
        """Add the window of an impact; it is used as long as the impact is accepted."""
        window = impact.readings[:, : self._block_samples]
        cut = []
        for samples in np.rint(_END_RATIOS * window.shape[1]).astype(int).tolist():
            cut.append(self._spectra(np.pad(window[:, :samples], ((0, 0), (0, self._block_samples - samples)))))
        # A sinusoidal change with the end has an amplitude of √2 standard deviations.
        self._impacts.append((impact, cut[-1], 2.0 * np.var(cut, axis=0)[self._rows]))

    @property
    def version(self) -> tuple[int, list[bool]]:
        """Cache key of `curves`: number of averaged blocks, and whether each impact is accepted."""
        return int(self._block_sums.count.sum()), [impact.accepted for impact, *_ in self._impacts]

    def curves(self) -> LiveCurves | None:
        """Return the current estimate; None before the first block."""
        sums = self._block_sums
        if self._impacts:
            sums = _SpectrumSums(len(self._rows), self._line_indices.size)
            for impact, spectra, _ in self._impacts:
                if impact.accepted:
                    sums.add(*self._force_and_motion(spectra), self._relation(impact.overloaded))
        if not sums.count.any():
            return None
        mean_force = sums.force / np.maximum(sums.count, 1)
        power = np.where(sums.count, sums.force_power, np.nan) / np.maximum(sums.count, 1)
        excited = mean_force > _EXCITED_RATIO * mean_force.max()
        if self._impacts:
            # A pulse excites the band below the first zero of its spectrum.
            strongest = int(mean_force.argmax())
            beyond = np.flatnonzero(~excited[strongest:])
            excited[strongest + beyond[0] if beyond.size else excited.size :] = False
        else:
            # A few successive lines are the main lobe of a tone, which is measured at the largest of them and has the
            # power of its lobe.
            for (lobe,) in scipy.ndimage.find_objects(scipy.ndimage.label(excited)[0]):
                if lobe.stop - lobe.start <= 2.0 * _LOBE_LINES:
                    excited[lobe] = mean_force[lobe] == mean_force[lobe].max()
                    power[lobe] = self._power(mean_force[lobe].sum())
        force = np.where(excited, sums.force, np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            # Without noise, rounding would exceed 1.
            coherence = np.minimum(np.abs(sums.cross) ** 2 / (force * sums.motion), 1.0)
            value = np.asarray(sums.cross / force, dtype=complex)
        coherence[:, sums.count < _MIN_COHERENCE_AVERAGES] = np.nan
        for row, first in enumerate(self._first_determined()):
            value[row, :first] = coherence[row, :first] = np.nan
        rms = np.sqrt(np.where(excited, power, np.nan))
        return LiveCurves(self.names, self.frequency, value, coherence, sums.relation, rms, sums.count)

    def _power(self, sum_of_squares: float) -> float:
        """Return the power of a windowed signal [N²] from the sum of the squares of its spectrum."""
        return float(2.0 * sum_of_squares / (self._block_samples * np.sum(self._hann_window**2)))

    def _first_determined(self) -> list[int]:
        """Return the first line of each response to accepted impacts that the end of the window does not dominate."""
        accepted = [(spectra[self._rows], error) for impact, spectra, error in self._impacts if impact.accepted]
        if not accepted:
            return []
        motion = np.sum([np.abs(spectra) ** 2 for spectra, _ in accepted], axis=0)
        error = np.sum([each for _, each in accepted], axis=0)
        # Averaged over lines, because a single line has a small error by chance.
        motion, error = (scipy.ndimage.uniform_filter1d(each, _AVERAGED_LINES, axis=1) for each in (motion, error))
        is_determined = error < _MAX_TRUNCATION_RATIO**2 * motion
        return [int(row.argmax()) if row.any() else row.size for row in is_determined]

    def _drop(self, samples: int) -> None:
        """Remove the oldest pending samples."""
        self._pending, self._pending_overload = self._pending[:, samples:], self._pending_overload[:, samples:]
        self._pending_band = self._pending_band[:, samples:]

    def _relation(self, overloaded: list[int]) -> NDArray[np.intp]:
        """Return the index in `RELATIONS` for each response, (channels, 1), from the rows with an overload."""
        force_is_clipped = bool(self._channel_weights[overloaded].any())
        return np.array([[(row in overloaded) + 2 * force_is_clipped] for row in self._rows])

    def _spectra(self, block: Array) -> ComplexArray:
        return np.asarray(np.fft.rfft(block, axis=1)[:, self._line_indices])

    def _force_and_motion(self, spectra: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Convert the spectra of all channels to force (lines,) and displacements (channels on bodies, lines)."""
        return (self._channel_weights * spectra).sum(axis=0), self._displacement_factors * spectra[self._rows]


def _force_weights(station: Station, frequency: Array) -> ComplexArray:
    """Return the weights of the channels' spectra in the force, (channels, lines), N per unit of the channel."""
    has_hammer = station.scene.hammer is not None
    for row, info in enumerate(station.channels):
        if info.quantity == "force" and (info.at == "hammer") == has_hammer:
            weights = np.zeros((len(station.channels), frequency.size), complex)
            weights[row] = 1.0 / info.response(frequency)
            return weights
    shaker = station.scene.driven_shaker
    if not has_hammer and station.scene.reference == "table":
        raise SceneError("the page has no responses to the motion of a table. Record the test, and use `analysis frf`.")
    if has_hammer or shaker is None or shaker.coil_spring is None:
        position = "hammer" if has_hammer else "shaker"
        raise SceneError(
            f"channels: no channel measures the force at the {position}. Add {{name: force, at: {position}}} to the "
            "channels of the scene."
        )
    return spring_force(station).weights(frequency)
