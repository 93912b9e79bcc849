"""The command `shotrig`, also as `python -m shotrig`: `shotrig rig explain fig9` is `rig explain fig9`."""

from __future__ import annotations

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
    if program in PROGRAMS:
        sys.argv[:2] = [program]
        import_module(f"{program}.__main__").main()
    elif program == "--version":
        from rig.core.base.unexpected import version

        print(f"shotrig {version()}")
    elif program == "--help":
        print("Usage: shotrig PROGRAM COMMAND [OPTIONS]\n\nPrograms:")
        print("\n".join(f"  {name:10}{text[0].upper()}{text[1:]}." for name, text in PROGRAMS.items()))
        print("\n`shotrig PROGRAM --help` lists its commands. Each program is also a command of its own.")
    else:
        print(f"shotrig: there is no program {program!r}. Choose {', '.join(PROGRAMS)}.", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
