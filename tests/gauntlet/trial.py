"""One scene on trial: drawn, recorded, judged."""

from __future__ import annotations

import tempfile
import traceback
import warnings
from dataclasses import replace
from pathlib import Path

import daq
import rig
from analysis.export.export import export
from analysis.recordings.slices import Slice
from rig.errors import ShotrigError
from tests.gauntlet.cavities import DECAY, STEPS, TONE, draw_cavities, draw_decay
from tests.gauntlet.judges import JUDGES, modes
from tests.gauntlet.landings import LANDINGS, STEPPED_LANDINGS, draw_landings
from tests.gauntlet.pairs import CURVES, MULTISINE, STEPPED, draw_pair, exact_curves
from tests.gauntlet.scenes import draw
from tests.gauntlet.verdict import Case, Verdict

_FORMS = (".npz", ".csv")
_DRAWS = {TONE: draw_cavities, STEPS: draw_cavities, DECAY: draw_decay}
_DRAWS |= dict.fromkeys((LANDINGS, STEPPED_LANDINGS), draw_landings)
_DRAWS |= dict.fromkeys((CURVES, MULTISINE, STEPPED), draw_pair)


def try_out(seed: int, number: int, kind: str) -> list[Verdict]:
    """Draw a scene, run its test, put the recording before all judges."""
    scene = _DRAWS.get(kind, draw)(seed, number, kind)
    if kind == CURVES:
        # Of closed form there is nothing to record.
        return [modes.judged(scene, exact_curves(scene, seed, number), kind)]
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always", daq.RunWarning)
        path = Path(folder) / "gauntlet.mcap"
        try:
            daq.record(scene, path)
        except ShotrigError as error:
            # A test that was broken off is one that was refused; what it leaves behind is judged all the same.
            if not path.exists():
                return [Verdict("record", kind, "refused", note=str(error), scene=scene.name)]
        if kind.startswith("imported_"):
            path = _imported(path, scene, _FORMS[number % len(_FORMS)])
        with daq.open(path) as recording:
            case = Case(scene, recording, [str(warning.message) for warning in heard])
            found = [verdict for name, judge in JUDGES.items() for verdict in _heard(name, judge, case, kind)]
    return [replace(verdict, scene=scene.name) for verdict in found]


def _imported(path: Path, scene: rig.Scene, ending: str) -> Path:
    """Write a recording's samples for other programs, and import them as another program's: no marks are left."""
    with daq.open(path) as recording:
        export(Slice.of(recording), path.with_suffix(ending))
    return daq.import_files(path.with_suffix(ending), scene, path.with_name("imported.mcap"))


def _heard(name, judge, case, kind) -> list[Verdict]:
    try:
        return judge(case, kind)
    except ShotrigError as error:
        return [Verdict(name, kind, "refused", note=str(error))]
    except Exception:
        # A traceback is the worst of answers.
        return [Verdict(name, kind, "wrong", note=traceback.format_exc(limit=-3))]
