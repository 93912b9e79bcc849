"""The command `shotrig`, also as `python -m shotrig`: `shotrig rig explain fig9` is `rig explain fig9`."""

from __future__ import annotations

import os
import sys
from importlib import import_module

PROGRAMS = {
    "rig": "scenes, simulation and design of dampers",
    "daq": "recordings, import, and the device for NI clients",
    "analysis": "curves, modes and reports from recordings",
}


def main() -> None:
    """Run the program that the first argument names."""
    program = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if "_SHOTRIG_COMPLETE" in os.environ or program in ("--install-completion", "--show-completion"):
        _complete()
    elif program in PROGRAMS:
        sys.argv[:2] = [program]
        import_module(f"{program}.__main__").main()
    elif program == "--version":
        from importlib.metadata import version

        print(f"shotrig {version('shotrig')}")
    elif program == "--help":
        print("Usage: shotrig PROGRAM COMMAND [OPTIONS]\n\nPrograms:")
        print("\n".join(f"  {name:10}{text[0].upper()}{text[1:]}." for name, text in PROGRAMS.items()))
        print("\n`shotrig PROGRAM --help` lists its commands. Each program is also a command of its own.")
        print("`shotrig --install-completion` lets the shell complete programs, commands and options.")
    else:
        print(f"shotrig: there is no program {program!r}. Choose {', '.join(PROGRAMS)}.", file=sys.stderr)
        sys.exit(2)


def _complete() -> None:
    """Install shell completion, or answer a request of the shell: only here are all programs loaded at once."""
    import typer

    application = typer.Typer()
    for name, text in PROGRAMS.items():
        application.add_typer(import_module(f"{name}.commands.cli").app, name=name, help=text)
    application(prog_name="shotrig")


if __name__ == "__main__":
    main()
