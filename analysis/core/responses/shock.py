"""Shock tests: they have no frequency responses, because their drive is known only about each pulse."""

from analysis.core.responses.estimator import Estimator, Request
from rig.core.base.errors import RecordingError
from rig.core.results.response import Response


def _compute(request: Request) -> list[Response]:
    """Reject the request, and name the analysis for shocks."""
    path = request.rec.path
    raise RecordingError(f"{path}: a shock has no frequency responses. Use `analysis srs {path}`.")


ESTIMATOR = Estimator(_compute, "a shock has no frequency responses", "")
