"""The processes that compute pieces of a study for this process."""

import psutil


def worker_processes() -> list[psutil.Process]:
    """Return the running worker processes."""
    return [child for child in psutil.Process().children() if "popen_loky" in " ".join(child.cmdline())]
