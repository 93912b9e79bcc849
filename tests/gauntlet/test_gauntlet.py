from __future__ import annotations

import pytest

from tests.gauntlet.scenes import KINDS
from tests.gauntlet.trial import try_out


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_given_scenes_that_nobody_prepared_when_analysed_then_no_answer_is_wrong_without_a_word(kind):
    found = [verdict for number in range(2) for verdict in try_out(5, number, kind)]
    assert found
    assert not [verdict for verdict in found if verdict.outcome == "wrong"]
