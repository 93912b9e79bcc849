"""The command `rig`, also as `python -m rig`."""

from __future__ import annotations


def main() -> None:
    """Run the command."""
    from rig.command_line import run

    run("rig.cli")


if __name__ == "__main__":
    main()
