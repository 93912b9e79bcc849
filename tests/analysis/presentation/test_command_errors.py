"""Command-line errors for unsuitable recordings and options: the message names the remedy, and the exit code is 2."""

import numpy as np
import pytest
from typer.testing import CliRunner

from analysis.commands.cli import app
from tests.analysis.responses import synthetic

RANDOM = "{kind: random, from: 8 Hz, to: 60 Hz, duration: 60 s, force: 1 N}"
IMPULSE = "{kind: impulse, body: 1, peak: 50 N, width: 6.25 ms}"


def tone_marker(last):
    """Return the marker of a measured tone that ends at sample `last`."""
    return ("measure", 0, last, {"frequency": 20.0, "level": 1.0, "direction": "up"})


def overload_markers(last):
    """Return markers of an overload of each body's channel up to sample `last`."""
    return [("overload", 0, last, {"channel": info.name}) for info in synthetic.channels()[:3]]


# Name, test (None: sine), number of channels, samples, markers, command, required part of the message.
CASES = [
    ("silent", None, 4, np.zeros(2560), [tone_marker(2559)], "frf", "force on the structure is zero throughout"),
    ("window", None, 4, np.ones(60), [tone_marker(59)], "frf", "shorter than a period of its tone"),
    ("clipped", None, 4, np.ones(2560), [tone_marker(2559), *overload_markers(2559)], "frf", "overloaded in every"),
    ("no table", None, 3, np.ones(2560), [tone_marker(2559)], "modes", "needs a motion channel at table"),
    ("never steady", None, 4, np.ones(2560), [("settle", 0, 2559, {})], "frf", "no steady state was measured"),
    ("dead", IMPULSE, 3, np.zeros(9000), [("hit", 900, 910, {})], "decay", "is constant throughout the decay"),
    (
        "all clipped", IMPULSE, 3, np.sin(np.arange(9000)), [("hit", 900, 910, {}), *overload_markers(8999)], "decay",
        "was overloaded for 100 % of the decay after impact 1",
    ),
    ("short", IMPULSE, 3, np.ones(1000), [("hit", 900, 910, {})], "decay", "expected 256 or more"),
    (
        "short random", RANDOM, 4, np.ones(30), [("measure", 0, 29, {"from": 8.0, "to": 60.0})], "frf",
        "too short to average",
    ),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=[case[0] for case in CASES])
def test_error_of_unsuitable_recording_names_problem(tmp_path, case):
    name, test, n_channels, samples, markers, command, message = case
    scene = synthetic.scene() if test is None else synthetic.scene(test)
    infos = synthetic.channels()[:n_channels]
    path = tmp_path / f"{name}.mcap"
    synthetic.write(path, scene, infos, np.tile(samples, (n_channels, 1)), markers)
    result = CliRunner().invoke(app, [command, str(path), "-o", str(tmp_path)])
    assert message in str(result.exception) + result.output
    assert getattr(result.exception, "exit_code", result.exit_code) == 2


@pytest.fixture(scope="module")
def stepped_path(tmp_path_factory):
    return synthetic.stepped_sine(tmp_path_factory.mktemp("stepped") / "a.mcap", np.linspace(8.0, 60.0, 40))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["frf", "--estimator", "H9"], "expected H1, H2, Hv"),
        (["frf", "--motion", "speed"], "expected displacement, velocity, acceleration"),
        (["frf", "--reference", "power"], "expected 'force' or 'table'"),
        (["frf", "--response", "bodi3"], "Did you mean 'body3'"),
        (["modes", "--modes", "0"], "number of modes: got 0; expected 1 or more"),
        (["frf", "--block", "2"], "--block has no effect on a.mcap: steady tones"),
        (["frf", "--overlap", "0.5"], "--overlap has no effect"),
        (["modes", "--unit", "g/N"], "a recording states its units"),
        (["decay"], "analysis frf"),
        (["dampers"], "no dampers"),
    ],
)
def test_error_of_invalid_option_names_valid_options(stepped_path, tmp_path, options, message):
    result = CliRunner().invoke(app, [options[0], str(stepped_path), *options[1:], "-o", str(tmp_path)])
    assert message in str(result.exception) + result.output
    assert getattr(result.exception, "exit_code", result.exit_code) == 2


@pytest.mark.usefixtures("undrawn_figures")
def test_unused_option_names_its_recordings(stepped_path, tmp_path):
    (tmp_path / "b.csv").write_text("f [Hz],x re [m/N],x im [m/N]\n10,1,0\n20,2,0\n")
    arguments = ["frf", str(stepped_path), str(tmp_path / "b.csv"), "--unit", "mm/N", "-o", str(tmp_path)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0
    assert "--unit has no effect on a.mcap: a recording states its units" in result.output
    for options in (["--theory"], ["--block", "2"], ["--reference", "table"]):
        failed = CliRunner().invoke(app, ["frf", str(tmp_path / "b.csv"), *options])
        assert "omit" in str(failed.exception).lower()
