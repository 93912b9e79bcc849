"""Hits at several points with fixed sensors give the modes of one hit and sensors at these points."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import pyuff
from typer.testing import CliRunner

import analysis
from analysis.commands.cli import app
from analysis.core.modal.roving_hammer import exchange_points
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError, SceneError
from rig.core.results.response import Response

FREQUENCY = np.arange(5.0, 60.0, 0.05)
NATURAL, DAMPING = np.array([15.0, 40.0]), np.array([0.01, 0.02])
# Elements of the mass-normalized shapes at three points.
SHAPES = np.array([[0.4, -0.9], [0.8, -0.2], [1.0, 0.7]])


def receptance(point: int, sensor: int, frequency: Array = FREQUENCY) -> ComplexArray:
    s, omega = 2j * np.pi * frequency[:, None], 2 * np.pi * NATURAL
    return (SHAPES[point % 10 - 1] * SHAPES[sensor - 1] / (s**2 + 2 * DAMPING * omega * s + omega**2)).sum(axis=1)


def hit(point: int, sensor: int, frequency: Array = FREQUENCY) -> Response:
    random = np.random.default_rng(10 * point + sensor)
    value = receptance(point, sensor, frequency)
    noise = random.standard_normal(value.size) + 1j * random.standard_normal(value.size)
    value += 1e-3 * np.median(abs(value)) * noise
    return Response.curve(
        frequency, value, f"a{sensor}", output_at=f"body {sensor}", input_at=f"body {point}", label=f"hit {point}"
    )


def test_shapes_have_a_component_for_each_point() -> None:
    modes = analysis.identify(exchange_points([hit(point, 3) for point in (1, 2, 3)]))
    np.testing.assert_allclose(modes.frequency, NATURAL, rtol=1e-4)
    assert modes.places == ("body 1", "body 2", "body 3") and modes.input == "force at body 3"
    np.testing.assert_allclose(modes.shapes.real, SHAPES / [1.0, -0.9], atol=0.01)


def test_shapes_are_in_the_order_of_bodies() -> None:
    modes = analysis.identify(exchange_points([hit(point, 3) for point in (10, 2, 1)])).of_bodies()
    assert modes.names == ("body 1", "body 2", "body 10")


def test_two_fixed_sensors_are_two_references() -> None:
    exchanged = exchange_points([hit(point, sensor) for point in (1, 2, 3) for sensor in (2, 3)])
    assert exchanged.value.shape == (FREQUENCY.size, 3, 2)
    np.testing.assert_allclose(analysis.identify(exchanged).shapes.real, SHAPES / [1.0, -0.9], atol=0.01)


def test_common_lines_are_used() -> None:
    exchanged = exchange_points([hit(1, 3), hit(2, 3, FREQUENCY[100:])])
    np.testing.assert_array_equal(exchanged.frequency, FREQUENCY[100:])
    with pytest.raises(RecordingError, match="0 frequencies in common"):
        exchange_points([hit(1, 3), hit(2, 3, FREQUENCY + 0.01)])


def test_points_without_places_are_named_after_files() -> None:
    curves = [Response.curve(FREQUENCY, receptance(point, 3), "response", label=f"point{point}") for point in (1, 2, 3)]
    modes = analysis.identify(exchange_points(curves))
    assert modes.responses == ("point1", "point2", "point3")
    np.testing.assert_allclose(modes.shapes.real, SHAPES / [1.0, -0.9], atol=0.01)


def test_opposite_sign_of_phase_is_reported() -> None:
    curve = hit(2, 3)
    with pytest.raises(RecordingError, match="hit 2: the phases have the opposite sign"):
        analysis.identify([replace(curve, value=curve.value.conj())])


@pytest.mark.parametrize("pairs", [[(1, 3)], [(1, 3), (1, 3)], [(1, 3), (2, 2)]])
def test_missing_points_are_refused(pairs: list[tuple[int, int]]) -> None:
    with pytest.raises(SceneError, match="Record one file for each point, with the same sensors"):
        exchange_points([hit(*pair) for pair in pairs])


def write_uff(path: Path, points: tuple[int, ...]) -> Path:
    sets = [
        {
            "type": 58, "binary": 0, "func_type": 4, "rsp_node": 3, "rsp_dir": 3, "ref_node": point, "ref_dir": 3,
            "rsp_ent_name": "NONE", "ref_ent_name": "NONE", "id1": "FRF", "x": FREQUENCY, "data": receptance(point, 3),
            "abscissa_spacing": 1, "abscissa_spec_data_type": 18, "ordinate_spec_data_type": 8,
            "ordinate_axis_units_lab": "m", "orddenom_spec_data_type": 13, "orddenom_axis_units_lab": "N",
            "z_axis_spec_data_type": 0,
        }
        for point in points
    ]  # fmt: skip
    pyuff.UFF(str(path)).write_sets(sets)
    return path


def test_universal_file_of_one_sensor_is_read(tmp_path: Path) -> None:
    response = analysis.read_frfs(write_uff(tmp_path / "a.uff", (1, 2)))
    assert response.keys() == ("node 1 +Z", "node 2 +Z") and response.input == "force at node 3 +Z"


def test_command_identifies_points_of_all_files(tmp_path: Path) -> None:
    files = [str(write_uff(tmp_path / f"h{point}.uff", (point,))) for point in (1, 2)]
    # The window of 0.8 s adds 1/(2 pi 15 Hz 0.8 s) = 1.33 % to the first damping ratio: more than (1.00 +- 0.07) %.
    result = CliRunner().invoke(app, ["modes", *files, "--roving", "--exponential-window", "100"])
    assert "force at node 3 +Z: 2 modes" in result.output and "at node 2 +Z" in result.output
    assert (tmp_path / "h1+h2-modes.csv").is_file()
    result = CliRunner().invoke(app, ["modes", files[0], "--exponential-window", "0.8"])
    assert isinstance(result.exception, SceneError) and "exponential window" in str(result.exception)
