"""The scene: everything that is on the bench, frozen, in SI, frequencies in Hz."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from rig.alternatives import Alternatives, by_key
from rig.excitation_settings import Test
from rig.matrices import Matrices
from rig.quantities import (
    ACCELERATION,
    DASHPOT,
    FORCE,
    LENGTH,
    MASS,
    RATE,
    RATIO,
    STIFFNESS,
    TIME,
    VOLTAGE,
    Kind,
)
from rig.quantity_field import Quantity
from rig.scene_checks import mistakes_between
from rig.sensor_settings import Channel, Converter
from rig.settings import Mistake, Place, Settings, at
from rig.shaker_settings import Body, Shaker

STANDARD_GRAVITY = 9.80665


class ModalDamping(Settings):
    """A damping ratio for each natural mode of the structure without dampers and coil spring.

    Attributes
    ----------
    modal : float or tuple of float
        One ratio for all modes, or one for each (0.005 = 0.5 %); 1 is critical.
    """

    modal: Annotated[float | tuple[float, ...], Quantity(RATIO, at_least=0.0, listed=True)] = Field(
        description="a ratio such as 0.5 %, or one for each mode"
    )


class Rayleigh(Settings):
    """C = alpha M + beta K, alpha in 1/s and beta in s."""

    alpha: Annotated[float, Quantity(RATE, at_least=0.0)] = 0.0
    beta: Annotated[float, Quantity(TIME, at_least=0.0)] = 0.0


class RayleighDamping(Settings):
    """Damping in proportion to mass and stiffness."""

    rayleigh: Rayleigh = Field(description="keys alpha and beta")


class Dashpots(Settings):
    """A dashpot beside each spring of the chain [N s/m]."""

    dashpots: tuple[Annotated[float, Quantity(DASHPOT, at_least=0.0)], ...]


Damping = Annotated[ModalDamping | RayleighDamping | Dashpots, Alternatives(by_key)]


class Structure(Settings):
    """The structure: a chain of bodies on springs, or any linear one given by matrices.

    Attributes
    ----------
    masses : tuple of float, optional
        Masses of the bodies [kg], body 1 first.
    springs : tuple of float, optional
        Stiffness of spring j between body j and body j-1, ground for j = 1 [N/m]. 0: not connected.
    damping : ModalDamping, RayleighDamping or Dashpots, optional
        None: undamped.
    matrices : Matrices, optional
        In place of masses and springs.
    """

    one_of: ClassVar = (("masses", "matrices"),)
    masses: tuple[Annotated[float, Quantity(MASS, above=0.0)], ...] | None = Field(None, min_length=1)
    springs: tuple[Annotated[float, Quantity(STIFFNESS, at_least=0.0)], ...] | None = Field(
        None, min_length=1
    )
    damping: Damping | None = None
    matrices: Matrices | None = None

    @property
    def bodies(self) -> int:
        """Number of bodies."""
        if self.masses is not None:
            return len(self.masses)
        return len(self.matrices.mass) if self.matrices is not None else 0

    def relations(self) -> Iterable[Mistake]:
        """Check that the parts are of one structure."""
        count = self.bodies
        if self.masses is not None and self.springs is None:
            yield Mistake((), f"springs missing; expected {count}, one for each mass")
        if self.masses is not None and self.springs is not None and len(self.springs) != count:
            yield Mistake(
                ("springs",), f"got {len(self.springs)} springs; expected {count}, one for each mass"
            )
        if self.matrices is not None:
            if self.springs is not None:
                yield Mistake(("springs",), "given beside matrices, which hold the stiffness")
            if self.damping is not None and self.matrices.damping is not None:
                yield Mistake(("damping",), "given beside the damping matrix; expected one of them")
            if isinstance(self.damping, Dashpots):
                yield Mistake(
                    ("damping",), "dashpots lie along a chain; with matrices give matrices: {damping: ...}"
                )
        listed = {
            "modal": self.damping.modal if isinstance(self.damping, ModalDamping) else 0.0,
            "dashpots": self.damping.dashpots if isinstance(self.damping, Dashpots) else 0.0,
        }
        for key, values in listed.items():
            if isinstance(values, tuple) and len(values) != count:
                yield Mistake(
                    ("damping", key), f"got {len(values)} values; expected {count}, as there are bodies"
                )


class Damper(Settings):
    """A particle damper: the bed as one mass that rides on, leaves and hits floor and ceiling of a cavity.

    Attributes
    ----------
    body : int
        The body with the cavity, from 1.
    mass : float, optional
        Mass of the bed [kg]; or else
    mass_ratio : float, optional
        as a share of the mass of its body.
    clearance : float
        Free height of the cavity above the bed [m]; infinite: no ceiling, 0: held.
    restitution : float
        Ratio of separation to approach speed in an impact, from 0 (perfectly plastic) to below 1.
    locked : bool
        Whether the bed is glued to the floor.
    """

    one_of: ClassVar = (("mass", "mass_ratio"),)
    body: Body
    mass: Annotated[float, Quantity(MASS, above=0.0)] | None = None
    mass_ratio: Annotated[float, Quantity(RATIO, above=0.0)] | None = None
    clearance: Annotated[float, Quantity(LENGTH, at_least=0.0, infinite=True)]
    restitution: Annotated[float, Quantity(RATIO, at_least=0.0, below=1.0)] = 0.0
    locked: bool = False


class Recording(Settings):
    """What goes into the recording besides the channels.

    Attributes
    ----------
    display : bool
        Channels thinned out for plots that need no configuration.
    truth : bool
        The true motion, under its own topics.
    samples : {"float64", "float32", "counts"}, optional
        How samples are stored. None: counts where the converter has bits, else float64.
    """

    display: bool = True
    truth: bool = False
    samples: Literal["float64", "float32", "counts"] | None = None


class Scene(Settings):
    """Everything on the bench.

    Attributes
    ----------
    name : str
        A line for titles and legends.
    structure, dampers, shaker, test, channels, converter, recording
        See their classes. `channels` None: ideal acceleration of every body and the table.
    gravity : float
        Downward acceleration [m/s^2].
    seed : int
        Where all random numbers of a run start.
    """

    name: str = Field("unnamed scene", min_length=1, max_length=200)
    structure: Structure = Field(description="keys masses and springs, or matrices")
    gravity: Annotated[float, Quantity(ACCELERATION, at_least=0.0)] = STANDARD_GRAVITY
    dampers: tuple[Damper, ...] = ()
    shaker: Shaker | None = None
    test: Test | None = None
    channels: tuple[Channel, ...] | None = Field(None, min_length=1)
    converter: Converter = Converter()
    recording: Recording = Recording()
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1

    @classmethod
    def kind_by_neighbours(cls, given: Mapping[str, Any]) -> Mapping[Place, Kind]:
        """Take the drive in what the shaker takes."""
        kinds = {"table": LENGTH, "electrodynamic": VOLTAGE, "force": FORCE}
        kind = kinds.get(str(at(given, ("shaker", "kind"))))
        return {} if kind is None else {("test", "drive"): kind}

    def relations(self) -> Iterable[Mistake]:
        """Check references from one part to another."""
        return mistakes_between(
            self.structure.bodies,
            self.dampers,
            self.shaker,
            self.test,
            self.channels,
            self.converter,
            self.recording,
        )

    def to_yaml(self) -> str:
        """Write a scene file, with everything in it, that loads back as an equal scene.

        Returns
        -------
        str
            YAML text; matrices are inline.
        """
        from rig.scene_text import write

        return write(self)
