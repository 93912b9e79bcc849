"""Description of unexpected errors, for reports to the developers."""

from __future__ import annotations

import sys


def version() -> str:
    """Return the version of the installed package."""
    from importlib import metadata

    return metadata.version("shotrig")


def describe_unexpected(error: BaseException) -> str:
    """Describe an unexpected error, and save the details that are needed to find its cause."""
    import platform
    import tempfile
    import traceback

    name = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    summary = f"error: unexpected error ({name[:300]}); this is a fault of shotrig"
    try:
        # On a full disk, or without free file descriptors, the version cannot be read either.
        details = "\n".join(
            [
                f"shotrig {version()}, Python {platform.python_version()}, {platform.platform()}",
                f"command: {sys.argv}",
                "".join(traceback.format_exception(error)),
            ]
        )
        descriptor, path = tempfile.mkstemp(prefix="shotrig-error-", suffix=".txt")
        with open(descriptor, "w", encoding="utf-8", errors="backslashreplace") as file:  # noqa: PTH123
            file.write(details)
    except OSError:
        return (
            f"{summary}. Run the command again with --debug directly after the program's name (rig --debug ...), and "
            "report the output."
        )
    return f"{summary}. Report it, and attach the file {path}."
