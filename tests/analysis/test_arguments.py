"""Arguments of the public functions: paths and mappings are accepted; errors explain wrong types and names."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import analysis
import daq
import rig
from analysis.core.modal.modes import BodyShapes, Modes
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.errors import RecordingError, SceneError, ShotrigError
from rig.core.results.response import Response
from tests.analysis.responses import synthetic

SWEEP = Path(__file__).parents[2] / "recordings" / "demo-sweep-no-damper.mcap"
BRACKET = {
    "structure": {
        "masses": {"base": "4.2 kg", "arm": "1.1 kg"},
        "springs": ["839.2 kN/m", "964.4 kN/m"],
        "damping": {"modal": "0.8 %"},
    },
    "shaker": {"kind": "force", "body": "base"},
    "test": {"kind": "impulse", "body": "base", "peak": "50 N", "width": "1 ms", "interval": "1 s"},
    "channels": [
        {"name": "hammer", "at": "hammer"},
        {"name": "low", "at": "base"},
        {"name": "left", "at": "arm"},
        {"name": "right", "at": "body arm"},
    ],
    "converter": {"rate": "5120 Hz"},
}


@pytest.fixture(scope="module")
def hit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the recording of a hit on a bracket whose bodies have names."""
    return daq.record(BRACKET, tmp_path_factory.mktemp("hit") / "hit.mcap")


@pytest.mark.parametrize("kind", [Path, str])
def test_recording_can_be_given_by_path(kind: type[Path | str], tmp_path: Path) -> None:
    path = kind(synthetic.stepped_sine(tmp_path / "a.mcap", [20.0, 30.0]))
    curves = analysis.frfs(path)
    with daq.open(path) as recording:
        assert np.array_equal(curves["body3"].value, analysis.compliance(recording, "body 3").value)
        assert recording.duration == recording.samples / recording.rate
    assert curves.keys() == ("body1", "body2", "body3")
    assert len(analysis.frequency_responses(path, ["body1"])) == 1
    assert analysis.sep005(path, ["body1"], 0.0, 0.1)[0]["name"] == "body1"


def test_mac_compares_identified_modes() -> None:
    modes = analysis.identify(analysis.frfs(SWEEP))
    assert np.array_equal(analysis.mac(modes, modes), analysis.mac(modes.shapes, modes.shapes))
    assert np.diag(analysis.mac(modes, modes)) == pytest.approx(1.0)


@pytest.fixture(scope="module")
def hit_responses(hit: Path) -> Response:
    return analysis.frfs(hit)


def test_response_can_be_selected_by_body(hit: Path, hit_responses: Response) -> None:
    curves = analysis.frfs(hit, ["base", "left"])
    assert curves.keys() == ("low", "left") and curves["arm"].response == "left"
    assert analysis.decay(hit, "arm").channel == "left"
    with pytest.raises(SceneError, match=r"2 responses are at arm\. Select one by its channel: left or right"):
        hit_responses["arm"]


def test_recorded_scene_has_body_names(hit: Path) -> None:
    with daq.open(hit) as recording:
        assert recording.scene == rig.load(BRACKET)
        assert recording.scene.structure.names == ("base", "arm")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: analysis.frfs(7), "frfs: got 7; expected a recording: its path"),
        (lambda: analysis.decay(None), "decay: got None; expected a recording"),
        (lambda: analysis.frfs("nothing.mcap"), "nothing.mcap: no such file"),
        (lambda: analysis.frfs(SWEEP, ["bdy3"]), "Did you mean 'body3'"),
        (lambda: analysis.frfs(SWEEP, 7), "channels: got 7; expected a list of names"),
        (lambda: analysis.frfs(SWEEP, motion="accel"), "motion: got 'accel'; expected displacement"),
        (lambda: analysis.frfs(SWEEP, ["body1"])["boby1"], "no response 'boby1'. Did you mean 'body1'"),
        (lambda: analysis.identify(SWEEP), "expected several curves, as analysis.frfs"),
        (lambda: analysis.identify([]), "got []; expected several curves"),
        (lambda: analysis.read_frfs(7), "path: got 7; expected the path of a file"),
        (lambda: analysis.fit(7, "bare-structure"), "fit: got 7; expected a recording: its path"),
        (lambda: analysis.modes(7), "recordings: got 7; expected a recording: its path"),
        (lambda: analysis.compare([SWEEP, None]), "recordings: got None; expected a recording"),
        (lambda: analysis.report([]), "report: no recordings"),
        (lambda: analysis.export([SWEEP, SWEEP], "a.npz"), "recording: got 2 recordings; expected one"),
        (lambda: analysis.fit(SWEEP, 7), "scene: got 7; expected a name, a path, a mapping or a rig.Scene"),
        (lambda: analysis.mac(np.eye(2), np.eye(3)), "expected two matrices with one row for each point"),
        (
            lambda: analysis.mac(analysis.frf(SWEEP), analysis.frf(SWEEP)),
            "mac: got Results; expected modes or their shapes, such as analysis.identify(frfs)",
        ),
        (
            lambda: analysis.mac(analysis.frfs(SWEEP), analysis.frfs(SWEEP)),
            "mac: got Response; expected modes or their shapes, such as analysis.identify",
        ),
        (lambda: daq.open(7), "path: got 7; expected the path of a file"),
        (lambda: daq.open(SWEEP).read("body4"), "no channel 'body4'. Did you mean 'body"),
        (lambda: daq.record(BRACKET, 7), "path: got 7; expected the path of a file"),
        (lambda: daq.record("fig99", "a.mcap"), "Did you mean 'fig9'"),
        (lambda: daq.recover(None, "a.mcap"), "path: got None; expected the path of a file"),
        (lambda: daq.import_files(7, "fig9", "a.mcap"), "files: got 7; expected the path of a file"),
        (lambda: rig.explain(7), "scene: got 7; expected a name"),
        (lambda: rig.Plant("fig99"), "Did you mean 'fig9'"),
        (lambda: rig.Plant(BRACKET, "5 V"), "is not a unit of sample rate"),
        (lambda: daq.Recorder("a.mcap", 7, [ChannelInfo("a", "body 1", "force", 1.0, 9.0)], 9.0), "scene: got 7"),
        (lambda: daq.Recorder("a.mcap", BRACKET, [], 9.0), "a.mcap: no channels"),
        (lambda: rig.simulate(BRACKET, None), "`duration`: got None"),
        (lambda: rig.simulate(BRACKET, object()), "is not a number; expected a time such as 4 ms"),
        (lambda: rig.periodic_orbit("fig9", None), "frequency: got nan"),
        (lambda: rig.follow_orbits("fig9", "frequency", 60), "bounds: got 60"),
        (lambda: rig.approximate_response(BRACKET, 1, 60), "band: got 60 Hz; expected two values"),
        (lambda: rig.approximate_response(BRACKET, "1", (50, 60)), "mode: got '1'; expected the number of a mode"),
        (lambda: rig.approximate_response(BRACKET, 1, (50, 60), at="amr"), "Did you mean 'arm'"),
        (lambda: rig.approximate_response(BRACKET, 1, (50, 60), at=3), "body 3 does not exist"),
        (lambda: rig.design(BRACKET, bodies=["amr"]), "bodies: no body has the name 'amr'. Did you mean 'arm'"),
        (lambda: rig.loads(7), "got 7; expected the text of a scene file"),
    ],
)
def test_wrong_argument_is_explained(call: Any, message: str) -> None:
    with pytest.raises(ShotrigError) as error:
        call()
    assert message in str(error.value)


@pytest.mark.thorough
def test_fit_parameter_can_be_named_by_body(hit: Path) -> None:
    result = analysis.fit(hit, BRACKET, ["structure.masses.arm"])
    assert result["structure.masses.arm"].value == pytest.approx(1.1, rel=0.02)
    with pytest.raises(SceneError, match=r"Did you mean 'structure.masses.arm'"):
        result["structure.mass.arm"]


def test_shapes_of_bodies_average_their_sensors(hit_responses: Response) -> None:
    modes = analysis.identify([curve.between("40 Hz", "200 Hz") for curve in hit_responses], 2)
    bodies = modes.of_bodies()
    assert modes.responses == ("low", "left", "right") and bodies.names == ("base", "arm")
    # Eigenvectors of the bracket (base of each mode), scaled so that the arm is 1.
    assert bodies.shapes[0] == pytest.approx([0.827, -0.3167], abs=0.01)
    assert abs(bodies.shapes).max(axis=0) == pytest.approx(1.0)


def test_shapes_have_the_signs_of_the_baseline() -> None:
    shapes, bounds = np.array([[0.9, 1.0], [1.0, -0.5]], dtype=complex), np.zeros((2, 2))
    baseline = BodyShapes(("base", "arm"), shapes, bounds)
    other = BodyShapes(("base", "arm"), shapes[:, ::-1] * [-1.0, 1.0], bounds)
    assert other.with_signs_of(baseline).shapes.real == pytest.approx(shapes[:, ::-1].real)
    assert other._replace(names=("a", "b")).with_signs_of(baseline).shapes is other.shapes


def test_average_of_sensors_is_weighted_by_variance() -> None:
    # Two sensors on body 2 with standard uncertainties of 0.01 and 0.1.
    zeros = np.zeros(2)
    modes = Modes(
        frequency=np.array([10.0]), frequency_std=zeros[:1], damping=zeros[:1], damping_std=zeros[:1],
        shape_std=np.array([[0.0], [0.01], [0.1]]), residue=np.array([[1.0 + 0j], [0.5], [0.61]]),
        responses=("a", "b", "c"), chart=(), lower=np.zeros(3), upper=np.zeros((3, 3)), model_error=0.0,
        label="", warnings=(), places=("body 1", "body 2", "body 2"),
    )  # fmt: skip
    bodies = modes.of_bodies()
    assert bodies.names == ("a", "body 2")
    in_order = replace(modes, places=("arm", "base", "base"), bodies=(2, 1, 1)).of_bodies()
    assert in_order.places == ("base", "arm")
    # The weights are 1 / error², 100 to 1.
    assert bodies.shapes[1, 0].real == pytest.approx(0.5 + 0.11 / 101)
    assert bodies.errors[1, 0] == pytest.approx(0.01, rel=0.01)


def test_unknown_body_of_a_recording_is_rejected(hit: Path) -> None:
    with pytest.raises(RecordingError, match="no channel 'amr'"):
        analysis.compliance(hit, "amr")
