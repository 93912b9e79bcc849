"""A kind of test that exists only here is used in all ways, with three files and no other change to the product."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
KINDS = ROOT / "tests" / "kinds"


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    product = tmp_path_factory.mktemp("product")
    for package in ("rig", "daq", "analysis"):
        shutil.copytree(ROOT / package, product / package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(KINDS / "two_tones_settings.py", product / "rig/scene/excitation/two_tones.py")
    shutil.copy(KINDS / "two_tones_procedure.py", product / "daq/excitation/two_tones.py")
    union = product / "rig/scene/excitation/__init__.py"
    text = union.read_text(encoding="utf-8").replace("Impulse | Free,", "Impulse | Free | TwoTones,")
    line = "from rig.scene.excitation.two_tones import TwoTones as TwoTones"
    union.write_text(text.replace("from rig.settings", f"{line}\nfrom rig.settings", 1), encoding="utf-8")
    command = [sys.executable, "-P", str(KINDS / "use_two_tones.py"), str(product / "two.mcap")]
    environment = {**os.environ, "PYTHONPATH": str(product)}
    run = subprocess.run(command, env=environment, cwd=product, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    return dict(json.loads(run.stdout))


def test_new_kind_is_checked(results: dict[str, Any]) -> None:
    assert "test.frequencies[2]: 2000 Hz" in results["message"]


def test_new_kind_is_explained(results: dict[str, Any]) -> None:
    assert "test two_tones" in results["explanation"] or "two tones" in results["explanation"]
    assert "Both frequencies, ascending" in results["help"]


def test_new_kind_is_recorded_and_analyzed(results: dict[str, Any]) -> None:
    assert results["measured"] == pytest.approx(results["exact"], rel=1e-3)
    assert "2 measure" in results["info"] and "analysis frf" in results["info"]


def test_new_kind_is_simulated_and_foreseen(results: dict[str, Any]) -> None:
    assert results["simulated"] > 0.0
    assert "the test takes 8" in results["foresight"]


def test_new_kind_is_offered_on_page(results: dict[str, Any]) -> None:
    assert "two tones" in results["forms"]
