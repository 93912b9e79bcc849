"""Errors of the instrument, with the codes that NI publishes for its driver: clients check these codes."""

from __future__ import annotations

from nidaqmx.error_codes import DAQmxErrors, DAQmxWarnings

from daq.instrument.driver_texts import DRIVER_TEXTS
from rig.errors import ShotrigError

Code = DAQmxErrors
STOPPED_BEFORE_DONE = int(DAQmxWarnings.STOPPED_BEFORE_DONE)


def meaning(code: int) -> str:
    """Return the driver's text of a code, or its name where that text is not known; empty for an unknown code.

    >>> meaning(-200220), meaning(-200709), meaning(-12345)
    ('Device identifier is invalid.', 'Teds sensor not detected.', '')
    """
    if code in DRIVER_TEXTS:
        return DRIVER_TEXTS[code]
    return f"{Code(code).name.replace('_', ' ').capitalize()}." if code in list(Code) else ""


class DaqError(ShotrigError):
    """An error in a call of the instrument.

    `message`: cause and remedy; `code`: the driver's code of the error; `done`: samples per channel that were read
    or written before the error.

    >>> error = DaqError("no such device", Code.INVALID_DEVICE_ID)
    >>> int(error.code), str(error)
    (-200220, 'no such device')
    """

    def __init__(self, message: str, code: int, done: int | None = None) -> None:
        super().__init__(message)
        self.code = int(code)
        self.done = done


def bad(message: str) -> DaqError:
    """Return the error for an invalid value (-200077)."""
    return DaqError(message, Code.INVALID_ATTRIBUTE_VALUE)


def unsupported(what: str, instead: str = "") -> DaqError:
    """Return the error for a function that this instrument does not support (-200452)."""
    hint = f" {instead}" if instead else ""
    return DaqError(
        f"{what} is not supported by the rig's instrument.{hint}",
        Code.ATTRIBUTE_NOT_SUPPORTED_IN_TASK_CONTEXT,
    )
