"""The example notebooks run as they stand, among the recordings that the repository keeps."""

from __future__ import annotations

import os
import runpy
import warnings
from pathlib import Path

import pytest

import analysis.examples

EXAMPLES = Path(analysis.examples.__file__).parent


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["first_sweep", "damping_against_amplitude", "choosing_a_damper"])
def test_given_an_example_when_run_then_it_tells_its_result(name, tmp_path, monkeypatch, capsys) -> None:
    (tmp_path / "recordings").mkdir()
    for file in Path("recordings").glob("*.mcap"):
        os.link(file, tmp_path / "recordings" / file.name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = runpy.run_path(str(EXAMPLES / f"{name}.py"))
    assert capsys.readouterr().out.count("\n") >= 1
    assert {
        "first_sweep": lambda: abs(found["modes"].frequency[0] - 34.777) < 0.01,
        "damping_against_amplitude": lambda: found["decays"][1].quiet_from < found["decays"][0].quiet_from,
        "choosing_a_damper": lambda: found["best"] == 0.98 or found["peaks"].min() < found["peaks"].max(),
    }[name]()
