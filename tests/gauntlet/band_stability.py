"""Modes of random curves with rubbish at both ends, in bands that differ: ``python -m tests.gauntlet.band_stability``.

Each set of curves is that of a free structure; its lines far below and far above the modes contain noise only. Modes
are identified in a band, with either limit changed by 20 %, from every second line, and from all lines. Printed are the
modes that another result does not even list as uncertain, those that differ by more than their expanded uncertainties,
and clear peaks that are not confirmed as modes. Exit code 1: too many differ, or a clear peak is not confirmed.
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

import analysis
from analysis.core.modal.modes import Modes, UncertainMode
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError
from rig.core.results.response import Response
from rig.core.results.uncertainty import expand

# Fraction of the comparisons that must agree.
MIN_AGREEMENT = 0.95
# Modes closer to a limit of the band than this fraction of their frequency are not compared.
_MARGIN = 0.03
# A clear peak rises above the valleys on both sides by at least this ratio, 10 dB, and this number of lines exceed half
# of its power.
_MIN_PROMINENCE = 10.0**0.5
_MIN_PEAK_LINES = 3


@dataclass(frozen=True)
class RandomCurves:
    """Curves of a free structure, and its modes."""

    curves: list[Response]
    frequency: Array  # Hz, natural frequencies
    damping: Array  # damping ratios

    @property
    def band(self) -> tuple[float, float]:
        """Return the limits of a band around the modes, Hz."""
        return 0.6 * float(self.frequency[0]), 1.35 * float(self.frequency[-1])


def draw_curves(seed: int, number: int) -> RandomCurves:
    """Draw accelerances of two to five modes from 100 Hz on, as a text file gives them: without uncertainties."""
    random = np.random.default_rng([seed, number])
    n_modes, n_curves = int(random.integers(2, 6)), int(random.integers(1, 4))
    first = float(np.exp(random.uniform(np.log(100.0), np.log(1000.0))))
    natural = first * np.cumprod(np.append(1.0, random.uniform(1.15, 1.7, n_modes - 1)))
    damping = np.exp(random.uniform(np.log(0.002), np.log(0.04), n_modes))
    spacing = float(np.min(damping * natural)) / random.uniform(1.5, 5.0)
    frequency = np.arange(spacing, 2.0 * natural[-1], spacing)
    s, omega = 2j * np.pi * frequency, 2 * np.pi * natural[:, None]
    shapes = random.uniform(0.3, 1.0, (n_curves, n_modes)) * random.choice([-1.0, 1.0], (n_curves, n_modes))
    receptance = shapes @ (1.0 / (s**2 + 2.0 * damping[:, None] * omega * s + omega**2))
    # Motion of the rigid body, and a mode above the lines.
    receptance += random.uniform(0.5, 2.0, (n_curves, 1)) / s**2
    receptance += random.uniform(0.5, 2.0, (n_curves, 1)) / (3.0 * omega[-1]) ** 2
    # An echo of the force, as of a double hit or a late reflection, that the measured force does not contain.
    delay = 1.0 / (random.uniform(5.0, 50.0) * float(np.min(damping * natural)))
    value = receptance * s**2 * (1.0 + 10.0 ** random.uniform(-3.5, -1.5) * np.exp(-s * delay))
    typical = np.median(abs(value))
    noise = random.standard_normal(value.shape) + 1j * random.standard_normal(value.shape)
    is_rubbish = (frequency < 0.1 * natural[0]) | (frequency > 1.6 * natural[-1])
    size = np.where(is_rubbish, random.uniform(1.0, 10.0), 10.0 ** random.uniform(-3.0, -1.5))
    value += typical * size * noise
    curves = [
        Response.curve(frequency, row, f"a{k}", motion="acceleration", resolution=1.5 * spacing)
        for k, row in enumerate(value, 1)
    ]
    return RandomCurves(curves, natural, damping)


def changed_bands(low: float, high: float) -> Iterator[tuple[str, float, float, int]]:
    """Yield the name of each change, the limits of its band, Hz, and the distance of its lines."""
    yield "low limit 20 % higher", 1.2 * low, high, 1
    yield "low limit 20 % lower", 0.8 * low, high, 1
    yield "high limit 20 % lower", low, 0.8 * high, 1
    yield "high limit 20 % higher", low, 1.2 * high, 1
    yield "every second line", low, high, 2
    yield "all lines", 0.0, np.inf, 1


def select(curves: list[Response], low: float, high: float, step: int = 1) -> list[Response]:
    """Select every first, second, ... line of a band."""
    frequency = curves[0].frequency
    lines = np.flatnonzero((frequency >= low) & (frequency <= high))[::step]
    return [curve.at(lines) for curve in curves]


def compare(drawn: RandomCurves) -> list[tuple[str, list[str], list[str]]]:
    """Identify modes in changed bands; return each change, its differences, and the clear peaks without a mode."""
    low, high = drawn.band
    lines = select(drawn.curves, low, high)
    reference = analysis.identify(lines)
    spacing = float(np.diff(lines[0].frequency[:2])[0])
    results, peaks = [], unconfirmed_peaks(reference, drawn, lines)
    for name, first, last, step in changed_bands(low, high):
        lines = select(drawn.curves, first, last, step)
        try:
            modes = analysis.identify(lines)
        except RecordingError:
            # A part of the band may contain no mode.
            modes = replace(reference, frequency=np.zeros(0), uncertain=())
        limits = max(low, first), min(high, last)
        texts = differences(reference, modes, *limits, step * spacing)
        results.append((name, texts, unconfirmed_peaks(modes, drawn, lines)))
    results.append(("modes of the structure", false_modes(modes, drawn), peaks))
    return results


def unconfirmed_peaks(modes: Modes, drawn: RandomCurves, curves: list[Response]) -> list[str]:
    """Describe the modes of a structure with a clear peak in a curve that are not among the identified modes."""
    texts = []
    for natural, damping in zip(drawn.frequency, drawn.damping, strict=True):
        half_width = damping * natural
        if any(is_clear_peak(curve, natural, half_width) for curve in curves) and not np.any(
            abs(modes.frequency - natural) < half_width
        ):
            texts.append(f"{natural:.5g} Hz is a clear peak")
    return texts


def is_clear_peak(curve: Response, natural: float, half_width: float) -> bool:
    """Return whether a curve has a clear peak within a half-width of a natural frequency, Hz."""
    magnitude, frequency = abs(curve.value), curve.frequency
    near = np.flatnonzero(abs(frequency - natural) < half_width)
    if not near.size or not (1.0 + _MARGIN) * frequency[0] < natural < (1.0 - _MARGIN) * frequency[-1]:
        return False
    peak = near[np.argmax(magnitude[near])]
    rises = []
    for step in (-1, 1):
        flank = magnitude[peak::step]
        higher = np.flatnonzero(flank > flank[0])
        rises.append(flank[0] / flank[: higher[0] if higher.size else None].min())
    around = magnitude[max(peak - _MIN_PEAK_LINES + 1, 0) : peak + _MIN_PEAK_LINES]
    return bool(min(rises) >= _MIN_PROMINENCE and (around > magnitude[peak] * 0.5**0.5).sum() >= _MIN_PEAK_LINES)


def differences(first: Modes, second: Modes, low: float, high: float, spacing: float) -> list[str]:
    """Describe the modes between two limits, Hz, that one result lacks or that differ beyond their uncertainties.

    A mode of one result may be an uncertain mode of the other. `spacing`: largest distance of the lines, Hz.
    """
    texts = []
    for modes, others, change in ((first, second, "missing"), (second, first, "added")):
        candidates = [*_rows(others), *others.uncertain]
        for mode in _rows(modes):
            if not (1.0 + _MARGIN) * low < mode.frequency < (1.0 - _MARGIN) * high:
                continue
            other = min(candidates, key=lambda each: abs(each.frequency - mode.frequency), default=None)
            errors = 0.0 if other is None else expand(mode.frequency_std + other.frequency_std)
            distance = max(mode.damping * mode.frequency, errors, spacing)
            if other is None or abs(other.frequency - mode.frequency) > distance:
                texts.append(f"{mode.frequency:.5g} Hz is {change}")
                continue
            if modes is second and not other.reason:
                continue  # compared already
            for name in ("frequency", "damping"):
                expanded = expand(max(getattr(each, f"{name}_std") for each in (mode, other)))
                if (ratio := abs(getattr(mode, name) - getattr(other, name)) / expanded) > 1.0:
                    texts.append(f"{mode.frequency:.5g} Hz: {name} differs by {ratio:.1f} expanded uncertainties")
    return texts


def _rows(modes: Modes) -> list[UncertainMode]:
    """Return the modes as rows without a reason."""
    columns = modes.frequency, modes.frequency_std, modes.damping, modes.damping_std
    return [UncertainMode(*row, "") for row in zip(*(column.tolist() for column in columns), strict=False)]


def false_modes(modes: Modes, drawn: RandomCurves) -> list[str]:
    """Describe the modes of a structure that are not even uncertain, and the identified modes that it does not have."""
    listed = np.append(modes.frequency, [each.frequency for each in modes.uncertain])
    is_same = abs(listed[:, None] - drawn.frequency) < drawn.damping * drawn.frequency
    return [
        *(f"{f:.5g} Hz is missing" for f in drawn.frequency[~is_same.any(axis=0)]),
        *(f"{f:.5g} Hz is spurious" for f in modes.frequency[~is_same[: modes.frequency.size].any(axis=1)]),
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=40, help="how many sets of curves (default: 40)")
    parser.add_argument("--first", type=int, default=0, help="number of the first set (default: 0)")
    parser.add_argument("--seed", type=int, default=1, help="another seed draws other curves")
    options = parser.parse_args()
    agreeing = total = n_unconfirmed = 0
    for number in range(options.first, options.first + options.sets):
        for name, texts, peaks in compare(draw_curves(options.seed, number)):
            total, agreeing, n_unconfirmed = total + 1, agreeing + (not texts), n_unconfirmed + len(peaks)
            if texts or peaks:
                print(f"{number} {name}: {'; '.join(texts + peaks)}")
    print(f"{agreeing} of {total} agree; {n_unconfirmed} clear peaks are not confirmed as modes")
    return int(agreeing < MIN_AGREEMENT * total or n_unconfirmed > 0)


if __name__ == "__main__":
    sys.exit(main())
