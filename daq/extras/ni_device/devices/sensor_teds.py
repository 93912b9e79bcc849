"""Electronic data sheets (TEDS) of the sensors in a scene's channels, encoded by IEEE 1451.4.

>>> from rig.core.scene.measurement_chain import Channel
>>> channel = Channel(name="body1", at="body 1", accelerometer={"preset": "PCB 352C33"})
>>> sheet = electronic_data_sheet(channel, seed=1)
>>> sheet.model, sheet.version_letter, sheet.version, len(sheet.bits)
(352, 'C', 33, 8)
>>> electronic_data_sheet(Channel(name="body2", at="body 2"), seed=1) is None
True
"""

from dataclasses import dataclass
from zlib import crc32

from rig.core.data_sheets.data_sheets import data_sheet
from rig.core.scene.measurement_chain import Channel


@dataclass(frozen=True)
class ElectronicDataSheet:
    """Electronic data sheet (TEDS) stored in a sensor.

    >>> basic = ElectronicDataSheet(17, 1, "A", 1, 12345, template=30)
    >>> list(basic.bits)  # as in the virtual data sheet that NI tests its driver with
    [17, 64, 0, 32, 4, 57, 48, 0]
    """

    manufacturer: int  # number of the manufacturer
    model: int  # number of the model
    version_letter: str  # A to Z
    version: int
    serial: int  # number of the individual sensor
    # number of the IEEE 1451.4 template that follows the basic data sheet; 25: accelerometer or force transducer with
    # constant-current amplifier. `bits` contains the basic data sheet only.
    template: int

    @property
    def bits(self) -> bytes:
        """Basic TEDS of IEEE 1451.4, 64 bits, least significant bit first.

        Manufacturer ID (14 bits), model number (15), version letter (5), version number (6), serial number (24).
        """
        letter = ord(self.version_letter) - ord("A") + 1
        value = self.manufacturer | self.model << 14 | letter << 29 | self.version << 34 | self.serial << 40
        return value.to_bytes(8, "little")


def electronic_data_sheet(channel: Channel, seed: int) -> ElectronicDataSheet | None:
    """Return the electronic data sheet of a channel's sensor.

    `channel`: a channel of the scene; `seed`: seed of the scene; with the channel's name it determines the serial
    number. Returns None if the sensor has no preset.
    """
    sensor = channel.hammer if channel.measures_force else channel.accelerometer
    if sensor is None or sensor.preset is None:
        return None
    facts = data_sheet(sensor.preset, type(sensor).__name__.lower()).facts.get("teds")
    if facts is None:
        return None
    return ElectronicDataSheet(serial=crc32(f"{seed} {channel.name}".encode()) % 2**24, **facts)
