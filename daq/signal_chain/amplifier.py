"""Integrating amplifiers, which turn the signal of an accelerometer into velocity or displacement."""

from __future__ import annotations

from daq.dsp.circuit import high_pass, integration
from daq.signal_chain.stage import Stage, data_sheet
from rig.scene.measurement_chain import Integrator


def integrating_amplifier(settings: Integrator) -> Stage:
    """Describe an integrating amplifier of order n, ``gain / (s + w)^n`` with w = 2 pi corner, in volts and seconds.

    A low cut-off adds a high pass at the input. Each integration has an equal share of the gain, and neither
    output exceeds the saturation voltage. The noise is that of the output.

    >>> from rig.scene.measurement_chain import Integrator
    >>> integrating_amplifier(Integrator(order=2, corner="1 Hz", gain=1000.0)).effects
    {'integration': 2}
    """
    gain = settings.gain ** (1.0 / settings.order)
    coupling = (
        () if settings.low_cutoff is None else (high_pass(settings.low_cutoff, "amplifier low cut-off"),)
    )
    return Stage(
        "integrator",
        (*coupling, *(integration(settings.corner, gain) for _ in range(settings.order))),
        nominal=settings.gain,
        noise=settings.noise,
        rails=settings.saturation,
        data=data_sheet("integrator", settings),
    )
