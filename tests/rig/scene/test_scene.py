"""Scenes: the documented format, the bundled scenes, and changed copies.

A scene is the description of a test rig and a test. Loading converts its quantities to SI units. "The paper" is Inoue,
Yokomichi and Hiraki (2011).
"""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import rig
from rig.core.base.errors import SceneError
from rig.core.scene.excitation import Impulse, Sine, SteppedSine
from rig.core.scene.scene import STANDARD_GRAVITY
from rig.core.scene.scene_files import bundled_scenes, summary
from rig.core.scene.shaker import ElectrodynamicShaker, ForceShaker, TableShaker
from rig.core.scene.structure import Dashpots, ModalDamping, RayleighDamping

TYPICAL_SCENE = """
name: three dampers, no ceiling
structure:
  masses: [0.74 kg, 0.71 kg, 0.64 kg]          # body 1 first
  springs: [24.3 kN/m, 21.8 kN/m, 19.8 kN/m]   # spring j: body j to body j-1, ground for j = 1
  damping: {modal: 0.5 %}
gravity: 9.80665 m/s^2
dampers:
  - {body: 1, mass_ratio: 10 %, clearance: .inf}
  - {body: 2, mass_ratio: 10 %, clearance: .inf}
  - {body: 3, mass_ratio: 10 %, clearance: .inf}
shaker:
  kind: table
  body: 1
  spring: 6.6 kN/m
test:
  kind: stepped_sine
  start: settled
  from: 8 Hz
  to: 60 Hz
  points: 150
  force: 2.6 N
  direction: up
channels:
  - {name: body1, at: body 1, accelerometer: {sensitivity: 100 mV/g, noise: 20 ug/sqrt(Hz), resonance: 30 kHz,
     low_cutoff: 0.5 Hz}, integrator: {order: 2, corner: 1 Hz}}
converter: {rate: 5120 Hz, bits: 24, range: 5 V}
recording: {display: true, truth: false}
seed: 1
"""
MINIMAL = "structure: {masses: [1 kg], springs: [1 kN/m]}\n"


def test_typical_scene_loads_in_si_units() -> None:
    scene = rig.loads(TYPICAL_SCENE)
    assert scene.name == "three dampers, no ceiling"
    assert scene.structure.masses == (0.74, 0.71, 0.64)
    assert scene.structure.springs == (24300.0, 21800.0, 19800.0)
    assert scene.structure.damping == ModalDamping(modal=0.005)
    assert scene.structure.bodies == 3
    assert scene.gravity == STANDARD_GRAVITY
    assert [damper.body for damper in scene.dampers] == [1, 2, 3]
    assert scene.dampers[0].mass_ratio == 0.1
    assert scene.dampers[0].clearance == math.inf
    assert scene.dampers[0].restitution == 0.0
    assert scene.shaker == TableShaker(body=1, spring=6600.0)
    assert isinstance(scene.test, SteppedSine)
    assert (scene.test.from_, scene.test.to, scene.test.points, scene.test.force) == (8.0, 60.0, 150, 2.6)
    assert scene.channels is not None
    (channel,) = scene.channels
    assert channel.accelerometer is not None and channel.integrator is not None
    assert channel.accelerometer.sensitivity == pytest.approx(0.1 / 9.80665, rel=1e-15)
    assert channel.accelerometer.noise == pytest.approx(20e-6 * 9.80665, rel=1e-15)
    assert (channel.accelerometer.resonance, channel.accelerometer.low_cutoff) == (30e3, 0.5)
    assert (channel.integrator.order, channel.integrator.corner) == (2, 1.0)
    assert (scene.converter.rate, scene.converter.bits, scene.converter.range) == (5120.0, 24, 5.0)
    assert (scene.recording.display, scene.recording.truth, scene.seed) == (True, False, 1)


@pytest.mark.parametrize(
    ("written", "damping"),
    [
        ("{modal: [0.5 %, 1 %, 2 %]}", ModalDamping(modal=(0.005, 0.01, 0.02))),
        ("{rayleigh: {alpha: 0.1 1/s, beta: 1e-5 s}}", RayleighDamping(rayleigh={"alpha": 0.1, "beta": 1e-5})),
        ("{dashpots: [0.5 N s/m, 0.4 N s/m, 0.3 N s/m]}", Dashpots(dashpots=(0.5, 0.4, 0.3))),
    ],
)
def test_each_form_of_damping_is_loaded(written: str, damping: object) -> None:
    scene = rig.loads(TYPICAL_SCENE.replace("{modal: 0.5 %}", written))
    assert scene.structure.damping == damping


def test_tone_and_impulse_tests_are_loaded() -> None:
    tone = rig.loads(
        MINIMAL
        + "shaker: {kind: force, body: 1}\ntest: {kind: sine, frequency: 218.8 rad/s, force: 2.6 N, start: empty}"
    )
    assert isinstance(tone.test, Sine) and isinstance(tone.shaker, ForceShaker)
    assert tone.test.frequency * 2.0 * math.pi == pytest.approx(218.8, rel=1e-15)
    assert (tone.test.start, tone.test.duration, tone.shaker.bodies) == ("empty", 2.0, (1,))
    hit = rig.loads(MINIMAL + "test: {kind: impulse, body: 1, peak: 50 N, width: 4 ms, repeats: 3, interval: 6 s}")
    assert hit.test == Impulse(body=1, peak=50.0, width=0.004, repeats=3, interval=6.0)


def test_electrodynamic_shaker_has_default_properties() -> None:
    scene = rig.loads(MINIMAL + "shaker: {kind: electrodynamic, body: 1, spring: 6.6 kN/m, amplifier: {limit: 40 V}}")
    shaker = scene.shaker
    assert isinstance(shaker, ElectrodynamicShaker)
    assert (shaker.coil.resistance, shaker.coil.inductance, shaker.coil.force_factor) == (2.0, 0.2e-3, 10.0)
    assert (shaker.armature.mass, shaker.armature.stiffness, shaker.armature.damping) == (0.25, 8e3, 8.0)
    assert (shaker.amplifier.mode, shaker.amplifier.gain, shaker.amplifier.limit) == ("voltage", 1.0, 40.0)


def test_every_sensor_key_is_loaded() -> None:
    scene = rig.loads(
        MINIMAL
        + """
test: {kind: impulse, body: 1, peak: 50 N, width: 4 ms, repeats: 2, double_hit: {hits: [2], after: 10 ms}}
channels:
  - name: body1
    at: body 1
    accelerometer: &sensor {sensitivity: 100 mV/g, sensitivity_tolerance: 5 %, resonance: 30 kHz, q: 40,
      low_cutoff: 0.5 Hz, noise: 20 ug/sqrt(Hz), noise_corner: 10 Hz, bias: 10 mV, bias_settling: 2 s,
      transverse: 5 %, lateral: 20 %, saturation: 50 g, overload_recovery: 10 us,
      temperature_drift: 0.05 %/K, temperature_change: 12 K}
    integrator: {order: 1, corner: 1 Hz, gain: 100, noise: 50 nV/sqrt(Hz), saturation: 10 V}
    alarm: 0.1 m/s
    abort: 200 mm/s
  - {name: again, at: body 1, accelerometer: *sensor}
  - {name: preset, at: body 1, accelerometer: {preset: PCB 352C33, noise_corner: 10 Hz}}
  - {name: hammer, at: hammer, hammer: {sensitivity: 2.25 mV/N, sensitivity_tolerance: 15 %,
     noise: 1 mN/sqrt(Hz), low_cutoff: 5 mHz, saturation: 2 kN}, abort: 1 kN}
converter: {preset: NI 9234, rate: 51.2 kHz, bits: 24, range: 5 V, noise: 1 uV/sqrt(Hz), coupling: AC,
  ac_corner: 0.5 Hz, excitation: 2 mA, filter: delta_sigma, remove_delay: on, skew: 1 us, clock_error: -5 ppm,
  jitter: 0.01 ns, dropped_blocks: [{at: 1.5 s, samples: 1024}]}
recording: {samples: counts}
"""
    )
    assert scene.channels is not None
    assert scene.channels[1].accelerometer == scene.channels[0].accelerometer
    assert scene.channels[0].abort == 0.2
    assert scene.channels[0].accelerometer is not None
    assert scene.channels[0].accelerometer.saturation == pytest.approx(50 * STANDARD_GRAVITY)
    assert (scene.channels[0].body, scene.channels[3].body) == (1, None)
    assert scene.converter.remove_delay is True
    assert scene.converter.clock_error == -5e-6
    assert isinstance(scene.test, Impulse) and scene.test.double_hit is not None
    assert scene.test.double_hit.hits == (2,)


@pytest.mark.parametrize(
    ("written", "value"), [("1e-5", 1e-5), ("010", 10.0), ("1_000", 1000.0), ("1.5e3 N/m", 1500.0)]
)
def test_numbers_that_yaml_misreads_load_as_written(written: str, value: float) -> None:
    scene = rig.loads(f"structure: {{masses: [1e-5], springs: [{written}]}}")
    assert scene.structure.springs == (value,)


@pytest.mark.parametrize("name", ["off", "2024-01-01", "1:30", "1e5", "true", "007", "a#b", "Ω µ"])
def test_names_that_yaml_misreads_stay_names(name: str) -> None:
    scene = rig.loads(f"name: {name}\n{MINIMAL}")
    assert scene.name == name
    assert rig.loads(scene.to_yaml()) == scene


@pytest.mark.parametrize(("written", "value"), [("on", True), ("yes", True), ("false", False), ("off", False)])
def test_yaml_booleans_in_words_are_loaded(written: str, value: bool) -> None:
    assert rig.loads(f"{MINIMAL}recording: {{truth: {written}}}").recording.truth is value


def test_stepped_sine_order_follows_direction_and_spacing() -> None:
    up = SteppedSine.model_validate({"from": 8, "to": 60, "points": 5, "force": [1.0, 2.0]})
    assert up.order == (8.0, 21.0, 34.0, 47.0, 60.0)
    assert up.levels == (1.0, 2.0)
    assert up.replace(direction="down").order == up.order[::-1]
    assert up.replace(direction="both").order == up.order + up.order[::-1]
    np.testing.assert_allclose(up.replace(spacing="log").order, np.geomspace(8.0, 60.0, 5), rtol=1e-14)
    listed = SteppedSine(frequencies=(10.0, 11.5), drive=0.3)
    assert (listed.order, listed.levels) == ((10.0, 11.5), (0.3,))


@pytest.mark.parametrize(
    "name", [name for name in bundled_scenes() if not name.startswith(("continuation", "fe-beam", "shaker-table"))]
)
def test_paper_scene_has_the_structure_of_the_paper(name: str) -> None:
    structure = rig.load(name).structure
    assert structure.masses == (0.74, 0.71, 0.64)
    assert structure.springs == (24300.0, 21800.0, 19800.0)


@pytest.mark.parametrize("name", bundled_scenes())
def test_bundled_scene_is_described_and_writable(name: str) -> None:
    scene = rig.load(name)
    assert scene.test is not None
    assert len(summary(name)) > 20
    assert rig.loads(scene.to_yaml()) == scene


def test_bundled_scenes_cover_the_settings_of_the_paper() -> None:
    expected_names = {"bare-structure", "fig9", "fig10a", "reference-A", "reference-B", "reference-C"}
    expected_names |= {f"fig8-{word}" for word in ("no-damper", "one-damper", "two-dampers", "three-dampers")}
    expected_names |= {"fig5-single-damper", "fig5-three-dampers", "fig10b-no-damper", "fig10b-three-dampers"}
    assert expected_names <= set(bundled_scenes())


@pytest.mark.parametrize(
    ("name", "force", "omega", "bodies", "ratio", "clearance"),
    [
        ("reference-A", 2.6, 218.8, [1, 2, 3], 0.1, math.inf),
        ("reference-B", 3.3, 312.4, [2], 0.06, 0.98e-3),
        ("reference-C", 10.0, 312.4, [1, 2, 3], 0.1, 1e-3),
    ],
)
def test_reference_case_is_the_published_problem(name, force, omega, bodies, ratio, clearance):
    scene = rig.load(name)
    # A damping ratio of 0.5 % at the first natural frequency, 81.9 rad/s.
    assert scene.structure.damping == RayleighDamping(rayleigh={"beta": 2 * 0.005 / 81.9})
    assert isinstance(scene.test, Sine) and isinstance(scene.shaker, ForceShaker)
    assert scene.shaker.bodies == (1,)
    assert (scene.test.force, scene.test.start) == (force, "empty")
    assert 2.0 * math.pi * scene.test.frequency == pytest.approx(omega, rel=1e-15)
    assert scene.test.duration * scene.test.frequency == pytest.approx(100.0, rel=1e-15)
    assert [damper.body for damper in scene.dampers] == bodies
    assert {(damper.mass_ratio, damper.clearance, damper.restitution) for damper in scene.dampers} == {
        (ratio, clearance, 0.0)
    }


def test_nameless_scene_is_named_after_its_file(tmp_path: Path) -> None:
    path = tmp_path / "my rig.yaml"
    path.write_text(MINIMAL)
    assert rig.load(path).name == "my rig"
    assert rig.load(str(path)) == rig.load(path)


def test_matrix_files_are_read_and_written_inline(tmp_path: Path) -> None:
    mass = np.array([[2.0, 0.1], [0.1, 1.0]])
    stiffness = np.array([[3e4, -1e4], [-1e4, 1e4]]) / 3.0
    np.save(tmp_path / "M.npy", mass)
    np.save(tmp_path / "K.npy", stiffness)
    (tmp_path / "s.yaml").write_text("structure: {matrices: {mass: M.npy, stiffness: K.npy}}\n")
    scene = rig.load(tmp_path / "s.yaml")
    assert scene.structure.matrices is not None
    np.testing.assert_array_equal(scene.structure.matrices.mass, mass)
    np.testing.assert_array_equal(scene.structure.matrices.stiffness, stiffness)
    assert rig.loads(scene.to_yaml()) == scene


def test_changed_copy_is_checked_and_original_unchanged() -> None:
    scene = rig.load("fig9")
    changed_scene = scene.replace(gravity="0 m/s^2", dampers=())
    assert (changed_scene.gravity, changed_scene.dampers) == (0.0, ())
    assert len(scene.dampers) == 1
    with pytest.raises(SceneError, match=r"Scene: dampers\[1\]\.body: body 4 does not exist"):
        scene.replace(dampers=[{"body": 4, "mass": "10 g", "clearance": "1 mm"}])
    assert scene.test is not None
    with pytest.raises(SceneError, match=r"SteppedSine: force: got -1"):
        scene.test.replace(force=-1)


def test_loaded_scene_is_frozen() -> None:
    with pytest.raises(ValueError, match="frozen"):
        rig.load("fig9").seed = 2  # type: ignore[misc]


def test_import_of_rig_loads_no_large_package() -> None:
    large_packages = "{'numba', 'pint', 'pydantic', 'matplotlib', 'scipy', 'yaml', 'numpy'}"
    code = f"import sys, rig; print(sorted({large_packages} & set(sys.modules)))"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert process.stdout.strip() == "[]"


def test_scene_in_si_units_loads_without_pint() -> None:
    text = rig.load("fig8-three-dampers").to_yaml()
    code = f"import sys, rig; rig.loads({text!r}); print('pint' in sys.modules)"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert process.stdout.strip() == "False"


def test_scene_overrides_the_preset_of_its_shaker() -> None:
    shaker = {"kind": "electrodynamic", "preset": "lds v203", "body": 1, "spring": "6.6 kN/m"}
    scene = rig.load("fig9", {"shaker": {**shaker, "coil": {"resistance": "2 ohm"}}})
    assert (scene.shaker.coil.resistance, scene.shaker.coil.inductance) == (2.0, 764e-6)
    # The data sheet specifies 178.04e-6 lbf s^2/in; 1 lbf/in is 175.1268 N/m.
    assert scene.shaker.armature.mass == pytest.approx(178.04e-6 * 175.1268, rel=1e-3)
    assert rig.loads(scene.to_yaml()) == scene and scene.replace(seed=3).shaker == scene.shaker
    with pytest.raises(SceneError, match="unknown shaker preset 'LDS V9'"):
        rig.load("fig9", {"shaker": {**shaker, "preset": "LDS V9"}})
