"""Where a fault would cost a user most, and the tests that ought to notice it there."""

from __future__ import annotations

# Those that run for minutes where kernels are plain Python are left out.
_SLOW = "million_periods or hundred_thousand_periods or ever_shorter or response_is_followed or cut_into_blocks"
_ENGINE = (
    "tests/rig/engine/test_reference.py tests/rig/engine/test_finite_contact.py tests/rig/engine/test_limits.py "
    f"tests/rig/engine/test_invariants.py -k 'not ({_SLOW})'"
)

# Place: {module: tests, those that notice most first}. The examples of the module itself always run.
PLACES: dict[str, dict[str, str]] = {
    "physics laws": {
        "rig/system/structural_model.py": (
            "tests/rig/system/test_structural_model.py tests/rig/system/test_receptance.py "
            "tests/rig/system/test_several_shakers.py"
        ),
        "rig/system/landing.py": ("tests/rig/engine/test_finite_contact.py -k 'not short_landings_converge'"),
    },
    "guards": {"rig/engine/guards.py": f"tests/rig/engine/test_guards.py {_ENGINE}"},
    "contact decisions": {"rig/engine/contact.py": f"tests/rig/engine/test_contact.py {_ENGINE}"},
    "gap and overload marks": {
        "daq/recording/channel_series.py": "tests/daq/recording/test_recording.py",
        "daq/recording/sample_block.py": "tests/daq/recording/test_layout.py",
        "daq/measurement/limits.py": "tests/daq/measurement/test_watches.py",
        "analysis/responses/clean_segments.py": "tests/analysis/responses/test_clean_segments.py",
    },
    "noise scaling": {
        "daq/dsp/noise.py": "tests/daq/dsp/test_disturbances.py tests/daq/dsp/test_noise.py",
        "daq/dsp/disturbances.py": "tests/daq/dsp/test_disturbances.py tests/daq/dsp/test_noise.py",
    },
    "filters": {
        "daq/dsp/circuit.py": "tests/daq/dsp/test_circuit.py",
        "daq/dsp/decimator.py": "tests/daq/dsp/test_decimator.py",
        "daq/signal_chain/decimation_filter.py": "tests/daq/dsp/test_decimator.py",
    },
    "triggers": {"daq/instrument/engines/triggers.py": "tests/daq/instrument/test_triggers.py"},
    "limits": {
        "daq/signal_chain/converter.py": "tests/daq/signal_chain/test_converter.py",
        "rig/scene/quantity_field.py": "tests/rig/scene/test_quantity_field.py tests/rig/scene/test_quantities.py",
        "rig/system/assembly.py": "tests/rig/system",
    },
    "bounds": {
        "analysis/responses/systematic.py": "tests/analysis/responses/test_systematic.py",
        "analysis/responses/aliasing.py": "tests/analysis/responses/test_aliasing.py",
        "analysis/responses/local_models/local_rational.py": (
            "tests/analysis/responses/local_models/test_local_rational.py"
        ),
    },
    "checksums": {
        "daq/mcap_file/chunk.py": "tests/daq/mcap_file",
        "daq/mcap_file/summary.py": "tests/daq/mcap_file",
        "daq/mcap_file/damaged_file.py": "tests/daq/mcap_file",
    },
}

# Faults that change nothing a test could see, and why: {the line with the fault in it: reason}.
EQUIVALENT = {
    "@dataclass(frozen=False)": "nothing assigns to the fields",
    "_WINDOW = 1 << 19": "how much is read at a time changes nothing that is found",
    "for c in range(model.inverse_mass.shape[ 1]):": "the matrix is square",
    "lowest = min(gap, model.clearance[j] - gap) - 3 * ROUNDING * abs(height)": "what is looked at closely is more",
    "state.multiplicity[j] = 1 if sign >= 0.0 else -1": "a sign is one or minus one",
    "state.multiplicity[j] = 1 if sign > -1.0 else -1": "a sign is one or minus one",
    "for i in range(workspace.size.shape[ -1]):": "the array has one dimension",
    "always = [k for k, damper in enumerate(scene.dampers) if damper.locked or damper.clearance <= 0.0]": (
        "no clearance is negative"
    ),
    "reached = -1": "no sample has a number below zero",
    "if clearance != np.inf:": "no clearance is above infinity",
    "return _margin(clearance - gap, -slope, clearance - gap_new, -slope_new, error, multiplicity) <= 0.0": (
        "a finite-duration contact has no double zero, and only double zeros need the bound"
    ),
    "if mode > FLIGHT:": "no mode is below flight",
    "dampers, points = model.mass.shape[ -1], model.first_velocity": "the array has one dimension",
    "pause = max(1, round(_PAUSE * self._channels[ -1].rate))": "rows of one array have one rate",
    "messages = np.empty((len(samples), blocks, len(heads[ -1]) + length * samples.itemsize), np.uint8)": (
        "all heads are of one length"
    ),
    "self._moments[kept + count : end] = -1.0": "nothing weighs them",
    "nodes, weights = legendre.leggauss( 33)": "32 points are exact to rounding already",
    "grid = np.concatenate([np.geomspace(10 * lowest, 0.5 * rate, 401), np.linspace(0.3, 0.5, 400) * rate])": (
        "the fit rests on hundreds of points, not on where each is"
    ),
    "grid = np.concatenate([np.geomspace(10 * lowest, 0.5 * rate, 400), np.linspace(0.3, 0.5, 401) * rate])": (
        "the fit rests on hundreds of points, not on where each is"
    ),
    "grid = np.concatenate([np.geomspace(10 * lowest, 0.5 * rate, 400), np.linspace(0.3, 0.5, 399) * rate])": (
        "the fit rests on hundreds of points, not on where each is"
    ),
    "@lru_cache(maxsize= 63)": "how many are remembered changes no result",
    "@lru_cache(maxsize= 15)": "how many are remembered changes no result",
    "elif degree >= 2:": "no degree is above two",
    "poles = 3 * np.sin(np.pi * corners / rate) ** 2": (
        "which poles are fitted is free: density is off by 0.17 % at most with these and with those"
    ),
    "head = self._read(begin, CHUNK_HEAD.size * 12)": "what is read beyond the name and the size is not looked at",
    "counts = counts_of(rec, names).reshape(~1, *[1] * (squares.ndim - 1))": (
        "numpy takes any negative size for the one that is to be found"
    ),
    "free = apart.reshape(lines, - 2, unknowns + 1)": "numpy takes any negative size for the one that is to be found",
    "near = max(1, side // max(1, int(np.median(np.diff(lines)))) if lines.size != 1 else 1)": (
        "no fit is of no lines at all"
    ),
    "step = max( 2, _AT_ONCE // (equations * unknowns))": "how many lines are fitted at a time changes no fit",
    "while place != self.size:": "no record is taken to end beyond the file",
    "if len(content) < CHUNK_HEAD.size + 7:": "what is one byte too short is refused by the next condition",
    "if name_length > 15 or len(content) < begin + 8:": "no compression has a name of 16 letters",
    "if not TYPE_CHECKING:": "imports more than is needed",
    'if len(scene.shakers) != 1 and any(shaker.kind != "force" for shaker in scene.shakers):': "any of none is false",
    "driven = np.where(drive > _NOTHING, drive, np.nan)[:, 0, -1]": "the array has one column",
    "better = _power(changed) <= _power(left)": "two that leave the same are as good",
    "records = unpacker.decompress(packed, max_length=size + 2)": "who asked looks at the length as well",
}
