"""The devices on the bench, by the names that scripts use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from daq.instrument.devices.modules import Module
from daq.instrument.devices.names import GIVEN_BY_DRIVER
from daq.instrument.errors import Code, DaqError


class DeviceList:
    """Finds devices by their names.

    `modules`: devices, including a chassis; a module without a name has all inputs and outputs.
    """

    def __init__(self, modules: Sequence[Module]) -> None:
        self._modules = {each.name.lower(): each for each in modules}

    def module(self, name: str) -> Module:
        """Return a device by its name; a typical driver name selects all inputs and outputs.

        Raises `DaqError` with -200220, if there is no device of that name.
        """
        bare = name.strip().lstrip("/").partition("/")[0]
        found = self._modules.get(bare.lower())
        if found is not None:
            return found
        everything = self._modules.get("")
        if everything is not None and GIVEN_BY_DRIVER.fullmatch(bare):
            return replace(everything, name=bare)
        raise DaqError(
            f"there is no device {name!r}: the bench has {', '.join(self.names)}"
            + (", which also go by names like Dev1, cDAQ1Mod1, PXI1Slot2" if everything else ""),
            Code.INVALID_DEVICE_ID,
        )

    @property
    def names(self) -> list[str]:
        """Names of the devices on the bench."""
        return [each.name for each in self._modules.values() if each.name]

    def modules_of(self, chassis: str) -> list[str]:
        """Names of the modules in a chassis, by slot."""
        found = [each for each in self._modules.values() if each.chassis and each.chassis == chassis]
        return [each.name for each in sorted(found, key=lambda each: each.slot)]
