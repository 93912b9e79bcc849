"""Decodes transducer electronic data sheets (TEDS, IEEE 1451.4) from sensors, or from files (virtual TEDS)."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from daq.extras.ni_device.devices.names import Port
from daq.extras.ni_device.errors import Code, DaqError
from rig.core.base.input_files import read_file

# Fields of the basic TEDS and their numbers of bits, in the order from the lowest bit.
_BASIC_FIELDS = (
    ("teds_mfg_id", 14),
    ("teds_model_num", 15),
    ("teds_version_letter", 5),
    ("teds_version_num", 6),
    ("teds_serial_num", 24),
)
# Size of the basic TEDS [bytes] (IEEE 1451.4).
_MIN_BYTES = 8
# The basic TEDS (64 bits), a selector (2 bits) and the template number (8 bits) precede the template's data.
_TEMPLATE_DATA_BIT = 74
# By template number: position of the 16-bit sensitivity in the template's data, smallest sensitivity (V per unit), and
# ratio of neighboring values. 25: accelerometer [m/s²] or force transducer [N], 27: microphone [Pa].
_SENSITIVITY = {25: (2, 5e-7, 1.0003), 27: (1, 1e-5, 1.0002)}
# Size of the header of a virtual TEDS file in which each further byte represents one bit [bytes].
_FILE_HEADER_BYTES = 40


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
    """The TEDS of the sensors, and the virtual TEDS (files) that replace them.

    `teds_of_sensor` returns the TEDS of the sensor at a terminal; None for a sensor without TEDS.
    """

    def __init__(self, teds_of_sensor: Callable[[Port], bytes | None]) -> None:
        self._teds_of_sensor = teds_of_sensor
        self._virtual: dict[str, bytes] = {}  # contents of files, by lower-case terminal

    def configure(self, port: Port, path: str) -> None:
        """Replace the TEDS of a sensor with a file; with an empty path, use the TEDS of the sensor."""
        if not path:
            self._virtual.pop(port.name.lower(), None)
            self.data(port)  # Raises an error for a sensor without TEDS.
            return
        try:
            data = read_file(Path(path))
        except OSError as error:
            raise DaqError(
                f"{path}: {error.strerror}. Give the path of a virtual TEDS file.", Code.VIRTUAL_TEDS_FILE_NOT_FOUND
            ) from None
        if not set(data) - {0, 1}:
            # A header, then one byte per bit.
            bits = data[_FILE_HEADER_BYTES:]
            value = sum(bit << position for position, bit in enumerate(bits))
            data = value.to_bytes(-(-len(bits) // 8), "little")  # rounded up
        basic_teds(data)
        self._virtual[port.name.lower()] = data

    def clear(self, port: Port) -> None:
        """Remove the file that replaces a sensor's TEDS."""
        self._virtual.pop(port.name.lower(), None)

    def write(self, port: Port, data: bytes) -> None:
        """Reject a write into a sensor: the emulated sensors have no writable memory."""
        basic_teds(data)
        raise DaqError(
            f"{port.name}: the sensor has no writable memory. Configure a virtual TEDS (configure_teds) instead.",
            Code.TEDS_SENSOR_NOT_DETECTED,
        )

    def data(self, port: Port) -> bytes:
        """Return the TEDS at a terminal. Raises `DaqError` -200709 for a sensor without TEDS."""
        data = self._virtual.get(port.name.lower()) or self._teds_of_sensor(port)
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
