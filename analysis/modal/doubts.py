"""What a reader of identified modes must know, in a sentence for each kind of doubt."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.modal.modes import DETERMINED, Modes
from analysis.modal.pole_errors import SMEAR
from analysis.responses.frf import Frf

Array = NDArray[np.float64]

# A damping ratio with a larger relative uncertainty is reported.
_OFF = 0.02
# Resolution over half the half-power width from which on leakage does that.
_SMEARED = float(np.sqrt(_OFF / SMEAR))


def doubts(
    modes: Modes,
    curves: Sequence[Frf],
    count: int | None,
    dropped: Sequence[float],
    loose: Array,
    unseen: Array,
    left_out: Sequence[str],
) -> Iterator[str]:
    """Describe what limits some modes.

    Parameters
    ----------
    curves : sequence of Frf
        What they were identified from.
    count : int or None
        Modes asked for.
    dropped : sequence of float
        Hz: poles left out, as their damping or their height is undetermined.
    loose : ndarray
        Hz: poles left out, as next to nothing bounds the curves there.
    unseen : ndarray
        Hz: poles left out, as no line was measured around them.
    left_out : sequence of str
        Responses left out.
    """
    yield from (f"{name} left out: nothing bounds its response." for name in left_out)
    if modes.model_error:
        stated = any(np.isfinite(curve.error).any() for curve in curves)
        beyond = "error bars" if stated else "scatter, by leakage and noise or by nature"
        yield (
            f"The curves are not those of a linear structure: the best one misses them by {modes.model_error:.2g} "
            f"of the peaks around, beyond their {beyond}. Where dampers work, or anything else that depends on "
            "amplitude, these modes are those of the linear structure that comes nearest at this level, with the "
            "width of its peaks as damping; at another level they are others. The stated errors hold for that fit."
        )
    if dropped:
        yield (
            f"Rejected the stable poles at {_listed(np.sort(dropped))} Hz: their damping or height is below the "
            "uncertainty of these curves. Impacts of dampers make peaks without poles."
        )
    if loose.size:
        yield (
            f"No mode at {_listed(loose)} Hz, where a pole was stable: next to nothing bounds the curves there."
        )
    if unseen.size:
        yield (
            f"No mode at {_listed(unseen)} Hz, where a pole was stable: the lines around it were left out, and what is "
            "there may as well be several."
        )
    f, zeta, error = modes.frequency, modes.damping, modes.damping_error
    if count is not None and f.size < count:
        yield f"Only {f.size} of {count} modes are in these curves."
    half, lines = zeta * f, curves[0].frequency
    resolution = max(curve.resolution for curve in curves)
    smeared, hidden = resolution > _SMEARED * half, (error > DETERMINED * zeta) & (resolution > 2.0 * half)
    if hidden.any():
        yield (
            f"{_listed(f[hidden])} Hz: narrower than the resolution of {resolution:.3g} Hz, so that the frequency is "
            "known to a line, and of the damping ratio an upper limit; use blocks many times as long, or burst "
            "random, multisine or stepped sine."
        )
    some = smeared & ~hidden
    if some.any():
        yield (
            f"{_listed(f[some])} Hz: the resolution of {resolution:.3g} Hz smears half-power widths of "
            f"{_listed(2.0 * half[some], 3)} Hz, so that more than {_OFF:.0%} of each damping ratio may be due to "
            f"that; use blocks of at least {1.5 / (_SMEARED * half[some].min()):.3g} s, or burst random, multisine "
            "or stepped sine."
        )
    inside = np.sum(abs(lines - f[:, None]) < 2.0 * half[:, None], axis=1)
    few = (inside < 2) & ~smeared
    if few.any():
        yield (
            f"{_listed(f[few])} Hz: fewer than two measured points lie within a half-power width of "
            f"{_listed(2.0 * half[few], 3)} Hz, so that damping ratios rest on the flanks; measure every "
            f"{half[few].min() / 2.0:.2g} Hz there."
        )
    unsure = (error > _OFF * zeta) & (error <= DETERMINED * zeta)
    if unsure.any():
        parts = ", ".join(f"{part:.0%}" for part in error[unsure] / zeta[unsure])
        yield f"{_listed(f[unsure])} Hz: damping ratios uncertain by {parts} (one standard deviation)."


def _listed(values: Array, digits: int = 4) -> str:
    return ", ".join(f"{value:.{digits}g}" for value in values)
