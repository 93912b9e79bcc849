"""Commands of rig as Python calls, and scenes built in Python."""

from collections.abc import Callable

import matplotlib.pyplot as plt
import numpy as np
import pytest

import rig
from rig.core.results.response import Response
from tests.rig.this_process import pieces_in_this_process

# A scene of two bodies that a force drives near the first natural frequency, 19.7 Hz.
STRUCTURE = {"masses": ["1 kg", "1 kg"], "springs": ["40 kN/m", "40 kN/m"], "damping": {"modal": "1 %"}}
DAMPER = {"body": 2, "mass": "20 g", "clearance": "0.5 mm"}
EXCITATION = {"shaker": {"kind": "force", "body": 1}, "test": {"kind": "sine", "frequency": "20 Hz", "force": "2 N"}}


def test_scene_built_in_python_survives_yaml() -> None:
    scene = rig.Scene(structure=rig.Structure(**STRUCTURE), dampers=[rig.Damper(**DAMPER)], **EXCITATION)
    assert scene.dampers[0].clearance == 0.5e-3
    assert rig.loads(scene.to_yaml()) == scene
    assert "0.5 mm" in scene.to_yaml()


def test_plant_takes_the_name_of_a_scene() -> None:
    plant, expected = rig.Plant("fig9"), rig.simulate("fig9", "5 ms", drive=np.ones((1, 20)))
    assert np.array_equal(plant.advance(np.ones((1, 20))).displacement, expected.displacement)


def test_scene_built_in_python_names_all_mistakes() -> None:
    with pytest.raises(rig.SceneError) as caught:
        rig.Scene(structure=STRUCTURE, dampers=[DAMPER | {"body": 7}, DAMPER | {"clearence": 1}])
    message = str(caught.value)
    assert "dampers[1].body: body 7 does not exist" in message
    assert "dampers[2].clearence: unknown key 'clearence'. Did you mean 'clearance'?" in message


def test_computed_responses_share_axes() -> None:
    scene = rig.Scene(structure=STRUCTURE, dampers=[DAMPER], **EXCITATION)
    simulated = rig.response(scene, "18 Hz", "22 Hz", 3)
    orbits = rig.orbit_response(scene, simulated.frequency)
    assert isinstance(simulated.response, Response)
    assert np.array_equal(simulated.response["body 2"].value, simulated.compliance[1])
    assert simulated.response["body 2"].value == pytest.approx(orbits.response["body 2"].value, rel=1e-5)
    axes = simulated.response.plot(orbits.response)
    assert len(axes.lines) == 4  # two responses of two bodies
    plt.close(axes.figure)


def test_explanation_is_a_table_with_a_plot() -> None:
    explanation = rig.explain(rig.Scene(structure=STRUCTURE, dampers=[DAMPER]))
    assert explanation.columns()["states"].sum() == sum(explanation.states.values())
    assert "particle dampers" in explanation._repr_html_()
    axes = explanation.plot()
    assert len(axes.patches) == len(explanation.states)
    plt.close(axes.figure)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda scene: rig.response(scene, 18.0, 22.0, 2.5), "points: got 2.5; expected a whole number of at least 2"),
        (lambda scene: rig.response(scene, 22.0, 18.0), r"got 22 Hz as `first` and 18 Hz as `last`"),
        (lambda scene: rig.map(scene, rows=2.5, first=18.0, last=22.0), "rows: got 2.5"),
        (lambda scene: rig.map(scene, points="3", first=18.0, last=22.0), "points: got '3'"),
        (lambda scene: rig.grains(scene, periods=0), "periods: got 0; expected a whole number of at least 1"),
        (lambda scene: rig.cost(scene, periods=0), "periods: got 0"),
        (lambda scene: rig.design(scene, dampers="2"), "dampers: got '2'"),
        (
            lambda scene: rig.design(scene, levels=[[1.0], [1.0, 2.0]]),
            "levels: got .*; expected one or more quantities",
        ),
        (lambda scene: rig.design(scene, band=[1j, 2j]), "band: got .*; expected one or more quantities"),
    ],
)
def test_argument_of_the_wrong_type_is_named(call: Callable[[rig.Scene], object], message: str) -> None:
    with pytest.raises(rig.SceneError, match=message):
        call(rig.Scene(structure=STRUCTURE, dampers=[DAMPER], **EXCITATION))


def test_map_and_cost_are_results() -> None:
    scene = rig.Scene(structure=STRUCTURE, dampers=[DAMPER], **EXCITATION)
    with pieces_in_this_process() as patch:
        # Each method of the study is measured once.
        patch.setattr("rig.studies.cost.motion_study.MIN_MEASURED_CPU_S", 0.0)
        map_ = rig.map(scene, rows=2, first="18 Hz", last="20 Hz", points=2)
        cost = rig.cost(scene, periods=1)
    assert map_.motion.shape == (2, map_.frequency.size)
    assert set(cost.columns()["method"]) == {point.method for _, point in cost.points}
    axes = cost.plot()
    assert axes.get_xscale() == "log"
    plt.close(axes.figure)


@pytest.mark.parametrize("kind", [{"kind": "swept_sine", "duration": "10 s"}, {"kind": "multisine", "lines": 50}])
def test_response_of_band_spans_band(kind: dict[str, str]) -> None:
    scene = rig.load("bare-structure").replace(test={"from": "8 Hz", "to": "20 Hz", "drive": "1 mm", **kind})
    response = rig.response(scene, points=7)
    assert response.frequency.tolist() == [8.0, 10.0, 12.0, 14.0, 16.0, 18.0, 20.0]
    whole = rig.response(scene).frequency
    assert (whole[0], whole[-1], whole.size) == (8.0, 20.0, 101)
