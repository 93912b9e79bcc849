"""Simplified models of a bed of grains, compared with the grains."""

import csv
from pathlib import Path

import pytest

from rig.studies.cost import bed_models as models
from rig.studies.cost.cost import cost
from rig.studies.cost.steady_study import OTHER_PACKING
from tests.rig.grains.scenes import with_grains


@pytest.fixture(autouse=True)
def short_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the simulated blocks to one period."""
    monkeypatch.setattr(models, "PERIODS", 1)


@pytest.mark.thorough
def test_all_but_soft_contacts_agree_at_rest(tmp_path: Path) -> None:
    scene = with_grains(test={"kind": "sine", "frequency": 60.0, "force": 0.003})

    result = cost(scene, None, 2)
    text, files = str(result), result.write(tmp_path)

    (table,) = (file for file in files if file.suffix == ".csv")
    with table.open(newline="", encoding="utf-8") as file:
        computed = {(row["method"], row["setting"]): float(row["error"]) for row in csv.DictReader(file)}
    assert computed["one mass", "instantaneous contact"] < 0.01
    assert computed["finite-duration contact", "1 ms"] < 0.01
    assert computed[OTHER_PACKING, "step 0.19 Rayleigh"] < 0.01
    assert computed["finite-duration contact", "8 ms"] > computed["finite-duration contact", "1 ms"]
    assert "6 grains simulated for" in text
    assert {file.suffix for file in files} == {".png", ".svg", ".csv"}


def test_shorter_time_steps_are_omitted() -> None:
    scene = with_grains()

    assert models.with_time_step(scene, 0.05) is None
    longer = models.with_time_step(scene, 0.19)
    assert longer is not None
    assert longer.dampers[0].grains.time_step > scene.dampers[0].grains.time_step


def test_softer_grains_change_only_modulus_and_step() -> None:
    scene = with_grains()

    softer = models.with_softer_grains(scene)

    grains = softer.dampers[0].grains
    assert grains.modulus == scene.dampers[0].grains.modulus / models.SOFTENING_RATIO
    assert grains.replace(modulus=1e7, time_step=15e-6) == scene.dampers[0].grains
