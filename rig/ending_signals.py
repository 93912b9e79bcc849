"""Signals that end a command like Ctrl-C, so that its files are closed; their delay while a file is being written."""

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import FrameType

Handler = Callable[[int, FrameType | None], object]

# Ctrl-C, system shutdown, and a closed terminal; the last does not exist on every system.
TERMINATION_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)

# Termination signals received by this command, in order.
received_signals: list[int] = []


@contextmanager
def delayed_interrupt() -> Iterator[None]:
    """Delay an interrupt during the body until the body has ended."""
    received: list[tuple[int, FrameType | None]] = []
    with handle_interrupts(lambda number, frame: received.append((number, frame))) as before:
        yield
    if received:
        before[received[0][0]](*received[0])


@contextmanager
def handle_interrupts(answer: Handler) -> Iterator[dict[int, Handler]]:
    """Handle interrupts in the body; give the handlers before."""
    before: dict[int, Handler] = {}
    with ExitStack() as restored:
        # Python delivers signals to its main thread only, and cannot restore handlers that it did not install.
        if threading.current_thread() is threading.main_thread():
            for number in TERMINATION_SIGNALS:
                earlier = signal.getsignal(number)
                if callable(earlier):
                    before[number] = earlier
                    restored.callback(signal.signal, number, earlier)
                    signal.signal(number, answer)
        yield before


@contextmanager
def interrupt_flag() -> Iterator[Callable[[], bool]]:
    """Convert the first Ctrl-C into a flag, so that blocks stay complete; the second Ctrl-C interrupts as usual."""
    pressed = threading.Event()

    def press(number: int, frame: FrameType | None) -> None:
        pressed.set()
        received_signals.append(number)
        for each, earlier in before.items():
            signal.signal(each, earlier)

    with handle_interrupts(press) as before:
        yield pressed.is_set
