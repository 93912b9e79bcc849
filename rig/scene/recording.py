"""What a recording holds beside the channels."""

from __future__ import annotations

from typing import Literal

from rig.scene.settings import Settings


class RecordingSettings(Settings):
    """What goes into the recording besides the channels."""

    display: bool = True
    """Channels thinned out for plots that need no configuration."""
    truth: bool = False
    """The true motion, under its own topics."""
    samples: Literal["float64", "float32", "counts"] | None = None
    """How samples are stored. None: counts where the converter has bits, else float64."""
