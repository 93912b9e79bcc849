"""The command `daq`, also as `python -m daq`: what is imported before anything that takes long."""

from __future__ import annotations

import signal

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # Until the command line answers Ctrl-C, it ends the process without a traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def main() -> None:
    """Run the command."""
    from rig.command_line import run

    run("daq.cli")


if __name__ == "__main__":
    main()
