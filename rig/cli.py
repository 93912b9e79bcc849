"""The `rig` command line."""

from __future__ import annotations

from rig.command import application, run

app = application("The physics of the virtual vibration rig.")


def main() -> None:
    """Run the `rig` command."""
    run(app)
