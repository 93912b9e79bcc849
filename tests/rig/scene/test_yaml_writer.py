"""A scene written to a file loads back as an identical scene."""

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

import rig
from rig.commands.cli import app
from rig.core.scene.json_schema import schema_text
from rig.core.scene.loading import loads_si
from rig.core.scene.scene import Scene
from rig.core.scene.scene_files import SCENES, bundled_scenes
from rig.core.settings.quantities import (
    ACCELERATION_NOISE,
    ACCELERATION_SENSITIVITY,
    FREQUENCY,
    LENGTH,
    RATIO,
    STIFFNESS,
    Kind,
    parse,
    shortest_notation,
)

# Magnitudes that every kind of quantity supports; the sample rate is three times a frequency.
positive = st.floats(min_value=1e-6, max_value=1e6)
frequency = st.floats(min_value=1e-6, max_value=3e7)
fraction = st.just(0.0) | st.floats(min_value=1e-12, max_value=1.0, exclude_max=True)
damping_ratio = st.floats(min_value=1e-6, max_value=1.0)
KINDS = [LENGTH, FREQUENCY, STIFFNESS, RATIO, ACCELERATION_SENSITIVITY, ACCELERATION_NOISE]
level_key = st.sampled_from(["force", "drive"])


def optional(**choices: st.SearchStrategy[Any]) -> st.SearchStrategy[dict[str, Any]]:
    """Draw a mapping with some of the given keys."""
    return st.fixed_dictionaries({}, optional=choices)


@st.composite
def excitations(draw: st.DrawFn) -> dict[str, Any]:
    """Draw a test of any kind."""
    low, high = sorted(draw(st.tuples(frequency, frequency).filter(lambda pair: pair[0] != pair[1])))
    band = {"from": low, "to": high, draw(level_key): draw(positive)}
    return draw(
        st.sampled_from(
            [
                {"kind": "sine", "frequency": low, "force": high},
                {"kind": "stepped_sine", **band, "points": 7, "settle": {"tolerance": high}},
                {"kind": "stepped_sine", "frequencies": [low, high], "force": [low, high], "direction": "both"},
                {"kind": "swept_sine", **band, "duration": draw(positive), "spacing": "linear"},
                {"kind": "random", **band, "duration": draw(positive), "burst": 0.7},
                {"kind": "multisine", **band, "lines": 31},
                {"kind": "impulse", "body": 1, "peak": draw(positive), "width": low, "interval": high},
                {"kind": "free", "mode": 1, "amplitude": draw(positive)},
            ]
        )
    )


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """Draw a scene of one to five bodies with dampers, a shaker, a test and a channel."""
    n = draw(st.integers(1, 5))
    per_body = st.tuples(*[positive] * n)
    damper = st.fixed_dictionaries(
        {"clearance": st.sampled_from([0.0, float("inf")]) | positive, "restitution": fraction, "locked": st.booleans()}
    )
    bodies = draw(st.sets(st.integers(1, n)))
    mass_key = draw(st.sampled_from(["mass", "mass_ratio"]))
    dampers = [{"body": body, mass_key: draw(positive), **draw(damper)} for body in bodies]
    accelerometer = optional(sensitivity=positive, noise=positive, low_cutoff=positive, bias=fraction)
    channel = {"name": "7", "at": f"body {n}", "accelerometer": draw(accelerometer), "abort": draw(positive)}
    spring = {"body": 1, "spring": draw(positive)}
    test = draw(st.none() | excitations())
    converter = draw(optional(rate=positive, jitter=positive, skew=st.tuples(positive)))
    # The sample rate must exceed twice the highest frequency of the test.
    tones = [value for key in ("frequency", "from", "to") if (value := (test or {}).get(key)) is not None]
    tones += (test or {}).get("frequencies", [])
    converter["rate"] = max([converter.get("rate", 5120.0), *(3.0 * tone for tone in tones)])
    return Scene(
        name=draw(st.text(st.characters(codec="utf-8", exclude_categories=["C", "Zl", "Zp"]), min_size=1)),
        structure={
            "masses": draw(per_body),
            "springs": draw(per_body),
            "damping": draw(
                st.none()
                | st.fixed_dictionaries({"modal": damping_ratio | st.tuples(*[damping_ratio] * n)})
                | st.just({"rayleigh": {"beta": 1e-7}})
            ),
        },
        gravity=draw(positive),
        dampers=dampers,
        shaker=draw(
            st.sampled_from(
                [{"kind": "table", **spring}, {"kind": "electrodynamic", **spring, "amplifier": {"mode": "current"}}]
            )
        ),
        test=test,
        channels=draw(st.none() | st.just([channel])),
        converter=converter,
        recording=draw(optional(truth=st.booleans(), samples=st.sampled_from(["float32", "float64"]))),
        seed=draw(st.integers(0, 2**63 - 1)),
    )


# A ratio is written without a unit, which causes a warning where the unit may have been forgotten.
@pytest.mark.filterwarnings("ignore::rig.core.base.errors.SceneWarning")
@settings(max_examples=40)
@given(scenes())
def test_any_scene_is_written_without_loss(scene: Scene) -> None:
    loaded = rig.loads(scene.to_yaml())
    assert loaded == scene
    assert loaded.to_yaml() == scene.to_yaml()


@settings(max_examples=40)
@given(st.integers(1, 4), st.integers(0, 2**32))
def test_any_matrices_are_written_without_loss(n: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    root = random.standard_normal((n, n))
    mass = root @ root.T + np.eye(n)
    # A dissipative (positive definite) part and a gyroscopic (antisymmetric) part.
    random_matrix = random.standard_normal((n, n))
    damping = (mass + random_matrix - random_matrix.T) * 10.0 ** random.integers(-200, 200)
    scene = Scene(structure={"matrices": {"mass": mass, "stiffness": mass / 3.0, "damping": damping}})
    assert rig.loads(scene.to_yaml()) == scene == rig.loads(scene.to_si_yaml())


def test_minus_zero_is_written_as_zero() -> None:
    channel = {"name": "a", "at": "body 1", "accelerometer": {"bias": -0.0}}
    scene = Scene(structure={"masses": (1.0,), "springs": (1.0,)}, channels=[channel])
    assert "bias: 0.0 V" in scene.to_si_yaml() and "bias: 0 V" in scene.to_yaml()
    assert rig.loads(scene.to_yaml()).to_yaml() == scene.to_yaml()


def test_si_text_has_si_units() -> None:
    text = rig.load("fig9").to_si_yaml()
    assert "springs: [24300.0 N/m, 21800.0 N/m, 19800.0 N/m]" in text
    assert "clearance: 0.00098 m" in text


# A scene file as the program writes it, in several units.
BRACKET = """name: bracket
structure:
  masses: {base: 4.20 kg, arm: 1100 g}
  springs: [1.21 MN/m, 780 N/mm]
gravity: 1 g
dampers:
- {body: arm, mass: 50 g, clearance: 0.133 mm}
shaker:
  kind: electrodynamic
  body: base
  spring: 6.6 kN/m
  amplifier: {mode: current, limit: 2000 mA}
test: {kind: stepped_sine, from: 200 rad/s, to: 9000 rpm, points: 20, drive: 0.5}
channels:
- name: a
  at: arm
  accelerometer: {sensitivity: 100 mV/g, noise: 20 ug/sqrt(Hz)}
  abort: 12 g
"""


def test_scene_keeps_units_digits_and_names() -> None:
    assert rig.loads(BRACKET).to_yaml() == BRACKET


def test_replaced_value_keeps_its_unit() -> None:
    scene = rig.loads(BRACKET)
    changed_scene = scene.replace(
        structure=scene.structure.replace(masses=(4.2, 0.9)), dampers=(scene.dampers[0].replace(clearance=0.00025),)
    )
    expected = BRACKET.replace("1100 g", "900 g").replace("0.133 mm", "0.25 mm")
    assert changed_scene.to_yaml() == expected


def test_recorded_text_is_written_in_customary_units() -> None:
    text = loads_si(rig.loads(BRACKET).to_si_yaml(), "recording").to_yaml()
    assert "{body: arm, mass: 50 g, clearance: 0.133 mm}" in text
    assert "{sensitivity: 100 mV/g, noise: 20 ug/sqrt(Hz)}" in text
    assert "converter" not in text
    assert rig.loads(text) == rig.loads(BRACKET)


def test_computed_frequency_stays_in_hertz() -> None:
    assert shortest_notation(60.50019366377975, FREQUENCY) == "60.50019366377975 Hz"


@given(positive, st.sampled_from(KINDS))
def test_written_quantity_is_parsed_without_loss(value: float, kind: Kind) -> None:
    assert parse(shortest_notation(value, kind), kind) == value
    assert parse(shortest_notation(value, kind, f"1 {kind.si}"), kind) == value


def test_packaged_schema_is_current() -> None:
    shipped = (SCENES.parent / "scene.schema.json").read_text(encoding="utf-8")
    assert json.loads(shipped) == json.loads(schema_text()), "run: rig schema > rig/core/scene/data/scene.schema.json"


def test_scene_list_has_one_described_scene_per_line() -> None:
    result = CliRunner().invoke(app, ["scenes"])
    assert result.exit_code == 0
    listed = dict(line.split("\t") for line in result.stdout.splitlines())
    assert tuple(listed) == bundled_scenes()
    assert listed["fig9"].startswith("Fig 9")


def test_printed_schema_is_json() -> None:
    result = CliRunner().invoke(app, ["schema"])
    assert json.loads(result.stdout)["title"] == "shotrig scene"
