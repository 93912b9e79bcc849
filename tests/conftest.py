"""Settings of all tests: property-based tests use the same cases on every machine, without a time limit."""

import functools
import gc
import signal

import typer.testing
from hypothesis import HealthCheck, settings

from rig.core.base import console

settings.register_profile(
    "project", derandomize=True, deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("project")

# No lines of progress: on a busy machine they would appear between the lines that tests check.
console.REPORT_INTERVAL_S = float("inf")

# The commands of a program are built once, not for each call: building them takes longer than many tests.
typer.testing._get_command = functools.cache(typer.main.get_command)

# A shell starts background programs with interrupts ignored, and child processes inherit this setting: then
# programs that a test interrupts would not end.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
# The same is true for nohup and the hang-up signal.
if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


# No garbage collection while pytest collects the tests: imports create almost no garbage, and garbage collection would
# take a fifth of the time.
gc.disable()


def pytest_collection_finish() -> None:
    """Exclude all imported modules from garbage collection, which would scan them again in every test.

    Modules that tests import are scanned seldom.
    """
    gc.enable()
    gc.collect()
    gc.freeze()
    gc.set_threshold(2000, 20, 100)
