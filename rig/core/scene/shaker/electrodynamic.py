"""An electrodynamic shaker: coil, armature and power amplifier."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import model_validator

from rig.core.base.arrays import ComplexArray
from rig.core.data_sheets.data_sheets import Preset, check_preset, data_sheet
from rig.core.equations import Current, Equations
from rig.core.scene.shaker.coil_spring import CoilSpringShaker
from rig.core.scene.shaker.kind import AmplifierOutput, Glyph, Load, ShakerEffect
from rig.core.scene.shaker.parts import Amplifier, Armature, Body, Coil, CoilSpring, Output, ShakerLimits
from rig.core.settings.problems import Problem
from rig.core.settings.quantities import VOLTAGE


class ElectrodynamicShaker(CoilSpringShaker):
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
    limits: ShakerLimits = ShakerLimits()
    """Limits from the data sheet."""
    output: Output = Output()
    """The analog output whose voltage is the drive."""

    drive_quantity: ClassVar = VOLTAGE
    glyph: ClassVar = Glyph("electrodynamic shaker", "cylinder")

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
        """Check that the product `preset` is known."""
        return check_preset(self.preset, "shaker")

    @property
    def _sets_current(self) -> bool:
        return self.amplifier.mode == "current"

    @property
    def power_amplifier(self) -> AmplifierOutput:
        """The amplifier, which sets the current or the voltage of the coil."""
        return AmplifierOutput("A" if self._sets_current else "V", self.amplifier.gain, self.amplifier.limit)

    @property
    def newtons_per_drive(self) -> float:
        """Force of the coil at rest per unit of drive [N]."""
        newtons = self.coil.force_factor * self.amplifier.gain
        return newtons if self._sets_current else newtons / self.coil.resistance

    @property
    def loads(self) -> tuple[Load, ...]:
        """Travel, current of the coil unless the amplifier sets it, and other quantities with a limit."""
        armature, limits, factor = self.armature, self.limits, self.coil.force_factor
        stiffness = armature.stiffness + self.spring

        def coil_force(scale: float) -> tuple[float, float, float, float]:
            return scale * stiffness, scale * armature.damping, scale * armature.mass, -scale * self.spring

        travel, current, force, velocity = (
            Load("table", "travel", "m", (1.0, 0.0, 0.0, 0.0), limits.travel or np.inf),
            Load("coil", "current", "A", coil_force(1.0 / factor), limits.current or np.inf),
            Load("coil", "force", "N", coil_force(1.0), limits.force or np.inf),
            Load("table", "velocity", "m/s", (0.0, 1.0, 0.0, 0.0), limits.velocity or np.inf),
        )
        others = [load for load in (force, velocity) if np.isfinite(load.limit)]
        return (travel, *([current] if np.isfinite(current.limit) or not self._sets_current else []), *others)

    def add_to(self, equations: Equations, drive: str, table: str) -> None:
        """Add the spring, the armature on its suspension and, with a voltage amplifier, the current of the coil."""
        coil, armature, gain = self.coil, self.armature, self.amplifier.gain
        row = equations.add_point(table, armature.mass)
        equations.add_spring(self.body - 1, row, self.spring)
        equations.support(row, armature.stiffness, armature.damping)
        forces = {row: gain * coil.force_factor} if self._sets_current else {}
        column = equations.add_input(drive, self.drive_unit, forces, self.drive_limit)
        if not self._sets_current:
            equations.add_current(Current(row, column, coil.resistance, coil.inductance, coil.force_factor, gain))

    def required_drive(self, s: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the drive: the current, or the voltage at the coil."""
        coil, armature = self.coil, self.armature
        force = armature.mass * s**2 + armature.damping * s + armature.stiffness
        if self._sets_current:
            return force, np.ones_like(s)
        impedance = (coil.resistance + coil.inductance * s) / coil.force_factor
        return impedance * force + coil.force_factor * s, impedance

    def effects(self, bodies: str, modes_at_rest: Callable[[], str]) -> Iterable[ShakerEffect]:
        """Yield spring and armature, the current of the coil, and clipping of the amplifier."""
        coil, amplifier = self.coil, self.power_amplifier
        detail = f"spring of {self.spring:.4g} N/m to {bodies}; armature of {self.armature.mass:.4g} kg"
        yield ShakerEffect("coil spring and table", 2, detail)
        if not self._sets_current:
            detail = f"{coil.resistance:.4g} ohm, {coil.inductance:.4g} H, {coil.force_factor:.4g} N/A"
            yield ShakerEffect("coil current", 1, detail)
        if np.isfinite(amplifier.limit):
            yield ShakerEffect("amplifier clipping", 0, f"at {amplifier.limit:.4g} {amplifier.unit}")

    def output_text(self, suffix: str, bodies: str) -> str:
        """Describe the voltage or the current of the coil."""
        unit, gain, _ = self.power_amplifier
        what = "current through" if self._sets_current else "voltage at"
        return f"{what} the coil{suffix and f' of shaker{suffix}'}, {gain:g} {unit}/V"
