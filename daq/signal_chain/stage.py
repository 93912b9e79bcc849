"""Effects of a device in a channel on the signal, as far as a scene names them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from daq.dsp.circuit import INTEGRATION, Section
from rig.scene.measurement_chain import Converter
from rig.scene.quantities import text
from rig.scene.quantity_field import quantity_of
from rig.scene.settings import Settings


@dataclass(frozen=True)
class Stage:
    """One device of a channel: its linear circuit, and its deviations from that."""

    name: str
    """The device: accelerometer, hammer, integrator, converter."""
    sections: tuple[Section, ...] = ()
    """Its circuit; none: it passes the signal on as it is."""
    nominal: float = 1.0
    """Volts out per unit in (V per m/s^2 for an accelerometer), as the data sheet says."""
    deviation: float = 0.0
    """True sensitivity relative to the nominal one, less 1."""
    noise: float | None = None
    noise_corner: float | None = None
    """Density of the noise at its output, V/sqrt(Hz), and the corner below which it rises as 1/f, Hz."""
    offset: float | None = None
    settling: float | None = None
    """Offset of its output, V, and the time constant with which it settles from zero after power-on, s."""
    limit: float | None = None
    """Largest output the signal can reach, V."""
    rails: float | None = None
    """Largest voltage each integration can reach, V."""
    data: Mapping[str, str] = field(default_factory=dict)
    """Its data sheet as text, figures with units."""

    @property
    def effects(self) -> dict[str, int]:
        """Each effect, with the number of states it adds."""
        effects: dict[str, int] = {}
        for section in self.sections:
            effects[section.name] = effects.get(section.name, 0) + section.states
        named = {
            "sensitivity deviation": (self.deviation or None, 0),
            "saturation": (self.limit or self.rails, 0),
            "noise": (self.noise, 0),
            "1/f noise": (self.noise_corner, 0),
            "offset": (self.offset, 0),
            "offset settling": (self.settling, 1),
        }
        return effects | {name: states for name, (there, states) in named.items() if there is not None}


#: In place of a sensor where a voltage is measured.
CABLE = Stage("cable")


def is_averaged(stages: Sequence[Stage], converter: Converter) -> bool:
    """Whether a sample is an average over its interval: by default where the signal may hold impulses."""
    if converter.filter is not None or converter.sampling is not None:
        return converter.filter is None and converter.sampling == "average"
    return not any(section.name == INTEGRATION for stage in stages for section in stage.sections)


def data_sheet(device: str, settings: Settings) -> dict[str, str]:
    """List the settings of a device that are not the default, with units.

    >>> from rig.scene.measurement_chain import Accelerometer
    >>> data_sheet("accelerometer", Accelerometer(resonance="30 kHz"))
    {'accelerometer.resonance': '30000.0 Hz'}
    """
    sheet = {}
    for name, described in type(settings).model_fields.items():
        value = getattr(settings, name)
        if value == described.default:
            continue
        parts = (*described.metadata, described.annotation)
        quantity = next((found for part in parts if (found := quantity_of(part)) is not None), None)
        if isinstance(value, float) and quantity is not None:
            value = text(value, quantity.kinds[0])
        sheet[f"{device}.{name}"] = str(value)
    return sheet
