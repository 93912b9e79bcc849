"""The function `daq.replay`: shows a recording in the viewer, writes a file for the viewer, or draws a picture."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from daq.core.recording.recording import Recording
from daq.extras.viewer import outputs
from daq.extras.viewer.replay import Replay
from rig.core.base.errors import SceneError
from rig.core.base.input_files import as_path
from rig.core.base.output_files import allow_overwriting
from rig.core.base.progress import FractionProgress


def replay(
    recording: Recording | str | Path,
    *,
    save: str | Path | None = None,
    screenshot: str | Path | None = None,
    web: bool = False,
    at: float | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    speed: float = 1.0,
    overwrite: bool = False,
    announce: Callable[[str], None] = print,
    progress: FractionProgress | None = None,
) -> Path | None:
    """Show a recording in the viewer, write a file for the viewer, or draw a picture.

    Parameters
    ----------
    recording : Recording, str or Path
        An open recording, or a file.
    save : str or Path, optional
        Write a file for the viewer (.rrd) instead of opening a window.
    screenshot : str or Path, optional
        Draw a picture (.png) instead of opening a window; needs Vulkan drivers, no display.
    web : bool
        Show the viewer in a browser on this machine, until interrupted.
    at : float, optional
        Time of the picture in seconds from the first sample. Default: time of the largest damper gap or displacement.
    from_s : float, optional
        Start of the part to use, in seconds from the first sample.
    to_s : float, optional
        End of the part to use, in seconds from the first sample.
    speed : float
        Playback speed; 1 is real time, 0.1 is ten times slower.
    overwrite : bool
        Whether an existing file may be replaced.
    announce : callable
        Called with a line for the user: the written file, or the address for the browser.
    progress : callable, optional
        ``progress(fraction, message)``.

    Returns
    -------
    Path or None
        The file that was written; None after a window was closed.

    Raises
    ------
    SceneError
        If the selected part contains no sample, or options contradict each other.
    RunError
        If there is no display, the viewer does not start, or the file cannot be written.
    """
    if sum([save is not None, screenshot is not None, web]) > 1:
        raise SceneError("`save`, `screenshot` and `web` cannot be combined: choose one of them.")
    if at is not None and screenshot is None:
        raise SceneError("`at` requires `screenshot`. Give `screenshot` as well, or omit `at`.")
    if speed != 1.0 and screenshot is not None:
        raise SceneError("`speed` cannot be combined with `screenshot`. Omit one of them.")
    if not isinstance(recording, Recording):
        with Recording(recording) as opened:
            return replay(
                opened, save=save, screenshot=screenshot, web=web, at=at, from_s=from_s, to_s=to_s, speed=speed,
                overwrite=overwrite, announce=announce, progress=progress,
            )  # fmt: skip
    segment = Replay(recording, from_s, to_s, speed)
    with allow_overwriting(overwrite):
        if save is not None:
            target = as_path(save, "save")
            outputs.save(segment, target, progress)
            announce(f"{target}: {target.stat().st_size / 1e6:.1f} MB; to look at it: rerun {target}")
            return target
        if screenshot is not None:
            target = as_path(screenshot, "screenshot")
            drawn_at_s = outputs.draw_picture(segment, target, at, progress)
            announce(f"{target}: the rig at {drawn_at_s:.3f} s")
            return target
    if web:
        with suppress(KeyboardInterrupt):
            outputs.show(segment, outputs.server(announce), progress)
    else:
        outputs.show(segment, outputs.window(outputs.NO_DISPLAY_REMEDY), progress)
    return None
