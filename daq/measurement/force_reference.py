"""Whether the channels of a scene measure the force on the structure, the reference of its responses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from daq.signal_chain.channel import ChannelInfo
    from rig.scene.scene import Scene


def missing_force_reference(scene: Scene, channels: Sequence[ChannelInfo]) -> str | None:
    """Name the channels that are missing to measure the shaker's force; None if none is missing.

    Parameters
    ----------
    channels : sequence of ChannelInfo
        Its channels.

    Examples
    --------
    >>> import rig
    >>> from daq.signal_chain.bench import Bench
    >>> bench = Bench(rig.load("bare-structure"))
    >>> missing_force_reference(bench.scene, bench.channels) is None
    True
    """
    shaker, test = scene.driven_shaker, scene.test
    if shaker is None or (test is not None and test.kind in ("impulse", "free")):
        return None
    if any(info.quantity == "force" for info in channels):
        return None
    if shaker.kind == "force":
        missing = [f"{{name: force, at: {scene.at_driven('shaker')}}}"]
    else:
        moving = {info.at for info in channels}
        missing = [
            f"{{name: {place.replace(' ', '')}, at: {place}}}"
            for place in (scene.at_driven("table"), f"body {shaker.body}")
            if place not in moving
        ]
    if not missing:
        return None
    return (
        "no channel measures the force on the structure, so `analysis frf` has no reference; "
        f"add {' and '.join(missing)} to the scene's channels"
    )
