"""Two processes that compute the parts of the reproduction, and leave nothing behind however the run ends.

They are joined to the parent by pipes alone: no semaphores that could leak. A worker ends when its pipe does, so
that it never outlives a parent that was killed by more than the part it is at, which is then of use to the next run.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Sequence
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from analysis.paper.store import PaperPart
from rig.errors import RunError

WORKERS = 2


def compute(parts: Sequence[PaperPart], folder: Path, done: Callable[[PaperPart], None]) -> None:
    """Compute parts and store them, longest first.

    Parameters
    ----------
    done : callable
        Called with each part as soon as it is stored.

    Raises
    ------
    ShotrigError
        What a part raised; RunError if a worker died.
    """
    waiting = sorted(parts, key=lambda part: part.effort)
    context = get_context("spawn")
    workers = []
    busy: dict[Connection, PaperPart] = {}
    previous = _on_termination(_interrupt)
    try:
        for _ in range(min(WORKERS, len(waiting))):
            own, other = context.Pipe()
            worker = context.Process(target=_work, args=(other, folder), daemon=True)
            worker.start()
            other.close()
            workers.append(worker)
            busy[own] = waiting.pop()
            own.send(busy[own])
        while busy:
            for connection in wait(list(busy)):
                assert isinstance(connection, Connection)
                part = busy.pop(connection)
                try:
                    failure = connection.recv()
                except EOFError:
                    raise RunError(f"the process that computed {part.name} has died; run it again") from None
                if failure is not None:
                    raise failure
                done(part)
                if waiting:
                    busy[connection] = waiting.pop()
                    connection.send(busy[connection])
    finally:
        for worker in workers:
            worker.kill()
        for worker in workers:
            worker.join()
        _on_termination(previous)


def _work(connection: Connection, folder: Path) -> None:
    """Compute what comes down the pipe until it ends."""
    # In a group of its own an interrupt from the keyboard does not reach it; the parent ends it.
    os.setpgid(0, 0)
    while True:
        try:
            part: PaperPart = connection.recv()
        except EOFError:
            return
        failure = None
        try:
            part.run(folder)
        except Exception as error:
            failure = error
        try:
            connection.send(failure)
        except BrokenPipeError:
            return


def _on_termination(handler: Any) -> Any:
    """Set what a request to terminate does; returns what it did before. Only the main thread may do that."""
    try:
        return signal.signal(signal.SIGTERM, handler)
    except ValueError:
        return handler


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt
