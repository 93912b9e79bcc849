"""The signals that end a command as Ctrl-C does, so that its files are closed."""

import signal

# Ctrl-C, what a machine sends that goes down, and a terminal that is closed; not every system knows the last.
ENDINGS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

# Signals that asked this command to end, in the order in which they came.
came: list[int] = []
