"""Import of files in tests: the opened recording and the warnings."""

import warnings
from contextlib import ExitStack

import pytest

import daq
from tests.daq.importing.files import make_scene


@pytest.fixture
def imported(tmp_path):
    """Return a function that imports files into r.mcap, and returns the open recording and the warnings."""
    with ExitStack() as stack:

        def import_and_open(files, scene=None, **options):
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                path = daq.import_files(files, scene or make_scene(), tmp_path / "r.mcap", overwrite=True, **options)
            return stack.enter_context(daq.open(path)), [str(warning.message) for warning in caught]

        yield import_and_open
