"""Frequency responses: selection, ratios, bands, uncertainty budgets and export."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from rig.core.base.errors import SceneError
from rig.core.results.response import Point, Response, stack
from rig.core.results.uncertainty import CLOCK, SENSITIVITY, Contribution, UncertaintyBudget

# Frequency lines, Hz.
LINES = np.linspace(10.0, 30.0, 41)
# Half-widths of the uniform distributions of systematic deviations of `curve`, relative to its magnitude.
ALIASING_LIMIT, SENSITIVITY_LIMIT, CLOCK_LIMIT = 0.002, 0.01, 0.005


def curve(name: str = "body1", scale: float = 1.0, **fields) -> Response:
    """Return the response of a mode at 20 Hz with scatter, aliasing and tolerances of data sheets."""
    value = scale * 1e-3 / (20.0**2 - LINES**2 + 8.0j)
    magnitude = abs(value)
    limits = {
        "aliasing": ALIASING_LIMIT * magnitude,
        SENSITIVITY: SENSITIVITY_LIMIT * magnitude,
        CLOCK: CLOCK_LIMIT * magnitude,
    }
    return Response.curve(
        LINES,
        value,
        name,
        error=0.001 * magnitude,
        degrees_of_freedom=np.full(41, 38.0),
        limits=limits,
        label="a",
        **fields,
    )


def matrix() -> Response:
    """Return responses of three bodies to two forces; at the first line the real parts are 0 to 5."""
    value = np.arange(41 * 6).reshape(41, 3, 2) + 1j
    outputs = tuple(Point(f"a{k}", place=f"body {k}") for k in (1, 2, 3))
    return Response(LINES, value, outputs, (Point("f1", "force", "body 1"), Point("f3", "force", "body 3")))


def test_bound_adds_tolerances_linearly_to_random_errors() -> None:
    frf = curve()
    # A limit of error has u = a / sqrt(3) and k = 2; added whole, it would give a larger radius here.
    independent = np.hypot(frf.random_bound(), 2.0 / np.sqrt(3.0) * frf.limits["aliasing"])
    tolerances = (SENSITIVITY_LIMIT + CLOCK_LIMIT) * abs(frf.value)
    np.testing.assert_allclose(frf.bound(), independent + tolerances)
    np.testing.assert_allclose(frf.without(SENSITIVITY, CLOCK).bound(), independent)
    np.testing.assert_allclose(frf.to("acceleration").bound(), frf.bound() * (2 * np.pi * LINES) ** 2)


def test_unknown_degrees_of_freedom_give_normal_coverage() -> None:
    frf = Response.curve(LINES, np.ones(LINES.size) + 0j, "a", error=np.full(LINES.size, 0.01))
    # 95 % quantile of the magnitude of a complex normal deviation (Rayleigh), and k = 2 of one component.
    np.testing.assert_allclose(frf.bound(), 0.01 * np.sqrt(-2.0 * np.log(0.05)), rtol=1e-5)
    np.testing.assert_allclose(frf.expanded(), 0.02, rtol=1e-12)


def test_budget_lists_contributions_by_variance() -> None:
    table = stack([curve(), curve("body2")]).budget("body2", "20 Hz")
    names, types, uncertainties, fractions = zip(*table.rows, strict=True)
    assert names == (SENSITIVITY, CLOCK, "aliasing", "scatter") and types == ("B", "B", "B", "A")
    assert sum(fractions) == pytest.approx(1.0) and table.unit == "µm/N"
    assert uncertainties[0] == pytest.approx(SENSITIVITY_LIMIT * table.value / np.sqrt(3.0))
    assert table.combined == pytest.approx(np.linalg.norm(uncertainties))
    assert "standard uncertainty / (µm/N)" in str(table) and "combined" in str(table)


def test_ratio_combines_the_uncertainties() -> None:
    ratio = curve(scale=3.0) / curve()
    np.testing.assert_allclose(ratio.value, 3.0)
    assert ratio.unit == "1" and ratio.name == "ratio"
    # Tolerances of both curves add linearly, other limits as root sum of squares.
    np.testing.assert_allclose(ratio.limits[SENSITIVITY], 3.0 * 2.0 * SENSITIVITY_LIMIT)
    np.testing.assert_allclose(ratio.limits["aliasing"], 3.0 * np.sqrt(2.0) * ALIASING_LIMIT)


def test_ratio_to_a_name_is_refused_with_example() -> None:
    with pytest.raises(TypeError, match=r"divided by a response, such as responses\['body1'\], not by 'body1'"):
        curve() / "body1"  # type: ignore[operator]


def test_common_sources_cancel_in_ratio() -> None:
    first, second = curve(scale=3.0), curve("body2")
    budgets = []
    for frf in (first, second):
        # The error of the reference changes both responses alike; each has a sensor of its own.
        own = {"reference": -0.02 * frf.value, frf.response: 0.01j * frf.value}
        total = 0.03 * abs(frf.value)
        budgets.append(
            UncertaintyBudget.of(frf.error, frf.degrees_of_freedom, {SENSITIVITY: total}, {SENSITIVITY: own})
        )
    ratio = replace(first, uncertainty=budgets[0]) / replace(second, uncertainty=budgets[1])
    np.testing.assert_allclose(ratio.limits[SENSITIVITY], 3.0 * 0.02)
    # Two independent limits of error of 1 %, and 0.1 % of scatter in both curves.
    combined = 3.0 * np.sqrt(2.0 * 0.01**2 / 3.0 + 2.0 * 0.001**2)
    np.testing.assert_allclose(ratio.uncertainty.combined(), combined)
    np.testing.assert_allclose(ratio.expanded(), 2.0 * combined)


def test_ratio_is_nan_outside_the_other_band() -> None:
    ratio = curve() / curve().band(12.2, 28.0)
    is_finite = np.isfinite(ratio.value)
    assert LINES[is_finite].min() == 12.5 and LINES[is_finite].max() == 28.0  # lines have a spacing of 0.5 Hz
    with pytest.raises(SceneError, match="Select the same outputs and inputs"):
        matrix() / curve()


def test_band_takes_texts_and_numbers() -> None:
    assert curve().band("12 Hz", 13.0).frequency.tolist() == [12.0, 12.5, 13.0]


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        (100.0, 200.0, r"no lines between 100 and 200 Hz; the response has lines from 10 to 30 Hz"),
        (20.0, 10.0, r"got 20 to 10 Hz; expected the lower frequency first"),
    ],
)
def test_empty_band_is_rejected(low: float, high: float, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        curve().band(low, high)


def test_frequency_instead_of_line_names_method() -> None:
    with pytest.raises(SceneError, match=r"at: got 39\.0; expected .* use interpolated"):
        curve().at(39.0)
    assert curve().interpolated(12.25).value.shape == (1,)


def test_keys_of_other_types_are_rejected() -> None:
    frfs = matrix()
    for key in (None, frfs[0], ("a1", None), ("a1", "f1", "f3")):
        with pytest.raises(SceneError, match=r"expected a name, such as '[af]1'"):
            frfs[key]
    with pytest.raises(IndexError, match=r"no curve with index 6\. Give an index from 0 to 5, or one of the names a1"):
        frfs[6]
    assert frfs[np.int64(1)].response == "a1"


def test_names_belong_to_the_response() -> None:
    frfs = matrix()
    assert "a1" in frfs and "body 3" in frfs and ("a2", "f3") in frfs and frfs[0] in frfs
    assert "a4" not in frfs and None not in frfs and curve() not in frfs
    assert [(name, part.keys()) for name, part in frfs.items()] == [(name, (name,)) for name in ("a1", "a2", "a3")]


def test_names_and_places_select_elements() -> None:
    frfs = matrix()
    assert frfs["a2", "f3"].value[0] == 3 + 1j and frfs["body 3", "f1"].value[0] == 4 + 1j
    assert frfs["a3"].value.shape == (41, 1, 2) and frfs[1:].keys() == ("a2", "a3")
    assert [element.value[0].real for element in frfs] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    with pytest.raises(SceneError, match=r"no response 'a4'\. Give one of a1, a2, a3"):
        frfs["a4"]
    with pytest.raises(ValueError, match="expected \\(41, 1, 1\\)"):
        Response(LINES, np.ones((41, 2, 1), dtype=complex), (Point("a"),))


def test_plot_draws_others_into_the_same_axes() -> None:
    ax = Figure().subplots()
    assert curve().plot(ax, curve("body2", 2.0)) is ax and len(ax.lines) == 2


def test_matrix_becomes_tables_with_all_elements() -> None:
    data = matrix().to_xarray()
    assert data.sizes == {"frequency": 41, "output": 3, "input": 2}
    assert data["value"].sel(output="a2", input="f3").values[0] == 3 + 1j
    assert list(matrix().to_dataframe().columns)[:2] == ["a1/f1_m/N", "a1/f1_bound_m/N"]


def test_stacked_curves_share_lines() -> None:
    short = curve("body2").band(15.0, 20.0)
    both = stack([curve(), short])
    assert both.value.shape == (41, 2, 1) and np.isnan(both["body2"].value[0])
    np.testing.assert_array_equal(both["body2"].band(15.0, 20.0).value, short.value)
    np.testing.assert_array_equal(both["body1"].bound(), curve().bound())


def test_unsteady_lines_remain_marked_at_other_lines() -> None:
    first, second = (curve(name, unsteady=line == LINES, amplitude=LINES) for name, line in (("a", 14.0), ("b", 20.0)))
    both = stack([first.band(10.0, 25.0), second.band(15.0, 30.0)])
    assert LINES[both.unsteady].tolist() == [14.0, 20.0]
    np.testing.assert_array_equal(both.amplitude, LINES)
    assert LINES[(first / second.band(15.0, 30.0)).unsteady].tolist() == [14.0, 20.0]
    # Interpolation uses the lines on both sides.
    assert first.interpolated(np.array([13.9, 14.2, 14.6])).unsteady.tolist() == [True, True, False]


def test_exact_response_has_no_uncertainty() -> None:
    exact = Response.curve(LINES, curve().value, "body1", uncertainty=UncertaintyBudget())
    assert not exact.bound().any() and not exact.error.any()


def test_universal_file_has_each_element(tmp_path) -> None:
    uff = pytest.importorskip("pyuff")
    path = matrix().to_uff(tmp_path / "a.uff", driven=[1, 3])
    sets = [data for data in uff.UFF(str(path)).read_sets() if data.get("func_type") == 4]
    assert [(int(data["rsp_node"]), int(data["ref_node"])) for data in sets] == [
        (1, 1), (1, 3), (2, 1), (2, 3), (3, 1), (3, 3),
    ]  # fmt: skip


def test_source_without_effect_has_no_unbounded_limit() -> None:
    sources = ({"cell": np.array([0.5]), "table": np.array([0.0])},)
    limits = Contribution(SENSITIVITY, "B", np.array([[np.inf]]), sources=sources).limits()
    assert limits.ravel().tolist() == [np.inf, 0.0]
