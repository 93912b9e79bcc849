"""Checks of references between the sections of a scene, such as whether the body or shaker that a test names exists.

Each check compares a section with the sections before it in `Scene`. `valid` contains the valid sections among these,
by key.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from pydantic import AfterValidator, ValidationInfo

from rig.core.base.errors import suggestion
from rig.core.scene.body_names import GROUND, body_problems
from rig.core.scene.excitation import Test
from rig.core.scene.joint import Joint
from rig.core.scene.measurement_chain import Channel, Converter, RecordingSettings
from rig.core.scene.shaker import KINDS, Shaker, as_tuple, at_shaker
from rig.core.settings.problems import KeyPath, Problem, combined_error

ValidSections = Mapping[str, Any]


def _check_joint(joint: Joint, valid: ValidSections) -> Iterable[Problem]:
    for k, body in enumerate(joint.between):
        if body != GROUND:
            yield from body_problems(valid, int(body), ("between", k))


def _check_shakers(value: Shaker | tuple[Shaker, ...] | None, valid: ValidSections) -> Iterable[Problem]:
    shakers = as_tuple(value)
    for number, shaker in enumerate(shakers):
        for body, key_path in zip(shaker.bodies, shaker.body_keys, strict=True):
            yield from body_problems(valid, body, (number, *key_path) if isinstance(value, tuple) else key_path)
    carriers = [number for number, shaker in enumerate(shakers) if shaker.carries_structure]
    if carriers and any(GROUND in joint.between for joint in valid.get("joints", ())):
        message = f"a shaker of kind {shakers[carriers[0]].kind} moves the ground, to which joints are connected."
        yield Problem((carriers[0],) if isinstance(value, tuple) else (), f"{message} Connect them to bodies only.")
    if carriers and not all(shaker.drive_is_force for shaker in shakers[: carriers[0]] + shakers[carriers[0] + 1 :]):
        message = f"a shaker of kind {shakers[carriers[0]].kind} can be combined with shakers of kind force only."
        yield Problem((carriers[0],), f"{message} Remove the others.")


def _check_channel(channel: Channel, valid: ValidSections) -> Iterable[Problem]:
    if channel.body is not None:
        yield from body_problems(valid, channel.body, ("at",))
    elif channel.at == "hammer":
        if "test" in valid and (valid["test"] is None or valid["test"].hammer is None):
            message = "this test has no hammer; expected a body or the table, or a test of kind impulse"
            yield Problem(("at",), message, absent="" if valid["test"] else "test")
    elif "shaker" in valid:
        yield from _check_location_at_shaker(channel, as_tuple(valid["shaker"]), valid.get("test"), ("at",))


def _check_channels(channels: tuple[Channel, ...] | None, valid: ValidSections) -> Iterable[Problem]:
    first_index: dict[str, int] = {}
    for k, channel in enumerate(channels or ()):
        if channel.name in first_index:
            first_number = first_index[channel.name] + 1
            message = f'"{channel.name}" is also the name of channels[{first_number}]; expected a unique name'
            yield Problem((k, "name"), message)
        first_index.setdefault(channel.name, k)


def _check_location_at_shaker(
    channel: Channel, shakers: tuple[Shaker, ...], test: Test | None, key_path: KeyPath
) -> Iterable[Problem]:
    """Check that the shaker at which a channel measures exists and has the measured quantity."""
    kind, n_shakers = channel.place_kind, len(shakers)
    if n_shakers > 1 and channel.number is None:
        names = ", ".join(at_shaker(kind, number, n_shakers) for number in range(1, n_shakers + 1))
        yield Problem(key_path, f"there are {n_shakers} shakers; expected one of {names}")
        return
    if channel.number is not None and (n_shakers < 2 or channel.number > n_shakers):
        names = f"{kind} 1 to {kind} {n_shakers}" if n_shakers > 1 else kind
        count_text = f"{n_shakers} shaker{'s' if n_shakers > 1 else ''}"
        yield Problem(key_path, f"got {channel.at} with {count_text} in the scene; expected {names}")
        return
    shaker = shakers[(channel.number or 1) - 1] if shakers else None
    absent = "" if shakers else "shaker"
    if kind == "table" and (shaker is None or kind not in shaker.points):
        with_table = " or ".join(name for name, each in KINDS.items() if kind in each.points)
        message = f"the scene has no shaker table; expected a body, or a shaker of kind {with_table}"
        yield Problem(key_path, message, absent)
    elif kind == "drive" and shaker is None:
        yield Problem(
            key_path,
            "the scene has no shaker, so there is no drive to measure. Add a shaker, or remove the channel.",
            absent,
        )
    elif kind == "shaker" and shaker is None:
        remedy = "Mount the channel on a body (at: body 1), or add a shaker."
        yield Problem(key_path, f"the scene has no shaker. {remedy}", absent)
    elif kind == "shaker" and shaker is not None and kind not in shaker.points:
        yield Problem(key_path, shaker.force_hint(at_shaker("table", channel.number or 1, n_shakers)))
    elif kind == "shaker" and test is not None and test.hammer is not None:
        message = "in an impact test the shaker is idle, so its force is not measured."
        yield Problem(key_path, f"{message} Mount this channel at the hammer (at: hammer).")


def _check_converter(converter: Converter, valid: ValidSections) -> Iterable[Problem]:
    channels = valid.get("channels")
    if channels is not None and isinstance(converter.skew, tuple) and len(converter.skew) != len(channels):
        yield Problem(("skew",), f"got {len(converter.skew)} values; expected {len(channels)}, one for each channel")


def _check_recording(recording: RecordingSettings, valid: ValidSections) -> Iterable[Problem]:
    converter = valid.get("converter")
    if converter is not None and recording.samples == "counts" and not (converter.bits or converter.preset):
        yield Problem(("samples",), "counts require a converter with bits. Add bits to converter.")


Check = Callable[[Any, ValidSections], Iterable[Problem]]


def _validator(check: Check) -> AfterValidator:
    """Return a pydantic validator that applies a check to a field of `Scene`, or to each item of the field."""

    def validate(section: Any, info: ValidationInfo) -> Any:
        problems = list(check(section, info.data))
        if problems:
            raise combined_error("references", problems)
        return section

    return AfterValidator(validate)


DAMPER = _validator(lambda damper, valid: body_problems(valid, damper.body, ("body",)))
JOINT = _validator(_check_joint)
SHAKERS = _validator(_check_shakers)
TEST = _validator(lambda test, valid: () if test is None else test.references(valid))
CHANNEL = _validator(_check_channel)
CHANNELS = _validator(_check_channels)
CONVERTER = _validator(_check_converter)
RECORDING = _validator(_check_recording)


def check_frequency(test: Test | None, converter: Converter) -> Iterable[Problem]:
    """Check that the test's highest frequency is below half the sample rate of readings and drive."""
    highest = None if test is None else test.highest
    if highest is None:
        return
    (key_path, frequency), rate = highest, converter.sample_rate
    if frequency >= rate / 2:
        yield Problem(
            ("test", *key_path),
            f"{frequency:.6g} Hz at {rate:.6g} samples a second; expected less than half the rate, {rate / 2:.6g} Hz. "
            "Lower the frequency, or raise converter.rate.",
        )


def check_named_channels(
    test: Test | None, channels: tuple[Channel, ...] | None, ideal: tuple[str, ...]
) -> Iterable[Problem]:
    """Check that the channels that a test names exist and measure motion; `ideal`: locations of ideal channels."""
    motion = [place.replace(" ", "") for place in ideal]
    if channels is not None:
        motion = [each.name for each in channels if not (each.measures_force or each.measures_voltage)]
    for key_path, name in () if test is None else test.named_channels:
        if name not in motion:
            hint = suggestion(name, motion) or f"Choose one of {', '.join(motion) or 'new channels'}."
            yield Problem(("test", *key_path), f"no motion channel {name!r}. {hint}")
