"""Conversion of data sheets into the stages of a channel: sensor, integrating amplifier, AC coupling."""

from dataclasses import replace

import numpy as np

from daq.core.dsp.circuit import high_pass, integration, recovery, resonance
from daq.core.dsp.noise import generator
from daq.core.signal_chain.stage import Stage, data_sheet
from rig.core.scene.measurement_chain import Accelerometer, Channel, Converter, Hammer, Integrator
from rig.core.scene.presets import complete_from_preset, needs_supply

# Default quality factor of a mounted resonance.
DEFAULT_Q = 30.0
# Default ratio of the lateral to the vertical acceleration.
DEFAULT_LATERAL_RATIO = 0.1
# Default corner frequency of an AC coupling [Hz].
DEFAULT_AC_CORNER_HZ = 0.5


def channel_stages(channel: Channel, converter: Converter, seed: int) -> tuple[Stage, ...]:
    """Return the stages of a channel: its sensor, its amplifier if any, and the AC coupling of the input if any."""
    coupling: tuple[Stage, ...] = ()
    if converter.coupling == "AC":
        corner = DEFAULT_AC_CORNER_HZ if converter.ac_corner is None else converter.ac_corner
        coupling = (Stage("converter", (high_pass(corner, "AC coupling"),)),)
    if channel.measures_voltage:
        return (Stage("cable"), *coupling)
    if channel.measures_force:
        sensor = force_sensor(complete_from_preset(channel.hammer or Hammer()), seed, channel.name)
    else:
        sensor = accelerometer(complete_from_preset(channel.accelerometer or Accelerometer()), seed, channel.name)
    if needs_supply(channel) and converter.excitation == 0.0:
        # Without a supply, the output of the sensor's internal amplifier is zero.
        sensor = replace(sensor, deviation=-1.0, noise=None, noise_corner=None, offset=None, settling=None)
    amplifier = () if channel.integrator is None else (integrating_amplifier(channel.integrator),)
    return (sensor, *amplifier, *coupling)


def accelerometer(settings: Accelerometer, seed: int, channel: str) -> Stage:
    """Return the stage of an accelerometer: mounted resonance and low cut-off, limit of the output, noise and offset.

    Tolerance, temperature drift and transverse sensitivity are combined into one deviation of the sensitivity from its
    data sheet. The rig moves vertically. The lateral acceleration is assumed to be in phase with the vertical
    acceleration and proportional to it; its direction is random.

    >>> ideal = accelerometer(Accelerometer(), 1, "body1")
    >>> ideal.nominal, ideal.effects
    (1.0, {})
    >>> accelerometer(Accelerometer(resonance="30 kHz", low_cutoff="0.5 Hz"), 1, "body1").effects
    {'resonance': 2, 'low cut-off': 1}
    """
    sensitivity = 1.0 if settings.sensitivity is None else settings.sensitivity
    sections = []
    if settings.resonance is not None:
        sections.append(resonance(settings.resonance, DEFAULT_Q if settings.q is None else settings.q))
    if settings.low_cutoff is not None:
        sections.append(high_pass(settings.low_cutoff, "low cut-off"))
    if settings.saturation is not None and settings.overload_recovery is not None:
        sections.append(recovery(settings.overload_recovery))
    return Stage(
        "accelerometer",
        tuple(sections),
        nominal=sensitivity,
        deviation=_deviation(settings, seed, channel),
        noise=None if settings.noise is None else settings.noise * sensitivity,
        noise_corner=settings.noise_corner,
        offset=settings.bias,
        settling=settings.bias_settling,
        limit=None if settings.saturation is None else settings.saturation * sensitivity,
        data=data_sheet("accelerometer", settings),
    )


def _deviation(settings: Accelerometer, seed: int, channel: str) -> float:
    """Return the relative deviation of an accelerometer's true sensitivity from its data sheet."""
    factor = 1.0
    if settings.sensitivity_tolerance is not None:
        factor += settings.sensitivity_tolerance * _draw_uniform(seed, channel, "tolerance")
    if settings.temperature_drift is not None and settings.temperature_change is not None:
        factor *= 1.0 + settings.temperature_drift * settings.temperature_change
    if settings.transverse is not None:
        lateral = DEFAULT_LATERAL_RATIO if settings.lateral is None else settings.lateral
        factor += settings.transverse * lateral * np.cos(np.pi * _draw_uniform(seed, channel, "transverse"))
    return float(factor - 1.0)


def _draw_uniform(seed: int, channel: str, purpose: str) -> float:
    """Draw a uniformly distributed number from -1 to 1."""
    return float(generator(seed, channel, purpose).uniform(-1.0, 1.0))


def force_sensor(settings: Hammer, seed: int, channel: str) -> Stage:
    """Return the stage of a force sensor, ideal by default: low cut-off, tolerance, limit of the output, noise."""
    sensitivity = 1.0 if settings.sensitivity is None else settings.sensitivity
    tolerance = settings.sensitivity_tolerance
    return Stage(
        "hammer",
        () if settings.low_cutoff is None else (high_pass(settings.low_cutoff, "low cut-off"),),
        nominal=sensitivity,
        deviation=0.0 if tolerance is None else tolerance * _draw_uniform(seed, channel, "tolerance"),
        noise=None if settings.noise is None else settings.noise * sensitivity,
        limit=None if settings.saturation is None else settings.saturation * sensitivity,
        data=data_sheet("hammer", settings),
    )


def integrating_amplifier(settings: Integrator) -> Stage:
    """Return the stage of an integrating amplifier of order n: ``gain / (s + w)^n`` with w = 2 pi corner, in rad/s.

    A low cut-off adds a high-pass filter at the input. Each integration has the gain ``gain^(1/n)``, and its output is
    limited to the saturation voltage. The noise is that at the amplifier's output.

    >>> from rig.core.scene.measurement_chain import Integrator
    >>> integrating_amplifier(Integrator(order=2, corner="1 Hz", gain=1000.0)).effects
    {'integration': 2}
    """
    gain_of_integration = settings.gain ** (1.0 / settings.order)
    sections = [integration(settings.corner, gain_of_integration)] * settings.order
    if settings.low_cutoff is not None:
        sections.insert(0, high_pass(settings.low_cutoff, "amplifier low cut-off"))
    return Stage(
        "integrator",
        tuple(sections),
        nominal=settings.gain,
        noise=settings.noise,
        rails=settings.saturation,
        data=data_sheet("integrator", settings),
    )
