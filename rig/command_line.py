"""What the command lines of the three packages share: an application object and its way to end."""

from __future__ import annotations

import os
import sys

import typer

from rig.errors import ShotrigError


def application(help_text: str) -> typer.Typer:
    """Make a command-line application in the style of the project."""
    return typer.Typer(
        help=help_text,
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )


def run(app: typer.Typer) -> None:
    """Run a command line; errors meant for the user end it with their message and exit code."""
    try:
        app()
    except ShotrigError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:
        # The reader of a pipe (head, less) has left; what Python would flush at exit has nowhere to go.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
