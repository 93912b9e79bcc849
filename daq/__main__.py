"""The command `daq`, also as `python -m daq`."""

import os
import sys

# The script of `daq run` inherits the environment, so it is not changed.
if "run" not in sys.argv:
    # The matrices are so small that the threads of OpenBLAS would wait for each other longer than they compute.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # No plugin of pydantic is used; looking for plugins reads the metadata of all installed packages.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "1")


def main() -> None:
    """Run the command."""
    from rig.commands.command_line import run_command

    run_command("daq.commands.cli")


if __name__ == "__main__":
    main()
