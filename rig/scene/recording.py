"""What a recording holds beside the channels."""

from __future__ import annotations

from typing import Literal

from rig.scene.settings import Settings


class RecordingSettings(Settings):
    """What goes into the recording besides the channels.

    Attributes
    ----------
    display : bool
        Channels thinned out for plots that need no configuration.
    truth : bool
        The true motion, under its own topics.
    samples : {"float64", "float32", "counts"}, optional
        How samples are stored. None: counts where the converter has bits, else float64.
    """

    display: bool = True
    truth: bool = False
    samples: Literal["float64", "float32", "counts"] | None = None
