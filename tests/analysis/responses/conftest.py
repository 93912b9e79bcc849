"""Fixture of tests that spend most of their time on local fits."""

from collections.abc import Iterator

import pytest


@pytest.fixture(scope="module")
def few_lines() -> Iterator[None]:
    """Estimate responses at a third of the lines."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("analysis.core.responses.segment_fits._MAX_LINES", 330)
        yield
