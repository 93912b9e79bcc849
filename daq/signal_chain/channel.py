"""Description of a channel: its quantity, and the frequency response from the true quantity to its readings."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from daq.signal_chain.field_checks import CHANNEL, check
from rig.arrays import ComplexArray
from rig.errors import RecordingError

Quantity = Literal["acceleration", "velocity", "displacement", "force", "voltage"]

UNITS: dict[str, str] = {"acceleration": "m/s^2", "velocity": "m/s", "displacement": "m", "force": "N", "voltage": "V"}


@dataclass(frozen=True)
class ChannelInfo:
    """A channel as its data sheets describe it: its location, its quantity and its frequency response.

    The value read is ``volts / sensitivity`` in `unit`. It differs from the true quantity by the linear response
    of sensor, amplifier and converter, which `response` gives in full; tolerances, noise, drift and clipping are
    not part of it.

    >>> ideal = ChannelInfo("body1", "body 1", "acceleration", sensitivity=1.0, rate=5120.0, average=True)
    >>> ideal.unit, f"{abs(ideal.response(512.0)):.6f}", f"{np.angle(ideal.response(512.0), deg=True):.1f}"
    ('m/s^2', '0.983632', '-18.0')
    >>> ChannelInfo.from_metadata(ideal.to_metadata()) == ideal
    True
    """

    name: str
    at: str  # "body 2", "table", "hammer", "shaker" or "drive"
    quantity: Quantity  # after integration, if any
    sensitivity: float  # nominal, V per unit
    rate: float  # as the clock states it, Hz
    zeros: tuple[complex, ...] = ()
    poles: tuple[complex, ...] = ()
    gain: float = 1.0  # factor of prod(s - zeros) / prod(s - poles), in rad/s
    average: bool = False  # over the sample interval that ends at the sample
    delay: float = 0.0  # in addition to the averaging, s
    filter: Mapping[str, float] = field(default_factory=dict)  # `Decimation` without its delay
    volts_per_count: float | None = None
    range: float | None = None  # full scale of the converter, ± V
    sensor: Mapping[str, str] = field(default_factory=dict)  # data sheet, figures with units

    @property
    def unit(self) -> str:
        """Unit of the quantity read."""
        return UNITS[self.quantity]

    @property
    def derivative(self) -> int | None:
        """Order of the derivative of the displacement that is read; None of a force or a voltage."""
        return {"displacement": 0, "velocity": 1, "acceleration": 2}.get(self.quantity)

    @property
    def sampling(self) -> Literal["point", "average", "filter"]:
        """Kind of sample: voltage at its instant, average over the interval before it, or output of the filter."""
        return "filter" if self.filter else "average" if self.average else "point"

    @property
    def unit_per_count(self) -> float:
        """Size of a converter count in the unit read; of a volt, where samples are volts."""
        return (1.0 if self.volts_per_count is None else self.volts_per_count) / self.sensitivity

    def response(self, frequency: ArrayLike) -> ComplexArray:
        """Return the ratio of the value read to the true quantity at frequencies in Hz; a lag has a negative phase.

        Below half the sample rate it is the reading of a tone; above, that of its alias.
        """
        f = np.asarray(frequency, dtype=float)
        s = 2j * np.pi * f
        value = np.full(f.shape, self.gain, dtype=complex)
        # Factor by factor, a zero with a pole: the products of many poles in rad/s would overflow in the end.
        for i in range(max(len(self.zeros), len(self.poles))):
            if i < len(self.zeros):
                value *= s - self.zeros[i]
            if i < len(self.poles):
                value /= s - self.poles[i]
        if self.average:
            value *= np.sinc(f / self.rate) * np.exp(-0.5 * s / self.rate)
        if self.filter:
            # The filter is needed by few readers of a channel, and it brings in scipy.
            from daq.signal_chain.decimation_filter import Decimation

            value *= Decimation(**self.filter).magnitude(f)
        if self.delay:
            value *= np.exp(-s * self.delay)
        return value

    def to_metadata(self) -> dict[str, str]:
        """Return the channel as text fields, every number exactly, for a recording's metadata."""
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
                    f"channel metadata: {entry.name!r} is missing (there: {', '.join(sorted(metadata)) or 'nothing'}). "
                    "The recording is damaged, or another program wrote it."
                ) from None
            except (ValueError, RecursionError):
                raise RecordingError(
                    f"channel metadata: {entry.name} = {text[:80]!r} is not JSON. The recording is damaged, "
                    "or another program wrote it."
                ) from None
        check(values, CHANNEL)
        for roots in ("zeros", "poles"):
            values[roots] = tuple(complex(real, imag) for real, imag in values[roots])
        return cls(**values)
