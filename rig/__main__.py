"""The command `rig`, also as `python -m rig`."""

from __future__ import annotations


def main() -> None:
    """Run the command."""
    from rig.command_line import run_command

    run_command("rig.cli")


if __name__ == "__main__":
    main()
