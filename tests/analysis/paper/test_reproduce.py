"""The reproduction of Inoue, Yokomichi, Hiraki (2011).

The reproduction can be resumed, its parts agree with each other, and its page contains the results.
"""

from pathlib import Path

import numpy as np
import pytest

import rig
from analysis.studies.paper.charts import abbreviate_types, holds_c2
from analysis.studies.paper.claim import Claim, Evidence
from analysis.studies.paper.claims import differences, resonance_peaks
from analysis.studies.paper.experiment import damper_sweep
from analysis.studies.paper.fig9_claim import compare_directions
from analysis.studies.paper.page import CAPTIONS, write_pages
from analysis.studies.paper.parts import FIGURE_5_SETTING, TYPES, all_parts
from analysis.studies.paper.reproduce import FIGURES, compute, reproduce
from analysis.studies.paper.scan import LEVELS, best_damper, least_affected, scan, type_iii_over_damping
from analysis.studies.paper.simulation import approximate_branches, exact_orbits, linear_properties, waveforms
from analysis.studies.paper.store import Arrays, PaperPart
from rig.core.base.errors import SceneError
from rig.core.system.open_loop_drive import with_ideal_force
from tests.rig.worker_processes import worker_processes

computed_values: list[float] = []


def compute_value(value: float) -> Arrays:
    computed_values.append(value)
    return {"value": np.array(value)}


def part_with(value: float) -> PaperPart:
    """Return a part of the reproduction whose result is this value."""
    return PaperPart("one", f"depends on {value}", compute_value, {"value": value}, "a part")


def test_finished_part_is_read_not_computed(tmp_path: Path) -> None:
    computed_values.clear()
    assert part_with(3.0).load(tmp_path) is None
    part_with(3.0).store(tmp_path, part_with(3.0).run())

    stored = part_with(3.0).load(tmp_path)

    assert stored is not None
    assert stored["value"] == 3.0
    assert list(stored) == ["value"]
    assert computed_values == [3.0]


def test_changed_or_damaged_part_is_not_read(tmp_path: Path) -> None:
    part_with(3.0).store(tmp_path, part_with(3.0).run())
    assert part_with(4.0).load(tmp_path) is None

    path = part_with(3.0).path(tmp_path)
    path.write_bytes(path.read_bytes()[:200])

    assert part_with(3.0).load(tmp_path) is None


def test_parts_are_unique_and_repeatable(tmp_path: Path) -> None:
    first, second = all_parts(tmp_path), all_parts(tmp_path)

    assert len({part.name for part in first}) == len(first)
    assert [part.digest for part in first] == [part.digest for part in second]
    assert len({part.digest for part in first}) == len(first)


def test_unknown_part_lists_the_parts(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"unknown part nonsense.* rec-bare"):
        reproduce(tmp_path, lambda line: None, ["nonsense"])


def test_recording_orbits_and_approximation_agree(tmp_path: Path) -> None:
    scene = rig.load("fig9")
    test = {"kind": "stepped_sine", "frequencies": [49.8, 50.0], "force": 3.3}

    measured = damper_sweep(scene.replace(test=test), tmp_path / "fig9.mcap")
    exact = exact_orbits(scene, (49.7, 50.1), searches=1)
    approximate = approximate_branches(scene, 3, (49.7, 50.1), "printed", searches=3)

    for i, frequency in enumerate(measured["frequency"]):
        exact_index = int(np.abs(exact["frequency"] - frequency).argmin())
        assert exact["type"][exact_index] == "II"
        assert abs(measured["compliance"][1, i]) == pytest.approx(abs(exact["compliance"][exact_index, 1]), rel=0.01)
        assert measured["impact_phi"][i] == pytest.approx(exact["phi"][exact_index], abs=0.06)
        assert measured["impact_tau_1"][i] == pytest.approx(exact["tau"][exact_index, 1], abs=0.06)
        approximate_index = int(np.abs(approximate["frequency"] - frequency).argmin())
        assert approximate["type"][approximate_index] == "II"
        assert approximate["phi"][approximate_index] == pytest.approx(exact["phi"][exact_index], abs=0.1)
        assert approximate["tau"][approximate_index, 0] == pytest.approx(exact["tau"][exact_index, 0], abs=0.1)
        assert abs(approximate["compliance"][approximate_index]) == pytest.approx(
            abs(exact["compliance"][exact_index, 1]), rel=0.05
        )


def test_existing_recording_is_reused(tmp_path: Path) -> None:
    scene = rig.load("fig9").replace(test={"kind": "stepped_sine", "frequencies": [49.8], "force": 3.3})
    path = tmp_path / "fig9.mcap"
    first = damper_sweep(scene, path)
    modified = path.stat().st_mtime_ns

    second = damper_sweep(scene, path)

    assert path.stat().st_mtime_ns == modified
    np.testing.assert_array_equal(first["compliance"], second["compliance"])


def test_scan_cell_equals_direct_simulation() -> None:
    scene = rig.load("fig5-single-damper")
    scene = scene.replace(dampers=[scene.dampers[0].replace(clearance=1e-3)], test=scene.test.replace(force=10.0))
    frequencies = np.array([47.5, 48.5, 49.5])

    cell = scan(scene, np.array([10.0]), np.array([1e-3]), frequencies, 0.10)

    response = rig.frequency_response(
        with_ideal_force(scene), [*frequencies[:2], *cell["peak_frequency"][0], frequencies[2]]
    )
    magnitude = np.abs(response.compliance[1])
    # The peak is searched between the grid frequencies, so it is at least as high as any grid value.
    assert cell["peak"][0, 0] == pytest.approx(magnitude.max(), rel=1e-6)
    assert cell["peak_frequency"][0, 0] == response.frequency[magnitude.argmax()]
    assert cell["peak_frequency"][0, 0] not in frequencies
    assert cell["exact"].all()
    assert cell["type_at_peak"][0, 0] == "III"


@pytest.mark.thorough
def test_optimum_is_better_than_all_trials() -> None:
    scene = rig.load("fig9")
    frequencies = np.linspace(47.0, 50.0, 7)

    optimum = best_damper(scene, 3.3, np.array([0.03, 0.06]), 1e-3 * np.array([0.6, 1.2]), frequencies, trials=6)

    assert optimum["peak"] == optimum["worst"].min()
    # The grid has four points; the simplex search adds better ones.
    assert len(optimum["worst"]) > 4
    assert optimum["peak"] < optimum["worst"][:4].min()
    assert 0.03 <= optimum["mass_ratio"] <= 0.06
    damper = {"body": 2, "mass_ratio": float(optimum["mass_ratio"]), "clearance": float(optimum["best"])}
    for force in 3.3 * LEVELS:
        test = scene.test.replace(force=float(force))
        trial_scene = with_ideal_force(scene.replace(dampers=[damper], test=test))
        response = rig.frequency_response(trial_scene, frequencies)
        assert np.abs(response.compliance[1]).max() < 1.001 * optimum["peak"]


def test_more_damping_removes_type_iii() -> None:
    frequencies = np.array([48.8, 49.0, 49.2])

    type_iii = type_iii_over_damping(rig.load("fig9"), np.array([0.005, 0.01]), np.array([0.98e-3]), frequencies)

    assert type_iii["has_type_iii"].ravel().tolist() == [True, False]


def test_waveforms_stay_in_their_cavities() -> None:
    waveform = waveforms(rig.load("fig5-three-dampers"), 50.5)

    assert (np.diff(waveform["time"]) >= -1e-12).all()
    assert waveform["time"][-1] == pytest.approx(2 / 50.5, rel=0.05)
    assert (waveform["gap"] >= -1e-9).all()
    assert (waveform["gap"] <= waveform["clearance"][:, None] + 1e-9).all()


def test_unknown_types_are_shortened_to_other() -> None:
    assert abbreviate_types(np.array(["I/II", "3 per 2/I", "I/riding", "irregular"])).tolist() == [
        "I/II",
        "I/other",
        "I/r",
        "other",
    ]


def test_c2_needs_ratio_and_types() -> None:
    single = {
        "peak": np.array([[3.0, 3.0, 1.5, 3.0, 3.0]]),
        "types": np.array([["I III", "I II", "III", "I III", "I III"]]),
    }
    three = {
        "peak": np.ones((1, 5)),
        "types": np.array([["I II", "I II", "I II", "I II III", "I II"]]),
        "type_at_peak": np.array([["I/II/riding", "I", "I", "I/III", "2 per 2/I"]]),
    }

    assert holds_c2({"scan-single": single, "scan-three": three}).tolist() == [[True, False, False, False, False]]


def test_differences_are_taken_at_antiresonances_and_peaks() -> None:
    # Of five frequencies, the first is near an antiresonance and the last near a peak.
    reference = {"compliance": np.tile(np.array([1.0, 2.0, 3.0, 4.0, 10.0]), (2, 1))}
    measured = {"compliance": reference["compliance"] * np.array([1.5, 1.0, 1.0, 1.0, 1.01])}

    assert differences(reference, measured) == pytest.approx((0.5, 0.01))


def test_damper_reduces_damped_peak_less() -> None:
    ratios = least_affected(
        rig.load("fig8-one-damper"), np.array([0.005, 0.05]), np.array([0.1]), np.array([2.6]), {3: (46.0, 50.5)},
        points=12,
    )  # fmt: skip

    # A damper hardly reduces a peak that is already well damped.
    assert 0.0 < ratios["peak_ratio"][0, 0, 0, 0] < 0.8 < ratios["peak_ratio"][1, 0, 0, 0] < 1.02


def test_page_shows_verdicts_evidence_and_figures(tmp_path: Path) -> None:
    claims = [
        Claim("C9", "Less is <more>.", (Evidence("It was 42 %.", ("rec-one",)),), "holds in part: because", ("fig9",))
    ]
    orbits: Arrays = {
        "branch": np.array([0]), "type": np.array(["II"]), "special": np.array([], dtype=str),
        "special_frequency": np.array([]), "failures": np.array(["at 50 Hz: none"]),
    }  # fmt: skip
    weights = {"mode": np.array([2]), "peak": np.array([[1.0], [1.3], [0.9]])}

    optimum: Arrays = {
        "mass_ratio": np.array(0.1), "mass_ratios": np.array([0.1]), "best": np.array(9e-4),
        "peak": np.array(1.4e-4), "worst": np.array([1.4e-4]), "orbit_share": np.array(0.9),
    }  # fmt: skip
    cells: Arrays = {"exact": np.array([[True, False]])}
    parts = {"orbit-fig9": orbits, "weights-one-damper": weights, "best-10": optimum, "optimum": optimum}

    paths = write_pages(tmp_path, claims, {**parts, "scan-single": cells, "scan-three": cells})

    markdown, html = (path.read_text(encoding="utf-8") for path in paths)
    for text in (markdown, html):
        assert "holds in part: because" in text
        assert "It was 42 %." in text
        assert "analysis paper --fresh rec-one" in text
        assert "fig9.png" in text
        assert "at 50 Hz: none" in text
        assert "one damper, mode 2: +30 % against -10 %" in text
    assert "Less is &lt;more&gt;." in html


@pytest.mark.thorough
def test_workers_store_all_parts_longest_first(tmp_path: Path) -> None:
    scene = rig.load("fig9")
    parts = [
        PaperPart(name, name, linear_properties, {"scene": scene, "frequencies": np.array([value])}, "a part", effort)
        for name, value, effort in (("short", 20.0, 1.0), ("long", 30.0, 5.0), ("middle", 40.0, 3.0))
    ]

    completed = [part.name for part, _ in compute(parts, tmp_path)]

    assert sorted(completed) == ["long", "middle", "short"]
    assert "short" not in completed[:1]
    stored = [part.load(tmp_path) for part in parts]
    assert [float(arrays["frequency"][0]) for arrays in stored if arrays is not None] == [20.0, 30.0, 40.0]


def test_failing_part_raises_and_leaves_nothing(tmp_path: Path) -> None:
    invalid = PaperPart("wrong", "wrong", exact_orbits, {"scene": rig.load("fig9"), "band": (50.0, 40.0)}, "a part")

    with pytest.raises(SceneError, match="two ascending values"):
        list(compute([invalid], tmp_path))

    assert not worker_processes()
    assert not list(tmp_path.rglob("*.npz"))


def test_each_figure_has_a_caption() -> None:
    assert set(FIGURES) == set(CAPTIONS)


@pytest.mark.parametrize("name", ["fig5-single-damper", "fig5-three-dampers"])
def test_fig_5_scenes_match_the_claim(name: str) -> None:
    scene = rig.load(name)
    assert scene.test.force == FIGURE_5_SETTING[0]
    assert {damper.clearance for damper in scene.dampers} == {FIGURE_5_SETTING[1]}


@pytest.mark.parametrize("kind", TYPES)
def test_fig_3_settings_show_their_type(kind: str) -> None:
    (part,) = (part for part in all_parts(Path()) if part.name == f"type-{kind}")
    assert part.run()["type"] == kind


def test_sweep_direction_differences_are_reported() -> None:
    frequency, magnitude = np.array([48.0, 49.0, 50.0]), np.array([[1.0] * 3, [1.0, 2.0, 1.0]])
    upward = {"frequency": frequency, "compliance": magnitude}
    equal = {"frequency": frequency[::-1], "compliance": 1.01 * magnitude[:, ::-1]}
    different = {"frequency": frequency[::-1], "compliance": np.array([[1.0] * 3, [1.0, 1.0, 1.0]])}
    exact = {"branch": np.zeros(4), "frequency": np.array([48.0, 48.4, 48.3, 48.1])}
    small = compare_directions(upward, equal, exact)
    assert (
        "at most 1.0 %, at " in small and "folds, next to which the motion depends on the direction, at 48.40" in small
    )
    assert "more than 5 % at 49.00 Hz" in compare_directions(upward, different, exact)


def test_peaks_of_claims_are_interpolated() -> None:
    frequency = np.concatenate([np.linspace(*band, 28) for band in ((12.0, 13.8), (31.5, 36.0), (45.5, 51.0))])
    value = sum(1e-6 / (1.0 - (frequency / f) ** 2 + 0.01j * frequency / f) for f in (13.0336, 34.85, 49.7))
    compliance, error = np.tile(value, (3, 1)), np.full((3, frequency.size), 1e-12)
    peaks = resonance_peaks({"frequency": frequency, "compliance": compliance, "error": error})
    assert np.all(abs(peaks[:, 0] - 1e-4) < peaks[:, 1] + 2e-6) and np.all(peaks[:, 1] < 1e-5)
