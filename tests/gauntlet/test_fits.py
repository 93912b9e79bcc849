from __future__ import annotations

import pytest

from tests.gauntlet.fits import draw, try_out


@pytest.mark.thorough
def test_given_a_bench_that_nobody_prepared_when_fitted_then_what_is_determined_is_right():
    trial = try_out(1, 12)
    determined = [one for one in trial.values if one.status == "determined"]
    assert len(draw(1, 12).dampers) == 1
    assert {"frequency", "mass_ratio"} <= {one.what for one in determined}
    assert sum(abs(one.off) <= one.bound for one in determined) >= 0.9 * len(determined)
    assert max(abs(one.off) for one in determined) < 0.02
