"""Trial of one random scene: draw it, record its test, compare the analysis with the truth."""

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
from tests.gauntlet.cavities import DECAY, STEPS, TONE, draw_cavities, draw_decay
from tests.gauntlet.judges import JUDGES, modes
from tests.gauntlet.landings import LANDINGS, STEPPED_LANDINGS, draw_landings
from tests.gauntlet.pairs import CURVES, MULTISINE, STEPPED, draw_pair, exact_curves
from tests.gauntlet.scenes import draw
from tests.gauntlet.two_shakers import MULTISINE as MULTISINE_SHAKERS
from tests.gauntlet.two_shakers import RANDOM, draw_shakers
from tests.gauntlet.verdict import Case, Verdict

_FORMATS = (".npz", ".csv")
_DRAW_FUNCTIONS = {TONE: draw_cavities, STEPS: draw_cavities, DECAY: draw_decay}
_DRAW_FUNCTIONS |= dict.fromkeys((LANDINGS, STEPPED_LANDINGS), draw_landings)
_DRAW_FUNCTIONS |= dict.fromkeys((CURVES, MULTISINE, STEPPED), draw_pair)
_DRAW_FUNCTIONS |= dict.fromkeys((RANDOM, MULTISINE_SHAKERS), draw_shakers)


def run_trial(seed: int, number: int, kind: str) -> list[Verdict]:
    """Draw a scene, record its test, and collect the verdicts of all judges."""
    scene = _DRAW_FUNCTIONS.get(kind, draw)(seed, number, kind)
    if kind == CURVES:
        # Curves in closed form need no recording.
        return [modes.compare_modes(scene, exact_curves(scene, seed, number), kind)]
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(record=True) as warnings_:
        warnings.simplefilter("always", daq.RunWarning)
        path = Path(folder) / "gauntlet.mcap"
        try:
            daq.record(scene, path)
        except ShotrigError as error:
            # An aborted test counts as refused; a recording that it leaves is judged nevertheless.
            if not path.exists():
                return [Verdict("record", kind, "refused", note=str(error), scene=scene.name)]
        if kind.startswith("imported_"):
            path = _import_again(path, scene, _FORMATS[number % len(_FORMATS)])
        with daq.open(path) as recording:
            case = Case(scene, recording, [str(warning.message) for warning in warnings_])
            verdicts = [verdict for name, judge in JUDGES.items() for verdict in _verdicts(name, judge, case, kind)]
    return [replace(verdict, scene=scene.name) for verdict in verdicts]


def _import_again(path: Path, scene: rig.Scene, ending: str) -> Path:
    """Export the samples and import them again, as a file of another program without markers."""
    with daq.open(path) as recording:
        export(Slice.of(recording), path.with_suffix(ending))
    return daq.import_files(path.with_suffix(ending), scene, path.with_name("imported.mcap"))


def _verdicts(name, judge, case, kind) -> list[Verdict]:
    try:
        return judge(case, kind)
    except ShotrigError as error:
        return [Verdict(name, kind, "refused", note=str(error))]
    except Exception:
        # A traceback counts as a wrong answer.
        return [Verdict(name, kind, "wrong", note=traceback.format_exc(limit=-3))]
