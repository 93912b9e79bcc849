"""The scene: everything that is on the bench, frozen, in SI, frequencies in Hz."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from rig.scene import consistency
from rig.scene.body_names import numbered
from rig.scene.damper import Damper
from rig.scene.excitation import Test
from rig.scene.measurement_chain import Channel, Converter, RecordingSettings
from rig.scene.quantities import (
    ACCELERATION,
    FORCE,
    LENGTH,
    VOLTAGE,
    Kind,
)
from rig.scene.quantity_field import Quantity, printable
from rig.scene.settings import Mistake, Place, Settings, at
from rig.scene.shaker import ElectrodynamicShaker, ForceShaker, Shaker, Shakers, TableShaker, at_shaker
from rig.scene.structure import Structure

STANDARD_GRAVITY = 9.80665
# A recording numbers 65 535 topics, of which a channel takes four.
MOST_CHANNELS = 16_000


class Scene(Settings):
    """Everything on the bench."""

    name: Annotated[str, AfterValidator(printable)] = Field("unnamed scene", min_length=1, max_length=200)
    """A line for titles and legends."""
    structure: Structure
    """Keys masses and springs, or matrices."""
    gravity: Annotated[float, Quantity(ACCELERATION, at_least=0.0)] = STANDARD_GRAVITY
    """Downward acceleration [m/s^2]."""
    dampers: tuple[Annotated[Damper, consistency.DAMPER], ...] = ()
    """Particle dampers, one or several in a body."""
    shaker: Annotated[Shakers | None, consistency.SHAKERS] = None
    """One, or a list of several, each with its own body, spring, amplifier and output."""
    test: Annotated[Test | None, consistency.TEST] = None
    """What the bench does to the structure, and for how long; `daq record` runs it."""
    channels: Annotated[tuple[Annotated[Channel, consistency.CHANNEL], ...] | None, consistency.CHANNELS] = (
        Field(None, min_length=1, max_length=MOST_CHANNELS)
    )
    """What is measured where. None: ideal acceleration of every body and the table."""
    converter: Annotated[Converter, consistency.CONVERTER] = Converter()
    """The analogue-to-digital converter and its clock; ideal, at 5120 Hz, where nothing is given."""
    recording: Annotated[RecordingSettings, consistency.RECORDING] = RecordingSettings()
    """What goes into the recording besides the channels."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    """Where all random numbers of a run start."""

    @classmethod
    def prepare(cls, given: Mapping[str, Any]) -> tuple[Mapping[str, Any], list[Mistake]]:
        """Take bodies by their names."""
        return numbered(given)

    @classmethod
    def kind_by_neighbours(cls, given: Mapping[str, Any]) -> Mapping[Place, Kind]:
        """Take the drive in what the shaker takes."""
        kinds = {"table": LENGTH, "electrodynamic": VOLTAGE, "force": FORCE}
        shaker, number = given.get("shaker"), str(at(given, ("test", "shaker")))
        if isinstance(shaker, list | tuple):
            chosen = int(number) if number.isdecimal() else 0
            shaker = shaker[chosen - 1] if 0 < chosen <= len(shaker) else None
        kind = kinds.get(str(at(shaker, ("kind",))))
        return {} if kind is None else {("test", "drive"): kind}

    @property
    def shakers(self) -> tuple[Shaker, ...]:
        """All shakers."""
        if self.shaker is None:
            return ()
        return self.shaker if isinstance(self.shaker, tuple) else (self.shaker,)

    @property
    def tables(self) -> tuple[tuple[str, TableShaker | ElectrodynamicShaker], ...]:
        """Names of the shakers' tables, each with its shaker, in their order."""
        return tuple(
            (at_shaker("table", number, len(self.shakers)), shaker)
            for number, shaker in enumerate(self.shakers, 1)
            if not isinstance(shaker, ForceShaker)
        )

    @property
    def driven(self) -> int | None:
        """Number of the shaker that the test drives, from 1; None where there is none, or none of several is named."""
        if len(self.shakers) == 1:
            return 1
        return getattr(self.test, "shaker", None)

    @property
    def driven_shaker(self) -> Shaker | None:
        """The shaker that the test drives; None as in `driven`."""
        return None if self.driven is None else self.shakers[self.driven - 1]

    @property
    def force_on(self) -> tuple[int, ...]:
        """Bodies on which the test's force acts, from 1: the one that is hit, or those of the driven shaker."""
        if self.test is not None and self.test.kind == "impulse":
            return (self.test.body,)
        return () if self.driven_shaker is None else self.driven_shaker.bodies

    def at_driven(self, what: str) -> str:
        """Name an input or a place at the shaker that the test drives: "shaker", "table" or "drive", and which."""
        return at_shaker(what, self.driven or 1, len(self.shakers) or 1)

    def relations(self) -> Iterable[Mistake]:
        """Check the frequencies of the test against the sample rate."""
        return consistency.too_high_frequency(self.test, self.converter)

    def to_yaml(self) -> str:
        """Write a scene file that loads back as an equal scene.

        Returns
        -------
        str
            YAML text: what was given, in the units and with the digits and the names of bodies with which it was
            given. Matrices are inline.
        """
        from rig.scene.yaml_writer import write

        return write(self, self.structure)

    def to_si_yaml(self) -> str:
        """Write every value, in SI: the same text for equal scenes, for recordings and to recognize stored results."""
        from rig.scene.yaml_writer import write_in_si

        return write_in_si(self)

    def __str__(self) -> str:
        """Describe the scene in a line.

        >>> from rig.scene.loading import load
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
        parts += [f"shaker {shaker.kind}" for shaker in self.shakers]
        parts += [] if self.test is None else [f"test {self.test.kind}"]
        parts += [] if self.channels is None else [f"{len(self.channels)} channels"]
        return f"{self.name}: {', '.join(parts)}"
