"""An electrodynamic shaker: coil, armature and power amplifier."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Literal

from pydantic import model_validator

from rig.data_sheets.data_sheets import Preset, check_preset, data_sheet
from rig.scene.shaker.parts import Amplifier, Armature, Body, Coil, CoilSpring, Output
from rig.settings.problems import Problem
from rig.settings.settings import Settings


class ElectrodynamicShaker(Settings):
    """A moving-coil shaker that drives body `body` through the coil spring, with the reaction of the structure."""

    kind: Literal["electrodynamic"] = "electrodynamic"
    preset: Preset | None = None
    """Name of a shaker whose data sheet supplies the values of coil and armature not given here."""
    body: Body
    """The driven body, by its number from 1 or its name."""
    spring: CoilSpring
    """Stiffness of the coil spring between the table and the body [N/m]."""
    coil: Coil = Coil()
    armature: Armature = Armature()
    amplifier: Amplifier = Amplifier()
    output: Output = Output()
    """The analog output whose voltage is the drive."""

    @model_validator(mode="before")
    @classmethod
    def _complete_from_preset(cls, content: Any) -> Any:
        """Complete the given values with those of the data sheet."""
        preset = content.get("preset") if isinstance(content, Mapping) else None
        if not isinstance(preset, str) or any(check_preset(preset, "shaker")):
            return content
        parts = {
            part: {**values, **content.get(part, {})}
            for part, values in data_sheet(preset, "shaker").settings["shaker"].items()
            if isinstance(content.get(part, {}), Mapping)
        }
        return {**content, **parts}

    def check_consistency(self) -> Iterable[Problem]:
        """Check that the part is known."""
        return check_preset(self.preset, "shaker")

    @property
    def bodies(self) -> tuple[int, ...]:
        """The driven body, from 1."""
        return (self.body,)
