"""Events of a task that clients register for: samples acquired or generated, done, signal."""

from collections.abc import Callable
from typing import Any

from daq.extras.ni_device.errors import Code, DaqError
from daq.extras.ni_device.values import EverySamples, Signal, enum_member

# Function called with the value of an event: samples since the last event, status at the end, or signal number.
Listener = Callable[[int], None]

_ALREADY_REGISTERED = {
    EverySamples.ACQUIRED: Code.EVERY_N_SAMPS_ACQ_INTO_BUFFER_EVENT_ALREADY_REGISTERED,
    EverySamples.TRANSFERRED: Code.EVERY_N_SAMPS_TRANSFERRED_FROM_BUFFER_EVENT_ALREADY_REGISTERED,
}
_NOT_SUPPORTED = {
    EverySamples.ACQUIRED: Code.EVERY_N_SAMPLES_ACQ_INTO_BUFFER_EVENT_NOT_SUPPORTED_BY_DEVICE,
    EverySamples.TRANSFERRED: Code.EVERY_N_SAMPS_TRANSFERRED_FROM_BUFFER_EVENT_NOT_SUPPORTED_BY_DEVICE,
}
# Signals that occur with every sample; the other signals occur once in a run.
_SIGNALS_OF_EACH_SAMPLE = (Signal.SAMPLE_COMPLETE, Signal.SAMPLE_CLOCK)


def _already_registered(event: str, code: Code) -> DaqError:
    return DaqError(f"{event} is already registered. Unregister it first: register None.", code)


class Events:
    """The listeners of a task; they are called with the chassis locked and must return immediately."""

    def __init__(self) -> None:
        # Type of the event, number of samples between two events, listener.
        self._every_n_samples: tuple[EverySamples, int, Listener] | None = None
        self._done: Listener | None = None
        self._signals: dict[Signal, Listener] = {}
        self._end_listeners: list[Callable[[None], None]] = []
        self.n_sent = 0  # calls of listeners
        self.begin()

    @property
    def are_registered(self) -> bool:
        """Whether the task has a listener to its samples, its end or its signals."""
        return bool(self._every_n_samples or self._done or self._signals)

    @property
    def interval(self) -> int:
        """Number of samples between two events of every N samples; 0 without a listener."""
        return 0 if self._every_n_samples is None else self._every_n_samples[1]

    def listen_every(
        self, event_type: int, n_samples: int, listener: Listener | None, has_outputs: bool = False
    ) -> None:
        """Register a listener that is called after every `n_samples` samples acquired or generated; None removes it.

        `has_outputs`: whether the task has outputs. Raises `DaqError` -200966 or -200967 if a listener is registered,
        -200980 for acquired samples of an output task, -200981 for generated samples of an input task, -200880 for
        fewer than one sample.
        """
        event = enum_member(EverySamples, event_type, "every_n_samples_event_type")
        if listener is None:
            self._every_n_samples = None
            return
        if event != (EverySamples.TRANSFERRED if has_outputs else EverySamples.ACQUIRED):
            raise DaqError(
                f"the task has {'outputs' if has_outputs else 'inputs'}: no event for {event.name.lower()} samples can "
                f"occur. Register an event for {'transferred' if has_outputs else 'acquired'} samples.",
                _NOT_SUPPORTED[event],
            )
        if self._every_n_samples is not None:
            raise _already_registered("an every-N-samples event", _ALREADY_REGISTERED[event])
        if n_samples < 1:
            raise DaqError(
                f"an event every {n_samples} samples is impossible. Give at least 1.",
                Code.EVERY_N_SAMPS_EVENT_INTERVAL_ZERO_NOT_SUPPORTED,
            )
        self._every_n_samples = event, n_samples, listener

    def listen_done(self, listener: Listener | None) -> None:
        """Register a listener that is called with the status when the task ends; None removes it."""
        if listener is None:
            self._done = None
            return
        if self._done is not None:
            raise _already_registered("a done event", Code.DONE_EVENT_ALREADY_REGISTERED)
        self._done = listener

    def listen_signal(self, signal: int, listener: Listener | None) -> None:
        """Register a listener that is called whenever a signal occurs; None removes it."""
        event = enum_member(Signal, signal, "signal_id")
        if listener is None:
            self._signals.pop(event, None)
            return
        if event in self._signals:
            raise _already_registered(f"an event for {event.name}", Code.SIGNAL_EVENT_ALREADY_REGISTERED)
        self._signals[event] = listener

    def remove_listener(self, listener: Callable[[Any], None]) -> None:
        """Remove a listener from all events."""
        if self._every_n_samples is not None and self._every_n_samples[2] == listener:
            self._every_n_samples = None
        if self._done == listener:
            self._done = None
        self._signals = {signal: other for signal, other in self._signals.items() if other != listener}
        self._end_listeners = [other for other in self._end_listeners if other != listener]

    def at_end(self, listener: Callable[[None], None]) -> None:
        """Register a listener that is called, with None, when the task is closed."""
        self._end_listeners.append(listener)

    def close(self) -> None:
        """Notify the listeners that the task has been closed."""
        for listener in self._end_listeners:
            listener(None)

    def begin(self) -> None:
        """Reset the counts of sent events at the start of a run."""
        self._n_every = 0  # every-N-samples events
        self._n_signaled = 0  # samples whose signals have been sent
        self._was_done_sent = False
        self._triggered: set[Signal] = set()  # triggers whose signals have been sent

    def next_due(self, n_samples: int) -> int | None:
        """Return the total number of samples at which the next event is due; None without a listener."""
        return (n_samples // self.interval + 1) * self.interval if self.interval else None

    def notify(self, n_samples: int, run: Any) -> bool:
        """Send all due events after `n_samples` per channel; return whether a callback of every N samples may read."""
        was_sent = False
        if self._every_n_samples is not None:
            _, interval, listener = self._every_n_samples
            while self._n_every < n_samples // interval:
                self._n_every += 1
                self._send(listener, interval)
                was_sent = True
        for signal in _SIGNALS_OF_EACH_SAMPLE:
            if signal in self._signals:
                for _ in range(n_samples - self._n_signaled):
                    self._send(self._signals[signal], int(signal))
        self._n_signaled = n_samples
        if run is None:
            return was_sent
        has_triggered = getattr(run, "trigger_sample", None) is not None
        occurred = {Signal.START_TRIGGER: run.has_started, Signal.REFERENCE_TRIGGER: has_triggered}
        for signal, has_occurred in occurred.items():
            if has_occurred and signal in self._signals and signal not in self._triggered:
                self._triggered.add(signal)
                self._send(self._signals[signal], int(signal))
        if self._done is not None and not self._was_done_sent and run.done:
            self._was_done_sent = True
            self._send(self._done, 0 if run.error is None else run.error.code)
        return was_sent

    def _send(self, listener: Listener, value: int) -> None:
        self.n_sent += 1
        listener(value)
