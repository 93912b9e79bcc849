"""Only laws, and files that print the names of events, know that a wall is a floor or a ceiling."""

from pathlib import Path

import rig.core

ROOMS = ("engine", "system", "orbits", "simulation", "steady_response")
#: Names of events in results, and names of borders.
PRINTING = {"orbits/event_sequence.py", "orbits/orbit.py", "simulation/simulate.py"}


def test_other_rooms_know_no_floor() -> None:
    core = Path(rig.core.__path__[0])
    files = [path for room in ROOMS for path in (core / room).glob("*.py")]
    texts = {path.relative_to(core).as_posix(): path.read_text(encoding="utf-8") for path in files}
    assert {name for name, text in texts.items() if "floor" in text or "ceiling" in text} == PRINTING
