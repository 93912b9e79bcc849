from __future__ import annotations

import pytest

from tests.gauntlet.scenes import KINDS
from tests.gauntlet.trial import run_trial


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_random_scenes_give_no_silent_wrong_answer(kind):
    found = [verdict for number in range(2) for verdict in run_trial(5, number, kind)]
    assert found
    assert not [verdict for verdict in found if verdict.outcome == "wrong"]
