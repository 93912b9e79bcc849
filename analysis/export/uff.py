"""Channels as a Universal File Format file, data set 58, which modal analysis programs read."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from analysis.recordings.slices import Slice
from daq.signal_chain.channel import ChannelInfo
from rig.errors import RunError, SceneError

# A data set 58 in text takes 20 bytes a sample, and its writer holds a channel in memory as text.
MOST_TEXT_SAMPLES = 1 << 24
# Kinds of data in the format's own numbering.
KINDS = {"displacement": 8, "velocity": 11, "acceleration": 12, "force": 13, "voltage": 1}


def write_uff(stretch: Slice, path: Path) -> None:
    """Write a UFF file in text, with a data set 58 (time response) for each channel.

    Node n is body n, direction +Z is up; table and hammer are node 0. The format rounds the sample
    interval to six digits; the exact rate stands in the fourth line of each set.

    Raises
    ------
    RecordingError
        If samples were lost.
    SceneError
        If there are too many samples for a text, or too few for the format.
    RunError
        If pyuff is not installed.
    """
    try:
        import pyuff
    except ImportError:
        raise RunError("UFF files need the package pyuff: pip install 'shotrig[export]'") from None
    stretch.need_all("UFF 58")
    count = stretch.stop - stretch.start
    if not 2 <= count <= MOST_TEXT_SAMPLES:
        raise SceneError(
            f"UFF 58 is written as text, {MOST_TEXT_SAMPLES} samples of a channel at most and 2 at least; "
            f"these are {count}: export a stretch (--from, --to), or .npz"
        )
    recording = stretch.recording
    file = pyuff.UFF(str(path))
    for number, info in enumerate(stretch.infos, start=1):
        data = recording.read(info.name, stretch.start, stretch.stop)
        file.write_sets(
            {
                "type": 58, "binary": 0, "func_type": 1, "func_id": number,
                "id1": f"{info.name}: {info.quantity} at {info.at}"[:80],
                "id2": f"from {recording.path.name}"[:80],
                "id4": f"sample rate {recording.rate!r} Hz"[:80],
                "rsp_ent_name": "NONE", "rsp_node": _node(info), "rsp_dir": 3,
                "ref_ent_name": "NONE", "ref_node": 0, "ref_dir": 0,
                "abscissa_spacing": 1, "abscissa_spec_data_type": 17,
                "abscissa_axis_lab": "Time", "abscissa_axis_units_lab": "s",
                "ordinate_spec_data_type": KINDS[info.quantity],
                "ordinate_axis_lab": info.quantity.capitalize(), "ordinate_axis_units_lab": info.unit,
                "orddenom_spec_data_type": 0, "z_axis_spec_data_type": 0,
                "data": data, "x": np.arange(stretch.start, stretch.stop) / recording.rate,
            },
            mode="add",
        )  # fmt: skip


def _node(info: ChannelInfo) -> int:
    return int(info.at.removeprefix("body ")) if info.at.startswith("body ") else 0
