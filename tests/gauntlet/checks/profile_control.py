"""Check of tests with profile control: the control lies within the promised deviation, limits are kept within 1 dB."""

import numpy as np

import analysis
from tests.gauntlet.profile_control import NOISE, SINE
from tests.gauntlet.result import Case, CheckResult

# Fraction of the frequencies within the tolerance of the test.
_MIN_WITHIN = {SINE: 1.0, NOISE: 0.95}
# Largest excess over a limit, dB.
_MAX_EXCESS_DB = 1.0


def check(case: Case, kind: str) -> list[CheckResult]:
    """Compare the motion of the control and of the limited channels with profile and limits."""
    if kind not in _MIN_WITHIN:
        return []
    result = analysis.profile(case.recording)
    within = (abs(result.deviation) <= result.tolerance) | result.is_reduced
    excess = [result.excess(level) for level in result.limited]
    highest = max((float(np.nanmax(value)) for value in excess), default=-np.inf)
    is_kept = within.mean() >= _MIN_WITHIN[kind] and highest <= _MAX_EXCESS_DB
    is_announced = any("exceeds the tolerance" in text for text in case.warnings)
    outcome = "correct" if is_kept else "warned" if is_announced else "wrong"
    worst = int(np.argmax(np.where(result.is_reduced, 0.0, abs(result.deviation))))
    note = f"{result.deviation[worst]:+.2f} dB at {result.frequency[worst]:.4g} Hz, limit {highest:+.2f} dB"
    return [CheckResult("profile", kind, outcome, note=note)]
