"""Checks of response curves: power flow at the driving point, delays of channels, and jumps between branches.

A passive structure absorbs power from the driving force, so the real part of the driving-point mobility is positive at
every frequency; see `daq.core.signal_chain.driving_power`. A curve jumps where the motion of dampers changes to another
stable branch.
"""

from collections.abc import Sequence

import numpy as np

from daq.core.signal_chain.driving_power import returns_energy
from rig.core.results import format_number
from rig.core.results.response import Response

# The power is evaluated at points whose relative expanded uncertainty is at most this.
_MAX_UNCERTAINTY = 0.3
# A step between two points is a jump if the magnitude of the change of the complex logarithm (nepers, radians) exceeds
# this value and the two following limits.
_MIN_STEP = 0.25
# A jump exceeds the larger of the steps on either side, scaled to the same frequency spacing, by this factor.
_MIN_RATIO_TO_NEIGHBORS = 4.0
# A jump exceeds this number of standard uncertainties of the step.
_MIN_SIGMAS = 5.0
# A step at a point is not a jump, but noise, if the expanded random uncertainty of the point exceeds this fraction of
# its value.
_MAX_NOISE_RATIO = 0.5

# Smallest number of points from which a delay is estimated.
_MIN_DELAY_LINES = 20
# Largest trial delay, in periods of a frequency equal to the width of the band.
_MAX_PERIODS = 1.0
# Number of trial delays.
_TRIAL_DELAYS = 801
# Number of lines whose phases are computed at a time for all trial values.
_MAX_LINES = 4096
# The misalignment of doubled phases is 0 if all phases are 0 or 180 degrees. A delay is estimated only if its
# correction leaves at most this misalignment.
_MAX_MISALIGNMENT = 0.25
# The delay is significant if its correction reduces the misalignment by more than this factor.
_MIN_IMPROVEMENT = 4.0
# A smaller remaining misalignment counts as this misalignment.
_MIN_MISALIGNMENT = 0.03
# Near its resonance, a damped mode may cause phases in proportion to frequency within this range, degrees. A delay with
# phases in this range is significant only if its correction leaves at most `_MIN_MISALIGNMENT`, ...
_MAX_MODE_PHASE = 190.0
# ... in a band whose limits have at least this ratio.
_MIN_BAND_RATIO = 1.3
# A line is evaluated if its receptance exceeds this fraction of the largest. Where it is smaller, as far above the
# resonances, damping forces determine the phase, which may rise or fall over a wide band.
_MIN_RECEPTANCE_RATIO = 1e-4
# One response is late if the delays of the other responses are below this fraction of its delay.
_MAX_OTHER_DELAY = 0.2


def reversed_force(curves: Sequence[Response]) -> str:
    """Return a warning if the structure seems to supply power at the driving point, due to a reversed sign.

    `curves`: responses to one force, measured together; only those at the driving point are evaluated. Without a
    reversed sign, the warning is empty.
    """
    reversed_curves = [curve for curve in curves if curve.is_driving_point and supplies_power(curve)]
    if not reversed_curves:
        return ""
    names = ", ".join(dict.fromkeys(curve.ratio for curve in reversed_curves))
    return (
        f"{names}: the phase at the driving point indicates a reversed channel, because the structure would supply "
        "energy (at resonances, the phase of the compliance is +90° instead of -90°). In the table of `daq import`, "
        "give sign: -1 for the force, or for this response if only this response is wrong; or turn the sensor around."
    )


def supplies_power(curve: Response) -> bool:
    """Return whether the structure seems to supply power to the force at the resonances of a driving-point response."""
    mobility = curve.to("velocity").sorted()
    magnitude = abs(mobility.value)
    is_precise = np.nan_to_num(mobility.bound()) < _MAX_UNCERTAINTY * magnitude
    valid = np.isfinite(magnitude) & (magnitude > 0.0) & is_precise
    log_frequency = np.log(mobility.frequency[valid])
    # Each point represents a range of the logarithmic frequency axis.
    has_several = log_frequency.size > 1 and np.ptp(log_frequency) > 0.0
    width = np.gradient(log_frequency) if has_several else np.ones(log_frequency.size)
    return returns_energy(mobility.value[valid] * width)


def delayed_channels(curves: Sequence[Response]) -> str:
    """Return a warning if one response is late or early compared with the others; "" otherwise.

    Away from resonances, the phase of a compliance is near 0 or 180 degrees; a delay adds a phase proportional to
    frequency. `curves`: responses to one reference, measured together. If all responses are late by the same time, the
    reference is early.
    """
    estimates = [_estimate_delay(curve) for curve in curves]
    known = [(curve, *estimate) for curve, estimate in zip(curves, estimates, strict=True) if estimate is not None]
    delayed = [(curve, delay) for curve, delay, is_delayed in known if is_delayed]
    if not delayed:
        return ""
    (first, *_), source = delayed, curves[0].inputs[0].name
    # A single force has no name of its own.
    article = "the " if source == curves[0].reference else ""
    others = [abs(delay) for _, delay, is_delayed in known if not is_delayed]
    times = np.array([delay for _, delay in delayed])
    if len(delayed) == 1 and max(others, default=0.0) < _MAX_OTHER_DELAY * abs(times[0]):
        time = f"{format_number(float(f'{1e3 * abs(times[0]):.2g}'))} ms"
        late, early = ("late", "early") if times[0] > 0.0 else ("early", "late")
        text = f"{first[0].response} seems to be {time} {late}" + ("" if others else f", or {article}{source} {early}")
    elif not others and np.ptp(times) < _MAX_OTHER_DELAY * abs(times.mean()):
        time = f"{format_number(float(f'{1e3 * abs(times.mean()):.2g}'))} ms"
        text = f"{article.capitalize()}{source} seems to be {time} {'early' if times[0] > 0.0 else 'late'}"
    else:
        return ""
    return (
        f"{text}: phases increase in proportion to frequency. Check cable, filter and time base of this channel, and "
        "give its delay in the table of `daq import`."
    )


def _estimate_delay(curve: Response) -> tuple[float, bool] | None:
    """Return the delay of a response in s, and whether it is significant; None if the phases determine no delay."""
    receptance = curve.to("displacement").sorted()
    magnitude = abs(receptance.value)
    valid = np.isfinite(magnitude) & (magnitude > 0.0)
    valid &= np.nan_to_num(receptance.bound(), nan=np.inf) < _MAX_UNCERTAINTY * magnitude
    valid &= magnitude > _MIN_RECEPTANCE_RATIO * magnitude[valid].max(initial=0.0)
    if valid.sum() < _MIN_DELAY_LINES:
        return None
    frequency, direction = receptance.frequency[valid], (receptance.value[valid] / magnitude[valid]) ** 2
    phase_range = np.ptp(np.degrees(np.unwrap(np.angle(receptance.value[valid]))))
    # Points are weighted, because they may be close together at resonances, where phases are not 0 or 180 degrees.
    direction *= np.gradient(frequency) / np.gradient(frequency).sum()
    delays = np.linspace(-1.0, 1.0, _TRIAL_DELAYS) * _MAX_PERIODS / np.ptp(frequency)
    alignment = np.zeros(delays.size)
    for first in range(0, frequency.size, _MAX_LINES):
        lines = slice(first, first + _MAX_LINES)
        alignment += (np.exp(4j * np.pi * np.outer(delays, frequency[lines])) @ direction[lines]).real
    best, misaligned = int(np.argmax(alignment)), 1.0 - float(direction.real.sum())
    if 1.0 - alignment[best] > _MAX_MISALIGNMENT:
        return None
    is_delayed = misaligned > _MIN_IMPROVEMENT * max(1.0 - alignment[best], _MIN_MISALIGNMENT)
    is_narrow = frequency[-1] < _MIN_BAND_RATIO * frequency[0]
    if is_delayed and phase_range < _MAX_MODE_PHASE and (is_narrow or 1.0 - alignment[best] > _MIN_MISALIGNMENT):
        return None
    return float(delays[best]), is_delayed


def find_jumps(frf: Response) -> list[tuple[float, str]]:
    """Locate the frequencies at which a curve jumps from one branch to another.

    `frf`: points in the order of measurement. Returns for each jump the mean frequency of the two points, Hz, and
    ``"jump up"`` or ``"jump down"`` in the order of measurement.

    >>> f = np.linspace(10.0, 20.0, 11)
    >>> value = np.where(f < 14.5, 1.0 + 0.02 * f, 0.5 + 0.02 * f).astype(complex)
    >>> error = np.full(11, 1e-6)
    >>> find_jumps(Response.curve(f, value, "body3", error=error, degrees_of_freedom=error + 38))
    [(14.5, 'jump down')]
    """
    if frf.frequency.size < 4:
        return []
    log_steps = np.log(frf.value[1:] / frf.value[:-1])
    step, spacing = abs(log_steps), np.maximum(abs(np.diff(frf.frequency)), 1e-12)
    # Steps expected over the same spacing, from the slopes on either side.
    slope = step / spacing
    before, after = np.append(0.0, slope[:-1]) * spacing, np.append(slope[1:], 0.0) * spacing
    # Without a stated uncertainty, a step cannot be distinguished from noise.
    relative = np.nan_to_num(frf.error / abs(frf.value), nan=np.inf)
    noise = np.hypot(relative[1:], relative[:-1])
    is_noise = ~(frf.random_bound() <= _MAX_NOISE_RATIO * abs(frf.value))
    is_jump = ~(is_noise[1:] | is_noise[:-1]) & (
        (step > _MIN_STEP) & (step > _MIN_RATIO_TO_NEIGHBORS * np.maximum(before, after)) & (step > _MIN_SIGMAS * noise)
    )
    return [
        (float(0.5 * (frf.frequency[i] + frf.frequency[i + 1])), "jump up" if log_steps[i].real > 0 else "jump down")
        for i in np.flatnonzero(is_jump)
    ]
