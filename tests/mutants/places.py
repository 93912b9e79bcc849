"""Where a fault would cost a user most, and the tests that ought to notice it there."""

from __future__ import annotations

# Place: {module: tests}. The examples of the module itself always run.
PLACES: dict[str, dict[str, str]] = {
    "physics laws": {
        "rig/system/structure.py": "tests/rig/system tests/rig/scene/test_unphysical.py",
        "rig/system/receptance.py": "tests/rig/system",
        "rig/system/landing.py": "tests/rig/engine",
    },
    "guards": {"rig/engine/guards.py": "tests/rig/engine"},
    "contact decisions": {"rig/engine/contact.py": "tests/rig/engine"},
    "gap and overload marks": {
        "daq/recording/channel_series.py": "tests/daq/recording",
        "daq/recording/sample_block.py": "tests/daq/recording",
        "analysis/responses/clean_stretches.py": "tests/analysis/responses",
        "analysis/responses/whole_stretches.py": "tests/analysis/responses",
    },
    "noise scaling": {
        "daq/dsp/noise.py": "tests/daq/dsp tests/daq/signal_chain",
        "daq/dsp/disturbances.py": "tests/daq/dsp tests/daq/signal_chain",
    },
    "filters": {
        "daq/dsp/circuit.py": "tests/daq/signal_chain",
        "daq/dsp/decimator.py": "tests/daq/signal_chain",
        "daq/signal_chain/decimation_filter.py": "tests/daq/signal_chain",
    },
    "triggers": {
        "daq/instrument/engines/triggers.py": "tests/daq/instrument tests/daq/server/test_task.py",
    },
    "limits": {
        "daq/signal_chain/converter.py": "tests/daq/signal_chain",
        "rig/scene/quantity_field.py": "tests/rig/scene",
        "rig/system/assembly.py": "tests/rig/engine/test_limits.py tests/rig/system tests/rig/scene",
    },
    "bounds": {
        "analysis/responses/systematic.py": "tests/analysis/responses tests/gauntlet",
        "analysis/responses/local_rational.py": "tests/analysis/responses tests/gauntlet",
    },
    "checksums": {
        "daq/mcap_file/chunk.py": "tests/daq/mcap_file tests/daq/recording",
        "daq/mcap_file/metadata_checksum.py": "tests/daq/mcap_file tests/daq/recording",
        "daq/mcap_file/damaged_file.py": "tests/daq/mcap_file tests/daq/recording",
    },
}

# Mutants that change nothing a test could see, and why: a text that its changed line contains.
EQUIVALENT: dict[str, str] = {}
