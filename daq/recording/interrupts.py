"""Ctrl-C, or a signal that ends the process, while a file is being written."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType

from rig.ending_signals import ENDINGS


@contextmanager
def delayed_interrupt() -> Iterator[None]:
    """Delay an interrupt during the body until the body has ended."""
    received: list[tuple[int, FrameType | None]] = []
    with answered(lambda number, frame: received.append((number, frame))) as before:
        yield
    if received:
        before[received[0][0]](*received[0])


@contextmanager
def answered(
    answer: Callable[[int, FrameType | None], object],
) -> Iterator[dict[int, Callable[[int, FrameType | None], object]]]:
    """Handle interrupts in the body; give the handlers before."""
    before: dict[int, Callable[[int, FrameType | None], object]] = {}
    with ExitStack() as restored:
        # Python delivers signals to its main thread only, and cannot restore handlers that it did not install.
        if threading.current_thread() is threading.main_thread():
            for number in ENDINGS:
                earlier = signal.getsignal(number)
                if callable(earlier):
                    before[number] = earlier
                    restored.callback(signal.signal, number, earlier)
                    signal.signal(number, answer)
        yield before
