"""Checkouts of other commits in separate folders, for comparison with this checkout."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_REPOSITORY = Path(__file__).parents[2]


@contextmanager
def temporary_checkout(commit: str, folder: Path) -> Iterator[Path]:
    """Check a commit out into a folder that does not exist yet, and remove it at the end."""
    add = ["git", "worktree", "add", "--quiet", "--detach", str(folder), commit]
    remove = ["git", "worktree", "remove", "--force", str(folder)]
    subprocess.run(add, check=True, cwd=_REPOSITORY)
    try:
        yield folder
    finally:
        subprocess.run(remove, check=False, cwd=_REPOSITORY)
