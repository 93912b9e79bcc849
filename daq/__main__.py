"""The command `daq`, also as `python -m daq`."""

from __future__ import annotations


def main() -> None:
    """Run the command."""
    from rig.command_line import run_command

    run_command("daq.cli")


if __name__ == "__main__":
    main()
