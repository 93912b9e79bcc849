"""Trial of one random scene: draw the scene, record its test, and compare the analysis with the truth."""

from __future__ import annotations

import tempfile
import traceback
import warnings
from dataclasses import replace
from pathlib import Path

import daq
import rig
from analysis.exporting.export import export
from analysis.recordings.slices import Slice
from rig.errors import ShotrigError
from tests.gauntlet.close_modes import CURVES, MULTISINE, STEPPED, draw_close_modes, exact_curves
from tests.gauntlet.finite_contact import STEPS_FINITE_CONTACT, TONE_FINITE_CONTACT, draw_finite_contact
from tests.gauntlet.instant_contact import DECAY, STEPS, TONE, draw_decay, draw_instant_contact
from tests.gauntlet.judges import JUDGES, Judge, modes
from tests.gauntlet.scenes import draw
from tests.gauntlet.two_shakers import MULTISINE as MULTISINE_TWO_SHAKERS
from tests.gauntlet.two_shakers import RANDOM, draw_two_shakers
from tests.gauntlet.verdict import Case, Verdict

# File formats of imported recordings.
_FILE_ENDINGS = (".npz", ".csv")
_DRAW_FUNCTIONS = {TONE: draw_instant_contact, STEPS: draw_instant_contact, DECAY: draw_decay}
_DRAW_FUNCTIONS |= dict.fromkeys((TONE_FINITE_CONTACT, STEPS_FINITE_CONTACT), draw_finite_contact)
_DRAW_FUNCTIONS |= dict.fromkeys((CURVES, MULTISINE, STEPPED), draw_close_modes)
_DRAW_FUNCTIONS |= dict.fromkeys((RANDOM, MULTISINE_TWO_SHAKERS), draw_two_shakers)


def run_trial(seed: int, number: int, kind: str) -> list[Verdict]:
    """Draw a scene, record its test, and collect the verdicts of all judges."""
    scene = _DRAW_FUNCTIONS.get(kind, draw)(seed, number, kind)
    if kind == CURVES:
        # Curves in closed form need no recording.
        return [modes.compare_modes(scene, exact_curves(scene, seed, number), kind)]
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(record=True) as caught_warnings:
        warnings.simplefilter("always", daq.RunWarning)
        path = Path(folder) / "gauntlet.mcap"
        try:
            daq.record(scene, path)
        except ShotrigError as error:
            # A test that aborts without a recording counts as refused. A partial recording is judged.
            if not path.exists():
                return [Verdict("record", kind, "refused", note=str(error), scene=scene.name)]
        if kind.startswith("imported_"):
            path = _export_and_import(path, scene, _FILE_ENDINGS[number % len(_FILE_ENDINGS)])
        with daq.open(path) as recording:
            case = Case(scene, recording, [str(warning.message) for warning in caught_warnings])
            verdicts = [verdict for name, judge in JUDGES.items() for verdict in _run_judge(name, judge, case, kind)]
    return [replace(verdict, scene=scene.name) for verdict in verdicts]


def _export_and_import(path: Path, scene: rig.Scene, ending: str) -> Path:
    """Export the samples and import them again: like a file of another program, the recording has no markers."""
    with daq.open(path) as recording:
        export(Slice.of(recording), path.with_suffix(ending))
    return daq.import_files(path.with_suffix(ending), scene, path.with_name("imported.mcap"))


def _run_judge(name: str, judge: Judge, case: Case, kind: str) -> list[Verdict]:
    """Return the verdicts of a judge; an exception becomes a verdict."""
    try:
        return judge(case, kind)
    except ShotrigError as error:
        return [Verdict(name, kind, "refused", note=str(error))]
    except Exception:
        # A traceback counts as a wrong answer.
        return [Verdict(name, kind, "wrong", note=traceback.format_exc(limit=-3))]
