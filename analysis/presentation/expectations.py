"""Which command suits a recording: a wrong one is refused in words that name the right one."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from rig.errors import RecordingError

if TYPE_CHECKING:
    from daq.recording.recording import Recording


def expect(rec: Recording, path: Path, command: str) -> None:
    """Refuse a recording that does not hold what a command is about.

    Parameters
    ----------
    rec : daq.recording.recording.Recording
        Open.
    path : Path
        Its file.
    command : {'frf', 'modes', 'decay', 'dampers'}

    Raises
    ------
    RecordingError
        Saying what the recording holds, and which command tells of that.
    """
    test = rec.scene.test
    kind = test.kind if test is not None else ""
    measured = [marker for marker in rec.markers if marker.kind == "measure"]
    hit = any(marker.kind == "hit" for marker in rec.markers) or kind == "free"
    file = shlex.quote(str(path))
    held = f"{path} holds a {kind.replace('_', ' ')} test" if kind else f"{path} holds no test"
    if command == "decay" and not hit and measured:
        raise RecordingError(f"{held} and no free decay: `analysis frf {file}` shows its frequency responses")
    if command in ("frf", "modes", "dampers") and kind == "free":
        raise RecordingError(f"{held}, which no force drives: `analysis decay {file}` shows how it dies away")
    if command == "dampers":
        if not rec.scene.dampers:
            raise RecordingError(
                f"{path}: its scene has no dampers; `analysis frf {file}` shows its responses"
            )
        if not any("frequency" in marker.fields for marker in measured) and (measured or hit):
            suits = "decay" if hit else "frf"
            raise RecordingError(
                f"{held}: what dampers do is told from held tones, test: {{kind: stepped_sine, ...}} or "
                f"{{kind: sine, ...}}; `analysis {suits} {file}` shows what this recording tells"
            )
