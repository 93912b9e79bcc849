"""The JSON Schema of scene files, with which editors check and complete them."""

import json
from typing import Any

from rig.core.scene.scene import Scene


def schema_text() -> str:
    """Return the text of `scene.schema.json`."""
    schema = _simplify(Scene.model_json_schema(by_alias=True))
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "shotrig scene"}
    return json.dumps(schema, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _simplify(node: Any) -> Any:
    """Remove entries that an editor does not need: derived titles, null as an alternative type, empty defaults."""
    if isinstance(node, list):
        return [_simplify(item) for item in node]
    if not isinstance(node, dict):
        return node
    simplified = {key: _simplify(value) for key, value in node.items() if key != "title" or not isinstance(value, str)}
    if simplified.get("default", 0) in (None, float("inf")):
        del simplified["default"]
    if "description" in simplified and isinstance(simplified["description"], str):
        simplified["description"] = " ".join(simplified["description"].split())
    choices = simplified.get("anyOf")
    if isinstance(choices, list) and {"type": "null"} in choices:
        # An empty value is equivalent to an omitted key, so editors need not propose it.
        alternatives = [choice for choice in choices if choice != {"type": "null"}]
        if len(alternatives) == 1:
            del simplified["anyOf"]
            simplified = {**alternatives[0], **simplified}
        else:
            simplified["anyOf"] = alternatives
    return simplified
