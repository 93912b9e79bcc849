"""A valid scene with any value in place of any entry loads, or is rejected with a message that names the file."""

from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import rig
from rig.core.base.errors import SceneError
from tests.soak.scenes import UNUSUAL_NUMBERS, UNUSUAL_TEXTS, VALID_SCENES, key_paths

# Texts, numbers and nested values that a user or a program might write by mistake.
texts = st.sampled_from(UNUSUAL_TEXTS) | st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]))
numbers = st.sampled_from(UNUSUAL_NUMBERS) | st.floats() | st.integers()
anything = st.recursive(
    st.none() | st.booleans() | numbers | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=5,
)


def set_value(content: Any, path: tuple[Any, ...], value: Any) -> None:
    """Replace the entry to which a sequence of keys leads."""
    *parents, last = path
    for key in parents:
        content = content[key]
    content[last] = value


@pytest.mark.filterwarnings("ignore::rig.core.base.errors.SceneWarning")
@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_value_anywhere_loads_or_is_rejected(data: st.DataObject, tmp_path: Path) -> None:
    content = yaml.safe_load(yaml.safe_dump(data.draw(st.sampled_from(VALID_SCENES))))
    set_value(content, data.draw(st.sampled_from(list(key_paths(content)))), data.draw(anything))
    path = tmp_path / "unusual.yaml"
    path.write_text(yaml.safe_dump(content, allow_unicode=True), encoding="utf-8")
    try:
        rig.load(path)
    except SceneError as error:
        assert str(path) in str(error)
