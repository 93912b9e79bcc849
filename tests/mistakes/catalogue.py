"""Forty mistakes of users, and the facts that each message must contain: where, what, and what to do."""

from dataclasses import dataclass, field

# A valid scene.
SCENE = """\
name: bracket
structure:
  masses: {base: 4.2 kg, arm: 1.1 kg}
  springs: [800 kN/m, 500 kN/m]
  damping: {modal: 1 %}
shaker: {kind: force, body: base}
test: {kind: stepped_sine, force: 2 N, from: 40 Hz, to: 220 Hz, points: 12}
"""


@dataclass(frozen=True)
class Mistake:
    """A mistake of a user."""

    description: str  # what the user did wrong
    command: str  # command line, typed in a folder with the recordings `sweep.mcap` and `hit.mcap`
    facts: tuple[str, ...]  # texts that the message must contain
    files: dict[str, str] = field(default_factory=dict)  # contents of other files in the folder, by name


def edited(old: str, new: str) -> dict[str, str]:
    """Return the file mine.yaml: the valid scene with one text replaced."""
    assert old in SCENE
    return {"mine.yaml": SCENE.replace(old, new)}


EXPLAIN = "rig explain mine.yaml"

MISTAKES = (
    # Scene: keys, values, units
    Mistake(
        "a misspelled top-level key",
        EXPLAIN,
        ("mine.yaml", "strukture", "structure"),
        edited("structure:", "strukture:"),
    ),
    Mistake("a misspelled inner key", EXPLAIN, ("mine.yaml:4", "springs"), edited("springs", "sprigns")),
    Mistake("a wrong unit", EXPLAIN, ("mine.yaml:3", "4.2 N", "a mass such as"), edited("4.2 kg", "4.2 N")),
    Mistake("an unknown unit", EXPLAIN, ("mine.yaml:3", "klb"), edited("4.2 kg", "4.2 klb")),
    Mistake("a decimal comma", EXPLAIN, ("mine.yaml:3", "4.2"), edited("base: 4.2 kg", "base: '4,2 kg'")),
    Mistake("a negative mass", EXPLAIN, ("mine.yaml:3", "masses"), edited("4.2 kg", "-4.2 kg")),
    Mistake("a mass of zero", EXPLAIN, ("mine.yaml:3", "masses"), edited("4.2 kg", "0 kg")),
    Mistake("too few springs", EXPLAIN, ("mine.yaml:4", "springs", "2"), edited("[800 kN/m, 500 kN/m]", "[800 kN/m]")),
    Mistake(
        "an unknown kind",
        EXPLAIN,
        ("mine.yaml:7", "steped_sine", "stepped_sine"),
        edited("stepped_sine", "steped_sine"),
    ),
    Mistake("an unknown body", EXPLAIN, ("mine.yaml:6", "bse", "base"), edited("body: base", "body: bse")),
    Mistake("a tab", EXPLAIN, ("mine.yaml:3", "tab"), edited("  masses", "\tmasses")),
    Mistake("an unclosed bracket", EXPLAIN, ("mine.yaml",), edited("500 kN/m]", "500 kN/m")),
    Mistake("an empty scene", EXPLAIN, ("mine.yaml", "structure"), {"mine.yaml": ""}),
    Mistake("a key twice", EXPLAIN, ("mine.yaml:8", "name"), {"mine.yaml": SCENE + "name: again\n"}),
    Mistake("damping above critical", EXPLAIN, ("mine.yaml:5", "100 %"), edited("modal: 1 %", "modal: 150 %")),
    Mistake(
        "a band with its ends exchanged", EXPLAIN, ("mine.yaml:7", "from", "to"), edited("from: 40 Hz", "from: 400 Hz")
    ),
    Mistake("a frequency above half the rate", EXPLAIN, ("mine.yaml", "test"), edited("to: 220 Hz", "to: 22000 Hz")),
    Mistake(
        "a clearance that is negative",
        EXPLAIN,
        ("mine.yaml:8", "clearance"),
        {"mine.yaml": SCENE + "dampers: [{body: arm, mass: 50 g, clearance: -1 mm}]\n"},
    ),
    Mistake("a scene that does not exist", "rig explain mini.yaml", ("mini.yaml", "rig scenes")),
    Mistake("a misspelled bundled scene", "rig explain fig8-tree-dampers", ("fig8-three-dampers",)),
    # Options
    Mistake("an unknown key in --set", "rig explain fig9 --set test.forc=3N", ("--set", "test.forc", "force")),
    Mistake("a --set without a value", "rig explain fig9 --set test.force", ("--set", "test.force", "=")),
    Mistake("a wrong unit in --set", "rig explain fig9 --set test.force=3Hz", ("--set", "3Hz", "N")),
    Mistake("a misspelled option", "analysis frf sweep.mcap --moton velocity", ("--moton", "--motion")),
    Mistake("a misspelled command", "analysis mode sweep.mcap", ("mode", "modes")),
    Mistake("an unknown motion", "analysis frf sweep.mcap --motion speed", ("speed", "velocity")),
    Mistake("an option without effect", "daq replay sweep.mcap --at 1", ("--at", "--screenshot")),
    Mistake("two exclusive options", "daq replay sweep.mcap --web --save x.rrd", ("--save", "--web")),
    # Files
    Mistake("a recording that does not exist", "analysis frf swep.mcap", ("swep.mcap", "no such file")),
    Mistake("a text file as a recording", "analysis frf notes.mcap", ("notes.mcap",), {"notes.mcap": "hello\n"}),
    Mistake("a folder as a recording", "daq info .", (".",)),
    Mistake(
        "an output that exists",
        "analysis frf sweep.mcap",
        ("sweep-frf.csv", "--overwrite"),
        {"sweep-frf.csv": "mine\n"},
    ),
    Mistake("a recording in another format", "daq record fig9 -o run.wav", ("run.wav", ".mcap")),
    Mistake("an interval without samples", "analysis export hit.mcap -o x.csv --from 900", ("hit.mcap", "6.25 s")),
    Mistake("one recording to compare", "analysis compare sweep.mcap", ("two",)),
    # Recordings of the wrong kind
    Mistake(
        "a free decay from a sweep recording", "analysis decay sweep.mcap", ("sweep.mcap", "analysis frf sweep.mcap")
    ),
    Mistake("dampers of a scene without any", "analysis dampers sweep.mcap", ("sweep.mcap", "dampers", "analysis frf")),
    Mistake("an unknown channel", "analysis frf sweep.mcap --response body9", ("body9", "body3")),
    Mistake(
        "an import of a table without samples",
        "daq import run.csv --scene mine.yaml",
        ("run.csv",),
        {"run.csv": "a,b\n1,2\n", **edited("name: bracket", "name: b")},
    ),
    Mistake("a negative duration", "rig simulate fig9 --duration -1s", ("duration", "-1")),
)
