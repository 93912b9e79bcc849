"""Description of a channel's devices in series (stages), and the channel's response and effects.

An effect is a property by which a real channel deviates from an ideal one, such as noise, saturation or a resonance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from daq.core.dsp.circuit import INTEGRATION, Section
from daq.core.signal_chain.channel import ChannelInfo, Quantity
from daq.core.signal_chain.converter import volts_per_count
from daq.core.signal_chain.decimation_filter import DELAY_SAMPLES, DecimationFilter
from rig.core.scene.measurement_chain import Converter
from rig.core.settings.quantities import si_text
from rig.core.settings.quantity_field import quantity_of
from rig.core.settings.settings import Settings

_QUANTITY_BY_INTEGRATIONS: tuple[Quantity, ...] = ("acceleration", "velocity", "displacement")
_QUANTITY_BY_SENSOR: dict[str, Quantity] = {"hammer": "force", "cable": "voltage"}


@dataclass(frozen=True)
class Stage:
    """One device of a channel: its linear circuit, and its deviations from linearity and from the data sheet."""

    name: str  # kind of device: accelerometer, hammer, cable, integrator or converter
    sections: tuple[Section, ...] = ()  # linear circuit, from input to output
    nominal: float = 1.0  # sensitivity or gain by the data sheet: V per m/s², V/N or V/V
    deviation: float = 0.0  # relative deviation of the true from the nominal sensitivity
    noise: float | None = None  # noise density at the output, V/sqrt(Hz)
    noise_corner: float | None = None  # frequency below which the noise rises as 1/f [Hz]
    offset: float | None = None  # offset at the output [V]
    settling: float | None = None  # time constant with which the offset rises from zero after power-on [s]
    limit: float | None = None  # largest magnitude of a sensor's output [V]
    rails: float | None = None  # largest magnitude of the output of each integration [V]
    data: Mapping[str, str] = field(default_factory=dict)  # settings as text, from `data_sheet`

    @property
    def effects(self) -> dict[str, int]:
        """Names of the device's effects, with the number of states that each adds to the simulation."""
        effects: dict[str, int] = {}
        for section in self.sections:
            effects[section.name] = effects.get(section.name, 0) + section.states
        # For each effect: its setting (None: absent), and its number of states.
        optional_effects = {
            "sensitivity deviation": (self.deviation or None, 0),
            "saturation": (self.limit or self.rails, 0),
            "noise": (self.noise, 0),
            "1/f noise": (self.noise_corner, 0),
            "offset": (self.offset, 0),
            "offset settling": (self.settling, 1),
        }
        return effects | {name: states for name, (value, states) in optional_effects.items() if value is not None}


def is_averaged(stages: Sequence[Stage], converter: Converter) -> bool:
    """Return whether each sample is an average over its interval, by default without an integrating amplifier.

    An integrating amplifier attenuates high frequencies itself.
    """
    if converter.filter is not None or converter.sampling is not None:
        return converter.filter is None and converter.sampling == "average"
    return not any(section.name == INTEGRATION for stage in stages for section in stage.sections)


def data_sheet(device: str, settings: Settings) -> dict[str, str]:
    """Return the settings of a device that differ from their defaults, as strings with units.

    >>> from rig.core.scene.measurement_chain import Accelerometer
    >>> data_sheet("accelerometer", Accelerometer(resonance="30 kHz"))
    {'accelerometer.resonance': '30000.0 Hz'}
    """
    sheet = {}
    for name, model_field in type(settings).model_fields.items():
        value = getattr(settings, name)
        if value == model_field.default:
            continue
        annotations = (*model_field.metadata, model_field.annotation)
        quantity = next((match for annotation in annotations if (match := quantity_of(annotation)) is not None), None)
        if isinstance(value, float) and quantity is not None:
            value = si_text(value, quantity.kinds[0])
        sheet[f"{device}.{name}"] = str(value)
    return sheet


def channel_info(
    name: str, at: str, stages: Sequence[Stage], converter: Converter, rate: float, delay: float
) -> ChannelInfo:
    """Describe a channel by the nominal response of its stages; `rate` in Hz, `delay` by skew in s."""
    sections = [section for stage in stages for section in stage.sections]
    integrations = sum(section.name == INTEGRATION for section in sections)
    zeros = [zero for section in sections for zero in section.zeros]
    poles = [pole for section in sections for pole in section.poles]
    gain = float(np.prod([section.gain for section in sections]))
    for stage in stages[1:]:
        gain /= stage.nominal
    # The response refers to the integrated quantity (velocity, displacement): each integration adds a zero at 0 Hz.
    # Zeros and poles at 0 Hz cancel.
    zeros += [0j] * integrations
    for _ in range(min(zeros.count(0j), poles.count(0j))):
        zeros.remove(0j)
        poles.remove(0j)
    low_pass = None if converter.filter is None else DecimationFilter.standard(rate)
    filter_delay = 0.0 if low_pass is None or converter.remove_delay else DELAY_SAMPLES / rate
    return ChannelInfo(
        name=name,
        at=at,
        quantity=_QUANTITY_BY_SENSOR.get(stages[0].name, _QUANTITY_BY_INTEGRATIONS[integrations]),
        sensitivity=float(np.prod([stage.nominal for stage in stages])),
        rate=rate,
        zeros=tuple(zeros),
        poles=tuple(poles),
        gain=gain,
        average=is_averaged(stages, converter),
        delay=filter_delay + delay,
        filter={} if low_pass is None else low_pass.parameters,
        volts_per_count=volts_per_count(converter),
        range=converter.range,
        sensor={key: text for stage in stages for key, text in stage.data.items()} | data_sheet("converter", converter),
    )


def channel_effects(stages: Sequence[Stage], converter: Converter, delay: float) -> dict[str, int]:
    """Return the effects in a channel from sensor to converter, and the number of states that each effect adds."""
    effects: dict[str, int] = {}
    for stage in stages:
        for name, states in stage.effects.items():
            effects[f"{stage.name} {name}" if name in effects else name] = states
    if converter.filter is not None:
        effects["decimation filter"] = 2 * DELAY_SAMPLES
    elif is_averaged(stages, converter):
        effects["averaging"] = 1
    else:
        effects["point sampling"] = 0
    optional_effects = {
        "skew": delay or None,
        "jitter": converter.jitter,
        "converter noise": converter.noise,
        "clipping": converter.range,
        "quantization": converter.bits,
    }
    return effects | {name: 0 for name, value in optional_effects.items() if value is not None}
