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

if TYPE_CHECKING:
    from daq.recording.markers import Marker
    from daq.recording.recording import Recording


NONLINEAR = (
    "The structure is nonlinear: the curve is the best linear approximation for this level and kind of excitation, and "
    "its error bars are valid only for them. Use stepped sine for the response to steady tones."
)
ONE_REALISATION = (
    "One realisation: the distortion by dampers cannot be separated from the response, and the error bars exclude it. "
    "Measure several (test: realisations)."
)
LIFTED = (
    "Dampers may leave the floor at this level, although the realisations scatter no more than noise: the error bars "
    "exclude distortion that is equal in every realisation. Use stepped sine for the response to steady tones."
)
# Assumed crest factor of a sum of tones, limited by the sum of their amplitudes.
_CREST = 4.0
# Distortion is detected if at least this share of the lines scatters by more than these multiples of the noise and of
# the mean.
_DISTORTED_LINES_SHARE = 0.2
_DISTORTION_TO_NOISE = 3.0
_DISTORTION_TO_MEAN = 2e-3


def best_linear_approximation(
    rec: Recording,
    markers: Sequence[Marker],
    names: Sequence[str],
    reference: str = "force",
    progress: Callable[[int, int], None] | None = None,
) -> Lines:
    """Average over periods, then over realisations (one marker each), each rotated by the phase of its own reference.

    The scatter contains noise and nonlinear distortion, which is the scatter of the realisations beyond the noise
    between periods (R. Pintelon, J. Schoukens, System Identification, 2nd ed., Wiley 2012, section 4.3).
    """
    found = [period_spectra(rec, names, marker) for marker in markers]
    if progress is not None:
        progress(len(markers), len(markers))
    notes = [note for each in found for note in each.notes]
    whole = [each for each in found if len(each.spectra)]
    if not whole:
        raise RecordingError(
            f"{rec.path}: no realisation of the multisine has two whole periods. {' '.join(notes)}"
        )
    count, frequency = len(whole), whole[0].frequency
    row = reference_of(rec, reference).row(rec, names, frequency)
    means, noises = [], []
    for each in whole:
        mean, periods = each.spectra.mean(axis=0), len(each.spectra)
        turn = np.sum(row * mean, axis=0)
        turn = turn.conj() / np.maximum(abs(turn), 1e-300)
        means.append(mean * turn)
        noises.append((each.spectra - mean) * turn / np.sqrt(periods * (periods - 1.0)))
    stack = np.stack(means)
    centre = stack.mean(axis=0)
    noise = Scatter(
        np.asarray(np.concatenate(noises) / count, dtype=complex),
        np.full(frequency.size, 2.0 * sum(len(each.spectra) - 1 for each in whole)),
    )
    unsettled = np.mean([remainder(each.spectra) for each in whole], axis=0)
    counts = counts_of(rec, names)
    samples = rec.rate / (frequency[1] - frequency[0]) if frequency.size > 1 else rec.rate / frequency[0]
    # Rounding to counts resembles noise of 1/12 count², of which 95 % of the amplitudes at a line are below this
    # limit. With additional noise of s counts, only a part of it is equal in every period and therefore absent from
    # the scatter.
    varies = np.mean([each.samples.var(axis=0, ddof=1).mean(axis=1) for each in whole], axis=0)
    same = scattered(varies / np.where(counts > 0.0, counts, 1.0) ** 2)
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
        return replace(base, warnings=(*notes, ONE_REALISATION)) if free else base
    rows = (stack - centre) / np.sqrt(count * (count - 1.0))
    realisations = Scatter(rows, np.full(frequency.size, 2.0 * (count - 1.0)))
    total = replace(base, scatter=realisations, noise=noise)
    if _distorted(total, base):
        return replace(total, warnings=(*notes, NONLINEAR))
    return replace(total, warnings=(*notes, _not_yet(rec, total, reference))) if free else total


def _not_yet(rec: Recording, total: Lines, reference: str) -> str:
    """Report if no damper moved, and the force at which a steady tone lifts a damper (body at 1 g)."""
    least = [(np.inf, np.nan)]
    row = (
        reference_of(rec, "force").row(rec, total.channels, total.frequency) if reference == "force" else 0.0
    )
    force: Array = np.asarray(abs(np.sum(row * total.mean, axis=0)))
    for body in {damper.body for damper in rec.scene.dampers if not damper.locked}:
        info = located(rec, f"body {body}")
        if info is not None and reference == "force":
            size = np.nan_to_num(abs(total.frf(rec, info.name, motion="acceleration").value))
            amplitudes = size * force
            # Peak value of a sum of tones with random phases.
            largest = min(_CREST * np.sqrt(np.sum(np.square(amplitudes)) / 2.0), amplitudes.sum())
            if largest > rec.scene.gravity:
                return LIFTED
            top = int(np.argmax(size))
            least.append((rec.scene.gravity / size[top], total.frequency[top]))
    least_force, frequency = min(least)
    lifting = f"of more than {least_force:.2g} N at {frequency:.4g} Hz"
    if np.isinf(least_force):
        lifting = "that move its body more"
    return (
        f"No nonlinear distortion is detected at this level, but dampers can move: steady tones {lifting} lift one. "
        "Use stepped sine for the response to such tones."
    )


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
        notes.append(f"Realisation {number} was measured before steady state. Increase test: settle.")
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


def _without_drift(periods: Array, numbers: NDArray[np.int64]) -> Array:
    """Subtract the linear drift of the mean from each period; shape (periods, channels, samples).

    A slowly settling bias changes each line from period to period. Noise may hide these changes although their sum is
    a significant error of the line. `numbers`: of the periods within the realisation.
    """
    slopes = np.gradient(periods.mean(axis=2), numbers, axis=0, edge_order=2 if len(numbers) > 2 else 1)
    return np.asarray(periods - slopes[:, :, None] * np.linspace(-0.5, 0.5, periods.shape[2]))


def _distorted(total: Lines, noise: Lines) -> bool:
    """Whether realisations scatter more than noise, residual transients and rounding to counts explain."""
    seen, expected = (np.linalg.norm(lines.scatter.rows, axis=0) for lines in (total, noise))
    others = [part for part in (total.remainder, total.resolution) if part is not None]
    distorted = seen > _DISTORTION_TO_NOISE * expected + np.sum(others, axis=0)
    distorted &= seen > _DISTORTION_TO_MEAN * abs(total.mean)
    return bool(np.max(distorted.mean(axis=1)) > _DISTORTED_LINES_SHARE)
