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

    name: str  # accelerometer, hammer, cable, integrator or converter
    sections: tuple[Section, ...] = ()  # its circuit
    nominal: float = 1.0  # volts out per unit in (V per m/s^2 for an accelerometer), by the data sheet
    deviation: float = 0.0  # true sensitivity relative to the nominal sensitivity, less 1
    noise: float | None = None  # density of the noise at its output, V/sqrt(Hz)
    noise_corner: float | None = None  # frequency below which the noise rises as 1/f, Hz
    offset: float | None = None  # of its output, V
    settling: float | None = None  # time constant with which the offset settles from zero after power-on, s
    limit: float | None = None  # largest output that the signal can reach, V
    rails: float | None = None  # largest voltage that each integration can reach, V
    data: Mapping[str, str] = field(default_factory=dict)  # its data sheet as text, figures with units

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
