"""The `daq` command line."""

from __future__ import annotations

from rig.command import application, run

app = application("The instrument: record, look at, repair and replay tests.")


def main() -> None:
    """Run the `daq` command."""
    run(app)
