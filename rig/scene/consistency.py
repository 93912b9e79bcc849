"""References between the parts of a scene: does what is named exist, and is it named once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from rig.scene.excitation import Free, Impulse, Sine, SteppedSine
from rig.scene.measurement_chain import Channel, Converter
from rig.scene.settings import Mistake, Place
from rig.scene.shaker import ForceShaker, at_shaker

if TYPE_CHECKING:
    from rig.scene.damper import Damper
    from rig.scene.excitation import Test
    from rig.scene.measurement_chain import RecordingSettings
    from rig.scene.shaker import Shaker


def mistakes_between(
    bodies: int | None,
    dampers: Sequence[Damper | None],
    shakers: Sequence[Shaker | None],
    test: Test | None,
    channels: Sequence[Channel | None] | None,
    converter: Converter | None,
    recording: RecordingSettings | None,
    given: frozenset[str] = frozenset(),
) -> list[Mistake]:
    """List the mistakes between parts.

    Parts that are wrong in themselves come as far as they are right, with None for what is not, so that their own
    mistakes and these can be reported together; `given` names the parts that are there, right or wrong.
    """
    return [
        *_dampers(bodies, dampers),
        *_shakers(bodies, shakers, given),
        *_test(bodies, shakers, test, given),
        *_channels(bodies, shakers, test, channels or (), given),
        *_sampling(channels, converter, recording, given),
        *_too_high(test, converter),
    ]


def _no_body(count: int | None, body: int | None, place: Place) -> Iterable[Mistake]:
    if count is not None and body is not None and body > count:
        yield Mistake(place, f"body {body} of {count}; expected a body of the structure, 1 to {count}")


def _dampers(count: int | None, dampers: Sequence[Damper | None]) -> Iterable[Mistake]:
    for k, damper in enumerate(dampers):
        yield from _no_body(count, None if damper is None else damper.body, ("dampers", k, "body"))


def _shakers(count: int | None, shakers: Sequence[Shaker | None], given: frozenset[str]) -> Iterable[Mistake]:
    for number, shaker in enumerate(shakers):
        if shaker is None:
            continue
        key: Place = ("shaker", "body") if len(shakers) == 1 else ("shaker", number, "body")
        for k, body in enumerate(shaker.bodies):
            yield from _no_body(count, body, (*key, k) if isinstance(shaker.body, tuple) else key)


def _test(
    count: int | None, shakers: Sequence[Shaker | None], test: Test | None, given: frozenset[str]
) -> Iterable[Mistake]:
    if test is None:
        return
    if isinstance(test, Impulse):
        yield from _no_body(count, test.body, ("test", "body"))
    elif isinstance(test, Free):
        for key, values in (("displacement", test.displacement), ("velocity", test.velocity)):
            if count is not None and values is not None and len(values) != count:
                yield Mistake(("test", key), f"got {len(values)} values; expected {count}, one for each body")
        if count is not None and test.mode is not None and test.mode > count:
            yield Mistake(("test", "mode"), f"mode {test.mode} of {count}; expected 1 to {count}")
    elif not shakers:
        if "shaker" not in given:
            yield Mistake(
                ("test", "kind"), f"{test.kind} has nothing to drive with; expected a shaker in the scene"
            )
    elif len(shakers) > 1 and test.shaker is None:
        yield Mistake(
            ("test",),
            f"shaker missing; there are {len(shakers)}, expected shaker: with the number of the one to drive, 1 to "
            f"{len(shakers)}",
        )
    elif (test.shaker or 1) > len(shakers):
        yield Mistake(
            ("test", "shaker"), f"shaker {test.shaker} of {len(shakers)}; expected 1 to {len(shakers)}"
        )
    elif any(number > len(shakers) for number in getattr(test, "also", None) or ()):
        yield Mistake(
            ("test", "also"), f"names a shaker that is missing; expected numbers up to {len(shakers)}"
        )
    elif len({test.shaker, *(also := getattr(test, "also", None) or ())}) <= len(also):
        yield Mistake(("test", "also"), "names a shaker twice; expected those beside test: shaker, each once")
    elif isinstance(shakers[(test.shaker or 1) - 1], ForceShaker) and test.drive is not None:
        yield Mistake(
            ("test", "drive"), "a shaker of kind force is driven by its force; expected force instead"
        )


def _channels(
    count: int | None,
    shakers: Sequence[Shaker | None],
    test: Test | None,
    channels: Sequence[Channel | None],
    given: frozenset[str],
) -> Iterable[Mistake]:
    first: dict[str, int] = {}
    for k, channel in enumerate(channels):
        if channel is None or channel.at is None:
            continue
        place = ("channels", k, "at")
        if channel.body is not None:
            yield from _no_body(count, channel.body, place)
        elif channel.at == "hammer":
            if "test" not in given and not isinstance(test, Impulse):
                yield Mistake(
                    place, "there is no hammer; expected a body or the table, or a test of kind impulse"
                )
        elif shakers or "shaker" not in given:
            yield from _at_shaker(channel, shakers, test, place)
        if channel.name is None:
            continue
        if channel.name in first:
            other = first[channel.name] + 1
            yield Mistake(
                ("channels", k, "name"),
                f'"{channel.name}" is the name of channels[{other}]; expected each once',
            )
        first.setdefault(channel.name, k)


def _at_shaker(
    channel: Channel, shakers: Sequence[Shaker | None], test: Test | None, place: Place
) -> Iterable[Mistake]:
    """Check that there is the shaker that a channel sits at, and that it has what the channel measures there."""
    what, several = channel.what, len(shakers) > 1
    if several and channel.number is None:
        expected = ", ".join(at_shaker(what, number, len(shakers)) for number in range(1, len(shakers) + 1))
        yield Mistake(place, f"there are {len(shakers)} shakers; expected one of {expected}")
        return
    if channel.number is not None and (not several or channel.number > len(shakers)):
        count = f"{len(shakers)} shaker{'s' if several else ''}"
        expected = f"{what} 1 to {what} {len(shakers)}" if several else what
        yield Mistake(place, f"got {channel.at} with {count} in the scene; expected {expected}")
        return
    shaker = shakers[(channel.number or 1) - 1] if shakers else None
    if what == "table" and (not shakers or isinstance(shaker, ForceShaker)):
        yield Mistake(
            place, "there is no table; expected a body, or a shaker of kind table or electrodynamic"
        )
    elif what == "drive" and not shakers:
        yield Mistake(place, "there is no drive; expected a shaker in the scene")
    elif what == "shaker" and not shakers:
        yield Mistake(place, "there is no shaker; expected a body, or a shaker of kind force in the scene")
    elif what == "shaker" and shaker is not None and not isinstance(shaker, ForceShaker):
        table = at_shaker("table", channel.number or 1, len(shakers))
        yield Mistake(
            place,
            f"a shaker of kind {shaker.kind} acts through its coil spring, whose force is measured by channels at its "
            f"two ends; expected at: {table} and at: body {shaker.bodies[0]}",
        )
    elif what == "shaker" and isinstance(test, Impulse):
        yield Mistake(place, "the shaker rests while the hammer hits; expected at: hammer")


def _sampling(
    channels: Sequence[Channel | None] | None,
    converter: Converter | None,
    recording: RecordingSettings | None,
    given: frozenset[str],
) -> Iterable[Mistake]:
    if converter is None:
        return
    if channels is not None and isinstance(converter.skew, tuple) and len(converter.skew) != len(channels):
        yield Mistake(
            ("converter", "skew"),
            f"got {len(converter.skew)} values; expected {len(channels)}, one for each channel",
        )
    if recording is not None and recording.samples == "counts" and not (converter.bits or converter.preset):
        yield Mistake(
            ("recording", "samples"), "counts of a converter without bits; expected bits in converter"
        )


def _too_high(test: Test | None, converter: Converter | None) -> Iterable[Mistake]:
    """Check that the sample rate resolves the test's frequencies, and that the drive can be made of samples."""
    highest = _highest(test)
    if highest is None or converter is None:
        return
    (place, frequency), rate = highest, converter.sample_rate
    if frequency >= rate / 2:
        yield Mistake(
            place,
            f"{frequency:.6g} Hz at {rate:.6g} samples a second; expected less than half of that, "
            f"{rate / 2:.6g} Hz, or a higher converter: rate",
        )


def _highest(test: Test | None) -> tuple[Place, float] | None:
    """Find the highest frequency of a test and where it stands; None where a test names none."""
    if test is None or isinstance(test, Impulse | Free):
        return None
    if isinstance(test, Sine):
        return None if test.frequency is None else (("test", "frequency"), test.frequency)
    if isinstance(test, SteppedSine) and test.frequencies is not None:
        return ("test", "frequencies", len(test.frequencies) - 1), test.frequencies[-1]
    first, last = test.from_ or 0.0, test.to or 0.0
    return (("test", "to"), last) if last > first else (("test", "from"), first)
