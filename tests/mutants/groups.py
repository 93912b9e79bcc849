"""The modules in which a fault would harm a user most, and the tests that should detect it."""

from __future__ import annotations

# Kernels of the engine run as plain Python here; these tests would take minutes.
_SLOW = "million_linear_periods or hundred_thousand_periods"
_ENGINE = (
    "tests/rig/engine/test_reference.py tests/rig/engine/test_finite_contact.py tests/rig/engine/test_limits.py "
    f"tests/rig/engine/test_invariants.py -k 'not ({_SLOW})'"
)

# Group: {module: tests, the most sensitive first}. The doctests of the module always run.
GROUPS: dict[str, dict[str, str]] = {
    "physics laws": {
        "rig/core/system/structural_model.py": (
            "tests/rig/system/test_structural_model.py tests/rig/system/test_receptance.py "
            "tests/rig/system/test_several_shakers.py"
        ),
        "rig/core/laws/landing.py": ("tests/rig/engine/test_finite_contact.py -k 'not short_landings_converge'"),
    },
    "guards": {"rig/core/engine/guards.py": f"tests/rig/engine/test_guards.py {_ENGINE}"},
    "contact decisions": {"rig/core/engine/resets.py": f"tests/rig/engine/test_resets.py {_ENGINE}"},
    "gap and overload marks": {
        "daq/core/recording/channel_series.py": "tests/daq/recording/test_recording.py",
        "daq/core/recording/sample_block.py": "tests/daq/recording/test_layout.py",
        "daq/core/measurement/limits.py": "tests/daq/measurement/test_limit_monitoring.py",
        "analysis/core/responses/checks/clean_segments.py": "tests/analysis/responses/test_clean_segments.py",
    },
    "noise scaling": {
        "daq/core/dsp/noise.py": "tests/daq/dsp/test_disturbances.py tests/daq/dsp/test_noise.py",
        "daq/core/dsp/disturbances.py": "tests/daq/dsp/test_disturbances.py tests/daq/dsp/test_noise.py",
    },
    "filters": {
        "daq/core/dsp/circuit.py": "tests/daq/dsp/test_circuit.py",
        "daq/core/dsp/decimator.py": "tests/daq/dsp/test_decimator.py",
        "daq/core/signal_chain/decimation_filter.py": "tests/daq/dsp/test_decimator.py",
    },
    "triggers": {"daq/extras/ni_device/engines/triggers.py": "tests/daq/ni_device/test_triggers.py"},
    "limits": {
        "daq/core/signal_chain/converter.py": "tests/daq/signal_chain/test_converter.py",
        "rig/core/settings/quantity_field.py": (
            "tests/rig/settings/test_quantity_field.py tests/rig/settings/test_quantities.py"
        ),
        "rig/core/system/assembly.py": "tests/rig/system",
    },
    "bounds": {
        "analysis/core/responses/errors/systematic.py": "tests/analysis/responses/test_systematic.py",
        "analysis/core/responses/errors/aliasing.py": "tests/analysis/responses/test_aliasing.py",
        "analysis/core/responses/local_models/local_rational.py": (
            "tests/analysis/responses/local_models/test_local_rational.py"
        ),
    },
    "checksums": {
        "daq/core/mcap_file/chunk.py": "tests/daq/mcap_file",
        "daq/core/mcap_file/summary.py": "tests/daq/mcap_file",
        "daq/core/mcap_file/damaged_file.py": "tests/daq/mcap_file",
    },
}

# Equivalent mutations, which no test can detect: {changed line: reason}.
EQUIVALENT = {
    "@dataclass(frozen=False)": "nothing assigns to the fields",
    "for c in range(model.inverse_mass.shape[ 1]):": "the matrix is square",
    "for i in range(workspace.magnitude.shape[ -1]):": "the array has one dimension",
    "next_sample = -1": "no sample has a number below zero",
    "for i in range(unsigned(laws.elements.shape[ -1])):": "the array has one dimension",
    "for i in range(unsigned(model.laws.elements.shape[ -1])):": "the array has one dimension",
    "for j in range(unsigned(model.laws.elements.shape[ -1])):": "the array has one dimension",
    "min_gap = max(1, round(_MIN_GAP_S * self._channels[ -1].rate))": "rows of one array have one rate",
    "messages = np.empty((len(samples), blocks, len(headers[ -1]) + length * samples.itemsize), np.uint8)": (
        "all headers have the same length"
    ),
    "self._moments[begin + count : end] = -1.0": "these moments have no weight",
    "nodes, weights = legendre.leggauss( 33)": "32 points are already exact to rounding error",
    "grid = np.concatenate([np.geomspace(10 * lowest, 0.5 * rate, 401), np.linspace(0.3, 0.5, 400) * rate])": (
        "the fit uses hundreds of points; the place of each does not matter"
    ),
    "grid = np.concatenate([np.geomspace(10 * lowest, 0.5 * rate, 400), np.linspace(0.3, 0.5, 401) * rate])": (
        "the fit uses hundreds of points; the place of each does not matter"
    ),
    "grid = np.concatenate([np.geomspace(10 * lowest, 0.5 * rate, 400), np.linspace(0.3, 0.5, 399) * rate])": (
        "the fit uses hundreds of points; the place of each does not matter"
    ),
    "@lru_cache(maxsize= 63)": "the size of the cache changes no result",
    "@lru_cache(maxsize= 15)": "the size of the cache changes no result",
    "elif degree >= 2:": "no degree is above two",
    "poles = 3 * np.sin(np.pi * corners / rate) ** 2": (
        "the choice of poles is free: the density deviates by at most 0.17 % with either"
    ),
    "steps = quantization_steps(rec, names).reshape(~1, *[1] * (squares.ndim - 1))": (
        "numpy computes the size that is negative"
    ),
    "equations = orthogonal.reshape(lines, - 2, unknowns + 1)": "numpy computes the size that is negative",
    "n_lines = max(1, half_width // max(1, int(np.median(np.diff(lines)))) if lines.size != 1 else 1)": (
        "every fit has lines"
    ),
    "step = max( 2, _MAX_ELEMENTS // ((2 * half_width + 1) * unknowns))": (
        "the number of lines per batch changes no fit"
    ),
    "if len(content) < CHUNK_HEAD.size + 7:": "content that is one byte too short fails the next condition",
    "if name_length > 15 or len(content) < begin + 8:": "no compression has a name of 16 letters",
    "if not TYPE_CHECKING:": "the only effect is an import",
    'if len(scene.shakers) != 1 and any(shaker.kind != "force" for shaker in scene.shakers):': "no shaker, no match",
    "excitation = np.where(input_rms > _ZERO_POWER, input_rms, np.nan)[:, 0, -1]": "the array has one column",
    "is_improved = _sum_of_squares(stepped_residual) <= _sum_of_squares(residual)": "equal residuals are equally good",
    "records = unpacker.decompress(packed, max_length=size + 2)": "the caller checks the length as well",
}
