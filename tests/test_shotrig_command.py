"""The command `shotrig` runs the other commands."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["--version"], 0, "shotrig 0."),
        ([], 0, "shotrig PROGRAM COMMAND"),
        (["rig", "presets"], 0, "NI 9234"),
        (["daq", "record", "missing.yaml"], 2, "missing.yaml: the file does not exist"),
        (["analysis", "--help"], 0, "frf"),
        (["rigg"], 2, "there is no program 'rigg'. Choose rig, daq, analysis."),
    ],
)
def test_shotrig_runs_programs(arguments, code, text):
    result = subprocess.run([sys.executable, "-m", "shotrig", *arguments], capture_output=True, text=True, check=False)
    assert result.returncode == code
    assert text in result.stdout + result.stderr
