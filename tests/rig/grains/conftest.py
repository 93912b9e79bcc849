"""Packings (settled positions of grains) are cached for one run of the tests, separate from the user's cache."""

from collections.abc import Iterator

import pytest

from rig.extras.grains import packing


@pytest.fixture(autouse=True, scope="session")
def packings_of_this_run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Store packings in a temporary folder."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("beds")
        patch.setattr(packing, "folder", lambda: folder)
        yield
