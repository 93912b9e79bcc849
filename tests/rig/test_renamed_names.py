"""Old names of attributes and parameters still work, with a warning that names the new one."""

from dataclasses import dataclass

import pytest

from rig.core.base.renamed import renamed, renamed_parameter


@dataclass(frozen=True)
class Reading:
    """A value with its standard uncertainty."""

    value: float
    value_std: float

    value_error = renamed("value_error", "value_std")


@renamed_parameter("hit", "impact")
def number_of(impact: int = 1) -> int:
    return impact


def test_old_attribute_reads_new_one():
    with pytest.warns(DeprecationWarning, match=r"Reading.value_error is deprecated. Use value_std"):
        assert Reading(1.0, 0.1).value_error == 0.1


def test_old_parameter_sets_new_one():
    with pytest.warns(DeprecationWarning, match=r"number_of\(hit=\) is deprecated. Use impact"):
        assert number_of(hit=3) == 3
    assert number_of(impact=2) == 2
