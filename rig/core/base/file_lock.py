"""Locks of open files against other processes, where the operating system and the disk support them."""

from typing import IO, Any


def lock(file: IO[Any]) -> bool:
    """Lock an open file until it is closed; return whether no other process has locked it."""
    try:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except (ImportError, OSError):
        # Some operating systems and disks do not support locks; the file is then not locked.
        pass
    return True
