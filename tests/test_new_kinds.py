"""Kinds that exist only here are used in all ways: a test with three files, a shaker with two, and no other change."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
KINDS = ROOT / "tests" / "kinds"


def use(product: Path, files: dict[str, str], union: str, new: str, script: str) -> dict[str, Any]:
    """Copy the product with the files of a new kind, and return what a script prints.

    `files`: modules of the product and their sources; `union`: the package that lists the kinds; `new`: the class
    of the new kind.
    """
    for package in ("rig", "daq", "analysis"):
        shutil.copytree(ROOT / package, product / package, ignore=shutil.ignore_patterns("__pycache__"))
    for target, source in files.items():
        shutil.copy(KINDS / source, product / target)
    module = next(iter(files)).removesuffix(".py").replace("/", ".")
    package = product / union / "__init__.py"
    text = re.sub(r",(\s*Alternatives\()", rf" | {new},\1", package.read_text(encoding="utf-8"), count=1)
    text = text.replace("from rig.core.settings", f"from {module} import {new} as {new}\nfrom rig.core.settings", 1)
    package.write_text(text, encoding="utf-8")
    command = [sys.executable, "-P", str(KINDS / script), str(product / "new.mcap")]
    environment = {**os.environ, "PYTHONPATH": str(product)}
    run = subprocess.run(command, env=environment, cwd=product, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    return dict(json.loads(run.stdout))


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    files = {
        "rig/core/scene/excitation/two_tones.py": "two_tones_settings.py",
        "daq/core/excitation/two_tones.py": "two_tones_procedure.py",
    }
    product = tmp_path_factory.mktemp("product")
    return use(product, files, "rig/core/scene/excitation", "TwoTones", "use_two_tones.py")


@pytest.fixture(scope="module")
def coil(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    files = {"rig/core/scene/shaker/voice_coil.py": "voice_coil_shaker.py"}
    product = tmp_path_factory.mktemp("product")
    return use(product, files, "rig/core/scene/shaker", "VoiceCoil", "use_voice_coil.py")


def test_new_kind_is_checked(results: dict[str, Any]) -> None:
    too_high, too_close = results["messages"]
    assert "test.frequencies[2]: 2000 Hz" in too_high
    assert "test.frequencies: tones that differ by 0.3 Hz do not settle within 60 s" in too_close


def test_new_kind_is_explained(results: dict[str, Any]) -> None:
    assert "test two_tones" in results["explanation"] or "two tones" in results["explanation"]
    assert "Both frequencies, ascending" in results["help"]


def test_new_kind_is_recorded_and_analyzed(results: dict[str, Any]) -> None:
    # 33.3 Hz is not a harmonic of 20 Hz: each tone disturbs a fit of the other alone.
    assert results["measured"] == pytest.approx(results["exact"], rel=1e-3)
    assert max(results["uncertainty"]) < 0.005
    assert "2 measure" in results["info"] and "analysis frf" in results["info"]


def test_new_kind_is_simulated_and_foreseen(results: dict[str, Any]) -> None:
    assert results["simulated"] > 0.0 and results["steady"] == [20.0, 33.3]
    assert "the test takes 8" in results["foresight"]


def test_new_kind_is_offered_on_page(results: dict[str, Any]) -> None:
    assert "two tones" in results["forms"]


def test_new_shaker_is_checked(coil: dict[str, Any]) -> None:
    assert "test.drive" in coil["message"] and "expected a voltage" in coil["message"]
    # A force cell measures at every coil spring.
    assert not coil["channel_message"]


def test_new_shaker_is_explained_and_foreseen(coil: dict[str, Any]) -> None:
    assert "head of 0.1 kg on body 1" in coil["explanation"]
    assert "table travel" in coil["foresight"]
    assert coil["output"] == "force on the head, 1 N/V"


def test_energy_of_new_shaker_is_balanced(coil: dict[str, Any]) -> None:
    residual, work = coil["energy"]
    assert work > 0.0 and abs(residual) < 1e-12 * work


def test_new_shaker_is_recorded_and_analyzed(coil: dict[str, Any]) -> None:
    compliance, ratio = coil["measured"]
    assert compliance == pytest.approx(coil["exact"], rel=1e-3)
    assert ratio == pytest.approx(coil["exact_ratio"], rel=1e-3)


def test_force_of_new_shaker_is_controlled(coil: dict[str, Any]) -> None:
    assert coil["reached"] == pytest.approx(0.3, rel=0.005)


def test_new_shaker_is_drawn(coil: dict[str, Any]) -> None:
    assert "voice coil" in coil["drawing"] and "6.6 kN/m" in coil["drawing"]
    assert "rig/coil_spring" in coil["entities"]
