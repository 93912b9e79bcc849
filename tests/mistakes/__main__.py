"""Print all mistakes of the catalogue with the messages that they cause: `python -m tests.mistakes`."""

import contextlib
import io
import os
import shlex
import sys
import tempfile
import warnings
from importlib import import_module
from pathlib import Path

from tests.mistakes.catalogue import MISTAKES, Mistake

RECORDINGS = Path(__file__).parents[2] / "recordings"


def message_of(mistake: Mistake, folder: Path) -> tuple[int, str]:
    """Make a mistake in an empty folder; return the exit code and the printed text."""
    for name, demo in {"sweep.mcap": "demo-sweep-no-damper.mcap", "hit.mcap": "demo-impulse-no-damper.mcap"}.items():
        (folder / name).symlink_to(RECORDINGS / demo)
    for name, text in mistake.files.items():
        (folder / name).write_text(text, encoding="utf-8")
    program, *words = shlex.split(mistake.command)
    previous_folder, previous_argv, printed = Path.cwd(), sys.argv, io.StringIO()
    os.chdir(folder)
    sys.argv = [program, *words]
    code = 0
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                import_module(f"{program}.commands.cli").main()
            except SystemExit as end:
                code = end.code if isinstance(end.code, int) else int(end.code is not None)
    finally:
        sys.argv = previous_argv
        os.chdir(previous_folder)
    return code, printed.getvalue()


def main() -> int:
    """Print the catalogue; return exit code 1 if a message lacks a fact."""
    failed = 0
    for number, mistake in enumerate(MISTAKES, 1):
        with tempfile.TemporaryDirectory() as folder:
            code, text = message_of(mistake, Path(folder))
        missing = [fact for fact in mistake.facts if fact not in " ".join(text.split())]
        failed += bool(missing or not code)
        print(f"{number:2d}. {mistake.description}\n    $ {mistake.command}\n      {text.strip()}")
        if missing or not code:
            print(f"    LACKS {missing}, exit code {code}")
    print(f"{len(MISTAKES) - failed} of {len(MISTAKES)} messages contain all facts")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
