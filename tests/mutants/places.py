"""Where a fault would cost a user most, and the tests that ought to notice it there."""

from __future__ import annotations

# Those that run for minutes where kernels are plain Python are left out.
_SLOW = (
    "million_periods or hundred_thousand_periods or ever_shorter or response_is_followed or cut_into_blocks"
)
_ENGINE = (
    "tests/rig/engine/test_reference.py tests/rig/engine/test_lasting.py tests/rig/engine/test_limits.py "
    f"tests/rig/engine/test_invariants.py -k 'not ({_SLOW})'"
)
_RECORDING, _CHAIN, _RESPONSES = "tests/daq/recording", "tests/daq/signal_chain", "tests/analysis/responses"
_FILE = f"{_RECORDING}/test_recording.py {_RECORDING}/test_recovery.py {_RECORDING} tests/daq/mcap_file"

# Place: {module: tests, those that notice most first}. The examples of the module itself always run.
PLACES: dict[str, dict[str, str]] = {
    "physics laws": {
        "rig/system/structure.py": "tests/rig/system tests/rig/scene/test_unphysical.py",
        "rig/system/receptance.py": "tests/rig/system/test_receptance.py tests/rig/system",
        "rig/system/landing.py": "tests/rig/engine/test_lasting.py",
    },
    "guards": {"rig/engine/guards.py": _ENGINE},
    "contact decisions": {"rig/engine/contact.py": _ENGINE},
    "gap and overload marks": {
        "daq/recording/channel_series.py": f"{_RECORDING}/test_recording.py {_RECORDING}/test_suspicion.py",
        "daq/recording/sample_block.py": f"{_RECORDING}/test_layout.py {_RECORDING}/test_recording.py",
        "daq/measurement/limits.py": "tests/daq/measurement/test_watches.py tests/daq/measurement/test_limits.py",
        "analysis/responses/clean_stretches.py": f"{_RESPONSES}/test_clean_stretches.py",
    },
    "noise scaling": {
        "daq/dsp/noise.py": "tests/daq/dsp/test_disturbances.py tests/daq/dsp",
        "daq/dsp/disturbances.py": "tests/daq/dsp/test_disturbances.py tests/daq/dsp",
    },
    "filters": {
        "daq/dsp/circuit.py": f"tests/daq/dsp/test_circuit.py {_CHAIN}/test_chain.py",
        "daq/dsp/decimator.py": f"tests/daq/dsp/test_decimator.py {_CHAIN}/test_decimation_filter.py",
        "daq/signal_chain/decimation_filter.py": "tests/daq/dsp/test_decimator.py "
        "tests/daq/signal_chain/test_decimation_filter.py",
    },
    "triggers": {
        "daq/instrument/engines/triggers.py": "tests/daq/instrument/test_triggers.py tests/daq/instrument",
    },
    "limits": {
        "daq/signal_chain/converter.py": f"{_CHAIN}/test_converter.py {_CHAIN}/test_bench.py",
        "rig/scene/quantity_field.py": "tests/rig/scene/test_quantity_field.py tests/rig/scene",
        "rig/system/assembly.py": "tests/rig/system tests/rig/scene/test_unphysical.py",
    },
    "bounds": {
        "analysis/responses/systematic.py": f"{_RESPONSES}/test_systematic.py",
        "analysis/responses/aliasing.py": f"{_RESPONSES}/test_aliasing.py {_RESPONSES}/test_stepped_sine.py",
        "analysis/responses/local_rational.py": f"{_RESPONSES}/test_local_rational.py",
    },
    "checksums": {
        "daq/mcap_file/chunk.py": _FILE,
        "daq/mcap_file/metadata_checksum.py": _FILE,
        "daq/mcap_file/damaged_file.py": _FILE,
    },
}

# Faults that change nothing a test could see, and why: {the line with the fault in it: reason}.
EQUIVALENT = {
    "@dataclass(frozen=False)": "nothing assigns to the fields",
    'if len(scene.shakers) != 1 and any(shaker.kind != "force" for shaker in scene.shakers):': "any of none is false",
}
