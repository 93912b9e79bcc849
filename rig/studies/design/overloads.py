"""Prediction of the sensors and converter inputs that the check of a design overloads."""

from collections.abc import Sequence
from dataclasses import dataclass
from shlex import quote

import numpy as np

from rig.core.results import format_number
from rig.core.scene.measurement_chain import Accelerometer, Integrator
from rig.core.scene.presets import complete_from_preset
from rig.core.scene.scene import STANDARD_GRAVITY, Scene
from rig.core.system.assembly import assemble
from rig.core.system.impact_acceleration import impact_acceleration
from rig.studies.design.check import Expected
from rig.studies.design.worst_peak import Peak


@dataclass(frozen=True)
class Overload:
    """An overload of an accelerometer or a converter input by a check."""

    reason: str  # channel, largest value, its force levels, and the limit that it exceeds
    changes: tuple[str, ...]  # changes of the scene for ``--set`` that remove the limit


def predict_overloads(scene: Scene, expected: Sequence[Expected], bare: Peak, level_unit: str = "N") -> list[Overload]:
    """Return overloaded accelerometers and converter inputs of a check, with remedies.

    `scene`: the scene of the check; `expected`: expected results of the check at each level; `bare`: largest peak
    without dampers; it is recorded at the smallest of these levels.
    """
    system = assemble(scene)
    lowest = min(result.peak.level for result in expected)
    peaks_and_levels = [(result.peak, result.peak.level) for result in expected] + [(bare, lowest)]
    overloaded: list[Overload] = []
    max_voltage, max_channel = 0.0, ""
    for number, channel in enumerate(scene.channels or (), 1):
        sensor = None if channel.accelerometer is None else complete_from_preset(channel.accelerometer)
        if sensor is None:
            continue
        steady_accelerations = [
            _steady_acceleration(scene, channel.at, peak, level) for peak, level in peaks_and_levels
        ]
        voltage = max(
            _voltage(sensor, channel.integrator, acceleration, peak.frequency)
            for acceleration, (peak, _) in zip(steady_accelerations, peaks_and_levels, strict=True)
        )
        if voltage > max_voltage:
            max_voltage, max_channel = voltage, channel.name
        if sensor.saturation is None:
            continue
        row = system.points.index(channel.at)
        impact_accelerations = [
            impact_acceleration(system, row, result.closing_speed, sensor.resonance) for result in expected
        ]
        # The last motion is without dampers, so without impacts.
        largest = [*map(max, impact_accelerations, steady_accelerations), steady_accelerations[-1]]
        exceeded = [k for k, acceleration in enumerate(largest) if acceleration > sensor.saturation]
        if exceeded:
            levels = ", ".join(dict.fromkeys(format_number(peaks_and_levels[k][1]) for k in exceeded))
            fastest = max(max(result.closing_speed, default=0.0) for result in expected)
            cause = (
                f", because of damper impacts with closing speeds of up to {fastest:.2g} m/s"
                if max(impact_accelerations) > max(steady_accelerations)
                else ""
            )
            reason = (
                f"{channel.name}: up to {_format_acceleration(max(largest))} at {levels} {level_unit}{cause}; "
                f"its accelerometer saturates at {_format_acceleration(sensor.saturation)}"
            )
            overloaded.append(Overload(reason, _remedies(number, channel.accelerometer, max(largest))))
    converter = None if scene.converter is None else complete_from_preset(scene.converter)
    if converter is not None and converter.range is not None and max_voltage > converter.range:
        voltage = float(f"{1.5 * max_voltage:.2g}")
        overloaded.append(
            Overload(
                f"{max_channel}: up to {format_number(max_voltage)} V; the range of the converter is "
                f"{format_number(converter.range)} V",
                (f"converter.range={format_number(voltage)}V",),
            )
        )
    return overloaded


def overload_lines(overloads: Sequence[Overload], finite_contact: bool) -> list[str]:
    """Format overloads as text lines with their remedies; empty without overloads."""
    if not overloads:
        return []
    remedy = "On a real bench, use sensors with a larger range, or lower levels."
    if not finite_contact:
        remedy += (
            " Impacts of shot take milliseconds: add contact: {duration: 2 ms} to the first damper of the scene, and "
            "repeat the design."
        )
    changes = " ".join(f"--set {quote(change)}" for overload in overloads for change in overload.changes)
    return [
        "",
        "this test overloads:",
        *(overload.reason for overload in overloads),
        f"The commands below remove these limits from the simulation ({changes}). {remedy}",
    ]


def _steady_acceleration(scene: Scene, at: str, peak: Peak, level: float) -> float:
    """Estimate an upper bound of the steady acceleration at a point [m/s²] from the largest acceleration of a body."""
    acceleration = peak.acceleration * level / peak.level
    spring = None if scene.driven_shaker is None else scene.driven_shaker.coil_spring
    # The displacement of the shaker table includes the elongation of the spring.
    if not at.startswith("body") and spring:
        acceleration += level / spring * (2.0 * np.pi * peak.frequency) ** 2
    return acceleration


def _voltage(sensor: Accelerometer, integrator: Integrator | None, acceleration: float, frequency: float) -> float:
    voltage = (sensor.sensitivity or 1.0) * acceleration
    if integrator is None:
        return voltage
    return voltage * integrator.gain / (2.0 * np.pi * frequency) ** integrator.order


def _remedies(number: int, sensor: Accelerometer | None, acceleration: float) -> tuple[str, ...]:
    """Return changes of a channel's accelerometer that remove its overload at an acceleration [m/s²]."""
    assert sensor is not None
    key = f"channels[{number}].accelerometer"
    if np.isfinite(acceleration):
        g = float(f"{2.0 * acceleration / STANDARD_GRAVITY:.1g}")
        return (f"{key}.saturation={format_number(g)}g",)
    if sensor.preset is None:
        recovery = () if sensor.overload_recovery is None else (f"{key}.overload_recovery=null",)
        return (*recovery, f"{key}.saturation=null")
    return (f"{key}.resonance=30kHz", f"{key}.saturation=1e6 g")


def _format_acceleration(acceleration: float) -> str:
    if np.isinf(acceleration):
        return "more than any sensor withstands"
    return f"{format_number(float(f'{acceleration / STANDARD_GRAVITY:.2g}'))} g"
