"""A remote call, and what its answers are made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.instrument.task import Task

if TYPE_CHECKING:
    from daq.server.served_instrument import ServedInstrument

Answer = dict[str, Any]


@dataclass
class Call:
    """A remote call.

    Attributes
    ----------
    instrument : ServedInstrument
        What it acts on.
    peer : str
        Who calls.
    message : Message
        The request.
    fields : dict
        What it holds, see `daq.server.protocol.decode`.
    strict : bool
        Whether a duplicate name is reported as the driver does, not as the network does.
    is_active : callable
        Whether the client still waits for the answer.
    """

    instrument: ServedInstrument
    peer: str
    message: Any = None
    fields: dict[str, Any] = field(default_factory=dict)
    strict: bool = False
    is_active: Callable[[], bool] = lambda: True

    @property
    def task(self) -> Task:
        """The task it is about; with -200088, if there is none of that name."""
        return self.instrument.sessions.find(self.fields["task"], self.peer)


def plain(value: Any) -> Any:
    """Give a field's value, lists of numbers as such."""
    return value.tolist() if isinstance(value, np.ndarray) else value


def does(action: Callable[[Task, dict[str, Any]], Any]) -> Callable[[Call], Answer]:
    """Make a call of something that a task does; a number it gives back is the status."""

    def act(call: Call) -> Answer:
        status = action(call.task, call.fields)
        return {"status": status} if isinstance(status, int) else {}

    return act
