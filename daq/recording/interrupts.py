"""Ctrl-C, or the end of the process, at a moment when a file would be left half-written."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType

from rig.ending_signals import ENDINGS


@contextmanager
def held_back() -> Iterator[None]:
    """Let an interrupt that comes during the body take effect right after it."""
    came: list[tuple[int, FrameType | None]] = []
    with answered(lambda number, frame: came.append((number, frame))) as before:
        yield
    if came:
        before[came[0][0]](*came[0])


@contextmanager
def answered(
    answer: Callable[[int, FrameType | None], object],
) -> Iterator[dict[int, Callable[[int, FrameType | None], object]]]:
    """Answer interrupts in the body; give who answered them before."""
    before: dict[int, Callable[[int, FrameType | None], object]] = {}
    with ExitStack() as put_back:
        # Python delivers signals to its main thread only; and what Python did not install it cannot put back.
        if threading.current_thread() is threading.main_thread():
            for number in ENDINGS:
                earlier = signal.getsignal(number)
                if callable(earlier):
                    before[number] = earlier
                    put_back.callback(signal.signal, number, earlier)
                    signal.signal(number, answer)
        yield before
