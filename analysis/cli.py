"""The `analysis` command line."""

from __future__ import annotations

from rig.command import application, run

app = application("From recordings to curves, modes and reports.")


def main() -> None:
    """Run the `analysis` command."""
    run(app)
