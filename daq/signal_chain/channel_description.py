"""Description of a channel: data sheets of its parts as text, its response, its effects."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from daq.dsp.circuit import INTEGRATION
from daq.signal_chain.channel import ChannelInfo, Quantity
from daq.signal_chain.decimation_filter import DELAY, Decimation
from daq.signal_chain.stage import Stage, data_sheet, is_averaged
from rig.scene.measurement_chain import Converter

_INTEGRATED: tuple[Quantity, ...] = ("acceleration", "velocity", "displacement")
_BY_SENSOR: dict[str, Quantity] = {"hammer": "force", "cable": "voltage"}


def channel_info(
    name: str, at: str, stages: Sequence[Stage], converter: Converter, rate: float, delay: float
) -> ChannelInfo:
    """Describe how a channel's readings relate to the quantity at its place, at a rate in Hz, late by `delay` in s."""
    sections = [section for stage in stages for section in stage.sections]
    order = sum(section.name == INTEGRATION for section in sections)
    zeros = [zero for section in sections for zero in section.zeros]
    poles = [pole for section in sections for pole in section.poles]
    gain = float(np.prod([section.gain for section in sections]))
    for stage in stages[1:]:
        gain /= stage.nominal
    # From acceleration to the reading: one more zero at 0 Hz for each integration, which cancels a pole there.
    zeros += [0j] * order
    for _ in range(min(zeros.count(0j), poles.count(0j))):
        zeros.remove(0j)
        poles.remove(0j)
    low_pass = None if converter.filter is None else Decimation.standard(rate)
    filter_delay = 0.0 if low_pass is None or converter.remove_delay else DELAY / rate
    return ChannelInfo(
        name=name,
        at=at,
        quantity=_BY_SENSOR.get(stages[0].name, _INTEGRATED[order]),
        sensitivity=float(np.prod([stage.nominal for stage in stages])),
        rate=rate,
        zeros=tuple(zeros),
        poles=tuple(poles),
        gain=gain,
        average=is_averaged(stages, converter),
        delay=filter_delay + delay,
        filter={} if low_pass is None else low_pass.design,
        sensor={key: text for stage in stages for key, text in stage.data.items()}
        | data_sheet("converter", converter),
    )


def channel_effects(stages: Sequence[Stage], converter: Converter, delay: float) -> dict[str, int]:
    """List the effects in a channel, in the order of the signal, with the states each adds."""
    effects: dict[str, int] = {}
    for stage in stages:
        for name, states in stage.effects.items():
            effects[f"{stage.name} {name}" if name in effects else name] = states
    if converter.filter is not None:
        effects["decimation filter"] = 2 * DELAY
    elif is_averaged(stages, converter):
        effects["averaging"] = 1
    else:
        effects["point sampling"] = 0
    named = {
        "skew": delay or None,
        "jitter": converter.jitter,
        "converter noise": converter.noise,
        "clipping": converter.range,
        "quantisation": converter.bits,
    }
    return effects | {name: 0 for name, value in named.items() if value is not None}
