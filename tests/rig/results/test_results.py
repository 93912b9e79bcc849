"""Results in a Python session: one-line summary, table, plot and page; quantities as arguments."""

import re
import sys

import numpy as np
import pytest
from matplotlib.figure import Figure

import analysis
import daq
import rig
from rig.core.base.errors import RunError, SceneError
from rig.core.results.table import Table, join_tables
from rig.core.simulation.run_output import summary
from tests.rig.this_process import pieces_in_this_process

SWEEP, HIT = "recordings/demo-sweep-no-damper.mcap", "recordings/demo-impulse-no-damper.mcap"


@pytest.fixture(scope="module")
def results():
    """One result of each kind."""
    force_driven = rig.load("fig9", {"shaker": {"kind": "force", "body": 1}, "channels": None})
    with daq.open(SWEEP) as sweep_recording, daq.open(HIT) as hit_recording, pieces_in_this_process():
        frfs = analysis.frfs(sweep_recording)
        yield [
            frfs,
            frfs["body3"],
            analysis.identify(frfs),
            analysis.decay(hit_recording),
            analysis.decay(hit_recording).modes[0],
            hit_recording,
            rig.simulate("fig9", "0.1 s", "1 kHz", frequency="49 Hz"),
            rig.frequency_response(force_driven, ["40 Hz"]),
            rig.periodic_orbit("fig9", "49.6 Hz"),
            rig.orbit_response("fig9", ["3.2 N", "3.3 N"], "force", frequency="49.6 Hz"),
            rig.follow_orbits("fig9", "frequency", ("49.5 Hz", "49.7 Hz"), searches=1),
            rig.approximate_response("fig9", 3, ("49.4 Hz", "49.8 Hz")),
            rig.map_motion("fig9", values=["0.01 N", "3.3 N"], frequencies=["49.5 Hz", "49.7 Hz"]),
        ]


def test_result_has_summary_page_plot_and_table(results) -> None:
    for result in results:
        line, ax = repr(result), Figure().subplots()
        assert line.startswith(f"<{type(result).__name__}: ") and "\n" not in line and len(line) < 300
        tags = r'</?(p|pre|div|table|thead|tbody|tr|th|td)( (class|data-label)="[^"<]*")*>'
        assert "<" not in re.sub(tags, "", result._repr_html_())
        assert result.plot(ax) is ax and ax.lines and ax.get_legend() is not None
        columns = result.columns()
        assert len({np.shape(column) for column in columns.values()}) == 1
        table, data = result.to_dataframe(), result.to_xarray()
        assert [table.index.name, *table.columns] == list(columns)
        if result is results[0]:
            assert data["value"].dims == ("frequency", "output", "input")
            np.testing.assert_array_equal(data["value"].sel(output="body3", input="force"), result["body3"].value)
        else:
            assert set(data.variables) == set(columns)
        for name in table.columns:
            np.testing.assert_array_equal(table[name].to_numpy(), columns[name])


def test_table_of_a_curve_has_its_numbers(results) -> None:
    frfs, frf = results[:2]
    assert frf is frfs["body3"] is frfs[2] and len(frfs[:2]) == 2
    table = frf.to_dataframe()
    np.testing.assert_array_equal(table["value_m/N"], frf.value)
    np.testing.assert_array_equal(table.index, frf.frequency)
    assert re.search(r"compliance, \d+ points, 8 to 58 Hz, highest \(\d+ ± \d+\) µm/N at 13\.\d+ Hz", repr(frf))


def test_table_of_an_orbit_is_periodic(results) -> None:
    (orbit,) = (result for result in results if isinstance(result, rig.Orbit))
    columns = orbit.columns()
    gap, time, body2 = columns["gap 1_m"], columns["time_s"], columns["body 2_m"]
    # The damper reaches floor and ceiling.
    assert gap.min() == 0.0 and gap.max() == pytest.approx(rig.load("fig9").dampers[0].clearance, rel=1e-6)
    assert time[-1] - time[0] == pytest.approx(orbit.repetition / orbit.frequency)
    assert body2[-1] == pytest.approx(body2[0], abs=1e-9) and (np.diff(time) >= 0.0).all()
    assert np.ptp(body2) / 2 == pytest.approx(orbit.peak[1], rel=1e-3)


def test_empty_curve_has_an_empty_table() -> None:
    # With this force the damper stays on its floor, so there is no branch of motion with impacts.
    approximation = rig.approximate_response("fig9", 3, ("49.4 Hz", "49.8 Hz"), force="1 uN")
    assert approximation.branches == () and len(approximation.to_dataframe()) == 0 and approximation._repr_html_()


def test_missing_package_has_an_install_hint(results, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    monkeypatch.setitem(sys.modules, "xarray", None)
    for convert in (results[0].to_dataframe, results[0].to_xarray):
        with pytest.raises(RunError, match=r'pip install "shotrig\[tables\]"'):
            convert()


def test_too_short_duration_is_reported() -> None:
    scene = rig.loads(
        "{structure: {masses: [1 kg], springs: [40 kN/m]}, test: {kind: free, displacement: [1 mm], duration: 1 s}}"
    )
    with pytest.raises(SceneError, match="duration: got 1e-12 s, less than a sample interval at 1000 Hz"):
        rig.simulate(scene, 1e-12, rate=1000.0)
    with pytest.raises(SceneError, match=r"duration: got 1 s, less than a sample interval at 0\.5 Hz"):
        rig.simulate(rig.load("reference-A"), 1.0, rate=0.5)


def test_summary_of_a_simulation_names_its_samples() -> None:
    text = summary(rig.simulate(rig.load("reference-A"), 0.5, rate=60.0))
    assert "largest samples at 60 Hz; the motion between samples can be larger" in text and "peak" not in text


@pytest.mark.parametrize(
    ("duration", "message"), [("2 kg", "`duration`: 'kg' is not a unit of time"), ("soon", "number")]
)
def test_invalid_quantity_of_an_argument_is_named(duration, message) -> None:
    with pytest.raises(SceneError, match=message):
        rig.simulate("fig9", duration)


def test_quantities_and_numbers_give_the_same_result(results) -> None:
    run = rig.simulate("fig9", 0.1, 1000.0, frequency=49.0)
    np.testing.assert_array_equal(
        run.displacement, next(result for result in results if isinstance(result, rig.Run)).displacement
    )


def test_joined_tables_are_printed_below_their_titles() -> None:
    first, second = (
        Table(("mode", "at a", "note"), "<><", [("1", "9", "")]),
        Table(("mode", "at b"), "<>", [("1", "-8")]),
    )
    assert join_tables([("A", first), ("B", second), ("C", first)]).lines("  ") == [
        "  mode  at a  at b", "  A", "  1        9", "  B", "  1             -8", "  C", "  1        9",
    ]  # fmt: skip
    assert join_tables([("A", Table(("mode",), "<", []))]).lines() == []
