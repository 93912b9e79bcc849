"""The JSON Schema of scene files, with which editors check and complete them."""

from __future__ import annotations

import json
from typing import Any

from rig.scene.scene import Scene


def schema_text() -> str:
    """Return the text of `scene.schema.json`."""
    schema = _lean(Scene.model_json_schema(by_alias=True))
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": "shotrig scene"}
    return json.dumps(schema, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _lean(node: Any) -> Any:
    """Remove what an editor does not need: derived titles, null as an alternative type, empty defaults."""
    if isinstance(node, list):
        return [_lean(item) for item in node]
    if not isinstance(node, dict):
        return node
    lean = {key: _lean(value) for key, value in node.items() if key != "title" or not isinstance(value, str)}
    if lean.get("default", 0) in (None, float("inf")):
        del lean["default"]
    if "description" in lean and isinstance(lean["description"], str):
        lean["description"] = " ".join(lean["description"].split())
    choices = lean.get("anyOf")
    if isinstance(choices, list) and {"type": "null"} in choices:
        # An empty value is equivalent to an omitted key, so editors need not propose it.
        rest = [choice for choice in choices if choice != {"type": "null"}]
        if len(rest) == 1:
            del lean["anyOf"]
            lean = {**rest[0], **lean}
        else:
            lean["anyOf"] = rest
    return lean
