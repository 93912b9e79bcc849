"""Reading of frequency responses from files of this and other programs: Universal Files, text tables and arrays."""

import csv
import re
import warnings
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.core.modal.roving_hammer import exchange_points
from analysis.core.responses.checks.curve_checks import reversed_force
from analysis.extras.formats.frf_arrays import response_arrays
from daq.extras.importing import uff
from daq.extras.importing.files import signals_of
from daq.extras.importing.text_layout import UNNAMED, without_brackets
from daq.extras.importing.units import KINDS, quantity_of
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError, SceneError
from rig.core.base.escaping import unescape_cell
from rig.core.base.input_files import as_path
from rig.core.results.response import MOTIONS, Response, stack
from rig.core.results.uncertainty import SYSTEMATIC
from rig.core.results.universal_file import BOUND_LINE, DEVIATION_LINE, FRF, GENERAL, RESOLUTION_LINE
from rig.core.settings.quantities import DASHPOT, FREQUENCY, MASS, STIFFNESS, Kind, is_unit

_ARRAY_ENDINGS = (".mat", ".h5", ".hdf5", ".npz", ".npy")
# Heading of a column: name of the response, component, and unit of the phase.
_COLUMN_NAME = re.compile(
    r"(.*?)[\s_.:,|-]*(?<![^\W_])(real|re|imaginary|imag|im|magnitude|mag|amplitude|ampl|amp|abs"
    r"|phase|phase angle|pha|phi|arg"
    r"|realteil|imaginärteil|betrag|coherence|coh|kohärenz)"
    r"[\s_.]*(deg|rad|degrees|°)?",
    re.IGNORECASE,
)
# The component before the name, as circuit simulators write it: ``Re(tip)``.
_COMPONENT_OF_NAME = re.compile(r"^(re|im|abs|mag|phi|phase)[({](.*)[)}]$", re.IGNORECASE)
# The component as the first word: ``Real H11``.
_COMPONENT_BEFORE_NAME = re.compile(
    r"^(real|imag\w*|mag\w*|modulus|amplitude|phase)(?:[\s_.]+part)?[\s_.]+(\w.*)$", re.IGNORECASE
)
# Unit of a phase; the column before it contains the magnitude.
_ANGLE = re.compile(r"deg(rees?)?|°|rad(ians?)?|grad", re.IGNORECASE)
# Beginning of a unit, also of one that pint does not know, which the name of a response does not have.
_UNIT_BEGINNING = re.compile(r"db|\W|1/", re.IGNORECASE)
# Unit of a magnitude in decibels, after "dB": a reference value, and its unit.
_DECIBELS = re.compile(
    r"(?:re(?:f\w*)?\.?:?\s*|/\s*)?(?P<reference>\d[\d.]*(?:e[+-]?\d+)?)?\s*(?P<unit>[^\d\s].*)?", re.IGNORECASE
)
# Kinds of responses by the quantity of their motion, and of their inverses.
_RATIOS = {
    motion: Kind(f"a ratio of {motion} to force", f"{kind.si}/N", f"1 {kind.si}/N")
    for motion, kind in KINDS.items()
    if motion in MOTIONS
}
_INVERSES = {"dynamic stiffness": STIFFNESS, "mechanical impedance": DASHPOT, "apparent mass": MASS}
# Units of frequencies, and their values in Hz.
_FREQUENCY_UNITS = {"hz": 1.0, "khz": 1e3, "rad/s": 0.5 / np.pi}
# Largest deviation of a step between lines of a DFT from a multiple of their spacing, due to rounding in a table,
# relative to the spacing.
_MAX_ROUNDING = 0.05
# A DFT has at least this share of such steps. Tones at a constant ratio have a smaller share.
_MIN_EVEN_SHARE = 0.8
# A DFT has at least this share of its lines, where a gap counts as at most `_MAX_GAP` lines, such as between two bands.
# Without every third line the share is 0.66. Rounded tones at a constant ratio have 0.59, and tones that are closer at
# resonances have less.
_MIN_PRESENT_SHARE, _MAX_GAP = 0.63, 10.0
# Assumed noise bandwidth in lines: that of a Hann window, because files do not state the window.
_HANN_BANDWIDTH_LINES = 1.5
# Plausible range of the largest magnitude of a response, in SI units; both limits are far from any real structure.
_MIN_MAGNITUDE = 1e-30
_MAX_MAGNITUDE = 1e30
# Two lines are distinct if their relative frequency difference is at least this value.
_MIN_SPACING_RATIO = 1e-9
# Remedy if a file may contain time histories instead of responses.
_IMPORT = "If the file contains time histories, make a recording of it with `daq import`."
# Beginning of the names of columns without a heading.
_NO_NAME = UNNAMED.format("")
_NO_SYSTEMATIC_ERRORS = "The file states no systematic errors: the uncertainties include only random errors (type A)."
# A phase in radians is at most π; files round it.
_MAX_RADIANS = 3.15
# Components of a response by the first letter of their names.
_COMPONENTS = {
    "r": "real", "i": "imag", "m": "magnitude", "a": "magnitude", "b": "magnitude", "p": "phase",
    "c": "coherence", "k": "coherence",
}  # fmt: skip


def read_frfs(path: str | Path, reference: str | None = None, unit: str | None = None) -> Response:
    r"""Read frequency responses of other programs, with coherence if the file contains it.

    Parameters
    ----------
    path : str or Path
        A Universal File with data sets 58 of function type 4, the output of `analysis frf`, or a table. The first
        column of a table contains frequencies in Hz, followed by two columns for each response: ``body1 real [m/N]``
        and ``body1 imag [m/N]``, or ``magnitude`` and ``phase [deg]``. A MATLAB or numpy file contains complex
        arrays (a response in each column), and an array of their frequencies or the scalar ``df`` [Hz].
    reference : str, optional
        Node and direction of the force, such as ``"1 +Z"``; required if the file contains several forces.
    unit : str, optional
        Unit of the values, such as ``"m/s^2/N"`` or ``"g/N"``; required if the file states no unit. It overrides the
        unit in the file.

    Returns
    -------
    Response
        Named after nodes and directions, or as in the file. `identify` and all figures accept it. Only files written
        by this program contain standard uncertainties, limits of systematic errors, and the resolution.

    Raises
    ------
    RecordingError
        If the file cannot be read or contains no frequency responses of motion to force.
    SceneError
        If the reference is ambiguous or not in the file, or if a unit is missing or wrong.
    RunError
        If a package is missing.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "beam.csv"
    ...     _ = file.write_text("f [Hz],tip re [g/N],tip im [g/N]\n10,1,0\n20,0,-2\n")
    ...     tip = read_frfs(file)["tip"]
    >>> tip.name, tip.value.round(3).tolist()
    ('accelerance', [(9.807+0j), -19.613j])
    """
    file = as_path(path)
    if not file.is_file():
        raise RecordingError(f"{file}: no such file. Check the path.")
    if file.suffix.lower() in (".uff", ".unv"):
        return _checked(_from_uff(file, reference, unit))
    if reference is not None:
        raise SceneError(f"{file}: this file has no references to choose from. Omit the reference {reference!r}.")
    if file.suffix.lower() in _ARRAY_ENDINGS:
        return _checked(_from_arrays(file, unit))
    try:
        curves = _from_long_table(file, unit)
    except csv.Error as error:
        raise RecordingError(f"{file}: not readable as a CSV table ({error}). Export it again.") from None
    return _checked(curves or _from_table(file, unit))


def _checked(curves: Sequence[Response]) -> Response:
    """Join the curves of a file, with a warning if the file states no systematic errors."""
    response = stack(curves)
    return response if all(curve.limits for curve in curves) else response.warn(_NO_SYSTEMATIC_ERRORS)


def is_frf_file(path: Path) -> bool:
    """Return whether a file may contain frequency responses; not a recording, or a scene, which has none yet."""
    return path.suffix.lower() not in (".mcap", ".yaml", ".yml")


def _from_uff(path: Path, reference: str | None, unit: str | None) -> list[Response]:
    """Read the responses to one reference from a Universal File."""
    sets = uff.functions(path)
    frf_sets = [data_set for data_set in sets if int(data_set["func_type"]) == FRF]
    if not frf_sets:
        has_time = any(uff.is_time(data_set) for data_set in sets)
        remedy = "It contains time responses: convert them with `daq import`."
        remedy = remedy if has_time else "Export a frequency response to this file."
        raise RecordingError(f"{path}: no frequency response (data set 58, function type 4). {remedy}")
    references = list(dict.fromkeys(uff.point(data_set, "ref") for data_set in frf_sets))
    is_roving = len(references) == len(frf_sets) > 1 == len({uff.point(data_set, "rsp") for data_set in frf_sets})
    if reference is None and len(references) > 1 and not is_roving:
        raise SceneError(
            f"{path}: the file contains responses to {len(references)} references. Choose one with `reference`: "
            f"{', '.join(references)[:300]}."
        )
    selected = [data_set for data_set in frf_sets if reference in (None, uff.point(data_set, "ref"))]
    if not selected:
        raise SceneError(f"{path}: no reference {reference!r}. Choose one of {', '.join(references)[:300]}.")
    coherence, column_of = {}, {}
    for data_set in sets:
        kind, points = int(data_set["func_type"]), _points(data_set)
        if kind == uff.COHERENCE:
            coherence[points] = np.asarray(data_set["data"]).real
        elif kind == GENERAL and uff.title(data_set).startswith((DEVIATION_LINE, BOUND_LINE)):
            column_of[points, uff.title(data_set)] = np.asarray(data_set["data"]).real
    curves = []
    for name, data_set in zip(_names(selected), selected, strict=True):
        data, frequency = np.asarray(data_set["data"]), np.asarray(data_set["x"], dtype=float)
        if not np.iscomplexobj(data) or data.size != frequency.size:
            raise RecordingError(
                f"{path}: {name} is not a complex value for each frequency. Export the response as complex values "
                "(real and imaginary parts)."
            )
        # The unit of the ratio follows from the axis labels.
        numerator, denominator = uff.label(data_set, "ordinate"), uff.label(data_set, "orddenom")
        label = f"({numerator})/({denominator})" if numerator and denominator else numerator
        motion, scale = _ratio(f"{path}: {name}", label, unit)
        points = _points(data_set)
        stated = (column_of.get((points, f"{line} {uff.title(data_set)}")) for line in (DEVIATION_LINE, BOUND_LINE))
        error, bound = (None if column is None else scale * column for column in stated)
        resolution = uff.stated_number(data_set, RESOLUTION_LINE)
        curve = _curve(path, name, frequency, scale * data, motion, coherence.get(points), error, resolution, bound)
        # In files of this program, nodes are bodies.
        is_own = str(data_set.get("id4") or "").startswith(RESOLUTION_LINE)
        places = [
            f"body {int(data_set[f'{end}_node'])}" if is_own else f"node {point}"
            for end, point in zip(("rsp", "ref"), points, strict=True)
        ]
        curves.append(curve.placed(places[0], places[1]))
    if reference is None and is_roving:
        note = "Roving hammer: by reciprocity, the points of the forces are listed as points of the responses."
        return [curve.warn(note) for curve in exchange_points(curves).curves()]
    warning = reversed_force(curves)
    return [curve.warn(warning) for curve in curves] if warning else curves


def _points(data_set: Mapping[str, Any]) -> tuple[str, str]:
    """Return the points of response and force."""
    return uff.point(data_set, "rsp"), uff.point(data_set, "ref")


def _names(sets: Sequence[Mapping[str, Any]]) -> list[str]:
    """Name responses by their titles if these are distinct, else by their positions if distinct, else with numbers."""
    for names in ([uff.title(data_set) for data_set in sets], [uff.point(data_set, "rsp") for data_set in sets]):
        if len(set(names)) == len(names):
            return names
    return [f"{uff.point(data_set, 'rsp')} #{number}" for number, data_set in enumerate(sets, 1)]


def _ratio(where: str, stated: str, given: str | None = None) -> tuple[str, float]:
    """Return the motion quantity of a ratio of motion to force, and the SI value of the ratio's unit.

    `where`: location in the file, for messages. The unit `given` overrides the unit `stated` in the file, but not that
    of a dynamic stiffness: its poles are antiresonances.

    >>> _ratio("a", "(1/N)*(m/s²)"), _ratio("a", "[g]/[N]"), _ratio("a", "m/N")
    (('acceleration', 1.0), ('acceleration', 9.80665), ('displacement', 1.0))
    """
    for text in filter(None, (stated, given)):
        # In FRFs, g is the standard gravity, not the gram.
        if found := quantity_of(re.sub(r"\b([mun]?)g\b", r"\1gn", text), _INVERSES):
            raise SceneError(
                f"{where}: the unit {text!r} is force per motion ({found[0]}). Export its inverse, such as m/N."
            )
    unit = given or stated.strip()
    if not unit:
        raise SceneError(f"{where}: the file states no unit. Give the unit, such as `unit` m/s^2/N.")
    if ratio := quantity_of(unit, _RATIOS):
        return ratio
    raise SceneError(
        f"{where}: unit {unit!r}; expected motion per force, such as m/N, m/s/N, m/s^2/N or g/N. If the values are "
        "such a response and not a cross spectrum, give its unit as `unit`. To identify the poles of other responses, "
        "such as sound pressures, give `unit` m/s^2/N; the shapes then have the unit of the file."
    )


def _from_long_table(path: Path, unit: str | None) -> list[Response]:
    """Read a table of `analysis frf`, with a row for each response and frequency; empty for other tables."""
    with path.open(newline="", encoding="utf-8-sig", errors="replace") as stream:
        reader = csv.DictReader(stream)
        heading = reader.fieldnames or []
        real = next((name for name in heading if name.startswith("real ")), None)
        if real is None or not {"response", "frequency_Hz", real.replace("real", "imag", 1)} <= {*heading}:
            return []
        motion, scale = _ratio(str(path), real.removeprefix("real "), unit)
        imag, deviation, systematic = (
            real.replace("real", name, 1) for name in ("imag", "magnitude_std", "systematic")
        )
        # Rows by the names of test and response, and the references of these responses.
        rows: dict[tuple[str, str], list[list[float]]] = {}
        inputs: dict[tuple[str, str], str] = {}
        for row in reader:
            try:
                # Empty cells are frequencies that the test omitted; a missing cell is an error.
                numbers = [
                    float(row["frequency_Hz"]),
                    *(float(row[name] if row[name] != "" else "nan") for name in (real, imag)),
                ]
                optional = (deviation, "coherence", "resolution_Hz", systematic)
                numbers += [float(row.get(name) or "nan") for name in optional]
            except (TypeError, ValueError):
                raise RecordingError(
                    f"{path}:{reader.line_num}: a cell is not a number; expected numbers in the columns "
                    f"frequency_Hz, {real}, {imag}. Correct this row."
                ) from None
            key = row.get("scene") or "", unescape_cell(row["response"] or "")
            rows.setdefault(key, []).append(numbers)
            inputs[key] = unescape_cell(row.get("reference") or "").removeprefix("force at ")
    scenes = {scene for scene, _ in rows}
    if len(scenes) > 1:
        raise SceneError(
            f"{path}: curves of several tests ({', '.join(sorted(scenes))[:200]}). Write a separate file for each test."
        )
    curves = []
    for (scene, name), numbers_of_curve in rows.items():
        frequency, real_part, imaginary_part, error, coherence, resolution, bound = np.array(numbers_of_curve).T
        value = scale * (real_part + 1j * imaginary_part)
        curve = _curve(
            path, name, frequency, value, motion, coherence, scale * error, float(resolution[0]), scale * bound
        )
        reference = inputs[scene, name]
        curves.append(curve.placed("", reference if reference != "force" else ""))
    return curves


def _from_table(path: Path, unit: str | None) -> list[Response]:
    """Read a table of columns: frequency, then two columns for each response."""
    with ExitStack() as stack, warnings.catch_warnings():
        # Without a heading, a rising first column is otherwise interpreted as times; here it contains frequencies.
        warnings.filterwarnings("ignore", message=".* has no heading; its first column rises evenly")
        first, *others = signals_of(path, stack)
        unnamed = [
            signal.read(0, signal.samples)
            for signal in (first, *others)
            if signal.name.startswith(_NO_NAME) and not signal.unit
        ]
        if first.name == UNNAMED.format(2) and first.rate is not None:
            unnamed.insert(0, first.start_s + np.arange(first.samples) / first.rate)
        if len(unnamed) == 3 and (np.diff(unnamed[0]) > 0.0).all():
            frequency, real, imag = unnamed
            return [_unnamed_curve(path, frequency, real, imag, unit)]
        frequency = first.read(0, first.samples)
        columns = [(signal.name, signal.unit, signal.read(0, signal.samples)) for signal in others]
    # A column in Hz contains frequencies, whatever its name: analyzers call it X-Axis.
    if (factor := _FREQUENCY_UNITS.get(first.unit.lower())) is not None:
        frequency = factor * frequency
    elif first.unit or not re.match(r"f|hz", first.name, re.IGNORECASE):
        column = f"is {first.name!r}" if first.rate is None else "contains times"
        raise RecordingError(
            f"{path}: the first column {column}; expected frequencies in Hz, such as 'f [Hz]'. {_IMPORT}"
        )
    for k in range(1, len(columns)):
        (name, column_unit, magnitude), (_, phase_unit, phase) = columns[k - 1 : k + 1]
        if _ANGLE.fullmatch(phase_unit) and not _COLUMN_NAME.fullmatch(name):
            name = "" if name.startswith(_NO_NAME) else name
            columns[k - 1] = f"{name} magnitude", column_unit, magnitude
            columns[k] = f"{name} phase", phase_unit, phase
    components: dict[str, dict[str, tuple[str, Array]]] = {}
    for heading, column_unit, values in columns:
        name, column_unit = _with_component(heading, column_unit)
        match = _COLUMN_NAME.fullmatch(_COMPONENT_OF_NAME.sub(r"\2 \1", name))
        match = match or _COLUMN_NAME.fullmatch(_COMPONENT_BEFORE_NAME.sub(r"\2 \1", name))
        if match is None:
            raise RecordingError(
                f"{path}: column {name!r}; expected a name that ends in real, imag, magnitude or phase. {_IMPORT}"
            )
        response, component = match[1].strip("|/") or "response", _COMPONENTS[match[2][0].lower()]
        if component in components.setdefault(response, {}):
            raise RecordingError(
                f"{path}: column {heading!r} is a second column for {component} of {response}. Give the columns the "
                "names of their responses, such as 'tip real' and 'tip imag'."
            )
        components[response][component] = (match[3] or column_unit, values)
    curves, incomplete = [], []
    for name, pair in components.items():
        _, coherence = pair.pop("coherence", ("", None))
        if not pair:
            # A column of coherence without the name of a response.
            continue
        if pair.keys() not in ({"real", "imag"}, {"magnitude", "phase"}):
            incomplete.append(f"{name} has columns for {', '.join(pair)}")
            continue
        column_unit, first_column = pair["real"] if "real" in pair else pair["magnitude"]
        if "magnitude" in pair:
            column_unit, first_column = _linear_magnitude(f"{path}: {name}", column_unit, first_column)
        motion, scale = _ratio(f"{path}: {name}", column_unit, unit)
        if "real" in pair:
            value = first_column + 1j * pair["imag"][1]
        else:
            phase_unit, phase = pair["phase"]
            if phase_unit and not _ANGLE.fullmatch(phase_unit):
                raise SceneError(f"{path}: {name}: its phase has the unit {phase_unit!r}. Export it in deg or rad.")
            largest = float(np.nanmax(abs(phase), initial=0.0))
            if not phase_unit and largest <= _MAX_RADIANS:
                raise SceneError(
                    f"{path}: {name}: its phase has no unit and is at most {largest:.3g}: it may be in rad "
                    "or in degrees. Add the unit to the name of the column, such as 'phase [rad]'."
                )
            value = first_column * np.exp(1j * (phase if phase_unit.startswith("rad") else np.radians(phase)))
        curves.append(_curve(path, name, frequency, scale * value, motion, coherence))
    missing = f"{'; '.join(incomplete)}; expected real and imag, or magnitude and phase. Export both."
    if not curves:
        raise RecordingError(f"{path}: {missing}")
    return [curve.warn(f"A response is omitted: {missing}") for curve in curves] if incomplete else curves


def _with_component(name: str, unit: str) -> tuple[str, str]:
    """Return the name of a column with the component of its response, which may stand in brackets, like a unit.

    >>> _with_component("H11", "real"), _with_component("Real", "H11"), _with_component("Real", "m/N")
    (('H11 real', ''), ('H11 Real', ''), ('Real', 'm/N'))
    """
    if unit and _COLUMN_NAME.fullmatch(unit):
        return f"{name} {unit}", ""
    match = _COLUMN_NAME.fullmatch(name)
    is_component_alone = match is not None and not match[1]
    if unit and is_component_alone and not (is_unit(unit) or _ANGLE.fullmatch(unit) or _UNIT_BEGINNING.match(unit)):
        return f"{unit} {name}", ""
    return name, unit


def _linear_magnitude(where: str, unit: str, magnitude: Array) -> tuple[str, Array]:
    """Return the unit of a magnitude, without decibels, and the magnitude in this unit.

    >>> _linear_magnitude("a", "dB re 1 m/s^2/N", np.array([20.0]))
    ('m/s^2/N', array([10.]))
    """
    if unit[:2].lower() == "db" and (match := _DECIBELS.fullmatch(without_brackets(unit[2:].strip()))):
        return match["unit"] or "", float(match["reference"] or 1.0) * 10.0 ** (magnitude / 20.0)
    if (magnitude < 0.0).any():
        raise SceneError(
            f"{where}: a magnitude is negative, so the values may be decibels. Give the column the unit dB, such "
            "as 'tip magnitude [dB re 1 m/s^2/N]'."
        )
    return unit, magnitude


def _from_arrays(path: Path, unit: str | None) -> list[Response]:
    """Read complex arrays of a MATLAB or numpy file."""
    values, frequency, coherence, stated_unit = response_arrays(path)
    motion, scale = _ratio(str(path), stated_unit, unit)
    return [_curve(path, name, frequency, scale * value, motion, coherence[name]) for name, value in values.items()]


def _unnamed_curve(path: Path, frequency: Array, real: Array, imag: Array, unit: str | None) -> Response:
    """Return the curve of a table without a heading; reject the table if its second column may contain magnitudes."""
    remedy = "a heading, such as: f [Hz],tip magnitude [m/N],tip phase [deg]"
    if not (real < 0.0).any():
        raise RecordingError(
            f"{path} has no heading, and its second column has no negative value: it may be a real part or a "
            f"magnitude. Add {remedy}."
        )
    motion, scale = _ratio(str(path), "", unit)
    curve = _curve(path, "response", frequency, scale * (real + 1j * imag), motion)
    return curve.warn(
        f"{path} has no heading: frequency in Hz, real part and imaginary part are assumed. If this is wrong, add "
        f"{remedy}."
    )


def _curve(
    path: Path,
    name: str,
    frequency: Array,
    value: NDArray[Any],
    motion: str,
    coherence: Array | None = None,
    error: Array | None = None,
    resolution: float | None = None,
    bound: Array | None = None,
) -> Response:
    """Build a curve from its valid lines in order of frequency; `bound`: systematic limit, infinite if unknown."""
    lines = _valid_lines(f"{path}: {name}", frequency, value)
    if resolution is None or not 0.0 <= resolution < np.inf:
        resolution = _HANN_BANDWIDTH_LINES * _dft_spacing(frequency[lines])

    def column(values: Array | None) -> Array:
        """Select the valid lines; NaN where the file has no value or an impossible value."""
        if values is None or values.size != frequency.size:
            return np.full(lines.size, np.nan)
        return np.where(np.isfinite(values[lines]) & (values[lines] >= 0.0), values[lines], np.nan)

    limits = {}
    if bound is not None and bound.size == frequency.size and not np.isnan(bound[lines]).all():
        limits[SYSTEMATIC] = np.where(abs(bound[lines]) < _MAX_MAGNITUDE, abs(bound[lines]), np.inf)
    return Response.curve(
        frequency[lines],
        np.asarray(value, dtype=complex)[lines],
        name,
        motion=motion,
        error=column(error),
        limits=limits,
        coherence=column(coherence),
        label=path.stem,
        resolution=resolution,
        omitted=np.sort(frequency[(frequency > 0) & np.isfinite(frequency) & ~np.isfinite(value)]),
    )


def _dft_spacing(frequency: Array) -> float:
    """Return the spacing of ascending lines of a DFT, some of which may be absent; 0 for other frequencies.

    >>> round(_dft_spacing(np.array([0.33, 0.67, 1.0, 1.33, 2.0, 2.33, 2.67])), 3)
    0.334
    >>> _dft_spacing(np.geomspace(1.0, 100.0, 50))
    0.0
    """
    steps = np.diff(frequency)
    if not steps.size:
        return 0.0
    # Absent lines make some steps larger, so the spacing is one of the smaller steps.
    spacing = float(np.quantile(steps, 0.25))
    multiples = np.maximum(np.round(steps / spacing), 1.0)
    is_even = np.quantile(abs(steps / spacing - multiples), _MIN_EVEN_SHARE) < _MAX_ROUNDING
    is_even &= steps.size >= _MIN_PRESENT_SHARE * np.minimum(multiples, _MAX_GAP).sum()
    return float(steps[abs(steps - spacing) < _MAX_ROUNDING * spacing].mean()) if is_even else 0.0


def _valid_lines(where: str, frequency: Array, value: NDArray[Any]) -> NDArray[np.intp]:
    """Return the indices of the valid lines in order of frequency; reject magnitudes that no structure can have."""
    valid = np.flatnonzero((frequency > 0) & np.isfinite(frequency) & np.isfinite(value))
    if not valid.size:
        raise RecordingError(f"{where} has no finite value at a frequency above 0 Hz. Export the file again.")
    lines = valid[np.argsort(frequency[valid])]
    for hertz in frequency[lines[[0, -1]]]:
        if not FREQUENCY.supports(hertz):
            raise RecordingError(f"{where} has a line at {hertz:.3g} Hz; expected {FREQUENCY.range}. Correct the file.")
    largest = abs(value[lines]).max()
    if largest and not _MIN_MAGNITUDE <= largest <= _MAX_MAGNITUDE:
        raise RecordingError(
            f"{where} reaches {largest:.3g} in SI units; expected {_MIN_MAGNITUDE:g} to {_MAX_MAGNITUDE:g}. Correct "
            "the unit, or export the file again."
        )
    repeated = np.flatnonzero(np.diff(frequency[lines]) <= _MIN_SPACING_RATIO * frequency[lines[1:]])
    if repeated.size:
        raise RecordingError(
            f"{where} has the frequency {frequency[lines[repeated[0]]]:.9g} Hz twice. Export the file with enough "
            "digits to distinguish the frequencies."
        )
    return lines
