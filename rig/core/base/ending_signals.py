"""Signals that end a command, such as Ctrl-C: open files are closed, and a file being written is completed."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType

Handler = Callable[[int, FrameType | None], object]

# Ctrl-C, system shutdown, and a closed terminal; the last does not exist on every system.
TERMINATION_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

# Numbers of the termination signals that this command has received, in order.
received_signals: list[int] = []


@contextmanager
def delayed_interrupt() -> Iterator[None]:
    """Delay an interrupt that arrives inside the `with` block until the end of the block."""
    received: list[tuple[int, FrameType | None]] = []
    with handle_interrupts(lambda number, frame: received.append((number, frame))) as previous:
        yield
    if received:
        number, frame = received[0]
        previous[number](number, frame)


@contextmanager
def handle_interrupts(handler: Handler) -> Iterator[dict[int, Handler]]:
    """Call `handler` for interrupts in the `with` block; provide the previous handlers by signal number."""
    previous: dict[int, Handler] = {}
    with ExitStack() as cleanup:
        # Python delivers signals to its main thread only, and cannot restore handlers that it did not install.
        if threading.current_thread() is threading.main_thread():
            for number in TERMINATION_SIGNALS:
                previous_handler = signal.getsignal(number)
                if callable(previous_handler):
                    previous[number] = previous_handler
                    cleanup.callback(signal.signal, number, previous_handler)
                    signal.signal(number, handler)
        yield previous


@contextmanager
def interrupt_flag() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether Ctrl-C was received; a second Ctrl-C interrupts as usual."""
    # A block of samples is completed after the first Ctrl-C.
    interrupted = threading.Event()

    def set_flag(number: int, frame: FrameType | None) -> None:
        interrupted.set()
        received_signals.append(number)
        for other, previous_handler in previous.items():
            signal.signal(other, previous_handler)

    with handle_interrupts(set_flag) as previous:
        yield interrupted.is_set
