"""Docstrings of the public functions are complete by numpydoc's validation."""

import inspect

import pytest
from numpydoc.validate import validate

import analysis
import daq
import rig

FUNCTIONS = [
    f"{package.__name__}.{name}"
    for package in (rig, daq, analysis)
    for name in package.__all__
    if inspect.isfunction(getattr(package, name))
]
# Sections that are not required: examples, references to other functions, and an extended summary.
OPTIONAL = {"ES01", "EX01", "SA01"}


@pytest.mark.parametrize("function", FUNCTIONS)
def test_docstring_documents_parameters_and_result(function: str) -> None:
    faults = [text for code, text in validate(function)["errors"] if code not in OPTIONAL]
    assert faults == []
