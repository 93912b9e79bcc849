"""Whether the channels of a scene tell the force on the structure, which responses are divided by."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from daq.signal_chain.channel import ChannelInfo
    from rig.scene.scene import Scene


def force_untold(scene: Scene, channels: Sequence[ChannelInfo]) -> str | None:
    """Say which channels are missing where none tells the force of the shaker; None where nothing is missing.

    Parameters
    ----------
    channels : sequence of ChannelInfo
        Its channels.

    Examples
    --------
    >>> import rig
    >>> from daq.signal_chain.bench import Bench
    >>> bench = Bench(rig.load("bare-structure"))
    >>> force_untold(bench.scene, bench.channels) is None
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
        "no channel tells the force on the structure, so that `analysis frf` will have nothing to divide by; "
        f"add {' and '.join(missing)} to the scene's channels"
    )
