"""Description of a measurement channel: its location, quantity, and response from true quantity to reading."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from daq.core.signal_chain.field_checks import CHANNEL_CHECKS, check
from rig.core.base.arrays import ComplexArray
from rig.core.base.errors import RecordingError

Quantity = Literal["acceleration", "velocity", "displacement", "force", "voltage"]

UNITS: dict[str, str] = {"acceleration": "m/s^2", "velocity": "m/s", "displacement": "m", "force": "N", "voltage": "V"}


@dataclass(frozen=True)
class ChannelInfo:
    """A channel as its data sheets describe it: its location, its quantity and its frequency response.

    The reading is ``volts / sensitivity``, in `unit`. `response` is the complete linear response of sensor,
    amplifier and converter. The response does not include tolerances, noise, drift and clipping.

    >>> ideal = ChannelInfo("body1", "body 1", "acceleration", sensitivity=1.0, rate=5120.0, average=True)
    >>> ideal.unit, f"{abs(ideal.response(512.0)):.6f}", f"{np.angle(ideal.response(512.0), deg=True):.1f}"
    ('m/s^2', '0.983632', '-18.0')
    >>> ChannelInfo.from_metadata(ideal.to_metadata()) == ideal
    True
    """

    name: str
    at: str  # location: "body 2", "table", "hammer", "shaker" or "drive"
    quantity: Quantity  # measured quantity, after integration by an amplifier
    sensitivity: float  # nominal sensitivity, V per unit
    rate: float  # nominal sample rate [Hz]
    zeros: tuple[complex, ...] = ()
    poles: tuple[complex, ...] = ()
    gain: float = 1.0  # factor of prod(s - zeros) / prod(s - poles), with s, zeros and poles in rad/s
    average: bool = False  # each sample is the average over the interval that ends at it
    delay: float = 0.0  # delay by filter and skew, s, without the delay of the averaging
    filter: Mapping[str, float] = field(default_factory=dict)  # fields of `DecimationFilter`, without its delay
    volts_per_count: float | None = None  # V per count; None if samples are in volts
    range: float | None = None  # full scale of the converter, ± V
    sensor: Mapping[str, str] = field(default_factory=dict)  # settings of all devices, as strings with units

    @property
    def unit(self) -> str:
        """Unit of the reading."""
        return UNITS[self.quantity]

    @property
    def body(self) -> int:
        """Number of the body on which the sensor is mounted; 0 for any other location."""
        return int(self.at.removeprefix("body ")) if self.at.startswith("body ") else 0

    @property
    def derivative(self) -> int | None:
        """Number of differentiations from displacement to the quantity; None for a force or a voltage."""
        return {"displacement": 0, "velocity": 1, "acceleration": 2}.get(self.quantity)

    @property
    def sampling(self) -> Literal["point", "average", "filter"]:
        """Kind of sampling: voltage at an instant, average over a sample interval, or output of the filter."""
        return "filter" if self.filter else "average" if self.average else "point"

    @property
    def unit_per_count(self) -> float:
        """Reading for one count of the converter, or for 1 V if samples are volts."""
        return (1.0 if self.volts_per_count is None else self.volts_per_count) / self.sensitivity

    def response(self, frequency: ArrayLike) -> ComplexArray:
        """Return the complex ratio of reading to true quantity at frequencies in Hz; a lag has a negative phase.

        Above half the sample rate, the reading is the alias of the true tone.
        """
        f = np.asarray(frequency, dtype=float)
        s = 2j * np.pi * f
        value = np.full(f.shape, self.gain, dtype=complex)
        # Multiply and divide in turns: the product of all poles alone, in rad/s, could overflow.
        for i in range(max(len(self.zeros), len(self.poles))):
            if i < len(self.zeros):
                value *= s - self.zeros[i]
            if i < len(self.poles):
                value /= s - self.poles[i]
        if self.average:
            value *= np.sinc(f / self.rate) * np.exp(-0.5 * s / self.rate)
        if self.filter:
            # Imported when first used: few callers need the filter, and it imports scipy.
            from daq.core.signal_chain.decimation_filter import DecimationFilter

            value *= DecimationFilter(**self.filter).amplitude_response(f)
        if self.delay:
            value *= np.exp(-s * self.delay)
        return value

    def to_metadata(self) -> dict[str, str]:
        """Return the fields as text for the metadata of a recording; numbers keep all digits."""
        values: dict[str, Any] = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        values["zeros"] = [(root.real, root.imag) for root in map(complex, self.zeros)]
        values["poles"] = [(root.real, root.imag) for root in map(complex, self.poles)]
        values["filter"], values["sensor"] = dict(self.filter), dict(self.sensor)
        text = {
            key: value if isinstance(value, str) else json.dumps(value, allow_nan=False)
            for key, value in values.items()
        }
        return text | {"unit": self.unit}

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> Self:
        """Make a channel from the result of `to_metadata`; raise `RecordingError` if a field is missing or invalid."""
        strings = {"name", "at", "quantity"}
        values: dict[str, Any] = {}
        for entry in fields(cls):
            try:
                text = metadata[entry.name]
                values[entry.name] = text if entry.name in strings else json.loads(text)
            except KeyError:
                raise RecordingError(
                    f"channel metadata: {entry.name!r} is missing (present: {', '.join(sorted(metadata)) or 'none'}). "
                    "Use a recording that shotrig wrote."
                ) from None
            except (ValueError, RecursionError):
                raise RecordingError(
                    f"channel metadata: {entry.name} = {text[:80]!r} is not JSON. Use a recording that shotrig wrote."
                ) from None
        check(values, CHANNEL_CHECKS)
        for roots in ("zeros", "poles"):
            values[roots] = tuple(complex(real, imag) for real, imag in values[roots])
        return cls(**values)
