"""Warnings about tests that were measured before steady state."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import analysis
import daq
from tests.analysis.responses import synthetic

SAMPLES = 20480
CASES = [
    (
        "{kind: swept_sine, from: 10 Hz, to: 40 Hz, duration: 8 s, force: 1 N}",
        {"from": 10.0, "to": 40.0, "duration": 8.0, "spacing": "log"},
    ),
    (
        "{kind: multisine, from: 10 Hz, to: 40 Hz, period: 1 s, force: 1 N}",
        {"realisation": 1, "period": 2560, "periods": 8, "lines": [10, 40]},
    ),
    ("{kind: stepped_sine, frequencies: [20 Hz], force: 1 N}", {"frequency": 20.0, "level": 1.0, "direction": "up"}),
]


@pytest.mark.parametrize(("test", "fields"), CASES, ids=["sweep", "multisine", "steps"])
def test_remedy_names_keys_of_the_test(test: str, fields: dict[str, Any], tmp_path: Path) -> None:
    samples = np.random.default_rng(1).standard_normal((4, SAMPLES))
    marks = [("measure", 0, SAMPLES - 1, {**fields, "settled": False})]
    path = synthetic.write(tmp_path / "a.mcap", synthetic.scene(test), synthetic.channels(), samples, marks)
    with daq.open(path) as rec:
        settings = type(rec.scene.test)
        warnings = analysis.frequency_responses(rec)[0].warnings
    [note] = [note for note in warnings if "steady state" in note]
    keys = {field.alias or name for name, field in settings.model_fields.items()}
    assert set(re.findall(r"\btest(?:\.|: )(\w+)", note)) <= keys
