"""Errors that tell the user what was wrong, where, what was expected and what to do."""

from __future__ import annotations


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


class SceneWarning(UserWarning):
    """A scene that can be used, with a value in it that is hardly what was meant."""
