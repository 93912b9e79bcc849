"""Frequency response matrices of two simultaneous shakers, compared with closed form: bounds, coherences and modes."""

import re

import numpy as np
import pytest
import pyuff
from scipy.io import loadmat

import analysis
import daq
import rig
from analysis.commands.presentation.comparison import compare_peaks
from analysis.commands.presentation.mode_findings import present_modes
from analysis.core.modal.modes import Modes
from analysis.core.modal.several_references import separate
from analysis.core.responses.checks.several_inputs import reciprocity
from analysis.core.responses.estimator import Blocks, Request, estimator_of
from analysis.core.responses.measurands import driven_forces
from analysis.extras.formats.results import export_results
from daq.core.excitation.station import Station
from daq.core.recording.markers import Marker
from rig.core.base.errors import RecordingError, SceneError
from rig.core.results.response import Point
from rig.core.system.structural_model import structure_matrices

pytestmark = [pytest.mark.filterwarnings("ignore::daq.RunWarning"), pytest.mark.usefixtures("few_lines")]

SCENE = """
name: two shakers
structure: {{masses: {masses}, springs: {springs}, damping: {{modal: 0.8 %}}}}
shaker: [{{kind: force, body: 1}}, {{kind: force, body: 3}}]
test: {test}
seed: {seed}
channels:
  - {{name: a1, at: body 1, accelerometer: &s {{sensitivity: 100 mV/g, noise: {noise} ug/sqrt(Hz)}}}}
  - {{name: a2, at: body 2, accelerometer: *s}}
  - {{name: a3, at: body 3, accelerometer: *s}}
  - {{name: f1, at: shaker 1, hammer: {{sensitivity: 100 mV/N}}}}
  - {{name: f3, at: shaker 2, hammer: {{sensitivity: 100 mV/N}}}}
converter: {{rate: 2048 Hz, bits: 24, range: 10 V}}
"""
RANDOM = "{kind: random, shaker: 1, also: [2], from: 8 Hz, to: 60 Hz, duration: 10 s, force: 1 N}"
MULTISINE = (
    "{kind: multisine, shaker: 1, also: [2], from: 8 Hz, to: 60 Hz, period: 2 s, periods: 4, realisations: 2, "
    "force: 1 N}"
)
MASSES, SPRINGS = "[0.74 kg, 0.71 kg, 0.64 kg]", "[24.3 kN/m, 21.8 kN/m, 19.8 kN/m]"


def record_scene(path, test, seed=0, noise=200, masses=MASSES, springs=SPRINGS):
    text = SCENE.format(test=test, seed=seed, noise=noise, masses=masses, springs=springs)
    return daq.record(rig.loads(text, where="two shakers"), path)


def exact_receptance(scene, frequency):
    """Return the receptance of all bodies to the forces on bodies 1 and 3 (frequencies, 3, 2)."""
    mass, damping, stiffness = structure_matrices(scene.structure)
    omega = 2 * np.pi * frequency[:, None, None]
    return np.linalg.inv(stiffness + 1j * omega * damping - omega**2 * mass)[:, :, [0, 2]]


def share_within_bound(response, scene):
    """Return the share of the values whose bound contains the truth."""
    exact = exact_receptance(scene, response.frequency)
    assert response.value.shape == exact.shape
    return float(np.mean(abs(response.value - exact) <= response.bound()))


def response_and_coverage(path, **options):
    """Return the response, and the share of its values whose bound contains the truth."""
    with daq.open(path) as rec:
        (response,) = analysis.frequency_responses(rec, **options)
        return response, share_within_bound(response, rec.scene)


@pytest.fixture(scope="module")
def random_path(tmp_path_factory):
    return record_scene(tmp_path_factory.mktemp("random") / "a.mcap", RANDOM)


@pytest.fixture(scope="module")
def multisine_path(tmp_path_factory):
    return record_scene(tmp_path_factory.mktemp("multisine") / "a.mcap", MULTISINE)


@pytest.fixture(scope="module")
def random_response(random_path):
    """Return the response by the local rational method, and the share of its values whose bound contains the truth."""
    return response_and_coverage(random_path)


@pytest.mark.parametrize("estimator", [None, "H1", "Hv"])
def test_bounds_contain_truth_for_random_forces(random_path, random_response, estimator):
    response, share = random_response if estimator is None else response_and_coverage(random_path, estimator=estimator)
    assert 0.9 < share < (0.99 if estimator is None else 0.999)
    assert response.coherence.shape == (response.frequency.size, 3) and np.nanmedian(response.coherence) > 0.9


def test_block_options_apply_to_several_inputs(random_path):
    with daq.open(random_path) as rec:
        (expected,) = analysis.frequency_responses(rec, ["a1"], estimator="H1")
        for options in ({"overlap": 0.5}, {"window": "hann"}):
            (response,) = analysis.frequency_responses(rec, ["a1"], **options)
            np.testing.assert_array_equal(response.value, expected.value)
        (separate,) = analysis.frequency_responses(rec, ["a1"], block=2.0, overlap=0.0)
        (overlapping,) = analysis.frequency_responses(rec, ["a1"], block=2.0)
    assert np.all(separate.degrees_of_freedom < overlapping.degrees_of_freedom)


@pytest.mark.parametrize("block", [None, 2.0])
def test_column_equals_response_to_one_input(block, tmp_path):
    text = SCENE.format(test=RANDOM.replace(", also: [2]", ""), seed=0, noise=200, masses=MASSES, springs=SPRINGS)
    with daq.open(daq.record(rig.loads(text), tmp_path / "one.mcap")) as rec:
        [expected] = analysis.frequency_responses(rec, ["a1", "a3"], block=block)
        request = Request(
            rec, ["a1", "a3"], "force", "displacement", Blocks(block=block), None, ["a1", "a3", "f1"],
            rec.markers[-1:], (Point("f1", "force", "body 1"),),
        )  # fmt: skip
        [matrix] = estimator_of("random").compute(request)
    np.testing.assert_array_equal(matrix.value, expected.value)
    np.testing.assert_array_equal(matrix.bound(), expected.bound())


def test_bounds_contain_truth_for_orthogonal_multisines(multisine_path):
    response, share = response_and_coverage(multisine_path)
    assert 0.9 < share < 0.995 and np.nanmedian(response.coherence) > 0.9


def test_multisine_of_few_lines_is_evaluated(tmp_path):
    test = MULTISINE.replace("to: 60 Hz, period: 2 s", "to: 30 Hz, period: 1 s")
    response, share = response_and_coverage(record_scene(tmp_path / "a.mcap", test))
    assert response.frequency.tolist() == [*range(8, 31)] and share > 0.9


def test_exported_elements_name_their_force(random_path, random_response, tmp_path):
    for form in ("uff", "mat"):
        export_results(random_path, tmp_path / f"frfs.{form}", "frfs")
    export_results(random_path, tmp_path / "modes.uff", "modes")
    response, _ = random_response
    np.testing.assert_array_equal(loadmat(tmp_path / "frfs.mat")["a2_f3"].ravel(), response["a2", "f3"].value)
    read_back = analysis.read_frfs(tmp_path / "frfs.uff", reference="3 +Z")
    np.testing.assert_allclose(read_back["a2"].value, response["a2", "f3"].value, rtol=1e-9)
    sets = pyuff.UFF(str(tmp_path / "modes.uff")).read_sets()
    assert next(data_set for data_set in sets if data_set["type"] == 55)["node_nums"].tolist() == [1, 2, 3]


def test_error_bars_exist_without_overloaded_realisation(multisine_path):
    with daq.open(multisine_path) as rec:
        last = [marker for marker in rec.markers if marker.kind == "measure"][-1]
        rec.markers.append(Marker("overload", last.first_sample, last.stop - 1, {"channel": "a1"}))
        (response,) = analysis.frequency_responses(rec)
    assert np.isfinite(response.error).all() and "Realization 2 omitted" in " ".join(response.warnings)


def warning_of_late_channel(path, channel):
    """Return the warning of a recording whose channel is 4 samples late from the middle on."""
    with daq.open(path) as rec:
        read, samples, first = rec.read, rec.read(channel), rec.samples // 2
        samples[first:] = samples[first - 4 : -4]
        rec.read = lambda name, start=0, stop=None: (samples if name == channel else read(name))[start:stop]
        [warning] = [text for text in analysis.frfs(rec).warnings if " on, in contrast" in text]
    return warning


@pytest.mark.parametrize("channel", ["f1", "a2"])
def test_channel_that_becomes_late_is_named(multisine_path, channel):
    assert warning_of_late_channel(multisine_path, channel).startswith(f"{channel} seems to be 2 ms late from about")


def test_late_force_blames_no_intact_response(tmp_path):
    # The delay of f3 explains the responses of this structure better than that of a3.
    masses, springs = ["0.74 kg", "0.82 kg", "1.3 kg"], ["25.2 kN/m", "25.2 kN/m", "17.1 kN/m"]
    path = record_scene(tmp_path / "a.mcap", MULTISINE, 7, masses=masses, springs=springs)
    assert re.match(r"f3 seems to be (1\.9|2) ms late from about", warning_of_late_channel(path, "f3"))


def test_late_force_is_seen_by_all_responses(tmp_path, monkeypatch):
    # The first two responses are at the same point, so they do not determine two forces.
    monkeypatch.setattr(f"{__name__}.SCENE", SCENE.replace("a2, at: body 2", "a2, at: body 1"))
    masses, springs = ["1.07 kg", "0.8 kg", "1.05 kg"], ["16.7 kN/m", "12.6 kN/m", "22.7 kN/m"]
    path = record_scene(tmp_path / "a.mcap", MULTISINE, 1, masses=masses, springs=springs)
    assert warning_of_late_channel(path, "f3").startswith("f3 seems to be 2 ms late from about")


def test_missing_experiment_omits_realisation(multisine_path):
    with daq.open(multisine_path) as rec:
        last = [marker for marker in rec.markers if marker.kind == "measure"][-1]
        rec.markers.remove(last)
        (response,) = analysis.frequency_responses(rec)
    assert "Realization 2 omitted: only 1 of its 2 experiments was recorded." in response.warnings


def test_shapes_use_the_input_that_excites_every_mode():
    shapes, participation = np.array([[1.0, 1.0], [2.0, -1.0]]), np.array([[1.0, 0.0], [0.7, 0.8]])
    zeros, residue = np.zeros(2), np.einsum("am,km->akm", shapes, participation).reshape(4, 2) + 0j
    modes = Modes(
        frequency=np.array([10.0, 20.0]), frequency_std=zeros, damping=zeros, damping_std=zeros,
        shape_std=np.zeros((4, 2)), residue=residue, responses=("a/1", "a/3", "b/1", "b/3"), chart=(),
        lower=np.zeros(4), upper=np.zeros((4, 3)), model_error=0.0, label="", warnings=(),
    )  # fmt: skip
    separated = separate(modes, ("f1", "f3"), (Point("a", place="body 1"), Point("b", place="body 3")))
    # The force f1 does not excite the second mode.
    assert separated.input == "f3"
    np.testing.assert_allclose(separated.residue, shapes * participation[1], atol=1e-12)


@pytest.mark.parametrize(("model_error", "count"), [(0.0, 2), (0.1, 1)])
def test_model_error_is_no_second_shape(model_error, count):
    residue = np.array([[1.0, 0.5], [0.5, 0.4]]).reshape(4, 1) + 0j
    zero = np.zeros(1)
    modes = Modes(
        frequency=np.array([10.0]), frequency_std=zero, damping=zero, damping_std=zero,
        shape_std=np.zeros((4, 1)), residue=residue, responses=("a/1", "a/3", "b/1", "b/3"), chart=(),
        lower=np.zeros(4), upper=np.zeros((4, 3)), model_error=model_error, label="", warnings=(),
    )  # fmt: skip
    assert (
        separate(modes, ("f1", "f3"), (Point("a", place="body 1"), Point("b", place="body 3"))).frequency.size == count
    )


@pytest.mark.thorough
def test_bounds_contain_truth_for_random_structures(tmp_path):
    random = np.random.default_rng(20)
    shares: dict[str, list[float]] = {"local rational": [], "multisine": [], "H1": [], "Hv": []}
    for number in range(6):
        masses, springs = random.uniform(0.5, 1.5, 3), random.uniform(10.0, 40.0, 3)
        path = record_scene(
            tmp_path / f"{number}.mcap", (RANDOM, MULTISINE)[number % 2], number, noise=random.uniform(20, 500),
            masses=[f"{mass:.4f} kg" for mass in masses], springs=[f"{spring:.3f} kN/m" for spring in springs],
        )  # fmt: skip
        with daq.open(path) as rec:
            if number % 2:
                (response,) = analysis.frequency_responses(rec)
                responses = {"multisine": response}
            else:
                (response,) = analysis.frequency_responses(rec)
                responses = {"local rational": response}
                for estimator in ("H1", "Hv"):
                    (responses[estimator],) = analysis.frequency_responses(rec, estimator=estimator)
            for method, response in responses.items():
                shares[method].append(share_within_bound(response, rec.scene))
    for method, method_shares in shares.items():
        assert 0.9 < np.mean(method_shares) < 0.99 and min(method_shares) > 0.85, method


def test_shaker_that_is_off_leaves_one_input(tmp_path):
    path = record_scene(tmp_path / "one.mcap", RANDOM.replace("also: [2], ", ""))
    with daq.open(path) as rec:
        (expected,) = analysis.frequency_responses(rec)
        inputs = driven_forces(rec)
    assert not inputs and expected.value.shape[2] == 1
    with daq.open(path) as rec:
        # The markers state both shakers, but the force of the second is zero.
        markers = [
            Marker(marker.kind, marker.first_sample, marker.last_sample, {**marker.fields, "shakers": [1, 2]})
            if marker.kind == "measure"
            else marker
            for marker in rec.markers
        ]
        object.__setattr__(rec, "markers", markers)
        assert [point.name for point in driven_forces(rec)] == ["f1"]
        (response,) = analysis.frequency_responses(rec)
    np.testing.assert_array_equal(response.value, expected.value)
    np.testing.assert_array_equal(response.bound(), expected.bound())
    assert "f3 at body 3 is zero" in " ".join(response.warnings)


@pytest.mark.parametrize("estimator", [None, "H1", "Hv"])
def test_coherent_inputs_are_rejected(estimator, tmp_path, monkeypatch):
    original = Station.generator
    monkeypatch.setattr(Station, "generator", lambda self, name: original(self, name.partition(" ")[0]))
    path = record_scene(tmp_path / "coherent.mcap", RANDOM)
    with daq.open(path) as rec, pytest.raises(RecordingError, match="The inputs are coherent at"):
        analysis.frequency_responses(rec, estimator=estimator)


def test_matrix_is_reciprocal(random_response):
    response, _ = random_response
    (pair,) = reciprocity(response)
    assert pair.within > 0.95 and not response.warnings
    # Responses of 1.5 and 1 differ by 0.4 of their mean.
    changed = response.value.copy()
    changed[:, 0] *= 1.5
    (pair,) = reciprocity(analysis.Response(response.frequency, changed, response.outputs, response.inputs))
    assert pair.within < 0.1 and pair.deviation == pytest.approx(0.4, rel=0.1)


def test_element_is_selected_by_output_and_input(random_response):
    response, _ = random_response
    curve = response["a2", "f3"]
    np.testing.assert_array_equal(curve.value, response.value[:, 1, 1])
    assert response["a2"].value.shape == (response.frequency.size, 1, 2) and len(response) == 6
    assert curve.input == "force at body 3"
    with pytest.raises(SceneError, match=r"force: missing.* Give one of f1, f3"):
        response.budget("a2", 20.0)
    assert "a2 / force at body 3" in str(response.budget("a2", 20.0, "f3"))


@pytest.mark.parametrize(("coupling", "noise"), [(180.0, 20), (70.0, 20), (0.0, 200)])
def test_close_modes_are_separated_by_two_references(coupling, noise, tmp_path):
    # Two equal oscillators, each 0.36 Hz wide. With weak coupling the modes are 0.2 or 0.08 Hz apart; uncoupled, they
    # coincide.
    stiffness = [[20e3 + coupling, 0.0, -coupling], [0.0, 4e4, 0.0], [-coupling, 0.0, 20e3 + coupling]]
    matrices = f"{{mass: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], stiffness: {stiffness}}}"
    text = SCENE.format(test=RANDOM.replace("10 s", "15 s"), seed=1, noise=noise, masses=[], springs=[]).splitlines()
    text[2] = f"structure: {{matrices: {matrices}, damping: {{modal: 0.8 %}}}}"
    path = daq.record(rig.loads("\n".join(text), where="oscillators"), tmp_path / "a.mcap")
    with daq.open(path) as rec:
        (response,) = analysis.frequency_responses(rec, ["a1", "a3"])
    modes = analysis.identify(response)
    natural = np.sqrt(np.array([20e3, 20e3 + 2.0 * coupling])) / (2 * np.pi)
    np.testing.assert_allclose(np.sort(modes.frequency), natural, rtol=3e-4)
    np.testing.assert_allclose(modes.damping, 0.008, rtol=0.03)
    # Both shapes together span all motions of the two bodies.
    assert np.linalg.svd(modes.shapes)[1][1] > 0.5
    assert any("Repeated modes" in text for text in modes.warnings) == (coupling == 0.0)


def test_modes_and_changes_belong_to_one_input(random_path, tmp_path):
    assert present_modes([random_path], tmp_path).lines[0].startswith("two shakers, force at body")
    changes = [change for _, _, change in compare_peaks([random_path, random_path]).changes]
    assert {change.response for change in changes} >= {"a1 / force at body 1", "a1 / force at body 3"}
    assert all(abs(change.decibel[0]) < 1e-9 for change in changes)
    with pytest.raises(RecordingError, match="several shakers were driven"):
        analysis.fit(random_path, "bare-structure")


def test_imported_test_of_two_shakers_has_two_inputs(random_path, tmp_path):
    with daq.open(random_path) as rec:
        scene, names = rec.scene, list(rec.channels)
        rows = np.array([rec.read(name) for name in names])
        time = np.arange(rows.shape[1]) / rec.rate
    units = [f"{name} [{'N' if name.startswith('f') else 'm/s^2'}]" for name in names]
    header = ",".join(["time [s]", *units])
    np.savetxt(tmp_path / "a.csv", np.vstack([time, rows]).T, delimiter=",", header=header, comments="", fmt="%.12g")
    response, share = response_and_coverage(daq.import_files(tmp_path / "a.csv", scene, tmp_path / "a.mcap"))
    assert [point.name for point in response.inputs] == ["f1", "f3"] and share > 0.9
