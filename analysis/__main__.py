"""The command `analysis`, also as `python -m analysis`: what is imported before anything that takes long."""

from __future__ import annotations

import os
import signal

# For matrices as narrow as these, a linear algebra library's threads wait for each other longer than they compute.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # Until the command line answers Ctrl-C, it ends the process without a traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def main() -> None:
    """Run the command."""
    from rig.command_line import run

    run("analysis.cli")


if __name__ == "__main__":
    main()
