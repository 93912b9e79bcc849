"""Check of modes: natural frequencies and damping ratios, compared with the structure within their stated errors.

Both modes of a close pair must be identified. Of other structures a mode may be missing, because noise may hide it.
"""

import numpy as np
from scipy import linalg

import analysis
import rig
from analysis.core.modal.modes import Modes
from rig.core.base.arrays import Array
from rig.core.results.response import Response
from rig.core.results.uncertainty import COVERAGE_FACTOR
from rig.core.system.structural_model import structure_matrices
from tests.gauntlet.close_modes import CURVES, MULTISINE, STEPPED, TWO_SHAKERS
from tests.gauntlet.result import Case, CheckResult, Outcome

# An error is plausible up to this number of standard uncertainties.
MAX_ERROR_SIGMAS = 4.5
# Warning that the points are too far apart to determine the modes.
_EXTRAPOLATED = "the damping is extrapolated from the flanks"
# Relative rounding error.
_ROUNDING = 1e-9
_CLOSE_MODES = (CURVES, MULTISINE, STEPPED, TWO_SHAKERS)


def check(case: Case, kind: str) -> list[CheckResult]:
    """Identify the modes of a linear structure from all curves of the first level."""
    if case.scene.dampers or not case.recording.test.drives:
        return []
    results = [
        compare_modes(case.scene, curves, kind)
        for curves in analysis.frequency_responses(case.recording)
        if curves[0].frequency.size > 2
    ]
    return results[:1]


def compare_modes(scene: rig.Scene, curves: list[Response], kind: str) -> CheckResult:
    """Compare the modes identified from curves with the structure; points are frequencies and damping ratios."""
    modes = analysis.identify(curves)
    true_frequency, true_ratio = true_modes(scene)
    matched, spurious = _match(modes, true_frequency, true_ratio)
    # Errors of frequency and damping ratio, in standard uncertainties.
    error = np.array(
        [
            [
                abs(modes.frequency[i] - true_frequency[j]) / (modes.frequency_std[i] + _ROUNDING * true_frequency[j]),
                abs(modes.damping[i] - true_ratio[j]) / (modes.damping_std[i] + _ROUNDING),
            ]
            for i, j in matched
        ]
    ).reshape(-1, 2)
    is_separated = kind not in _CLOSE_MODES or {0, 1} <= {j for _, j in matched}
    outcome: Outcome = "correct"
    if modes.model_error:
        outcome = "warned"
    elif spurious or not is_separated or np.any(error > MAX_ERROR_SIGMAS):
        outcome = "warned" if any(_EXTRAPOLATED in text for text in modes.warnings) else "wrong"
    counted = outcome != "warned"
    worst = error.max(initial=0.0)
    note = f"{len(matched)} of {true_frequency.size} modes identified, largest error {worst:.2f} standard uncertainties"
    note += "".join(f", {modes.frequency[i]:.5g} Hz is spurious" for i in spurious)
    note += "" if is_separated else f", the pair at {true_frequency[0]:.5g} Hz is not separated"
    relative_bound = float(np.median(COVERAGE_FACTOR * modes.damping_std / modes.damping))
    return CheckResult(
        "modes", kind, outcome, int(np.sum(error < COVERAGE_FACTOR)) if counted else 0, error.size if counted else 0,
        relative_bound, note, scene.name,
    )  # fmt: skip


def true_modes(scene: rig.Scene) -> tuple[Array, Array]:
    """Return natural frequencies [Hz] and damping ratios; the frequencies are read with the error of the clock."""
    mass, damping, stiffness = structure_matrices(scene.structure)
    bodies = len(mass)
    state_matrix = np.block(
        [[np.zeros((bodies, bodies)), np.eye(bodies)], [-linalg.solve(mass, np.hstack([stiffness, damping]))]]
    )
    poles = np.linalg.eigvals(state_matrix)
    poles = poles[poles.imag > 0.0]
    poles = poles[np.argsort(abs(poles))]
    clock = 1.0 + (scene.converter.clock_error or 0.0)
    return abs(poles) / (2.0 * np.pi * clock), -poles.real / abs(poles)


def _match(modes: Modes, frequency: Array, ratio: Array) -> tuple[list[tuple[int, int]], list[int]]:
    """Return pairs of indices of identified and true modes, nearest first, and the indices of spurious modes."""
    distance = abs(modes.frequency[:, None] - frequency)
    is_close = distance < np.maximum(5.0 * modes.frequency_std[:, None], ratio * frequency)
    matched: list[tuple[int, int]] = []
    for flat_index in np.argsort(distance, axis=None):
        i, j = divmod(int(flat_index), frequency.size)
        if is_close[i, j] and all(i != a and j != b for a, b in matched):
            matched.append((i, j))
    matched_modes = {i for i, _ in matched}
    return matched, [i for i in range(modes.frequency.size) if i not in matched_modes]
