"""Reads transducer electronic data sheets (TEDS, IEEE 1451.4): from the sensors, or from files as virtual TEDS."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from daq.instrument.devices.names import Port
from daq.instrument.errors import Code, DaqError
from rig.input_files import read_file

# Fields of the basic TEDS in their order, with their bits, lowest bit first.
_BASIC = (
    ("teds_mfg_id", 14),
    ("teds_model_num", 15),
    ("teds_version_letter", 5),
    ("teds_version_num", 6),
    ("teds_serial_num", 24),
)
_MIN_BYTES = 8
# First bit of a template's data: after the 64 bits of the basic TEDS, 2 bits of selector and 8 bits of template number.
_TEMPLATE_DATA_BIT = 74
# By template: position of the 16-bit sensitivity in its data, and the logarithmic coding, smallest sensitivity (V per
# unit) and ratio of a step. 25: accelerometer (m/s^2) or force transducer (N), 27: microphone (Pa).
_SENSITIVITY = {25: (2, 5e-7, 1.0003), 27: (1, 1e-5, 1.0002)}
# Header of a virtual data sheet file; one byte per bit.
_FILE_HEADER_BYTES = 40


def basic_teds(data: bytes) -> dict[str, Any]:
    """Return the values of the basic TEDS of a data sheet, and the number of the template, by NI's names.

    `data` is the memory of the sensor without the checksum bytes, which TEDS readers remove. Raises `DaqError` -200826
    if it is not a data sheet.

    >>> values = basic_teds(bytes([17, 64, 0, 32, 4, 57, 48, 0, 120]))
    >>> values["teds_mfg_id"], values["teds_version_letter"], values["teds_serial_num"], values["teds_template_i_ds"]
    (17, 'A', 12345, [30])
    """
    if len(data) < _MIN_BYTES:
        raise DaqError(
            f"an electronic data sheet has at least {_MIN_BYTES} bytes, this has {len(data)}. Give a complete sheet.",
            Code.TEDS_SENSOR_DATA_ERROR,
        )
    bits = int.from_bytes(data, "little")
    values: dict[str, Any] = {"teds_bit_stream": data}
    for name, width in _BASIC:
        values[name], bits = bits & ((1 << width) - 1), bits >> width
    values["teds_version_letter"] = chr(ord("A") + values["teds_version_letter"] - 1)
    # Two bits select what follows (0: a template of IEEE 1451.4), eight bits are the number of the template.
    selector_code, template = bits & 3, (bits >> 2) & 0xFF
    values["teds_template_i_ds"] = [template] if selector_code == 0 and template else []
    return values


def sensitivity(data: bytes) -> float | None:
    """Return the sensitivity in a data sheet, V per unit; None for a template without sensitivity.

    >>> sheet = with_sensitivity(bytes([17, 64, 0, 32, 4, 57, 48, 0]), 25, 0.0102)
    >>> f"{sensitivity(sheet):.5f}"
    '0.01020'
    """
    bits = int.from_bytes(data, "little")
    if (bits >> 64) & 3 or (bits >> 66) & 0xFF not in _SENSITIVITY:
        return None
    offset, smallest, ratio = _SENSITIVITY[(bits >> 66) & 0xFF]
    return smallest * ratio ** float((bits >> (_TEMPLATE_DATA_BIT + offset)) & 0xFFFF)


def with_sensitivity(basic: bytes, template: int, volts: float) -> bytes:
    """Return a data sheet: a basic TEDS with a template that contains the sensitivity `volts`, V per unit."""
    bits = int.from_bytes(basic, "little") | template << 66
    if template in _SENSITIVITY:
        offset, smallest, ratio = _SENSITIVITY[template]
        bits |= round(math.log(volts / smallest, ratio)) << (_TEMPLATE_DATA_BIT + offset)
    return bits.to_bytes(12, "little")


class TedsMemory:
    """The data sheets of the sensors, and the virtual data sheets (files) that replace them.

    `sensor_sheet` returns the data sheet of the sensor at a terminal, None without a data sheet.
    """

    def __init__(self, sensor_sheet: Callable[[Port], bytes | None]) -> None:
        self._sensor_sheet = sensor_sheet
        self._virtual: dict[str, bytes] = {}

    def configure(self, port: Port, path: str) -> None:
        """Replace a sensor's data sheet by a file; without a file, read the data sheet of the sensor."""
        if not path:
            self._virtual.pop(port.name.lower(), None)
            self.sheet(port)
            return
        try:
            data = read_file(Path(path))
        except OSError as error:
            raise DaqError(
                f"{path}: {error.strerror}. Give the file of a data sheet.", Code.VIRTUAL_TEDS_FILE_NOT_FOUND
            ) from None
        if not set(data) - {0, 1}:
            # A virtual data sheet: a header and one byte per bit.
            bits = data[_FILE_HEADER_BYTES:]
            value = sum(bit << place for place, bit in enumerate(bits))
            data = value.to_bytes(-(-len(bits) // 8), "little")
        basic_teds(data)
        self._virtual[port.name.lower()] = data

    def clear(self, port: Port) -> None:
        """Remove the file that replaces a sensor's data sheet."""
        self._virtual.pop(port.name.lower(), None)

    def write(self, port: Port, data: bytes) -> None:
        """Reject a write into a sensor: the emulated sensors have no writable memory."""
        basic_teds(data)
        raise DaqError(
            f"{port.name}: the sensor has no writable memory. Configure a virtual data sheet instead.",
            Code.TEDS_SENSOR_NOT_DETECTED,
        )

    def sheet(self, port: Port) -> bytes:
        """Return the data sheet at a terminal; `DaqError` -200709 if there is no data sheet."""
        data = self._virtual.get(port.name.lower()) or self._sensor_sheet(port)
        if data is None:
            raise DaqError(
                f"{port.name}: the sensor has no electronic data sheet. Set its sensitivity in the channel.",
                Code.TEDS_SENSOR_NOT_DETECTED,
            )
        return data

    def read(self, port: Port, name: str) -> Any:
        """Return a property of the data sheet at a terminal; `DaqError` -200709 if the property is missing."""
        values = basic_teds(self.sheet(port))
        if name not in values:
            raise DaqError(f"{port.name}: the electronic data sheet has no {name}", Code.TEDS_SENSOR_NOT_DETECTED)
        return values[name]
