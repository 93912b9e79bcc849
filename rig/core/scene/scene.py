"""The scene: an immutable description of the whole test bench in SI units, with frequencies in Hz."""

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Self

from pydantic import AfterValidator, Field

from rig.core.scene import consistency
from rig.core.scene.body_names import replace_names
from rig.core.scene.damper import Damper
from rig.core.scene.excitation import Test
from rig.core.scene.joint import Joint
from rig.core.scene.measurement_chain import Channel, Converter, RecordingSettings
from rig.core.scene.shaker import KINDS, Shaker, Shakers, as_tuple, at_shaker
from rig.core.scene.structure import Structure
from rig.core.settings.problems import KeyPath, Problem
from rig.core.settings.quantities import ACCELERATION, Kind
from rig.core.settings.quantity_field import Quantity, printable
from rig.core.settings.settings import Settings, value_at

STANDARD_GRAVITY = 9.80665  # m/s²
# A recording has at most 65 535 topics, and a channel uses four.
MAX_CHANNELS = 16_000


class Scene(Settings):
    """A vibration test: structure, dampers, joints, shakers, sensors, converter and excitation."""

    name: Annotated[str, AfterValidator(printable)] = Field("unnamed scene", min_length=1, max_length=200)
    """Name for titles and legends, on one line."""
    structure: Structure
    """Keys masses and springs, or matrices."""
    gravity: Annotated[float, Quantity(ACCELERATION, at_least=0.0)] = STANDARD_GRAVITY
    """Downward acceleration [m/s²]."""
    dampers: tuple[Annotated[Damper, consistency.DAMPER], ...] = ()
    """Particle dampers, and masses on springs or with friction; a body may have several."""
    joints: tuple[Annotated[Joint, consistency.JOINT], ...] = ()
    """Stops and joints with friction between two bodies, or a body and the ground."""
    shaker: Annotated[Shakers | None, consistency.SHAKERS] = None
    """One shaker or a list of shakers, each with its own body, spring, amplifier and output."""
    test: Annotated[Test | None, consistency.TEST] = None
    """Excitation and its duration; `daq record` runs the test."""
    channels: Annotated[tuple[Annotated[Channel, consistency.CHANNEL], ...] | None, consistency.CHANNELS] = Field(
        None, min_length=1, max_length=MAX_CHANNELS
    )
    """Measured signals and their locations. None: ideal acceleration of every body and the table."""
    converter: Annotated[Converter, consistency.CONVERTER] = Converter()
    """The analog-to-digital converter and its clock; by default ideal, at 5120 Hz."""
    recording: Annotated[RecordingSettings, consistency.RECORDING] = RecordingSettings()
    """Content of the recording in addition to the channels."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    """Seed of all random numbers of a run."""

    @classmethod
    def prepare(cls, content: Mapping[str, Any]) -> tuple[Mapping[str, Any], list[Problem]]:
        """Replace names of bodies with their numbers."""
        return replace_names(content)

    @classmethod
    def kinds_from_other_keys(cls, content: Mapping[str, Any]) -> Mapping[KeyPath, Kind]:
        """Return the quantity of the drive (length, voltage or force), which follows from the kind of the shaker."""
        shaker, number = content.get("shaker"), str(value_at(content, ("test", "shaker")))
        if isinstance(shaker, list | tuple):
            driven = int(number) if number.isdecimal() else 0
            shaker = shaker[driven - 1] if 0 < driven <= len(shaker) else None
        kind = KINDS.get(str(value_at(shaker, ("kind",))))
        return {} if kind is None else {("test", "drive"): kind.drive_quantity}

    @property
    def shakers(self) -> tuple[Shaker, ...]:
        """All shakers."""
        return as_tuple(self.shaker)

    @property
    def tables(self) -> tuple[tuple[str, Shaker], ...]:
        """Names of the shaker tables, each with its shaker, in the order of the shakers."""
        return tuple(
            (at_shaker("table", number, len(self.shakers)), shaker)
            for number, shaker in enumerate(self.shakers, 1)
            if "table" in shaker.points
        )

    @property
    def driven(self) -> int | None:
        """Number of the driven shaker, from 1; None without a shaker, or if the test does not select one of several."""
        if len(self.shakers) == 1:
            return 1
        return None if self.test is None else self.test.driven

    @property
    def driven_shaker(self) -> Shaker | None:
        """The driven shaker; None as in `driven`."""
        return None if self.driven is None else self.shakers[self.driven - 1]

    @property
    def level_key(self) -> str:
        """Key of the test's level; empty without a level."""
        return "" if self.test is None else self.test.level_key

    @property
    def controlled_terms(self) -> dict[str, float]:
        """Controlled quantity per meter of displacement at each location used by the controller; empty in open loop."""
        if self.test is None or self.driven_shaker is None:
            return {}
        table, cell = self.at_driven("table"), self.at_driven("shaker")
        terms = self.test.controlled_terms(self.driven_shaker, table)
        is_force = bool(terms) and terms == self.driven_shaker.force_terms("", table)
        has_cell = any(channel.at == cell for channel in self.channels or ())
        return {cell: 1.0} if is_force and has_cell and self.test.controls_by_cell else terms

    def force_terms(self, location: str) -> dict[str, float]:
        """Return the points whose displacements give the force at a shaker, with weights in N/m.

        `location`: location of the force, such as "shaker 2". The location itself has the weight 1 if the force is the
        drive.
        """
        number = int(location.partition(" ")[2] or 1)
        return self.shakers[number - 1].force_terms(location, at_shaker("table", number, len(self.shakers)))

    @property
    def is_linear(self) -> bool:
        """Whether no damper can hit a wall or slide with friction, and there are no joints."""
        return not self.joints and not any(damper.impacts for damper in self.dampers)

    @property
    def hammer(self) -> int | None:
        """Number of the body that the test hits with a hammer, from 1; None without a hammer."""
        return None if self.test is None else self.test.hammer

    @property
    def reference(self) -> str:
        """Denominator of the test's responses, unless another is requested: "force" or "table"."""
        return "force" if self.hammer is not None or self.driven_shaker is None else self.driven_shaker.references[0]

    @property
    def force_on(self) -> tuple[int, ...]:
        """Bodies on which the test's force acts, from 1: the body hit by the hammer, or the driven shaker's bodies."""
        if self.hammer is not None:
            return (self.hammer,)
        return () if self.driven_shaker is None else self.driven_shaker.bodies

    def with_ideal_channels(self, **changes: Any) -> Self:
        """Return a changed scene with ideal channels, and without a test that names channels."""
        names_channels = self.test is not None and any(self.test.named_channels)
        return self.replace(channels=None, test=None if names_channels else self.test, **changes)

    def at_driven(self, name: str) -> str:
        """Return "shaker", "table" or "drive" with the number of the driven shaker, if there are several."""
        return at_shaker(name, self.driven or 1, len(self.shakers) or 1)

    def check_consistency(self) -> Iterable[Problem]:
        """Check the frequencies of the test against the sample rate, and the channels that it names."""
        yield from consistency.check_frequency(self.test, self.converter)
        ideal = (*(f"body {k + 1}" for k in range(self.structure.bodies)), *(name for name, _ in self.tables))
        yield from consistency.check_named_channels(self.test, self.channels, ideal)

    def to_yaml(self) -> str:
        """Write a scene file that loads back as an equal scene.

        Returns
        -------
        str
            YAML text of the given values, with the user's units, digits and names of bodies. Matrices are inline.
        """
        from rig.core.scene.yaml_writer import write

        return write(self, self.structure)

    def to_si_yaml(self) -> str:
        """Write every value in SI. Equal scenes have equal text, which identifies stored results."""
        from rig.core.scene.yaml_writer import write_in_si

        return write_in_si(self)

    def __str__(self) -> str:
        """Describe the scene in one line.

        >>> from rig.core.scene.loading import load
        >>> print(load("bare-structure"))
        bare structure, ideal sensors: 3 bodies, shaker table, test stepped_sine
        """
        count = self.structure.bodies
        parts = [f"{count} {'body' if count == 1 else 'bodies'}"]
        if self.structure.names is not None:
            parts[0] += f" ({', '.join(self.structure.names[:6])}{', ...' * (count > 6)})"
        if self.dampers:
            where = ", ".join(dict.fromkeys(self.structure.label(damper.body) for damper in self.dampers))
            parts.append(f"{len(self.dampers)} damper{'s' * (len(self.dampers) > 1)} ({where})")
        if self.joints:
            parts.append(f"{len(self.joints)} joint{'s' * (len(self.joints) > 1)}")
        parts += [f"shaker {shaker.kind}" for shaker in self.shakers]
        parts += [] if self.test is None else [f"test {self.test.kind}"]
        parts += [] if self.channels is None else [f"{len(self.channels)} channel{'s' * (len(self.channels) != 1)}"]
        return f"{self.name}: {', '.join(parts)}"
