"""Errors that state what was wrong, where, what was expected and what to do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class ShotrigError(Exception):
    """Base of every error meant for the user; the command lines print it without a traceback."""

    exit_code = 1


class SceneError(ShotrigError):
    """A scene, a parameter or a command-line argument that cannot be used."""

    exit_code = 2


class RecordingError(ShotrigError):
    """A recording that cannot be read, or lacks what was asked of it."""

    exit_code = 2


class RunError(ShotrigError):
    """A simulation or a test that could not be carried through."""

    exit_code = 1


class UncoveredMotionError(RunError):
    """A motion for which orbits are not computed; its only argument says what happens in it."""

    def __str__(self) -> str:
        instead = "a settled simulation (rig.frequency_response) covers it"
        return f"{self.args[0]}, for which orbits are not computed; {instead}"


class SceneWarning(UserWarning):
    """A scene that can be used, with a value in it that is hardly what was meant."""


class RunWarning(UserWarning):
    """A test or an import that went on, with something in it that its user should know."""


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Name a recording in errors of the body that do not: those of its bytes do, those of its messages do not."""
    try:
        yield
    except RecordingError as error:
        if str(error).startswith(str(path)):
            raise
        raise RecordingError(f"{path}: {error}") from error
