"""What all tests share: property-based tests try the same cases on every machine, however slow it is."""

from __future__ import annotations

import signal

from hypothesis import HealthCheck, settings

from rig import console

settings.register_profile(
    "project",
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("project")

# A busy machine would have commands say that they are still at work, between the lines that tests look at.
console.MAX_SILENCE_S = float("inf")

# A shell starts what it runs in the background with interrupts ignored, and programs that tests start inherit it:
# those that are to be interrupted would go on for ever.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
# And so does nohup with the end of a terminal.
if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
