"""The command `shotrig` runs the other commands."""

import os
import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["--version"], 0, "shotrig 0."),
        ([], 0, "shotrig PROGRAM COMMAND"),
        (["rig", "presets"], 0, "NI 9234"),
        (["rig", "scenes", "fig9"], 0, "# Fig 9"),
        (["rig", "scenes", "--show", "fig9"], 0, "# Fig 9"),
        (["daq", "record", "missing.yaml"], 2, "missing.yaml: the file does not exist"),
        (["analysis", "--help"], 0, "frf"),
        (["rigg"], 2, "there is no program 'rigg'. Choose rig, daq, analysis."),
    ],
)
def test_shotrig_runs_programs(arguments, code, text):
    result = subprocess.run([sys.executable, "-m", "shotrig", *arguments], capture_output=True, text=True, check=False)
    assert result.returncode == code
    assert text in result.stdout + result.stderr


@pytest.mark.parametrize(("typed", "completion"), [("shotrig an", "analysis"), ("shotrig rig expl", "explain")])
def test_shell_completes_programs_and_commands(typed, completion):
    words = {"_SHOTRIG_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": str(len(typed.split()) - 1)}
    result = subprocess.run(
        [sys.executable, "-m", "shotrig"], env=os.environ | words, capture_output=True, text=True, check=False
    )
    assert result.stdout.split() == [completion]
