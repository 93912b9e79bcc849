"""Multisine with random phases: best linear approximation, with noise and nonlinear distortion separated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from analysis.recordings.slices import read_slices
from analysis.responses.clean_stretches import describe_flaws, flaws
from analysis.responses.local_models.local_spectra import SIDE
from analysis.responses.measurands import located, reference_of
from analysis.responses.scatter import Scatter
from analysis.responses.spectral_lines import Lines, remainder
from analysis.responses.systematic import counts_of, in_counts, scattered, tone_gain
from rig.arrays import Array, ComplexArray
from rig.errors import RecordingError
from rig.results.response import Response

if TYPE_CHECKING:
    from daq.recording.markers import Marker
    from daq.recording.recording import Recording


NONLINEAR = (
    "The structure is nonlinear: the curve and its uncertainty are those of the best linear "
    "approximation for this level and kind of excitation. Steady tones of another amplitude (stepped "
    "sine) give another curve."
)
ONE_REALISATION = (
    "One realisation only: distortion by dampers cannot be separated from the response and is not in "
    "the uncertainty. Measure several (test: realisations)."
)
LIFTED = (
    "Dampers may leave the floor at this level, although the realisations scatter no more than noise: "
    "the curve is the best linear approximation, and its uncertainty does not include distortion that "
    "is equal in all realisations. Steady tones of another amplitude (stepped sine) give another curve."
)
# Assumed crest factor of a sum of tones, limited by the sum of their amplitudes.
_CREST = 4.0
# Distortion is detected if at least this share of the lines scatters by this multiple of the noise, and by this share
# of the mean.
_SHARE, _BEYOND, _SEEN = 0.2, 3.0, 2e-3


@dataclass(frozen=True)
class BestLinearApproximation:
    """Best linear approximation from the periods and realisations of a multisine."""

    total: Lines  # mean over realisations with their scatter: noise and nonlinear distortion together
    noise: Lines  # the same mean with the scatter of the periods alone
    realisations: int

    def frf(
        self, rec: Recording, response: str, reference: str = "force", motion: str = "displacement"
    ) -> Response:
        """Estimate the best linear approximation; the error bars contain noise and nonlinear distortion."""
        return self.total.frf(rec, response, reference, motion)

    def distortion(self, rec: Recording, response: str, reference: str = "force") -> Array:
        """Estimate the nonlinear distortion in one realisation, as a standard deviation of the receptance.

        Zero where noise explains the scatter of the realisations. Requires several realisations (R. Pintelon, J.
        Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., section 4.3).
        """
        total = self.total.frf(rec, response, reference).error ** 2
        noise = self.noise.frf(rec, response, reference).error ** 2
        return np.sqrt(2.0 * self.realisations * np.maximum(total - noise, 0.0))


def best_linear_approximation(
    rec: Recording,
    markers: Sequence[Marker],
    names: Sequence[str],
    reference: str = "force",
    progress: Callable[[int, int], None] | None = None,
) -> BestLinearApproximation:
    """Average over periods, then over realisations.

    The spectra of each realisation are rotated by the phase of its own reference before averaging. The remaining
    scatter between realisations, beyond the noise between periods, is the nonlinear distortion.

    `markers`: the ``measure`` markers of the test, one for each realisation; `names`: names of the channels to
    average; `reference`: 'force' or 'table'. Reference whose phases are used.
    """
    found = [_realisation(rec, names, marker, reference) for marker in markers]
    if progress is not None:
        progress(len(markers), len(markers))
    notes = [note for one in found for note in one.notes]
    kept = [one for one in found if one.periods]
    if not kept:
        raise RecordingError("no realisation of the multisine holds two whole periods: " + " ".join(notes))
    count, frequency = len(kept), kept[0].frequency
    stack = np.stack([one.mean for one in kept])
    centre = stack.mean(axis=0)
    noise = Scatter(
        np.asarray(np.concatenate([one.noise for one in kept]) / count, dtype=complex),
        np.full(frequency.size, 2.0 * sum(one.periods - 1 for one in kept)),
    )
    unsettled = np.mean([one.remainder for one in kept], axis=0)
    counts = counts_of(rec, names)
    samples = rec.rate / (frequency[1] - frequency[0]) if frequency.size > 1 else rec.rate / frequency[0]
    # Rounding to counts resembles noise of 1/12 count², of which 95 % of the amplitudes at a line are below this
    # limit. With additional noise of s counts, only a part of it is equal in every period and therefore absent from
    # the scatter.
    scatter = np.mean([one.scatter for one in kept], axis=0) / np.where(counts > 0.0, counts, 1.0) ** 2
    same = scattered(scatter)
    amplitude: Array = np.abs(centre)
    # From the amplitudes at all lines; in the worst case a resonance reduces the reading to a single tone.
    gain = np.minimum(tone_gain(in_counts(rec, names, np.sum(amplitude**2, axis=1) / 2.0)), 0.5)
    rounding = same[:, None] * (counts[:, None] / np.sqrt(samples) + gain[:, None] * amplitude)
    base = Lines(
        tuple(names), frequency, centre, noise, rec.scene.name, tuple(notes), unsettled,
        around=SIDE, turned=count, resolution=rounding,
    )  # fmt: skip
    free = any(damper.moves for damper in rec.scene.dampers)
    if count == 1:
        if free:
            base = replace(base, warnings=(*notes, ONE_REALISATION))
        return BestLinearApproximation(base, base, 1)
    rows = (stack - centre) / np.sqrt(count * (count - 1.0))
    realisations = Scatter(rows, np.full(frequency.size, 2.0 * (count - 1.0)))
    total = replace(base, scatter=realisations, noise=noise)
    if _distorted(total, base):
        total = replace(total, warnings=(*notes, NONLINEAR))
    elif free:
        total = replace(total, warnings=(*notes, _not_yet(rec, total, reference)))
    return BestLinearApproximation(total, base, count)


def _not_yet(rec: Recording, total: Lines, reference: str) -> str:
    """Report if no damper moved, and the force at which a steady tone lifts a damper (body at 1 g)."""
    least = [(np.inf, np.nan)]
    for body in {damper.body for damper in rec.scene.dampers if not damper.locked}:
        info = located(rec, f"body {body}")
        if info is not None and reference == "force":
            size = np.nan_to_num(abs(total.frf(rec, info.name, motion="acceleration").value))
            if _largest(size * _force(rec, total)) > rec.scene.gravity:
                return LIFTED
            top = int(np.argmax(size))
            least.append((rec.scene.gravity / size[top], total.frequency[top]))
    force, frequency = min(least)
    lifting = (
        "that move its body more" if np.isinf(force) else f"of more than {force:.2g} N at {frequency:.4g} Hz"
    )
    return (
        "No nonlinear distortion is detected at this level, but dampers can move: steady tones "
        f"(stepped sine) {lifting} lift one, and give another curve."
    )


def _force(rec: Recording, total: Lines) -> Array:
    """Return the amplitudes of the force, N; shape (lines,)."""
    row = reference_of(rec, "force").row(rec, total.channels, total.frequency)
    return np.asarray(abs(np.sum(row * total.mean, axis=0)))


def _largest(amplitudes: Array) -> float:
    """Estimate the peak value of a sum of tones with random phases."""
    rms = np.sqrt(np.sum(np.square(amplitudes)) / 2.0)
    return float(min(_CREST * rms, amplitudes.sum()))


@dataclass(frozen=True)
class _Realisation:
    """Averages of the periods of one realisation; without periods if too few are complete."""

    frequency: Array
    periods: int
    notes: tuple[str, ...]
    mean: ComplexArray
    noise: ComplexArray  # rows of the mean's `Scatter`; shape (periods, channels, lines)
    remainder: Array
    scatter: Array  # variance of the samples from period to period; shape (channels,)


@dataclass(frozen=True)
class PeriodSpectra:
    """Amplitudes of each clean period of a multisine."""

    frequency: Array
    spectra: ComplexArray  # shape (periods, channels, lines)
    samples: Array  # shape (periods, channels, samples)
    notes: tuple[str, ...]


def period_spectra(rec: Recording, names: Sequence[str], marker: Marker) -> PeriodSpectra:
    """Transform the periods without overload or lost samples; empty if there are fewer than two."""
    number = marker.fields["realisation"]
    size, periods = int(marker.fields["period"]), int(marker.fields["periods"])
    low, high = marker.fields["lines"]
    lines = np.arange(int(low), int(high) + 1)
    frequency = lines * rec.rate / size
    bounds = [(marker.first_sample + k * size, marker.first_sample + (k + 1) * size) for k in range(periods)]
    spoilt = [flaws(rec, names, *bound) for bound in bounds]
    clean = [
        bound for bound, found in zip(bounds, spoilt, strict=True) if not found and bound[1] <= rec.samples
    ]
    notes = []
    if marker.fields.get("settled") is False:
        notes.append(f"Realisation {number} was measured before the motion had become periodic.")
    if len(clean) < periods:
        why = describe_flaws(rec, [flaw for found in spoilt for flaw in found])
        notes.append(f"{periods - len(clean)} of {periods} periods of realisation {number} left out: {why}.")
    if len(clean) < 2:
        notes.append(f"Realisation {number} left out: fewer than two whole periods.")
        empty = np.zeros((0, len(names), 0))
        return PeriodSpectra(frequency, empty.astype(complex), empty, tuple(notes))
    whole = np.stack(list(read_slices(rec, names, clean)))
    level = _without_drift(whole, np.array([(first - marker.first_sample) // size for first, _ in clean]))
    spectra = fft.rfft(level, axis=2)[:, :, lines] * (2.0 / size)
    return PeriodSpectra(frequency, spectra, whole, tuple(notes))


def _realisation(rec: Recording, names: Sequence[str], marker: Marker, reference: str) -> _Realisation:
    """Average the clean periods of a realisation."""
    found = period_spectra(rec, names, marker)
    spectra, periods = found.spectra, len(found.spectra)
    if not periods:
        empty = np.zeros(0, dtype=complex)
        return _Realisation(found.frequency, 0, found.notes, empty, empty, empty.real, empty.real)
    mean = spectra.mean(axis=0)
    turn = np.sum(reference_of(rec, reference).row(rec, names, found.frequency) * mean, axis=0)
    turn = turn.conj() / np.maximum(abs(turn), 1e-300)
    noise = (spectra - mean) * turn / np.sqrt(periods * (periods - 1.0))
    varies = found.samples.var(axis=0, ddof=1).mean(axis=1)
    return _Realisation(found.frequency, periods, found.notes, mean * turn, noise, remainder(spectra), varies)


def _without_drift(periods: Array, numbers: NDArray[np.int64]) -> Array:
    """Subtract the linear drift of the mean from each period.

    A slowly settling bias changes each line from period to period. Noise may hide these changes although their sum is
    a significant error of the line.

    `periods` has the shape (periods, channels, samples); `numbers`, shape (periods,): numbers of these periods
    within the realisation.
    """
    slopes = np.gradient(periods.mean(axis=2), numbers, axis=0, edge_order=2 if len(numbers) > 2 else 1)
    return np.asarray(periods - slopes[:, :, None] * np.linspace(-0.5, 0.5, periods.shape[2]))


def _distorted(total: Lines, noise: Lines) -> bool:
    """Whether realisations scatter more than noise, residual transients and rounding to counts explain."""
    seen, expected = (np.linalg.norm(lines.scatter.rows, axis=0) for lines in (total, noise))
    others = [part for part in (total.remainder, total.resolution) if part is not None]
    beyond = (seen > _BEYOND * expected + np.sum(others, axis=0)) & (seen > _SEEN * abs(total.mean))
    return bool(np.max(beyond.mean(axis=1)) > _SHARE)
