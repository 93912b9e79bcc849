"""Check of restitution: the coefficient of restitution estimated from velocity jumps, compared with the scene."""

from analysis.core.damper_motion.free_flight import BodyMotion, restitution
from tests.gauntlet.instant_contact import TONE
from tests.gauntlet.result import Case, CheckResult

# Coverage factor of the 95 % interval.
COVERAGE_FACTOR = 2.0
# An error is plausible up to this number of standard uncertainties.
MAX_ERROR_SIGMAS = 4.0


def check(case: Case, kind: str) -> list[CheckResult]:
    """Compare the estimate for each damper with the scene."""
    if kind != TONE:
        return []
    recording, results = case.recording, []
    [window] = [marker for marker in recording.markers if marker.kind == "measure"]
    for damper in case.scene.dampers:
        motion = BodyMotion(recording, f"a{damper.body}", window.first_sample, window.stop)
        estimate = restitution(motion, damper)
        if estimate is None:
            results.append(CheckResult("restitution", kind, "undetermined", note="not determined"))
            continue
        error = abs(estimate.value - damper.restitution) / estimate.error
        note = (
            f"a{damper.body}: {estimate.value:.3f}, standard uncertainty {estimate.error:.3f}, "
            f"true {damper.restitution:.3f}"
        )
        results.append(
            CheckResult(
                "restitution",
                kind,
                "correct" if error < MAX_ERROR_SIGMAS else "wrong",
                int(error < COVERAGE_FACTOR),
                1,
                note=note,
            )
        )
    return results
