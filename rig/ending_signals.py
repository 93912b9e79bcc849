"""Signals that end a command like Ctrl-C, so that its files are closed."""

import signal

# Ctrl-C, system shutdown, and a closed terminal; the last does not exist on every system.
ENDINGS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

# Termination signals received by this command, in order.
came: list[int] = []
