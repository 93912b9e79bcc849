"""Tables that analyzers export as text: names and units of the columns are recognized."""

import warnings
from contextlib import ExitStack
from pathlib import Path

import h5py
import nptdms
import numpy as np
import pytest
import scipy

import analysis
from daq.commands.import_report import listing
from daq.extras.importing.files import signals_of
from daq.extras.importing.text_table import text_signals
from daq.extras.importing.units import quantity_and_scale
from rig.core.base.errors import RecordingError, RunWarning, SceneError

FREQUENCY = np.arange(0.25, 50.0, 0.25)
OMEGA = 2 * np.pi * FREQUENCY
ACCELERANCE = -(OMEGA**2) / ((2 * np.pi * 20.0) ** 2 - OMEGA**2 + 2j * 0.02 * OMEGA * 2 * np.pi * 20.0)
REAL_IMAG = np.stack([FREQUENCY, ACCELERANCE.real, ACCELERANCE.imag], axis=1)
POLAR = np.stack([FREQUENCY, abs(ACCELERANCE), np.degrees(np.angle(ACCELERANCE))], axis=1)
DECIBELS = np.stack([FREQUENCY, 20 * np.log10(abs(ACCELERANCE)), np.degrees(np.angle(ACCELERANCE))], axis=1)
TIME = np.arange(300) / 1024.0
SAMPLES = np.stack([TIME, np.cos(TIME), np.sin(9.0 * TIME)], axis=1)

PULSE = (
    "Header Size:\t7\nTitle:\tH1 tip\nData Type:\tComplex\nX-Axis size:\t199\nX-AxisUnit:\tHz\n"
    "AmplitudeUnit:\t(m/s²)/N\nScaling:\tRMS\n\n"
)
TESTLAB = "Function class\tFRF\nPoint id\ttip:+Z\nX axis unit\tHz\nY axis unit\t(m/s²)/N\n"
TESTLAB_TIME = "Function class\tTime\tTime\nPoint id\tforce\ttip:+Z\nX axis unit\ts\ts\nY axis unit\tN\tm/s²\n"
POLYTEC = (
    "Source File Name:\tscan.svd\nSignal:\tH1\n\nFrequency\tReal\tImaginary\n[ Hz ]\t[ m/s^2 / N ]\t[ m/s^2 / N ]\n"
)
POLYTEC_TIME = "Point Index:\t1\nSignal:\tVib\n\nTime\tforce\ttip:+Z\n[ s ]\t[ N ]\t[ m/s² ]\n"
MP_TIME = "m+p Analyzer\nChannel\tforce\ttip:+Z\nUnit\tN\tm/s²\nSampling rate\t1024\t1024\n"
MESCOPE = (
    "Measurement Type\tFRF\nX Axis Units\tHz\nY Axis Type\tReal/Imaginary\nY Axis Units\t(m/s²)/N\nY Axis DOFs\t1Z:3Z\n"
)
SIGNALCALC = "SignalCalc ACE\nTest:\tMünchen\n\nX-Axis(Hz)\tH2,1 Real(m/s²/N)\tH2,1 Imag(m/s²/N)\n"
SIGNALCALC_RATIO = "Units: Ratio\nChannel Name\t : \n\nFrequency\t Real\t Imaginary\n\nUnits:\nHz\t(m/s²)(N)\t \n"
PULSE_INDEX = (
    "PULSE LabShop\nTitle1:\tH1\nX-Axis unit:\tHz\nY-Axis unit:\t(m/s²)/N\nY-Axis type:\tComplex\n"
    "Domain:\tFrequency\n\nHeader end:\n\nIndex\tX-Axis\tReal\tImag\n"
)
SIGNALCALC_TIME = "SignalCalc ACE\nDate:\t12.03.2019\n\nX-Axis(s)\tforce(N)\ttip:+Z(m/s²)\n"


def write(path: Path, heading: str, rows: np.ndarray, comma: bool = False) -> Path:
    text = "".join("\t".join(f"{cell:.8E}" for cell in row) + "\n" for row in rows)
    path.write_bytes((heading + (text.replace(".", ",") if comma else text)).encode("cp1252"))
    return path


@pytest.mark.parametrize(
    ("heading", "rows", "name"),
    [
        (PULSE, np.insert(REAL_IMAG, 0, np.arange(1, 200), axis=1), "H1 tip"),
        (TESTLAB, REAL_IMAG, "tip:+Z"),
        (POLYTEC, REAL_IMAG, "response"),
        (MESCOPE, REAL_IMAG, "1Z:3Z"),
        (SIGNALCALC, REAL_IMAG, "H2,1"),
        ("Frequency (Hz)\tAmplitude (m/s²/N)\tPhase (°)\n", POLAR, "response"),
        ('H1(tip,force) - Mark 1\n"[Hz]"\t"[(m/s²)/N]"\t"[Degree]"\n', POLAR, "response"),
        ("X-Axis\tH1,2\tH1,2\nHz\tdB re 1 m/s²/N\tdeg\n", DECIBELS, "H1,2"),
        ("Frequency (Hz)\ttip Magnitude (dB re 1 m/s²/N)\ttip Phase (deg)\n", DECIBELS, "tip"),
        ("Frequenz [Hz]\t|H1| [dB re 1 m/s²/N]\tPhase [°]\n", DECIBELS, "H1"),
        ("Frequency [Hz]\tMag [dB ref. 1e-6 m/s²/N]\tPhase [°]\n", np.add(DECIBELS, [0.0, 120.0, 0.0]), "response"),
        ("f / kHz\tBetrag / m/s²/N\tPhase / Grad\n", POLAR * [1e-3, 1.0, 1.0], "response"),
        ("f/Hz\tRe/(m/s²/N)\tIm/(m/s²/N)\n", REAL_IMAG, "response"),
        (PULSE_INDEX, np.insert(REAL_IMAG, 0, np.arange(1, 200), axis=1), "response"),
        ("Frequency\tMagnitude\tPhase\nHz\tdB(m/s²/N)\tdeg\n", DECIBELS, "response"),
        ("omega [rad/s]\tRe [m/s²/N]\tIm [m/s²/N]\n", REAL_IMAG * [2 * np.pi, 1.0, 1.0], "response"),
        ("Freq\tMag\tPhase\n(Hz)\t((m/s²)/N)\t(deg)\n", POLAR, "response"),
        ("Frequency (Hz)\tFRF/AI2;AI1/Re (m/s²/N)\tFRF/AI2;AI1/Im (m/s²/N)\n", REAL_IMAG, "FRF/AI2;AI1"),
        ("Freq\tMag\tPhase\nHz\t[m/s^2]/[N]\tdeg\n", POLAR, "response"),
        (
            "\tfrequency_Hz\ttip_real [m/s²/N]\ttip_imag [m/s²/N]\n",
            np.insert(REAL_IMAG, 0, np.arange(199), axis=1),
            "tip",
        ),
        ("Line\tFreq[Hz]\tMag[(m/s²)/N]\tPha[deg]\n", np.insert(POLAR, 0, np.arange(1, 200), axis=1), "response"),
    ],
)
@pytest.mark.parametrize("comma", [False, True])
def test_exported_responses_are_read(heading: str, rows: np.ndarray, name: str, comma: bool, tmp_path: Path) -> None:
    curves = analysis.read_frfs(write(tmp_path / "a.txt", heading, rows, comma))
    assert curves[name].name == "accelerance"
    np.testing.assert_allclose(curves[name].value, ACCELERANCE, rtol=1e-6)


@pytest.mark.parametrize("heading", [TESTLAB_TIME, POLYTEC_TIME, MP_TIME, SIGNALCALC_TIME])
@pytest.mark.parametrize("comma", [False, True])
def test_exported_samples_have_names_and_units(heading: str, comma: bool, tmp_path: Path) -> None:
    with ExitStack() as stack:
        force, tip = text_signals(write(tmp_path / "a.txt", heading, SAMPLES, comma), stack)
        assert [(each.name, each.unit, each.rate) for each in (force, tip)] == [
            ("force", "N", 1024.0),
            ("tip:+Z", "m/s²", 1024.0),
        ]
        np.testing.assert_allclose(tip.read(0, 300), SAMPLES[:, 2], atol=1e-8)


def test_dots_between_thousands_are_read(tmp_path: Path) -> None:
    rows = "".join(f"{k},0;{1000 * k:,}".replace(",", ".").replace(".0;", ",0;") + ",5\n" for k in range(1, 20))
    (tmp_path / "a.csv").write_text("Zeit [s];Kraft [N]\n" + rows)
    with ExitStack() as stack:
        (force,) = text_signals(tmp_path / "a.csv", stack)
        np.testing.assert_array_equal(force.read(0, 19), 1000.0 * np.arange(1, 20) + 0.5)


@pytest.mark.parametrize("lines", [slice(None), slice(4)])
@pytest.mark.parametrize("step", [1.0, 4.0])
def test_numbered_lines_may_be_uneven(lines: slice, step: float, tmp_path: Path) -> None:
    rows = np.insert(REAL_IMAG, 0, np.arange(1, 200), axis=1)[lines]
    rows[:, 1] = (step * rows[:, 1]) ** 1.3
    curve = analysis.read_frfs(write(tmp_path / "a.txt", PULSE, rows))["H1 tip"]
    np.testing.assert_allclose(curve.frequency, rows[:, 1])
    np.testing.assert_allclose(curve.value, ACCELERANCE[lines], rtol=1e-6)


def test_numbered_samples_have_their_clock(tmp_path: Path) -> None:
    heading = "Header Size:\t3\nTitle:\tforce\nX-AxisUnit:\ts\nAmplitudeUnit:\tN\n\n"
    rows = np.insert(SAMPLES[:, :2], 0, np.arange(1, 301), axis=1)
    with ExitStack() as stack:
        (force,) = text_signals(write(tmp_path / "a.txt", heading, rows), stack)
        assert (force.name, force.unit, force.rate) == ("force", "N", 1024.0)


@pytest.mark.parametrize("step", [0.25, 1.0])
def test_unnamed_line_numbers_are_omitted(step: float, tmp_path: Path) -> None:
    rows = np.insert(REAL_IMAG * [4.0 * step, 1.0, 1.0], 0, np.arange(1, 200), axis=1)
    file = write(tmp_path / "a.txt", "Beam\n\n", rows)
    with pytest.warns(RunWarning, match="first column contains line numbers"):
        curve = analysis.read_frfs(file, unit="m/s^2/N")["response"]
    np.testing.assert_allclose(curve.frequency, 4.0 * step * FREQUENCY)
    np.testing.assert_allclose(curve.value, ACCELERANCE, rtol=1e-6)


def test_unit_of_cross_spectrum_needs_unit(tmp_path: Path) -> None:
    file = write(tmp_path / "a.txt", SIGNALCALC_RATIO, REAL_IMAG)
    with pytest.raises(SceneError, match="not a cross spectrum, give its unit"):
        analysis.read_frfs(file)
    curve = analysis.read_frfs(file, unit="m/s^2/N")["response"]
    np.testing.assert_allclose(curve.value, ACCELERANCE, rtol=1e-6)


def test_units_below_names_need_no_brackets(tmp_path: Path) -> None:
    with ExitStack() as stack:
        signals = text_signals(write(tmp_path / "a.csv", "force\ttip\nN\tm/s^2\n", SAMPLES[:, 1:]), stack)
        assert [(each.name, each.unit) for each in signals] == [("force", "N"), ("tip", "m/s^2")]


def test_lines_of_text_below_table_are_omitted(tmp_path: Path) -> None:
    file = write(tmp_path / "a.csv", "Time (s)\tforce (N)\ttip (g)\n", SAMPLES)
    file.write_text(file.read_text() + "End of data\nChecksum:\t3a7f\n")
    with ExitStack() as stack, pytest.warns(RunWarning, match="the last 2 lines are texts"):
        assert [signal.samples for signal in text_signals(file, stack)] == [300, 300]


def test_short_names_are_no_units(tmp_path: Path) -> None:
    with ExitStack() as stack:
        signals = text_signals(write(tmp_path / "a.csv", "Rig\tBench\nA\tV\n", SAMPLES[:, 1:]), stack)
        assert [signal.name for signal in signals] == ["A", "V"]


@pytest.mark.filterwarnings("ignore:.*has no heading; its first column rises evenly")
def test_even_signal_shows_no_line_numbers(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("".join(f"{k},{2.0 * k},{k**2 + 0.5}\n" for k in range(20)))
    with ExitStack() as stack:
        assert [signal.rate for signal in text_signals(tmp_path / "a.csv", stack)] == [None, None, None]


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_decimal_comma_follows_whole_numbers(delimiter: str, tmp_path: Path) -> None:
    rows = ["0|0", *(f"0,{k:03}|{k},5" for k in range(1, 40))]
    (tmp_path / "a.csv").write_text("\n".join(["Zeit [s]|Kraft [N]", *rows]).replace("|", delimiter))
    with ExitStack() as stack:
        [force] = text_signals(tmp_path / "a.csv", stack)
        assert force.rate == 1000.0 and force.read(0, 3).tolist() == [0.0, 1.5, 2.5]


@pytest.mark.parametrize("name", ["epoch", "unixtime", "Unix_Time", "timestamp"])
def test_seconds_since_1970_are_times(name: str, tmp_path: Path) -> None:
    rows = "".join(f"{1714737600 + k / 1000:.6f},{np.sin(k)}\n" for k in range(40))
    (tmp_path / "a.csv").write_text(f"{name},ax\n{rows}")
    with ExitStack() as stack:
        assert [(signal.name, signal.rate) for signal in text_signals(tmp_path / "a.csv", stack)] == [("ax", 1000.0)]


def test_complex_numbers_need_frequencies(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("(1.5+2.5j)\n(1.25-0.5j)\n(1.0+1.5j)\n")
    with ExitStack() as stack, pytest.raises(RecordingError, match="complex numbers without frequencies"):
        text_signals(tmp_path / "a.txt", stack)


def test_several_responses_have_pairs_of_columns(tmp_path: Path) -> None:
    heading = (
        "Measurement Type\tFRF\nX Axis Units\tHz\nY Axis Type\tReal/Imaginary\nY Axis Units\tg/N\t\tg/N\t\n"
        "Y Axis DOFs\t1Z:3Z\t\t2Z:3Z\t\n"
    )
    rows = np.concatenate([REAL_IMAG, -2.0 * REAL_IMAG[:, 1:]], axis=1)
    curves = analysis.read_frfs(write(tmp_path / "a.txt", heading, rows))
    assert list(curves.keys()) == ["1Z:3Z", "2Z:3Z"]
    np.testing.assert_allclose(curves["2Z:3Z"].value, -2.0 * 9.80665 * ACCELERANCE, rtol=1e-6)


def test_columns_of_coherence_are_read(tmp_path: Path) -> None:
    heading = "Freq\tPt1 Re\tPt1 Im\tPt1 Coh\nHz\tm/s²/N\tm/s²/N\t\n"
    rows = np.column_stack([REAL_IMAG, np.full(FREQUENCY.size, 0.98)])
    curve = analysis.read_frfs(write(tmp_path / "a.dat", heading, rows))["Pt1"]
    np.testing.assert_allclose(curve.value, ACCELERANCE, rtol=1e-6)
    np.testing.assert_allclose(curve.coherence, 0.98)


@pytest.mark.parametrize(
    ("heading", "form"),
    [
        ("f [Hz],tip [m/s^2/N]\n", "{f},({re:.8e}{im:+.8e}j)\n"),
        ("f [Hz];tip [m/s^2/N]\n", "{f};{re:.8e} {sign} {abs:.8e} i\n"),
        ("% f (Hz)      tip (m/s^2/N)\n", "{f}  {re:.8e}+{im:.8e}j\n"),
        ("f (Hz)   tip (m/s^2/N)\n", "{f} ({re:.8e},{im:.8e})\n"),
        ('f [Hz], "Re(tip) [m/s^2/N]", "Im(tip) [m/s^2/N]"\n', "{f},{re:.8e},{im:.8e}\n"),
    ],
)
def test_complex_numbers_are_read(heading: str, form: str, tmp_path: Path) -> None:
    values = zip(FREQUENCY, ACCELERANCE, strict=True)
    rows = (form.format(f=f, re=h.real, im=h.imag, sign="-" if h.imag < 0 else "+", abs=abs(h.imag)) for f, h in values)
    (tmp_path / "a.txt").write_text(heading + "".join(rows))
    [curve] = analysis.read_frfs(tmp_path / "a.txt")
    assert curve.response == "tip"
    np.testing.assert_allclose(curve.value, ACCELERANCE, rtol=1e-7)


@pytest.mark.parametrize(
    "forms",
    [
        ("Real {}", "Imag {}"),
        ("Real Part {}", "Imaginary Part {}"),
        ("Real({})", "Imag({})"),
        ("{} (real)", "{} (imag)"),
        ("Re{{{}}}", "Im{{{}}}"),
        ("{}: real", "{}: imag"),
    ],
)
def test_component_stands_before_or_after_name(forms: tuple[str, str], tmp_path: Path) -> None:
    heading = ["f [Hz]", *(form.format(name) for name in ("H11", "H21") for form in forms)]
    rows = np.concatenate([REAL_IMAG, -2.0 * REAL_IMAG[:, 1:]], axis=1)
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header=",".join(heading), comments="")
    curves = analysis.read_frfs(tmp_path / "a.csv", unit="m/s^2/N")
    assert list(curves.keys()) == ["H11", "H21"]
    np.testing.assert_allclose(curves["H21"].value, -2.0 * curves["H11"].value, rtol=1e-12)


def test_two_columns_for_one_component_are_refused(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "a.csv", REAL_IMAG[:, [0, 1, 1]], delimiter=",", header="f [Hz],real,real", comments="")
    with pytest.raises(RecordingError, match="column 'real' is a second column for real of response"):
        analysis.read_frfs(tmp_path / "a.csv", unit="m/N")


def test_listing_of_frequencies_names_command_for_responses(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "a.csv", REAL_IMAG, delimiter=",", header="Frequency,Real H11,Imag H11", comments="")
    assert f"If it contains frequency responses: analysis modes {tmp_path / 'a.csv'}" in next(
        listing([tmp_path / "a.csv"])
    )


def test_complex_number_without_heading_is_read(tmp_path: Path) -> None:
    rows = zip(FREQUENCY, ACCELERANCE, strict=True)
    (tmp_path / "a.csv").write_text("".join(f"{f},{h.real:.8e}{h.imag:+.8e}j\n" for f, h in rows))
    [curve] = analysis.read_frfs(tmp_path / "a.csv", unit="m/s^2/N")
    np.testing.assert_allclose(curve.value, ACCELERANCE, rtol=1e-7)


def test_unnamed_complex_column_leaves_other_names(tmp_path: Path) -> None:
    rows = (f"{k / 10}\t{k}.25\t{k}.1-2.5i\n" for k in range(6))
    (tmp_path / "a.txt").write_text("t (s)\tb\t\n" + "".join(rows))
    with ExitStack() as stack:
        assert [signal.name for signal in text_signals(tmp_path / "a.txt", stack)] == ["b", "column 3", "column 4"]


@pytest.mark.filterwarnings("ignore:.* the table has no times")
@pytest.mark.parametrize(
    ("heading", "row"),
    [
        ("Sample rate: 1,024 Hz\nforce [N],tip [m/s^2]\n", "{y},{z}\n"),
        ("Abtastrate: 1.024 Hz\nforce [N];tip [m/s^2]\n", "{y};{z}\n"),
        ("Sample rate: 1 024 Hz\nforce [N],tip [m/s^2]\n", "{y},{z}\n"),
        (
            '"Model","DL850"\n"TraceName","force","tip"\n"VUnit","N","m/s^2"\n"SampleRate",1.024E+03,1.024E+03\n',
            ",{y},{z},\n",
        ),
        ("Source,force,tip\nSecond,N,m/s^2\n", "{t},{y},{z}\n"),
        ("Time/s,force/N,tip/(m/s^2)\n", "{t},{y},{z}\n"),
        ("in s,force in N,tip in m/s^2\n", "{t},{y},{z}\n"),
        ("Fs = 1024 Hz\nforce [N],tip [m/s^2]\n", "{y},{z}\n"),
        ('"TIMESTAMP","force","tip"\n"TS","N","m/s^2"\n"","Smp","Smp"\n', '"2026-11-30 10:00:0{t}",{y},{z}\n'),
        ("Kanalname;force;tip\nEinheit;N;m/s^2\nx-Einheit;s;s\nStart;10:15;10:15\n", "{t};{y};{z}\n"),
    ],
)
def test_clock_and_units_of_instruments_are_read(heading: str, row: str, tmp_path: Path) -> None:
    rows = "".join(row.format(t=f"{t:.9f}", y=f"{y:.9f}", z=f"{z:.9f}") for t, y, z in SAMPLES)
    (tmp_path / "a.csv").write_text(heading + (rows.replace(".", ",") if "Abtast" in heading else rows))
    with ExitStack() as stack:
        signals = signals_of(tmp_path / "a.csv", stack)
        assert [(signal.name, signal.unit) for signal in signals] == [("force", "N"), ("tip", "m/s^2")]
        assert signals[0].rate == pytest.approx(1024.0)
        np.testing.assert_allclose(signals[1].read(0, 300), SAMPLES[:, 2], atol=1e-8)


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be"])
def test_utf16_needs_no_mark(encoding: str, tmp_path: Path) -> None:
    rows = "".join(f"{t:.6f},{y:.6f}\n" for t, y, _ in SAMPLES)
    (tmp_path / "a.csv").write_bytes(("Time (s),tip (m/s²)\n" + rows).encode(encoding))
    with ExitStack() as stack:
        [signal] = signals_of(tmp_path / "a.csv", stack)
        assert (signal.name, signal.unit, signal.samples) == ("tip", "m/s²", 300)


def test_magnitude_of_reference_is_left_out(tmp_path: Path) -> None:
    heading = "Frequency (Hz),Channel 1 Magnitude (dB),Channel 2 Magnitude (dB),Channel 2 Phase (deg)\n"
    rows = "".join(f"{f:.4f},0.0,{level:.8f},{phase:.8f}\n" for f, level, phase in DECIBELS)
    (tmp_path / "a.csv").write_text(heading + rows)
    [curve] = analysis.read_frfs(tmp_path / "a.csv", unit="m/s^2/N")
    assert curve.response == "Channel 2"
    assert any("omitted: Channel 1 has columns for magnitude;" in warning for warning in curve.warnings)
    np.testing.assert_allclose(curve.value, ACCELERANCE, rtol=1e-6)


def test_unit_of_decibels_may_be_given(tmp_path: Path) -> None:
    path = write(tmp_path / "a.asc", "f (Hz)\tMagnitude (dB)\tPhase (deg)\n", DECIBELS)
    np.testing.assert_allclose(abs(analysis.read_frfs(path, unit="m/s^2/N")["response"].value), abs(ACCELERANCE))


def test_negative_magnitude_suggests_decibels(tmp_path: Path) -> None:
    path = write(tmp_path / "a.txt", "f (Hz)\tMagnitude (m/s²/N)\tPhase (deg)\n", DECIBELS)
    with pytest.raises(SceneError, match="may be decibels"):
        analysis.read_frfs(path)


def test_sound_pressure_is_refused_with_remedy() -> None:
    with pytest.raises(ValueError, match=r"sound pressure \(Pa\) is not a quantity .* Omit this channel"):
        quantity_and_scale("Pa")


SIGNALS = ["force", "tip"]


@pytest.mark.filterwarnings("ignore:.*the sample rate of its heading, 1024 Hz, is used")
@pytest.mark.parametrize(
    ("heading", "row"),
    [
        ("Sample;Time (s);force (N);tip (g)", "{number};{time:.8f};{force:.6f};{tip:.6f}"),
        ("Time 1 (s);force (N);Time 2 (s);tip (g)", "{time:.8f};{force:.6f};{time:.8f};{tip:.6f}"),
        ("Time (msec);force (N);tip (g)", "{ms:.5f};{force:.6f};{tip:.6f}"),
        ("Time (ms);force (N);tip (g);", "{ms:.5f};{force:.6f};{tip:.6f};"),
        ("% exported;by Fortran\nTime (s);force (N);tip (g)", "{time:.8f};{force:.6f};{fortran}"),
        (";time;force;tip", "{number};{time:.8f};{force:.6f};{tip:.6f}"),
        ("x-axis;force;tip\nsecond;N;Volt", "{time:+.8E};{force:+.6E};{tip:+.6E}"),
        ("X;force;tip;Start;Increment;\nSequence;N;g;-0.1;9.765625E-4;", "{number};{force:.6f};{tip:.6f};"),
        ("Time [s];force [N];tip [g]\n1 kHz;1 kHz;1 kHz\nMX840 1;MX840 2;MX840 3", "{time:.8f};{force:.6f};{tip:.6f}"),
        ("Time;force;tip\ns;N;g\nStart: 30.11.2026;;", "{time:.8f};{force:.6f};{tip:.6f}"),
        ("Zeit;force in N;tip in m/s²", "30.11.2026 10:15:0{time:.6f};{force:.6f};{tip:.6f}"),
        ("Sample Number;Date/Time;force (N);tip (g)", "{number};11/30/2026 9:15:0{time:.6f} PM;{force:.6f};{tip:.6f}"),
        ("Sampling rate [Hz]:;1024\nforce (N);tip (g)", "{force:.6f};{tip:.6f}"),
        ("Delta T (ms):;0.9765625\nforce (N);tip (g)", "{force:.6f};{tip:.6f}"),
        ("time_ms;force_N;tip_m/s2", "{ms:.5f};{force:.6f};{tip:.6f}"),
        ("millis;force;tip", "{ms:.5f};{force:.6f};{tip:.6f}"),
        ("Time;force;tip", "{time:.8f} sec;{force:.6f};{tip:.6f}"),
        ("Number,Date&Time,ms,force,tip\nNO.,Time,ms,N,g", "{number},2026/11/30 10:00:00,{ms:.4f},{force},{tip:.6f}"),
        ("Time interval : 0.9765625mS\n\n    #    force(N)    tip(g)", "{number}    {force:.6f}    {tip:.6f}"),
        ("Time (s);force (N);tip (g);Comment", "{time:.8f};{force:.6f};{tip:.6f};{comment}"),
        ("Time [s]   force [N]   tip [m/s²]", "{time:.8f}   {force:.6f}   {tip:.6f}"),
    ],
)
def test_columns_without_signals_are_omitted(heading: str, row: str, tmp_path: Path) -> None:
    rows = [
        row.format(
            number=number,
            time=time,
            ms=1e3 * time,
            force=force,
            tip=tip,
            fortran=f"{tip:.6E}".replace("E", "D"),
            comment="hit" if number == 100 else "",
        )
        for number, (time, force, tip) in enumerate(SAMPLES)
    ]
    (tmp_path / "a.prn").write_text("\n".join([heading, *rows]), encoding="utf-8")
    with ExitStack() as stack:
        signals = signals_of(tmp_path / "a.prn", stack)
        assert [signal.name for signal in signals] == ["force", "tip"]
        assert [signal.rate for signal in signals] == [1024.0, 1024.0]
        np.testing.assert_allclose(signals[1].read(0, 300), SAMPLES[:, 2], atol=1e-6)


@pytest.mark.parametrize(
    ("heading", "texts", "before"),
    [
        ("Time (s);force (N);tip (g);Info", ["triggered", ""], 3),
        ("Time (s);force (N);tip (g);Info", ["on"] * 300, 3),
        ("Time (s);force (N);tip (g);;Model;AB-12", [";Serial;12", ";Rate;1024 Hz"], 3),
        ("Time (s);Status;force (N);tip (g)", ["OK"] * 300, 1),
        ("Time (s);Event;force (N);tip (g)", ["start"] + [""] * 299, 1),
        ("No.;Event;at;Comment\n1;start;0.0;\n2;stop;0.3;\n\nTime;force (N);tip (g);Info", ["on"] * 300, 3),
    ],
)
def test_columns_of_texts_are_omitted(heading: str, texts: list[str], before: int, tmp_path: Path) -> None:
    rows = [[f"{value:.8f}" for value in row] for row in SAMPLES]
    for row, text in zip(rows, texts, strict=False):
        row.insert(before, text)
    (tmp_path / "a.csv").write_text("\n".join([heading, *map(";".join, rows)]), encoding="utf-8")
    with ExitStack() as stack, pytest.warns(RunWarning, match="columns with texts are not imported: "):
        signals = signals_of(tmp_path / "a.csv", stack)
        assert [(signal.name, signal.unit, signal.rate) for signal in signals] == [
            ("force", "N", 1024.0),
            ("tip", "g", 1024.0),
        ]
        np.testing.assert_allclose(signals[1].read(0, 300), SAMPLES[:, 2], atol=1e-8)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("Time (s),tip (g)\n0,00,0,16\n0,01,0,25\n", "commas separate its columns, and seem to be decimal marks"),
        ("Time (s),tip (g)\n0,1,1,6\n0,2,2,5\n", "commas separate its columns, and seem to be decimal marks"),
        ("Time (s),tip (g)\n0,0,5\n1,0,6\n2,1,7\n", "commas separate its columns, and seem to be decimal marks"),
        ("Time,tip (g)\n44321.500000000000,1\n44321.500011574074,2\n44321.500023148148,3\n", "a date in days"),
        ("time,tip (g)\n1620208800000.0,1\n1620208800001.0,2\n", "is probably a date in ms"),
        ("0.0,0.1,0.2\n0.0,1.6,1.7\n", "3 unnamed columns of 2 numbers"),
    ],
)
def test_ambiguous_numbers_are_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text)
    with ExitStack() as stack, pytest.raises(RecordingError, match=message):
        [signal.read(0, signal.samples) for signal in signals_of(tmp_path / "a.csv", stack)]


@pytest.mark.parametrize(
    "text",
    [
        "Sample rate,51200\n7,3,11\n14,6,22\n21,9,33\n",
        "Gain,2\n7,3,11,2\n14,6,22,4\n21,9,33,6\n28,9,44,8\n",
        "Fs,1000 Hz\n7,3,11,2\n14,6,22,4\n21,9,33,6\n28,9,44,8\n",
        "force,tip\n7,3,11\n14,6,22\n21,9,33\n",
        "01,3,01\n02,6,02\n03,9,03\n",
    ],
)
@pytest.mark.filterwarnings("ignore:.*has no heading; its first column rises evenly")
def test_other_lines_above_integers_are_read(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text)
    with ExitStack() as stack:
        columns = [signal.read(0, signal.samples).tolist()[:3] for signal in signals_of(tmp_path / "a.csv", stack)]
    assert [3.0, 6.0, 9.0] in columns


@pytest.mark.parametrize("rows", ["0,5,\n1,6,\n2,7,\n", "00,5\n01,6\n02,7\n", "0,05\n1,06\n2,07\n"])
def test_integers_are_no_decimals(rows: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("Time (s),tip (g)\n" + rows)
    with ExitStack() as stack:
        [signal] = signals_of(tmp_path / "a.csv", stack)
        assert (signal.name, signal.read(0, 3).tolist()) == ("tip", [5.0, 6.0, 7.0])


@pytest.mark.filterwarnings("ignore:.*has no heading; its first column rises evenly")
def test_text_above_numbers_is_no_name(tmp_path: Path) -> None:
    rows = "".join(f"{time:.8f},{tip:.6f}\n" for time, _, tip in SAMPLES)
    (tmp_path / "a.csv").write_text("Points:,300\nData:,\n" + rows)
    with ExitStack() as stack:
        [signal] = signals_of(tmp_path / "a.csv", stack)
        assert (signal.name, signal.rate) == ("column 2", 1024.0)


@pytest.mark.parametrize("ending", [".h5", ".npz", ".tdms", ".csv"])
def test_scale_of_integers_is_reported(ending: str, tmp_path: Path) -> None:
    path, counts = tmp_path / f"a{ending}", np.arange(-20, 20)
    if ending == ".h5":
        with h5py.File(path, "w") as file:
            file["tip"] = counts
            file["tip"].attrs["scale_factor"] = 0.0005
    elif ending == ".npz":
        np.savez(path, tip=counts, gain=0.0005)
    elif ending == ".tdms":
        with nptdms.TdmsWriter(str(path)) as writer:
            writer.write_segment([nptdms.ChannelObject("a", "tip", counts, {"gain": 0.0005})])
    else:
        path.write_text("Scale factor:,0.0005\ntime (s),tip\n" + "".join(f"{k},{n}\n" for k, n in enumerate(counts)))
    with ExitStack() as stack, pytest.warns(RunWarning, match="contains integers.* value of one count"):
        signals_of(path, stack)


@pytest.mark.parametrize("first", ["0.0;OL;1.0", "10:00:00;0.5;OL", "0.0;OL;OL", "10:00:00;OL;OL"])
def test_text_among_first_numbers_is_refused(first: str, tmp_path: Path) -> None:
    stamp = first.partition(";")[0]
    rows = [f"{stamp[:-1]}{number};0.5;1.0" for number in range(1, 6)]
    (tmp_path / "a.csv").write_text("\n".join(["Time;force (N);tip (g)", first, *rows]), encoding="utf-8")
    with ExitStack() as stack, pytest.raises(RecordingError, match="line 2: 'OL' is not a number"):
        signals_of(tmp_path / "a.csv", stack)


@pytest.mark.parametrize("heading", ["1;Kraft", "10;Kraft", "2026-11-30 10:00:00;start"])
@pytest.mark.filterwarnings("ignore:.*its first column rises evenly")
def test_heading_may_begin_with_number(heading: str, tmp_path: Path) -> None:
    rows = "".join(f"{time:.8f};{tip:.6f}\n" for time, _, tip in SAMPLES)
    (tmp_path / "a.csv").write_text(f"{heading}\n{rows}", encoding="utf-8")
    with ExitStack() as stack:
        signal = signals_of(tmp_path / "a.csv", stack)[-1]
        np.testing.assert_allclose(signal.read(0, 300), SAMPLES[:, 2], atol=1e-6)


def test_decimal_commas_may_be_quoted(tmp_path: Path) -> None:
    rows = [f'"{time:.8f}","{force:.6f}","{tip:.6f}"'.replace(".", ",") for time, force, tip in SAMPLES]
    (tmp_path / "a.csv").write_text("\n".join(['"Time (s)","force (N)","tip (g)"', *rows]), encoding="utf-8")
    with ExitStack() as stack:
        signals = text_signals(tmp_path / "a.csv", stack)
        assert [signal.rate for signal in signals] == [1024.0, 1024.0]
        np.testing.assert_allclose(signals[1].read(0, 300), SAMPLES[:, 2], atol=1e-6)


@pytest.mark.parametrize("changed", [0, 200])
def test_columns_of_other_times_are_refused(changed: int, tmp_path: Path) -> None:
    rows = [
        f"{time:.8f};{force:.6f};{time * (1 + (number >= changed)):.8f};{tip:.6f}"
        for number, (time, force, tip) in enumerate(SAMPLES)
    ]
    (tmp_path / "a.csv").write_text("\n".join(["Time 1 (s);force (N);Time 2 (s);tip (g)", *rows, ""]), encoding="utf-8")
    with ExitStack() as stack, pytest.raises(RecordingError, match=r"the times of column 'Time 2' differ"):
        text_signals(tmp_path / "a.csv", stack)[0].read(0, 300)


@pytest.mark.filterwarnings("ignore:.*its first column rises evenly", "ignore:.*columns with texts")
def test_settings_of_oscilloscope_are_omitted(tmp_path: Path) -> None:
    settings = ["Record Length,300,Points", "Source,CH1,", "Vertical Units,V,", *[",,"] * 297]
    rows = [f"{text},{time - 0.1:.8f},{tip:.6f},\n" for text, (time, _, tip) in zip(settings, SAMPLES, strict=True)]
    (tmp_path / "a.csv").write_text("".join(rows), encoding="utf-8")
    with ExitStack() as stack:
        signal = text_signals(tmp_path / "a.csv", stack)[0]
        assert signal.rate == 1024.0
        np.testing.assert_allclose(signal.read(0, 300), SAMPLES[:, 2], atol=1e-6)


def test_values_beyond_range_are_infinite(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("Time,tip\n(ms),(g)\n\n0,1\n1,∞\n2,-∞\n", encoding="utf-8")
    with ExitStack() as stack:
        assert text_signals(tmp_path / "a.csv", stack)[0].read(0, 3).tolist() == [1.0, np.inf, -np.inf]


def test_number_before_unit_is_no_scale(tmp_path: Path) -> None:
    rows = [f"{time:.8f},{tip:.6f}" for time, _, tip in SAMPLES]
    (tmp_path / "a.csv").write_text("\n".join(["Time (s),X (100g)", *rows]), encoding="utf-8")
    with ExitStack() as stack:
        [signal] = text_signals(tmp_path / "a.csv", stack)
        assert (signal.name, signal.unit) == ("X (100g)", "")


def test_arrays_of_hdf5_have_their_rate(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["test/force"], file["test/tip"] = SAMPLES[:, 1], SAMPLES[:, 2]
        file.attrs["fs"] = 1024.0
    with ExitStack() as stack:
        signals = signals_of(tmp_path / "a.h5", stack)
        assert [(signal.name, signal.rate) for signal in signals] == [("test.force", 1024.0), ("test.tip", 1024.0)]
        np.testing.assert_array_equal(signals[1].read(0, 300), SAMPLES[:, 2])


def test_other_items_of_hdf5_are_omitted(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, values in (("force", SAMPLES[:, 1]), ("tip", SAMPLES[:, 2])):
            file[name] = values
            file[name].attrs.update({"unit": "N" if name == "force" else "g", "sample_rate": 1024.0})
        file["comment"], file["empty"], file["none"] = "first hit", h5py.Empty("f"), np.zeros((0, 3))
        file.create_dataset("ragged", (2,), h5py.vlen_dtype(np.float64))[0] = [1.0, 2.0]
    with ExitStack() as stack, pytest.warns(RunWarning, match="omitted: /ragged"):
        signals = signals_of(tmp_path / "a.h5", stack)
    assert [(signal.name, signal.unit, signal.rate) for signal in signals] == [
        ("force", "N", 1024.0),
        ("tip", "g", 1024.0),
    ]


@pytest.mark.filterwarnings("ignore:.*'data.index' rises evenly")
@pytest.mark.parametrize("times", ["time", "index"])
def test_table_of_hdf5_has_columns(times: str, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["data"] = np.array([tuple(row) for row in SAMPLES], dtype=[(times, "f8"), ("force", "f8"), ("tip", "f8")])
    with ExitStack() as stack:
        signals = signals_of(tmp_path / "a.h5", stack)
        assert [(signal.name, signal.rate) for signal in signals] == [("data.force", 1024.0), ("data.tip", 1024.0)]
        np.testing.assert_array_equal(signals[1].read(0, 300), SAMPLES[:, 2])


def test_testlab_structure_states_frequencies(tmp_path: Path) -> None:
    axis = {"start_value": 0.25, "increment": 0.25, "number_of_values": FREQUENCY.size}
    ordinate = {"values": ACCELERANCE[:, None], "quantity": {"label": "(m/s^2)/N"}}
    scipy.io.savemat(tmp_path / "a.mat", {"FRF_1": {"x_values": axis, "y_values": ordinate}})
    [curve] = analysis.read_frfs(tmp_path / "a.mat")
    np.testing.assert_allclose(curve.frequency, FREQUENCY)
    np.testing.assert_allclose(curve.value, ACCELERANCE)


def test_exponents_of_fortran_are_read(tmp_path: Path) -> None:
    text = "".join(f"{f:14.6E}{real:16.8E}{imag:16.8E}\n".replace("E", "D") for f, real, imag in REAL_IMAG)
    (tmp_path / "a.dat").write_text(text, encoding="utf-8")
    [curve] = analysis.read_frfs(tmp_path / "a.dat", unit="m/s^2/N")
    np.testing.assert_allclose(curve.value, ACCELERANCE, rtol=1e-7)


@pytest.mark.parametrize(
    ("name", "unit", "factor"),
    [("omega", "rad/s", 2 * np.pi), ("freq_rad_sec", "rad/s", 2 * np.pi), ("f_kHz", "kHz", 1e-3)],
)
def test_unit_in_name_of_frequencies_is_read(name: str, unit: str, factor: float, tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", H=ACCELERANCE, **{name: factor * FREQUENCY})
    with pytest.warns(RunWarning, match=f"'{name}' are read in {unit}"):
        [curve] = analysis.read_frfs(tmp_path / "a.npz", unit="m/s^2/N")
    np.testing.assert_allclose(curve.frequency, FREQUENCY)


@pytest.mark.parametrize("name", ["f_radial", "Hz_radial"])
def test_name_of_direction_is_no_unit(name: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", H=ACCELERANCE, **{name: FREQUENCY})
    [curve] = analysis.read_frfs(tmp_path / "a.npz", unit="m/s^2/N")
    np.testing.assert_allclose(curve.frequency, FREQUENCY)


@pytest.mark.parametrize("name", ["CrossPowerSpectrum", "SpectrumXY", "H_csd"])
def test_cross_spectrum_is_omitted(name: str, tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", H=ACCELERANCE, f=FREQUENCY, **{name: ACCELERANCE})
    with pytest.warns(RunWarning, match=name):
        [_] = analysis.read_frfs(tmp_path / "a.npz", unit="m/s^2/N")


@pytest.mark.filterwarnings("ignore:.*has no heading; its first column rises evenly")
def test_first_line_may_contain_nan(tmp_path: Path) -> None:
    lines = "".join(f"{k / 100};{k};{k + 0.5}\n" for k in range(1, 30))
    (tmp_path / "a.csv").write_text(f"0.0;NaN;0.5\n{lines}", encoding="utf-8")
    with ExitStack() as stack:
        assert [signal.rate for signal in signals_of(tmp_path / "a.csv", stack)] == [100.0, 100.0]


def test_response_of_specimen_is_no_spectrum(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", H=ACCELERANCE, H_specimen=ACCELERANCE, f=FREQUENCY)
    assert len(analysis.read_frfs(tmp_path / "a.npz", unit="m/s^2/N")) == 2


def test_phase_needs_unit_below_pi(tmp_path: Path) -> None:
    rows = np.radians(POLAR)
    rows[0, 1:] = np.nan
    path = write(tmp_path / "a.txt", "f [Hz]\ttip mag [m/s²/N]\ttip phase\n", rows)
    with pytest.raises(SceneError, match=r"may be in rad or in degrees.*'phase \[rad\]'"):
        analysis.read_frfs(path)


def test_spectra_next_to_responses_are_left_out(tmp_path: Path) -> None:
    spectrum = np.full(FREQUENCY.size, 1.0 + 1.0j)
    scipy.io.savemat(tmp_path / "a.mat", {"f": FREQUENCY, "Hf_chan_2": ACCELERANCE, "Hf_Cross_Spec_chan_2": spectrum})
    with pytest.warns(RunWarning, match="omitted: Hf_Cross_Spec_chan_2"):
        [curve] = analysis.read_frfs(tmp_path / "a.mat", unit="m/s^2/N")
    np.testing.assert_allclose(curve.value, ACCELERANCE)


@pytest.mark.parametrize("ending", [".h5", ".tdms"])
def test_unit_of_times_is_read(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{ending}"
    if ending == ".h5":
        with h5py.File(path, "w") as file:
            file["time"], file["tip"] = 1e3 * TIME, SAMPLES[:, 2]
            file["time"].attrs["unit"] = "ms"
    else:
        channels = [nptdms.ChannelObject("a", "Time (ms)", 1e3 * TIME), nptdms.ChannelObject("a", "tip", SAMPLES[:, 2])]
        with nptdms.TdmsWriter(str(path)) as writer:
            writer.write_segment(channels)
    with ExitStack() as stack:
        [signal] = signals_of(path, stack)
        assert signal.rate == pytest.approx(1024.0)


@pytest.mark.parametrize(
    ("unit", "factor"),
    [
        ("seconds since 2026-11-30 10:00:00", 1.0),
        ("ms (relative)", 1e3),
        ("(ms)", 1e3),
        ("[ms]", 1e3),
        ("days since 2026-11-30", 1 / 86400),
    ],
)
def test_units_of_netcdf_times_are_read(unit: str, factor: float, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["time"], file["tip"] = factor * TIME, SAMPLES[:, 2]
        file["time"].attrs["units"] = unit
    with ExitStack() as stack:
        [signal] = signals_of(tmp_path / "a.h5", stack)
        assert signal.rate == pytest.approx(1024.0)


@pytest.mark.parametrize("unit", ["-", "1", "samples"])
def test_other_units_of_times_are_reported(unit: str, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["time"], file["tip"] = TIME, SAMPLES[:, 2]
        file["time"].attrs["units"] = unit
    with ExitStack() as stack, pytest.warns(RunWarning, match=r"time.* in s"):
        [signal] = signals_of(tmp_path / "a.h5", stack)
        assert signal.rate == pytest.approx(1024.0)


def test_seconds_of_day_are_no_dates(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", time=36000.0 + np.arange(300) / 8640.0, tip=SAMPLES[:, 2])
    with ExitStack() as stack:
        [signal] = signals_of(tmp_path / "a.npz", stack)
        assert signal.rate == pytest.approx(8640.0)


def test_date_of_calibration_is_no_scale(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", tip=np.arange(-20, 20), calibration_date=20260401, calendar=1, fs=1024.0)
    with ExitStack() as stack, warnings.catch_warnings():
        warnings.simplefilter("error", RunWarning)
        signals_of(tmp_path / "a.npz", stack)


def test_phase_in_other_units_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.txt", "f [Hz]\ttip mag [m/s²/N]\ttip phase [cycles]\n", POLAR / [1.0, 1.0, 360.0])
    with pytest.raises(SceneError, match=r"'cycles'\. Export it in deg or rad"):
        analysis.read_frfs(path)
