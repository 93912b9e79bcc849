"""Grain beds are cached for one test run, independent of the user's cache."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from rig.grain_beds import packing


@pytest.fixture(autouse=True, scope="session")
def beds_of_this_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep beds in a folder of their own."""
    with pytest.MonkeyPatch.context() as patch:
        beds = tmp_path_factory.mktemp("beds")
        patch.setattr(packing, "folder", lambda: beds)
        yield
