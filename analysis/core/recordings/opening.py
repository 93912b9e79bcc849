"""Opening of recordings that functions and commands take as paths or opened."""

from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, nullcontext
from functools import wraps
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

from daq.core.recording.recording import Recording
from rig.core.base.errors import RecordingError

Parameters = ParamSpec("Parameters")
Returned = TypeVar("Returned")


def require_file(path: Path) -> None:
    """Raise `RecordingError` if an input file does not exist; the message suggests how to get it."""
    if not path.exists():
        similar_path = "recordings" / Path(path.name)
        hint = (
            f". Did you mean '{similar_path}'?"
            if similar_path.exists()
            else f". Make one: `daq record SCENE -o {path}`."
        )
        raise RecordingError(f"{path}: no such file{hint}")


def open_existing(path: Path) -> Recording:
    """Open a recording that must exist."""
    import daq

    require_file(path)
    return daq.open(path)


class OpenRecordings(ExitStack):
    """The recordings of a command: each is opened, and its scene read, once, when it is first used."""

    def __init__(self) -> None:
        super().__init__()
        self._open: dict[Path, Recording] = {}

    def of(self, path: Path) -> Recording:
        """Return the recording in a file, which stays open until this context ends."""
        if path not in self._open:
            self._open[path] = self.enter_context(open_existing(path))
        return self._open[path]


def with_recordings(
    command: Callable[Concatenate[OpenRecordings, Parameters], Returned],
) -> Callable[Parameters, Returned]:
    """Decorate a command: pass it its recordings, and close them afterwards."""

    @wraps(command)
    def run(*args: Parameters.args, **options: Parameters.kwargs) -> Returned:
        with OpenRecordings() as recordings:
            return command(recordings, *args, **options)

    return run


def as_context(recording: Recording | str | Path) -> AbstractContextManager[Recording]:
    """Return a context with a recording: a path is open inside the context; an open recording stays open."""
    return open_existing(Path(recording)) if isinstance(recording, str | Path) else nullcontext(recording)


def require_recording(recording: object, name: str) -> None:
    """Reject an argument that is neither a path nor a recording; the message begins with `name`."""
    if not isinstance(recording, str | Path) and not hasattr(recording, "channels"):
        raise RecordingError(
            f"{name}: got {recording!r:.60}; expected a recording: its path, or the object that daq.open returns"
        )


def takes_path(
    function: Callable[Concatenate[Recording, Parameters], Returned],
) -> Callable[Concatenate[Recording | str | Path, Parameters], Returned]:
    """Decorate a function of a recording so that it also takes a path; the file is open while the function runs."""

    @wraps(function)
    def with_opened(
        recording: Recording | str | Path, /, *args: Parameters.args, **kwargs: Parameters.kwargs
    ) -> Returned:
        require_recording(recording, function.__name__)
        with as_context(recording) as rec:
            return function(rec, *args, **kwargs)

    return with_opened
