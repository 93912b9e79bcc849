"""A remote call, and helpers for its handlers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from daq.instrument.task import Task

if TYPE_CHECKING:
    from daq.server.served_instrument import ServedInstrument

Answer = dict[str, Any]
Handler = Callable[["Call"], Answer | None]  # None: an empty answer


@dataclass
class Call:
    """A remote call.

    `fields`: decoded fields of the request, see `daq.server.protocol.decode`; `strict`: whether a duplicate name is
    the error of the driver instead of that of the network.
    """

    instrument: ServedInstrument  # instrument of the server
    peer: str  # address of the client
    message: Any = None  # the request
    fields: dict[str, Any] = field(default_factory=dict)
    strict: bool = False
    is_active: Callable[[], bool] = lambda: True  # returns whether the client still waits for the response

    @property
    def task(self) -> Task:
        """Task of the call; with -200088, if there is no task of that name."""
        return self.instrument.sessions.find(self.fields["task"], self.peer)


def plain_value(value: Any) -> Any:
    """Return the value of a field; numpy arrays become lists."""
    return value.tolist() if isinstance(value, np.ndarray) else value


def task_action(action: Callable[[Task, dict[str, Any]], Any]) -> Handler:
    """Return the handler for an action of a task; a number that the action returns is the status."""

    def act(call: Call) -> Answer:
        status = action(call.task, call.fields)
        return {"status": status} if isinstance(status, int) else {}

    return act
