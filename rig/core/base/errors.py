"""Errors and warnings meant for users; their messages state where and what was wrong, and what to do."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path


class ShotrigError(Exception):
    """Base of every error meant for the user; the command lines print it without a traceback."""

    exit_code = 1


class SceneError(ShotrigError):
    """A scene, a parameter or a command-line argument that cannot be used."""

    exit_code = 2


class RecordingError(ShotrigError):
    """A recording that cannot be read, or lacks required data."""

    exit_code = 2


class RunError(ShotrigError):
    """A simulation or test that could not be completed."""

    exit_code = 1


class UncoveredMotionError(RunError):
    """A motion for which orbits are not computed; its only argument describes the reason."""

    def __str__(self) -> str:
        return f"{self.args[0]}; orbits of such motions are not computed. Use rig.frequency_response."


class SceneWarning(UserWarning):
    """A usable scene with an implausible value."""


class RunWarning(UserWarning):
    """A completed test or import with a problem that the user should know."""


@contextmanager
def add_path(path: Path | str) -> Iterator[None]:
    """Prefix errors in the `with` block with the path of a recording or a topic, unless they begin with it."""
    try:
        yield
    except RecordingError as error:
        if str(error).startswith(str(path)):
            raise
        raise RecordingError(f"{path}: {error}") from error


def unexpected_text(error: BaseException) -> str:
    """Describe an error that only the developers can correct, with its traceback."""
    from traceback import format_exception

    lines = "".join(format_exception(error)).rstrip()
    return f"unexpected error; this is a fault of shotrig. Report it with these lines:\n{lines}"


def suggestion(name: str, names: Iterable[str], otherwise: str = "", n: int = 1, cutoff: float = 0.6) -> str:
    """Return a question with the names that resemble `name`; without a similar name, return `otherwise`.

    >>> suggestion("clearence", ["mass", "clearance"]), suggestion("x", ["mass"], "Give mass.")
    ("Did you mean 'clearance'?", 'Give mass.')
    """
    from difflib import get_close_matches

    similar = dict.fromkeys(get_close_matches(name, list(names), n=n, cutoff=cutoff))
    return f"Did you mean {' or '.join(map(repr, similar))}?" if similar else otherwise
