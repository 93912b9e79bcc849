"""Unphysical scenes are rejected before a simulation, with all errors at once."""

from contextlib import nullcontext

import pytest
from hypothesis import given
from hypothesis import strategies as st

import daq
import rig
from rig.core.base.errors import RunError, SceneWarning
from rig.core.scene.loading import loads_si
from tests.rig.scene.test_scene_mistakes import error_of

# Positive definite stiffness matrix, N/m.
GROUNDED_STIFFNESS = "[[3, -1], [-1, 2]]"


def structure_text(stiffness: str, damping: str = "[[0, 0], [0, 0]]") -> str:
    """Return a scene with masses of 1 kg and 2 kg and the given matrices, in SI units."""
    return f"structure: {{matrices: {{mass: [[1, 0], [0, 2]], stiffness: {stiffness}, damping: {damping}}}}}"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (structure_text("[[-1000, 0], [0, 1000]]"), "structure.matrices.stiffness: not positive semidefinite"),
        (structure_text("[[1, 2], [2, 1]]"), "squared natural frequency -0.6"),
        (
            structure_text(GROUNDED_STIFFNESS, "[[-1, 0], [0, 1]]"),
            "structure.matrices.damping: negative damping: at 0.2",
        ),
        (structure_text(GROUNDED_STIFFNESS, "[[-50, 0], [0, 1]]"), "the free motion grows"),
        (
            "structure: {masses: [1 kg], springs: [1 kN/m], damping: {modal: 5}}",
            "structure.damping.modal: got 5, which is 500 % of critical; expected at most 100 %, such as 5 %",
        ),
        (
            "structure: {masses: [1 kg, 1 kg], springs: [1 kN/m, 1 kN/m], damping: {modal: [1 %, 120 %]}}",
            "structure.damping.modal[2]: got 1.2",
        ),
    ],
)
def test_impossible_structure_is_rejected_with_its_reason(text: str, message: str) -> None:
    assert message in error_of(text)


def test_stable_general_damping_matrix_is_accepted() -> None:
    # The antisymmetric (gyroscopic) part of the first matrix does no work. The second matrix is indefinite, but every
    # free motion decays.
    for damping in ("[[0.1, 5], [-5, 0.1]]", "[[0.3, 0.32], [0.32, 0.3]]"):
        assert rig.loads(structure_text(GROUNDED_STIFFNESS, damping)).structure.bodies == 2


def test_free_structure_may_move_as_rigid_body() -> None:
    assert rig.loads(structure_text("[[1000, -1000], [-1000, 1000]]")).structure.bodies == 2


def test_implausible_clearance_without_unit_causes_warning() -> None:
    chain = "structure: {masses: [1 kg], springs: [1 kN/m]}\ndampers: [{body: 1, mass: 1 g, clearance: %s}]"
    with pytest.warns(
        SceneWarning, match=r"scene:2: dampers\[1\].clearance: got 0.98 .* \(980 mm\). Add .* such as 0.98 mm"
    ):
        rig.loads(chain % "0.98")
    for clearance in ("0.98 m", "0.00098", ".inf", "0"):
        rig.loads(chain % clearance)


def test_tolerance_in_percent_without_unit_causes_warning() -> None:
    with pytest.warns(SceneWarning, match=r"test.settle.tolerance: got 2 without a unit.* such as 2 %"):
        rig.load("fig8-no-damper", {"test.settle.tolerance": 2})


CHAIN = "structure: {masses: [%s, 0.7 kg], springs: [%s, 20 kN/m]}\ndampers: [{body: 1, mass: %s, clearance: 1 mm}]"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (("0.8 kg", "2.4 mN/m", "74 g"), r"springs\[1\]: got 2.4 mN/m, .* resonates at 0.00872 Hz. .* 2.4 MN/m\?"),
        (("0.8", "2.4 mN/m", "74 g"), r"springs\[1\]: got 2.4 mN/m, .* 2.4 MN/m\?"),
        (("0.8 kg", "2.4", "74 g"), r"springs\[1\]: got 2.4 without a unit, .* such as 2.4 kN/m"),
        (("800", "24 kN/m", "99 kg"), r"masses\[1\]: got 800 without a unit, read as 800 kg: .* such as 800 g"),
        (("0.8 kg", "24 kN/m", "100"), r"dampers\[1\].mass: got 100 .*, 125 times the mass .* such as 100 g"),
        (("0.8 kg", "24 kN/m", "1.5 kg"), r"dampers\[1\].mass: got 1.5 kg, .* 1.88 times the mass .* mean 1.5 g\?"),
        (("0.8 kg", "24 kN/m", "1500 g"), r"dampers\[1\].mass: got 1500 g, .* 1.88 times the mass .* Check this value"),
        (("0.8 kg", "24 kN/m", "74 mg"), r"dampers\[1\].mass: got 74 mg, .* Did you mean 74 g\?"),
    ],
)
def test_improbable_spring_or_mass_names_likely_intent(values, message) -> None:
    with pytest.warns(SceneWarning, match=message):
        rig.loads(CHAIN % values)


def test_scene_of_a_recording_is_not_checked_for_units() -> None:
    structure = "structure: {masses: [22 kg, 55 kg], springs: [60 kN/m, 48 kN/m], damping: {modal: 12 %}}"
    scene = rig.loads(structure + "\ndampers: [{body: 1, mass_ratio: 300 %, clearance: 20 cm}]")
    assert loads_si(scene.to_si_yaml(), "scene.yaml") == scene


def test_soft_spring_among_si_values_is_accepted() -> None:
    rig.loads("structure: {masses: [0.8, 0.7], springs: [10, 24000]}")
    rig.loads("structure: {masses: [0.8 kg, 0.7 kg], springs: [10, 24000]}")


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (("width: 4 s", "sensitivity: 100 mV/g"), r"test.width: got 4 s, .* Did you mean 4 ms\?"),
        (("width: 4 ms", "sensitivity: 100"), r"accelerometer.sensitivity: got 100 without .* such as 100 mV/g"),
        (("width: 4 ms", "resonance: 30"), r"accelerometer.resonance: got 30 without .* such as 30 kHz"),
        (("width: 4 ms", "noise: 20"), r"accelerometer.noise: got 20 without .* such as 20 ug/sqrt\(Hz\)"),
    ],
)
def test_improbable_pulse_or_sensor_names_likely_intent(keys, message) -> None:
    pulse, sensor = keys
    test = f"test: {{kind: impulse, body: 1, peak: 50 N, interval: 9 s, {pulse}}}"
    channel = f"channels: [{{name: a, at: body 1, accelerometer: {{{sensor}}}}}]"
    with pytest.warns(SceneWarning, match=message):
        rig.loads("\n".join([CHAIN % ("0.8 kg", "24 kN/m", "74 g"), test, channel]))


@pytest.mark.parametrize(
    ("damping", "message"),
    [
        ("damping: {modal: 0.5}", r"structure.damping.modal: got 0.5 .* \(50 %\). Add .* such as 0.5 %"),
        ("damping: {modal: [0.5 %, 0.3]}", r"structure.damping.modal\[2\]: got 0.3 .*\(30 %"),
        ("damping: {modal: 50 %}", None),
        ("damping: {modal: 0.005}", None),
    ],
)
def test_damping_ratio_like_a_percentage_causes_warning(damping, message) -> None:
    chain = f"structure: {{masses: [1 kg, 1 kg], springs: [1 kN/m, 1 kN/m], {damping}}}"
    with pytest.warns(SceneWarning, match=message) if message else nullcontext():
        rig.loads(chain)


DIVERGING_SCENE = """
# Stable without the damper, unstable with its mass in body 2.
structure:
  matrices: {mass: [[1, 0], [0, 2]], stiffness: [[3000, -1000], [-1000, 2000]], damping: [[-8, -19], [-18, 21.5]]}
dampers: [{body: 2, mass: 1 kg, clearance: 1 mm}]
shaker: {kind: force, body: 1}
test: {kind: sine, frequency: 3 Hz, force: 1 N, duration: 60 s}
recording: {display: false}
"""


def test_diverging_motion_stops_with_time_and_quantity(tmp_path) -> None:
    scene = rig.loads(DIVERGING_SCENE)
    # The negatively damped mode reaches 1000 km after 10 to 20 s.
    message = r"diverges: the displacement of body [12] is [0-9.]+e\+06 m at 1[0-9][0-9.]* s"
    with pytest.raises(RunError, match=message):
        rig.simulate(scene, 60.0)
    with pytest.raises(RunError, match=message):
        daq.record(scene, tmp_path / "a.mcap")


INVALID_SETTINGS = st.sampled_from(
    ["clearance: -1 mm", "clearance: 3 kg", "clearance: soon", "locked: maybe, clearance: 1 mm"]
)


@given(body=st.integers(3, 999), setting=INVALID_SETTINGS)
def test_unknown_bodies_are_reported_with_other_mistakes(body: int, setting: str) -> None:
    message = error_of(
        "structure: {masses: [1 kg, 2 kg], springs: [1 kN/m, 1 kN/m]}\n"
        f"dampers: [{{body: {body}, mass: 1 g, {setting}}}]\n"
        f"shaker: {{kind: table, body: {body}, spring: 0 N/m}}\n"
        f"channels: [{{name: a, at: body {body}, hammer: {{}}}}]\n"
    )
    assert message.count(f"body {body} does not exist") == 3
    assert len(message.splitlines()) == 6
