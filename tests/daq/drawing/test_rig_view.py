"""The drawing of the rig: parts stay connected for any scene and motion.

Bodies are stacked on their springs from the ground up; each damper moves in a cavity of its body.
"""

import numpy as np
import pytest

import rig
from daq.core.drawing.rig_view import Extremes, RigMotion, RigView, exaggeration
from daq.core.drawing.stack import COIL_LENGTH, DAMPER_HEIGHT, HEADROOM, PLATE, WALL, WIDTH, cavities
from rig.core.scene.scene_files import SCENES

SCENE = rig.load("fig8-three-dampers")
CHAIN = """
name: {name}
structure: {{masses: [1 kg, 2 kg, 1 kg, 2 kg], springs: [10 kN/m, 10 kN/m, 0 N/m, 10 kN/m]}}
dampers: [{{body: 2, mass: 50 g, clearance: 1 mm}}, {{body: 4, mass: 50 g, clearance: 2 mm, locked: true}}]
shaker: {shaker}
"""


def random_motion(scene, amplitude_m, seed=0, instants=50):
    """Return a random motion of all parts: displacements up to an amplitude, and gaps from 0 to it."""
    noise = np.random.default_rng(seed)
    bodies, dampers = scene.structure.bodies, len(scene.dampers)
    return RigMotion(
        displacement=amplitude_m * noise.uniform(-1, 1, (bodies, instants)),
        tables=amplitude_m * noise.uniform(-1, 1, (len(scene.tables), instants)),
        gap=amplitude_m * noise.uniform(0, 1, (dampers, instants)),
    )


def draw(scene, motion):
    """Return the view, and for each moving part its heights in m and its scale factors."""
    extremes = Extremes().extended_by(motion, [shaker.first_body for _, shaker in scene.tables])
    view = RigView(scene, extremes, gaps_known=True)
    parts = {entity: (translation[:, 2], scale) for entity, translation, scale in view.moving_parts(motion)}
    return view, parts


def test_stop_hangs_above_the_lower_body_by_its_gap():
    scene = SCENE.replace(joints=[{"between": [1, 2], "gap": 1e-4, "stiffness": 1e5}])
    view, _ = draw(scene, random_motion(scene, 1e-3))
    [block] = view.stack.blocks
    (_, _, middle), (_, _, height) = block.box
    top_of_lower = view.stack.bottoms[0] + view.stack.heights[0]
    assert block.entity == "rig/body_2/joint_1"
    assert view.stack.bottoms[1] + middle - height / 2 - top_of_lower == pytest.approx(1e-4 * view.exaggeration)
    assert middle + height / 2 == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("between", [[2, 1], [1, "ground"], ["ground", 2], ["ground", 1], [1, 3]])
def test_stop_between_any_places_is_drawn(between):
    scene = SCENE.replace(joints=[{"between": between, "gap": 1e-2, "stiffness": 1e5}])
    view, _ = draw(scene, random_motion(scene, 1e-3))
    assert all(size > 0.0 for size in view.stack.blocks[0].box[1])
    assert any(entity.endswith("joint_1") for entity, _ in view.static_parts())


def test_friction_joint_touches_both_bodies():
    scene = SCENE.replace(joints=[{"between": [1, 2], "slip_force": 3.0, "stiffness": 1e5}])
    view, _ = draw(scene, random_motion(scene, 1e-3))
    [block] = view.stack.blocks
    (_, _, middle), (_, _, height) = block.box
    assert middle + height / 2 == pytest.approx(0.0, abs=1e-12)
    assert view.stack.bottoms[1] - height == pytest.approx(view.stack.bottoms[0] + view.stack.heights[0])


@pytest.mark.parametrize("amplitude_m", [1e-6, 0.3e-3, 1e-3, 7e-3, 0.2])
def test_springs_end_at_the_parts_they_join(amplitude_m):
    motion = random_motion(SCENE, amplitude_m)
    view, parts = draw(SCENE, motion)
    ground = np.zeros(50)
    top_of_lower_part = ground
    for body in (1, 2, 3):
        lower_end, scale = parts[f"rig/spring_{body}"]
        upper_end = lower_end + scale[:, 2] * view.stack.lengths[body - 1]
        bottom_of_body = parts[f"rig/body_{body}"][0]
        np.testing.assert_allclose(lower_end, top_of_lower_part, atol=1e-12)
        np.testing.assert_allclose(upper_end, bottom_of_body, atol=1e-12)
        top_of_lower_part = bottom_of_body + view.stack.heights[body - 1]
    lower_end, scale = parts["rig/coil_spring"]
    np.testing.assert_allclose(lower_end, parts["rig/table"][0], atol=1e-12)
    np.testing.assert_allclose(lower_end + COIL_LENGTH * scale[:, 2], parts["rig/body_1"][0], atol=1e-12)


@pytest.mark.parametrize("amplitude_m", [1e-6, 0.3e-3, 1e-3, 7e-3, 0.2])
def test_parts_never_pass_through_each_other(amplitude_m):
    motion = random_motion(SCENE, amplitude_m, seed=1)
    _, parts = draw(SCENE, motion)
    for path, (height, scale) in parts.items():
        if scale is not None:
            # Springs are compressed by at most 60 % of their length.
            assert scale[:, 2].min() > 0.3, path
        if path.endswith("damper"):
            assert height.min() >= 0.0, path
            assert height.max() <= HEADROOM + 1e-12, path


def test_table_stays_above_the_ground():
    motion = RigMotion(np.zeros((3, 2)), np.array([[0.0, -0.6e-3]]), np.zeros((len(SCENE.dampers), 2)))
    assert draw(SCENE, motion)[1]["rig/table"][0].min() >= PLATE


def test_damper_at_its_ceiling_touches_it():
    scene = rig.load("fig9")
    clearance = scene.dampers[0].clearance
    motion = RigMotion(np.zeros((3, 2)), np.zeros((1, 2)), np.array([[0.0, clearance]]))
    view, parts = draw(scene, motion)
    floor_gap, ceiling_gap = parts["rig/body_2/damper"][0]
    assert floor_gap == 0.0
    [cavity] = cavities(scene.dampers, 2, view.exaggeration)
    assert cavity.ceiling == pytest.approx(WALL + DAMPER_HEIGHT + ceiling_gap)


def test_cavity_with_distant_ceiling_is_open():
    scene = SCENE.replace(dampers=[{"body": 2, "mass": "50 g", "clearance": "1 m"}])
    view, _ = draw(scene, random_motion(scene, 1e-3))
    [cavity] = cavities(scene.dampers, 2, view.exaggeration)
    assert cavity.ceiling is None


def test_two_dampers_have_separate_cavities():
    pair = [{"body": 2, "mass": f"{mass} g", "clearance": "1 mm"} for mass in (30, 20)]
    scene = SCENE.replace(dampers=[*pair, {"body": 3, "mass": "10 g", "clearance": "1 mm"}])
    _, parts = draw(scene, random_motion(scene, 1e-3))
    assert {"rig/body_2/damper_1", "rig/body_2/damper_2", "rig/body_3/damper"} <= parts.keys()
    left, right = cavities(scene.dampers, 2, 1.0)
    assert left.x + left.width / 2 + WALL == pytest.approx(right.x - right.width / 2)
    assert right.x + right.width / 2 + WALL == pytest.approx(WIDTH / 2)


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.yaml")), ids=lambda path: path.stem)
def test_bundled_scene_is_drawn_completely(path):
    scene = rig.load(path)
    view, parts = draw(scene, random_motion(scene, 1e-3))
    static_parts = [entity for entity, _ in view.static_parts()]
    assert len(static_parts) == len(set(static_parts))
    for moving in parts:
        assert any(entity == moving or entity.startswith(f"{moving}/") for entity in static_parts), moving


@pytest.mark.parametrize(
    "shaker",
    [
        "{kind: force, body: [1, 3]}",
        "{kind: table, body: 3, spring: 5 kN/m}",
        "{kind: electrodynamic, body: 1, spring: 5 kN/m}",
    ],
)
def test_other_rigs_are_drawn_without_missing_parts(shaker):
    scene = rig.loads(CHAIN.format(name="chain", shaker=shaker))
    view, parts = draw(scene, random_motion(scene, 1e-3))
    static_parts = {entity for entity, _ in view.static_parts()}
    assert "rig/spring_3" not in static_parts and "rig/spring_3" not in parts
    assert ("rig/table" in parts) == ("force" not in shaker)
    assert ("rig/body_1/drive" in static_parts) == ("force" in shaker)
    assert ("rig/body_3/lug" in static_parts) == ("body: 3" in shaker)


def test_matrices_draw_bodies_without_springs():
    matrices = {"mass": [[1.0, 0.0], [0.0, 1.0]], "stiffness": [[2e4, -1e4], [-1e4, 1e4]]}
    scene = rig.loads(f"name: given\nstructure: {{matrices: {matrices}}}\n".replace("'", ""))
    view, parts = draw(scene, random_motion(scene, 1e-3))
    assert set(parts) == {"rig/body_1", "rig/body_2"}
    assert not any("spring" in entity for entity, _ in view.static_parts())


def test_noise_at_rest_is_not_exaggerated():
    assert exaggeration(Extremes()) == 1.0
    assert exaggeration(Extremes(spring=1e-15)) <= 1e4  # the largest exaggeration


def test_lost_samples_do_not_count_as_extremes():
    motion = RigMotion(np.array([[1e-3, np.nan], [0.0, np.nan]]), np.array([[np.nan, 0.0]]), None)
    extremes = Extremes().extended_by(motion, [1])
    assert extremes.body == extremes.spring == 1e-3


def test_unmeasured_points_are_labeled():
    view = RigView(SCENE, Extremes(), gaps_known=True, unmeasured=["body 2", "table"])
    names = {path: part for path, part in view.static_parts() if path.endswith("/name")}
    texts = {path: str(part.labels.as_arrow_array()) for path, part in names.items()}
    unmeasured = {path for path, text in texts.items() if "not measured" in text}
    assert unmeasured == {"rig/body_2/name", "rig/table/name"}
