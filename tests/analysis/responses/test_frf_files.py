"""Frequency responses in files of other programs and of ours, and block averages against scipy."""

import numpy as np
import pytest
import pyuff
from scipy import signal
from scipy.io import savemat
from typer.testing import CliRunner

import analysis
import daq
from analysis.commands.cli import app
from analysis.commands.presentation.tables import frf_table
from rig.core.base.errors import RecordingError, SceneError
from rig.core.results.response import Response, stack
from rig.core.results.uncertainty import SENSITIVITY
from tests.daq.importing.files import NAMES, RATE, make_scene, write_tdms

# pyuff leaves a binary file open that it wrote.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
FREQUENCY = np.arange(801) * 0.25  # Hz
DAMPED_FREQUENCIES = np.array([40.0, 95.0])  # Hz
DAMPING = np.array([0.01, 0.004])  # as decay rate over damped frequency
NATURAL_FREQUENCIES = DAMPED_FREQUENCIES * np.sqrt(1.0 + DAMPING**2)
POLES = (2 * np.pi * DAMPED_FREQUENCIES * (-DAMPING + 1j))[:, None]
SHAPES = np.array([[1.0, 0.7], [-0.4, 1.0]])


def accelerance(noise: float = 0.0) -> np.ndarray:
    """Return the accelerance of two modes at two points in m/s^2/N, shape (points, lines)."""
    s = 2j * np.pi * FREQUENCY
    modes = 1.0 / (s - POLES) / (2j * POLES.imag) + 1.0 / (s - POLES.conj()) / (-2j * POLES.imag)
    random = np.random.default_rng(2).standard_normal((2, 2, FREQUENCY.size))
    value = s**2 * (SHAPES.T @ modes)
    return value + noise * abs(value).max() * (random[0] + 1j * random[1])


def write_uff(path, value, binary=0, reference=(1, 3), **labels):
    """Write responses at nodes 1, 2, ... to a force at the reference (node, direction)."""
    file = pyuff.UFF(str(path))
    for number, row in enumerate(value, 1):
        file.write_sets(
            {
                "type": 58, "binary": binary, "func_type": 4, "rsp_node": number, "rsp_dir": -3,
                "ref_node": reference[0], "ref_dir": reference[1], "abscissa_spacing": 1, "abscissa_spec_data_type": 18,
                "ordinate_spec_data_type": 12, "orddenom_spec_data_type": 13, "data": row, "x": FREQUENCY, **labels,
            },
            mode="add",
        )  # fmt: skip


@pytest.mark.parametrize("binary", [0, 1])
def test_universal_file_contains_lines_and_modes(binary, tmp_path):
    write_uff(
        tmp_path / "a.uff",
        accelerance(1e-4) / 9.80665,
        binary,
        ordinate_axis_units_lab="g",
        orddenom_axis_units_lab="N",
    )
    result = analysis.read_frfs(tmp_path / "a.uff")
    assert [curve.response for curve in result] == ["1 -Z", "2 -Z"] and result[0].name == "accelerance"
    for curve, row in zip(result, accelerance(1e-4), strict=True):
        np.testing.assert_allclose(curve.value, row[1:], rtol=1e-9)
        np.testing.assert_allclose(curve.frequency, FREQUENCY[1:], rtol=1e-5)
    modes = analysis.identify(result)
    np.testing.assert_allclose(modes.frequency, NATURAL_FREQUENCIES, rtol=1e-4)
    np.testing.assert_allclose(modes.damping, DAMPING, rtol=0.02)


@pytest.mark.parametrize(
    ("heading", "columns"),
    [
        ("f [Hz],tip re [g/N],tip im [g/N],root real [g/N],root imag [g/N]", lambda v: (v.real, v.imag)),
        ("Frequency (Hz),tip magnitude [m/s^2/N],tip phase [deg],root mag [m/s^2/N],root phase [deg]",
         lambda v: (abs(v) * 9.80665, np.angle(v, deg=True))),
    ],
)  # fmt: skip
def test_table_headings_give_components_and_units(heading, columns, tmp_path):
    value = accelerance() / 9.80665
    rows = np.vstack([FREQUENCY, *columns(value[0]), *columns(value[1])]).T
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header=heading, comments="")
    result = analysis.read_frfs(tmp_path / "a.csv")
    for name, row in zip(("tip", "root"), value, strict=True):
        np.testing.assert_allclose(result[name].value, row[1:] * 9.80665, rtol=1e-9)


@pytest.mark.usefixtures("undrawn_figures")
def test_commands_accept_files_of_other_programs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_uff(tmp_path / "a.uff", accelerance(1e-3), ordinate_axis_units_lab="m/s2", orddenom_axis_units_lab="N")
    result = CliRunner().invoke(app, ["modes", "a.uff"])
    assert result.exit_code == 0, (result.output, result.exception)
    assert "a, force at node 1 +Z: 2 modes" in result.output
    result = CliRunner().invoke(app, ["frf", "a.uff", "--motion", "acceleration"])
    assert result.exit_code == 0, (result.output, result.exception)
    frfs = analysis.read_frfs(tmp_path / "a-frf.csv")
    np.testing.assert_allclose(frfs["1 -Z"].value, accelerance(1e-3)[0, 1:], rtol=1e-8)


def test_incomplete_responses_name_missing_options(tmp_path):
    write_uff(tmp_path / "a.uff", accelerance())
    with pytest.raises(SceneError, match=r"states no unit.*`unit` m/s\^2/N"):
        analysis.read_frfs(tmp_path / "a.uff")
    (first, _) = analysis.read_frfs(tmp_path / "a.uff", unit="mm/s^2/N")
    assert first.value[9] == pytest.approx(1e-3 * accelerance()[0, 10], rel=1e-9)
    write_uff(tmp_path / "a.uff", accelerance(), reference=(7, 1))
    with pytest.raises(SceneError, match=r"2 references. Choose one with `reference`: 1 \+Z, 7 \+X"):
        analysis.read_frfs(tmp_path / "a.uff", unit="m/N")
    assert len(analysis.read_frfs(tmp_path / "a.uff", "7 +X", "m/N")) == 2
    with pytest.raises(SceneError, match="force per motion"):
        analysis.read_frfs(tmp_path / "a.uff", "7 +X", "N/m")


def test_unit_in_windows_encoding_is_read(tmp_path):
    write_uff(tmp_path / "a.uff", accelerance(), ordinate_axis_units_lab="(1/N)*(m/s#)")
    (tmp_path / "a.uff").write_bytes((tmp_path / "a.uff").read_bytes().replace(b"#", b"\xb2"))
    assert analysis.read_frfs(tmp_path / "a.uff")[0].value[9] == pytest.approx(accelerance()[0, 10], rel=1e-9)


BAD_FILES = {
    "no file": None,
    "not a file.uff": b"nothing",
    "empty.uff": b"",
    "no extension": b"1,2",
    "text.csv": b"to whom it may concern",
    "time.csv": b"time [s],a real [m/N],a imag [m/N]\n" + b"".join(b"%d,1,1\n" % k for k in range(9)),
    "half.csv": b"f,a real [m/N]\n1,2\n2,3\n",
    "names.csv": b"f,a [m/N],b [m/N]\n1,2,3\n2,3,4\n",
    "units.csv": b"f,a re [V],a im [V]\n1,2,3\n2,3,4\n",
    "long cell.csv": b"response,frequency_Hz,real m/N,imag m/N\na,1,1,2\n" + b"x" * 200_000 + b",1,1,2\n",
    "large.csv": b"f,a re [m/N],a im [m/N]\n20,1e308,1e308\n21,2e305,3\n",
    "small.csv": b"f,a re [m/N],a im [m/N]\n20,1e-310,0\n21,2e-310,0\n",
    "high frequency.csv": b"f,a re [m/N],a im [m/N]\n20,1,0\n21e300,2,0\n",
    "low frequency.csv": b"f,a re [m/N],a im [m/N]\n2e-300,1,0\n3e-300,2,0\n",
    "twice.csv": b"f,a re [m/N],a im [m/N]\n20,2,3\n21,2,3\n20,2,3\n",
    "same frequency.csv": b"f,a re [m/N],a im [m/N]\n" + 30 * b"20,2,3\n",
    "infinite frequency.csv": b"f,a re [m/N],a im [m/N]\ninf,2,3\ninf,2,3\n",
    "long.csv": b"response,frequency_Hz,real m/N,imag m/N\na,1,x,2\n",
}


@pytest.mark.parametrize(("function_type", "is_time_history"), [(1, True), (2, False)])
def test_time_functions_suggest_import(function_type, is_time_history, tmp_path):
    write_uff(tmp_path / "a.uff", abs(accelerance()), func_type=function_type)
    with pytest.raises(RecordingError, match="no frequency response") as error:
        analysis.read_frfs(tmp_path / "a.uff")
    assert ("`daq import`" in str(error.value)) == is_time_history


@pytest.mark.parametrize("name", BAD_FILES)
def test_file_without_responses_is_rejected(name, tmp_path):
    if BAD_FILES[name] is not None:
        (tmp_path / name).write_bytes(BAD_FILES[name])
    with pytest.raises((RecordingError, SceneError), match=name.replace(" ", r"\s")):
        analysis.read_frfs(tmp_path / name)


# In pure noise, the driving-point response may appear reversed.
@pytest.mark.filterwarnings("ignore:.*channel is reversed")
def test_averaged_hits_are_ratio_of_averaged_spectra(tmp_path):
    pulse = np.sin(np.pi * np.arange(1, 9) / 9)
    force = np.zeros(24000)
    for begin, peak in ((900, 70.0), (9000, 50.0), (17000, 60.0)):
        force[begin : begin + 8] = peak * pulse
    response = signal.lfilter([1.0], [1.0, -1.96, 0.985], force)
    rows = np.vstack([response / 9.80665, 0.5 * response, force]) + 1e-3 * np.random.default_rng(6).standard_normal(
        (3, force.size)
    )
    write_tdms(tmp_path / "a.tdms", rows)
    daq.import_files(
        tmp_path / "a.tdms", make_scene("{kind: impulse, body: 1, peak: 50 N, width: 4 ms}"), tmp_path / "r.mcap",
    )  # fmt: skip
    with daq.open(tmp_path / "r.mcap") as recording:
        begins = [marker.first_sample for marker in recording.markers]
        (curves,) = analysis.frequency_responses(recording, motion="acceleration", estimator="H1", block=3.0)
        size, before_hit = 6144, 6144 // 50  # Samples of a block, and of its part before the hit.
        blocks = np.stack(
            [
                [recording.read(name, begin - before_hit, begin - before_hit + size) for name in NAMES]
                for begin in begins
            ]
        )
    spectra = np.fft.rfft(blocks - blocks.mean(axis=2, keepdims=True), axis=2)
    expected = (spectra[:, 0] * spectra[:, 2].conj()).sum(axis=0) / (abs(spectra[:, 2]) ** 2).sum(axis=0)
    indices = np.searchsorted(np.fft.rfftfreq(size, 1 / RATE), curves[0].frequency - 1e-6)
    np.testing.assert_allclose(curves[0].value, expected[indices], rtol=1e-9)
    assert not any("leak" in note for note in curves[0].warnings)


def test_lines_are_sorted_by_frequency(tmp_path):
    (tmp_path / "a.csv").write_text("f,tip re [m/N],tip im [m/N]\n30,3,0\n10,1,0\n20,2,0\n")
    tip = analysis.read_frfs(tmp_path / "a.csv")["tip"]
    assert tip.frequency.tolist() == [10.0, 20.0, 30.0] and tip.value.real.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("absent", "cell"),
    [([], ""), ([40], ""), ([40], "nan"), ([40], None), ([10, 11, 12, 50, 90], None), (range(2, 99, 3), None)],
)
def test_absent_lines_do_not_change_resolution(absent, cell, tmp_path):
    # Two digits make the steps unequal: 0.33 and 0.34 Hz.
    rows = [f"{line / 3.0:.2f},{line}.5,1" for line in range(1, 100) if cell is not None or line not in absent]
    if cell is not None:
        rows = [f"{row.split(',')[0]},{cell},{cell}" if k in absent else row for k, row in enumerate(rows)]
    (tmp_path / "a.csv").write_text("\n".join(["f [Hz],tip re [m/N],tip im [m/N]", *rows]))
    assert analysis.read_frfs(tmp_path / "a.csv")["tip"].resolution == pytest.approx(0.5, rel=0.02)


@pytest.mark.parametrize(
    "tones",
    [
        np.geomspace(10.0, 20.0, 60),
        np.geomspace(10.0, 20.0, 60).round(1),
        np.union1d(np.arange(80, 600, 5), np.r_[150:180, 320:350]) / 10.0,
    ],
)
def test_uneven_tones_have_no_resolution(tones, tmp_path):
    rows = [f"{f:.6g},{f},1" for f in np.unique(tones)]
    (tmp_path / "a.csv").write_text("\n".join(["f [Hz],tip re [m/N],tip im [m/N]", *rows]))
    assert analysis.read_frfs(tmp_path / "a.csv")["tip"].resolution == 0.0


@pytest.mark.parametrize("extension", ["uff", "csv"])
def test_errors_and_modes_survive_a_written_file(extension, tmp_path):
    value = accelerance()[:, 1:] / (2j * np.pi * FREQUENCY[1:]) ** 2
    # An error that is nearly equal at neighboring lines causes no scatter, such as the error of AC coupling in a
    # hammer.
    error = 1e-4 * abs(value).max() * (1.0 + 1e3 * np.exp(-FREQUENCY[1:] / 1.5))
    error = np.where(FREQUENCY[1:] < 15.0, error, 1e-9 * abs(value).max())
    measured = value + error * np.exp(0.3j * FREQUENCY[1:])
    ones = np.ones(error.size)
    bound = np.where(FREQUENCY[1:] > 150.0, np.inf, 0.01 * abs(value[0]))
    fields = {"error": error, "degrees_of_freedom": 30.0 * ones, "limits": {SENSITIVITY: bound}, "coherence": ones}
    curves = [
        Response.curve(FREQUENCY[1:], row, f"body{k}", label="own", **fields) for k, row in enumerate(measured, 1)
    ]
    path = tmp_path / f"own.{extension}"
    if extension == "uff":
        stack(curves).to_uff(path, [1, 2], [1])
    else:
        frf_table(path, curves)
    stored = analysis.read_frfs(path)
    for before, after in zip(curves, stored, strict=True):
        np.testing.assert_allclose(after.error, before.error, rtol=1e-8)
        np.testing.assert_allclose(after.expanded_systematic(), bound, rtol=1e-8)
        assert after.resolution == before.resolution == 0.0
    modes = analysis.identify(stored)
    assert modes.model_error == 0.0 and not modes.warnings
    np.testing.assert_allclose(modes.frequency, NATURAL_FREQUENCIES, rtol=1e-4)


@pytest.mark.parametrize("extension", ["uff", "csv"])
def test_mode_uncertainty_survives_a_written_file(extension, tmp_path):
    value = accelerance()[:, 1:] / (2j * np.pi * FREQUENCY[1:]) ** 2
    error = 1e-6 * abs(value).max() * np.ones(value.shape[1])
    # The sensitivity errors at both ends of a coil spring act like an error of its stiffness.
    curves = [
        Response.curve(FREQUENCY[1:], row, f"body{k}", error=error, limits={SENSITIVITY: 0.1 * abs(row) ** 2 / 1e-5})
        for k, row in enumerate(value, 1)
    ]
    path = tmp_path / f"own.{extension}"
    if extension == "uff":
        stack(curves).to_uff(path, [1, 2], [1])
    else:
        frf_table(path, curves)
    expected, stored = analysis.identify(curves), analysis.identify(analysis.read_frfs(path))
    assert expected.frequency_std[0] > 0.01
    np.testing.assert_allclose(stored.frequency_std, expected.frequency_std, rtol=0.01)


def test_table_keeps_omitted_frequencies(tmp_path):
    frequency, omitted = np.array([10.0, 11.0, 14.0, 15.0]), np.array([12.0, 13.0])
    curve = Response.curve(frequency, 1e-6 * (1.0 + 2.0j) * frequency, "tip", omitted=omitted)
    frf_table(tmp_path / "a.csv", [curve])
    [stored] = analysis.read_frfs(tmp_path / "a.csv")
    np.testing.assert_array_equal(stored.frequency, frequency)
    np.testing.assert_array_equal(stored.omitted, omitted)


def test_missing_systematic_errors_are_reported(tmp_path):
    write_uff(tmp_path / "a.uff", accelerance(), ordinate_axis_units_lab="m/s2", orddenom_axis_units_lab="N")
    response = analysis.read_frfs(tmp_path / "a.uff")
    assert not response.limits
    frf_table(tmp_path / "a.csv", list(response))
    for name in ("a.uff", "a.csv"):
        [text] = analysis.read_frfs(tmp_path / name).warnings
        assert "The file states no systematic errors" in text


@pytest.mark.parametrize("stated", ["kN/(m/s)", "(N)/(m/s²)", "kg/1", "N/g", "N-s/m", "(1/m)*(N)"])
@pytest.mark.parametrize("unit", [None, "m/s^2/N"])
def test_dynamic_stiffness_is_refused(stated, unit, tmp_path) -> None:
    file = tmp_path / "a.csv"
    file.write_text(f"f [Hz],tip re [{stated}],tip im [{stated}]\n10,1,0\n20,0,-2\n", encoding="utf-8")
    with pytest.raises(SceneError, match=r"force per motion.*Export its inverse"):
        analysis.read_frfs(file, unit=unit)


@pytest.mark.parametrize(
    ("heading", "problem"),
    [("time,force,acc", "column 'acc'"), ("time [s],f [N],a [g]", "first column contains times")],
)
def test_table_of_time_histories_should_be_imported(heading, problem, tmp_path) -> None:
    (tmp_path / "a.csv").write_text(f"{heading}\n0,1,2\n0.1,2,3\n0.2,3,4\n", encoding="utf-8")
    with pytest.raises(RecordingError, match=f"{problem}.*time histories.*daq import"):
        analysis.read_frfs(tmp_path / "a.csv")


@pytest.mark.parametrize(
    "lines",
    [
        # SignalCalc, Dewesoft, and a table of Excel with decimal commas.
        ["SignalCalc 730", "Date: 12/03/2021", "", "X-Axis(Hz)\tH2,1 Real((m/s²)/N)\tH2,1 Imag((m/s²)/N)"],
        ["File name: a.dxd", "", "Frequency (Hz)\tFRF Ampl (m/s2/N)\tFRF Phase (deg)"],
        ["Frequenz [Hz];Betrag [m/s²/N];Phase [°]"],
        ["Frequenz [Hz];Realteil [m/s²/N];Imaginärteil [m/s²/N]"],
    ],
)
def test_table_of_analyzer_is_read(lines, tmp_path) -> None:
    value = accelerance()[0]
    are_parts = "Real" in lines[-1]
    columns = (value.real, value.imag) if are_parts else (abs(value), np.angle(value, deg=True))
    separator = ";" if ";" in lines[-1] else "\t"
    rows = [separator.join(f"{number:.9e}" for number in row) for row in zip(FREQUENCY, *columns, strict=True)]
    text = "\n".join(lines + [row.replace(".", ",") if separator == ";" else row for row in rows])
    (tmp_path / "a.txt").write_bytes(text.encode("cp1252"))
    [curve] = analysis.read_frfs(tmp_path / "a.txt")
    assert curve.motion == "acceleration"
    np.testing.assert_allclose(curve.value, value[1:], rtol=1e-7)


def test_table_without_heading_is_read(tmp_path) -> None:
    frequency = 2.0 * np.arange(1, 51)
    value = 1.0 / (2000.0 - frequency**2 + 4j * frequency)
    file = tmp_path / "beam.txt"
    np.savetxt(file, np.column_stack([frequency, value.real, value.imag]))
    curve = analysis.read_frfs(file, unit="m/N")
    assert curve.frequency == pytest.approx(frequency)
    assert curve.value.ravel() == pytest.approx(value)
    assert any("real part and imaginary part are assumed" in text for text in curve.warnings)


def test_table_without_heading_may_contain_magnitudes(tmp_path) -> None:
    file = tmp_path / "beam.txt"
    np.savetxt(file, np.column_stack([np.arange(1.0, 51.0), np.full(50, 2.0), np.linspace(-90.0, 90.0, 50)]))
    with pytest.raises(RecordingError, match=r"real part or a magnitude. Add a heading"):
        analysis.read_frfs(file, unit="m/N")


def test_arrays_of_responses_are_read(tmp_path):
    frequency, value = np.linspace(1.0, 50.0, 50), np.exp(1j * np.linspace(0.0, 3.0, 50))
    both = np.column_stack([value, 2.0 * value])
    np.savez(tmp_path / "a.npz", f=frequency, h=both, coherence_h=0.9)
    savemat(tmp_path / "a.mat", {"h": both.T, "df": 1.0, "unit": "mm/N"})
    for name, unit, scale in (("a.npz", "m/N", 1.0), ("a.mat", None, 1e-3)):
        response = analysis.read_frfs(tmp_path / name, unit=unit)
        lines = frequency if name == "a.npz" else frequency[:49]
        np.testing.assert_allclose(response["h(2)"].frequency, lines)
        np.testing.assert_allclose(response["h(2)"].value, 2.0 * scale * (value if name == "a.npz" else value[1:]))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"x": np.arange(9.0)}, "no array of complex numbers"),
        ({"h": np.ones(9, complex)}, "frequencies of the 9 lines are not stated"),
        ({"h": np.ones(9, complex), "f": np.arange(9.0), "fb": np.arange(9)}, "may be f or fb"),
        ({"h": np.ones(9, complex), "g": np.ones(8, complex)}, "have 8, 9 lines"),
    ],
)
def test_unclear_arrays_are_refused_with_remedy(tmp_path, arrays, message):
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(RecordingError, match=message):
        analysis.read_frfs(tmp_path / "a.npz", unit="m/N")


def test_coherence_in_complex_array_is_read(tmp_path):
    value = np.exp(1j * np.linspace(0.0, 3.0, 30))
    savemat(tmp_path / "a.mat", {"yspec": np.column_stack([value, np.linspace(1.0, 0.5, 30)]), "df": 1.0})
    [curve] = analysis.read_frfs(tmp_path / "a.mat", unit="m/N")
    np.testing.assert_allclose(curve.value, value[1:])
    np.testing.assert_allclose(curve.coherence, np.linspace(1.0, 0.5, 30)[1:])
