"""Trial of one random scene: draw the scene, record its test, and compare the analysis with the truth."""

import tempfile
import traceback
import warnings
from dataclasses import replace
from pathlib import Path

import daq
import rig
from analysis.core.recordings.slices import Slice
from analysis.extras.formats.export import export
from rig.core.base.errors import ShotrigError
from tests.gauntlet import controlled_tones
from tests.gauntlet.checks import CHECKS, Check, modes
from tests.gauntlet.close_modes import CURVES, MULTISINE, STEPPED, TWO_SHAKERS, draw_close_modes, exact_curves
from tests.gauntlet.finite_contact import STEPS_FINITE_CONTACT, TONE_FINITE_CONTACT, draw_finite_contact
from tests.gauntlet.instant_contact import DECAY, STEPS, TONE, draw_decay, draw_instant_contact
from tests.gauntlet.linear_decays import LINEAR_DECAY, draw_linear_decay
from tests.gauntlet.profile_control import NOISE, SINE, draw_profile_control
from tests.gauntlet.result import Case, CheckResult
from tests.gauntlet.scenes import draw
from tests.gauntlet.two_shakers import MULTISINE as MULTISINE_TWO_SHAKERS
from tests.gauntlet.two_shakers import RANDOM, draw_two_shakers

# File formats of imported recordings.
_FILE_ENDINGS = (".npz", ".csv")
_DRAW_FUNCTIONS = {TONE: draw_instant_contact, STEPS: draw_instant_contact, DECAY: draw_decay}
_DRAW_FUNCTIONS |= dict.fromkeys((TONE_FINITE_CONTACT, STEPS_FINITE_CONTACT), draw_finite_contact)
_DRAW_FUNCTIONS |= dict.fromkeys((CURVES, MULTISINE, STEPPED, TWO_SHAKERS), draw_close_modes)
_DRAW_FUNCTIONS |= dict.fromkeys(controlled_tones.KINDS, controlled_tones.draw_controlled_tone)
_DRAW_FUNCTIONS[controlled_tones.FOLDS] = controlled_tones.draw_folds
_DRAW_FUNCTIONS[LINEAR_DECAY] = draw_linear_decay
_DRAW_FUNCTIONS |= dict.fromkeys((SINE, NOISE), draw_profile_control)
_DRAW_FUNCTIONS |= dict.fromkeys((RANDOM, MULTISINE_TWO_SHAKERS), draw_two_shakers)


def run_trial(seed: int, number: int, kind: str) -> list[CheckResult]:
    """Draw a scene, record its test, and collect the results of all checks."""
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
            # A test that aborts without a recording counts as refused. A partial recording is compared.
            if not path.exists():
                return [CheckResult("record", kind, "refused", note=str(error), scene=scene.name)]
        if kind.startswith("imported_"):
            path = _export_and_import(path, scene, _FILE_ENDINGS[number % len(_FILE_ENDINGS)])
        with daq.open(path) as recording:
            case = Case(scene, recording, [str(warning.message) for warning in caught_warnings])
            results = [result for name, check in CHECKS.items() for result in _run_check(name, check, case, kind)]
    return [replace(result, scene=scene.name) for result in results]


def _export_and_import(path: Path, scene: rig.Scene, ending: str) -> Path:
    """Export the samples and import them again: like a file of another program, the recording has no markers."""
    with daq.open(path) as recording:
        export(Slice.of(recording), path.with_suffix(ending))
    return daq.import_files(path.with_suffix(ending), scene, path.with_name("imported.mcap"))


def _run_check(name: str, check: Check, case: Case, kind: str) -> list[CheckResult]:
    """Return the results of a check; an exception becomes the outcome."""
    try:
        return check(case, kind)
    except ShotrigError as error:
        return [CheckResult(name, kind, "refused", note=str(error))]
    except Exception:
        # A traceback counts as a wrong answer.
        return [CheckResult(name, kind, "wrong", note=traceback.format_exc(limit=-3))]
