"""Decodes transducer electronic data sheets (TEDS, IEEE 1451.4) of sensors."""

import math
from collections.abc import Callable
from typing import Any

from daq.extras.ni_device.devices.names import Port
from daq.extras.ni_device.errors import Code, DaqError

# Fields of the basic TEDS and their numbers of bits, in the order from the lowest bit.
_BASIC_FIELDS = (
    ("teds_mfg_id", 14),
    ("teds_model_num", 15),
    ("teds_version_letter", 5),
    ("teds_version_num", 6),
    ("teds_serial_num", 24),
)
# Size of the basic TEDS, bytes (IEEE 1451.4).
_MIN_BYTES = 8
# The basic TEDS (64 bits), a selector (2 bits) and the template number (8 bits) precede the template's data.
_TEMPLATE_DATA_BIT = 74
# By template number: position of the 16-bit sensitivity in the template's data, smallest sensitivity (V per unit), and
# ratio of neighboring values. 25: accelerometer (m/s^2) or force transducer (N), 27: microphone (Pa).
_SENSITIVITY = {25: (2, 5e-7, 1.0003), 27: (1, 1e-5, 1.0002)}


def basic_teds(data: bytes) -> dict[str, Any]:
    """Return the values of the basic TEDS, the template number and the raw data, by NI's names.

    `data` is the content of the sensor's memory without its checksums, which TEDS readers remove. Raises `DaqError`
    -200826 if `data` is too short.

    >>> values = basic_teds(bytes([17, 64, 0, 32, 4, 57, 48, 0, 120]))
    >>> values["teds_mfg_id"], values["teds_version_letter"], values["teds_serial_num"], values["teds_template_i_ds"]
    (17, 'A', 12345, [30])
    """
    if len(data) < _MIN_BYTES:
        raise DaqError(
            f"the TEDS has {len(data)} bytes, but the minimum is {_MIN_BYTES}. Give the complete content of a TEDS.",
            Code.TEDS_SENSOR_DATA_ERROR,
        )
    bits = int.from_bytes(data, "little")
    values: dict[str, Any] = {"teds_bit_stream": data}
    for name, width in _BASIC_FIELDS:
        values[name], bits = bits & ((1 << width) - 1), bits >> width
    values["teds_version_letter"] = chr(ord("A") + values["teds_version_letter"] - 1)
    # The selector is 0 before a template of IEEE 1451.4.
    selector, template = bits & 3, (bits >> 2) & 0xFF
    values["teds_template_i_ds"] = [template] if selector == 0 and template else []
    return values


def sensitivity(data: bytes) -> float | None:
    """Return the sensitivity in TEDS data, V per unit; None for a template without sensitivity.

    >>> data = with_sensitivity(bytes([17, 64, 0, 32, 4, 57, 48, 0]), 25, 0.0102)
    >>> f"{sensitivity(data):.5f}"
    '0.01020'
    """
    bits = int.from_bytes(data, "little")
    selector, template = (bits >> 64) & 3, (bits >> 66) & 0xFF
    if selector or template not in _SENSITIVITY:
        return None
    offset, smallest, ratio = _SENSITIVITY[template]
    return smallest * ratio ** float((bits >> (_TEMPLATE_DATA_BIT + offset)) & 0xFFFF)


def with_sensitivity(basic: bytes, template: int, volts_per_unit: float) -> bytes:
    """Return TEDS data: a basic TEDS, then a template that contains the sensitivity."""
    bits = int.from_bytes(basic, "little") | template << 66
    if template in _SENSITIVITY:
        offset, smallest, ratio = _SENSITIVITY[template]
        bits |= round(math.log(volts_per_unit / smallest, ratio)) << (_TEMPLATE_DATA_BIT + offset)
    return bits.to_bytes(12, "little")


class TedsMemory:
    """The TEDS of the sensors; `teds_of_sensor` returns that at a terminal, None for a sensor without TEDS."""

    def __init__(self, teds_of_sensor: Callable[[Port], bytes | None]) -> None:
        self._teds_of_sensor = teds_of_sensor

    def data(self, port: Port) -> bytes:
        """Return the TEDS at a terminal. Raises `DaqError` -200709 for a sensor without TEDS."""
        data = self._teds_of_sensor(port)
        if data is None:
            raise DaqError(
                f"{port.name}: the sensor has no TEDS. Create the channel without TEDS, and give its sensitivity.",
                Code.TEDS_SENSOR_NOT_DETECTED,
            )
        return data

    def read(self, port: Port, name: str) -> Any:
        """Return a property of the TEDS at a terminal. Raises `DaqError` -200709 if the property is missing."""
        values = basic_teds(self.data(port))
        if name not in values:
            raise DaqError(f"{port.name}: the TEDS has no {name}. Do not query it.", Code.TEDS_SENSOR_NOT_DETECTED)
        return values[name]
