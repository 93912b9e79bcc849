"""Text of `rig design` on the test that checks a design: expected results, and commands to run it."""

from pathlib import Path
from shlex import quote

from rig.core.results import format_decimals, format_number, format_percent
from rig.core.scene.excitation import FORCE_TOLERANCE
from rig.core.scene.scene import Scene
from rig.studies.design.check import Expected
from rig.studies.design.design import Design
from rig.studies.design.grain_check import grain_check
from rig.studies.design.overloads import overload_lines, predict_overloads

_OTHER_MOTION = (
    "At one frequency several steady-state motions may exist. The design assumes the motion with the largest "
    "response; a test that measures a smaller response has settled to a different motion."
)


def describe_check(design: Design, scene: Path) -> str:
    """Describe the test in the scene of a design, its expected results, and the commands to run it."""
    test = design.scene.test
    assert test is not None and test.band is not None
    level, display = design.question.level, design.question.response_display
    levels = ", ".join(map(format_number, test.levels))
    bare = f"test.{level.name}={format_number(test.levels[0])}{level.kind.si}"
    overloads = predict_overloads(design.scene, design.expected, design.bare, level.unit)
    remedies = "".join(f" --set {quote(change)}" for overload in overloads for change in overload.changes)
    finite_contact = all(damper.contact is not None for damper in design.scene.dampers)
    locations = {channel.name: channel.at for channel in design.scene.channels or ()}
    added = ", ".join(f"{name} (at {locations[name]})" for name in design.added_channels)
    file, with_dampers, without_dampers = (
        quote(str(path)) for path in (scene, scene.with_suffix(".mcap"), scene.with_name(f"{scene.stem}-without.mcap"))
    )
    return "\n".join(
        [
            (
                f"{scene}: the scene with these dampers and a test of the design, a stepped sine from "
                f"{test.band[0]:.4g} to {test.band[1]:.4g} Hz at {levels} {level.unit} around the largest peaks "
                "with and without dampers"
            ),
            *([f"channels that this test has in addition to those of the scene: {added}"] if added else []),
            "",
            f"expected largest peaks in {display[1]}: for a sinusoidal {level.name}, as in the design, and in this "
            "test (with limits).",
            f"In the test, {_accuracy_of_level(design.scene)}the motion is measured when it is steady within "
            f"{format_percent(test.steady_state.tolerance)}.",
            *([_OTHER_MOTION] if any(map(_has_other_motion, design.expected)) else []),
            f"{f'{level.name}, {level.unit}':>14}{'peak of':>9}{'at Hz':>9}{'sinusoidal':>15}  this test",
            *(_expected_line(expected, display[2]) for expected in design.expected),
            *overload_lines(overloads, finite_contact),
            "",
            "to check the design, record and compare tests without and with dampers:",
            f"daq record {file} --set dampers=null --set {quote(bare)}{remedies} -o {without_dampers}",
            f"daq record {file}{remedies} -o {with_dampers}",
            f"analysis frf {without_dampers} {with_dampers}",
            f"analysis compare {without_dampers} {with_dampers}",
            "",
            *(grain_check(design.scene.dampers, design.expected, scene) if level.name == "force" else []),
        ]
    )


def _accuracy_of_level(scene: Scene) -> str:
    """Return the first clause of a sentence about the force of a test: its accuracy, and harmonics by a coil spring."""
    if scene.level_key != "force":
        return ""
    spring = None if scene.driven_shaker is None else scene.driven_shaker.coil_spring
    harmonics = "" if spring is None else "the coil spring adds harmonics to the force, "
    return f"{harmonics}the force is accurate to {format_percent(FORCE_TOLERANCE)} and "


def _has_other_motion(expected: Expected) -> bool:
    """Return whether the largest peak is above the range that the test should measure."""
    return expected.magnitudes is not None and expected.peak.magnitude > expected.magnitudes[2]


def _expected_line(expected: Expected, factor: float) -> str:
    peak = expected.peak
    in_this_test = "no steady state, so measured values scatter"
    if expected.magnitudes is not None:
        low, nominal, high = (f"{factor * magnitude:.4g}" for magnitude in expected.magnitudes)
        in_this_test = f"{nominal} ({low} to {high})"
    operating_point = f"{format_number(peak.level):>14}{f'body {peak.body}':>9}{format_decimals(peak.frequency, 2):>9}"
    return f"{operating_point}{factor * peak.magnitude:15.4g}  {in_this_test}"
