"""The example scripts run with the recordings of the repository and give their results."""

import os
import runpy
import warnings
from pathlib import Path

import pytest

import analysis.examples

EXAMPLES = Path(analysis.examples.__file__).parent
NAMES = sorted(path.stem for path in EXAMPLES.glob("[a-z]*.py"))
# True values of the scenes in the examples.
BODY_1_MASS_KG, MODE_2_HZ, BRACKET_MODE_1_HZ = 0.74, 34.777, 62.0
# Condition on the variables of each example at its end.
RESULT_CONDITIONS = {
    "accuracy_against_time": lambda names: names["errors"][-1] < names["errors"][0],
    "approximate_theory": lambda names: {each.motion_type for each in names["theory"].branches} == {"I", "II", "III"},
    "choosing_a_damper": lambda names: 0 < names["peaks"].argmin() < names["peaks"].size - 1,
    "damping_against_amplitude": lambda names: names["decays"][1].quiet_from < names["decays"][0].quiet_from,
    "hammer_faults": lambda names: names["overloads"]["clipped"] and "clipped" not in names["peaks"],
    "import_and_fit": lambda names: abs(names["fit"]["structure.masses[1]"].value - BODY_1_MASS_KG) < 0.02,
    "low_frequencies": lambda names: all(each[-1] < 0.05 for each in names["errors"].values()),
    "nidaqmx_and_pyfrf": lambda names: abs(names["peak"] - BRACKET_MODE_1_HZ) < 0.3 and names["magnitude_error"] < 0.05,
    "nonlinear_tests": lambda names: abs(names["deviation"][names["inside"]]).max() < 0.01,
    "rehearse_a_sweep": lambda names: (
        names["durations"]["0.001 %"] > names["durations"]["10 %"]
        and abs(names["modes"].frequency[0] - MODE_2_HZ) < 0.01
    ),
}


def test_every_example_has_a_condition() -> None:
    assert list(RESULT_CONDITIONS) == NAMES
    assert len(NAMES) >= 8


@pytest.mark.thorough
@pytest.mark.parametrize("name", NAMES)
def test_example_shows_its_result(name, tmp_path, monkeypatch, capsys) -> None:
    if name == "nidaqmx_and_pyfrf":
        pytest.importorskip("pyFRF", reason="pyFRF comes with the extra 'docs'")
    (tmp_path / "recordings").mkdir()
    for file in Path("recordings").glob("*.mcap"):
        os.link(file, tmp_path / "recordings" / file.name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        variables = runpy.run_path(str(EXAMPLES / f"{name}.py"))
    assert capsys.readouterr().out.count("\n") >= 1
    assert RESULT_CONDITIONS[name](variables)
