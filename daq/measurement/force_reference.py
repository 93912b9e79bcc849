"""Check that the channels of a scene measure the force on the structure, the reference of the FRFs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from daq.recording.scene_outline import SceneOutline

if TYPE_CHECKING:
    from daq.signal_chain.channel import ChannelInfo
    from rig.scene.scene import Scene


def missing_force_reference(scene: Scene, channels: Sequence[ChannelInfo]) -> str | None:
    """Return a text with the channels that are missing for the shaker's force; None if they are complete.

    >>> import rig
    >>> from daq.virtual_bench.bench import Bench
    >>> bench = Bench(rig.load("bare-structure"))
    >>> missing_force_reference(bench.scene, bench.channels) is None
    True
    """
    outline = SceneOutline.of(scene)
    forces = any(info.quantity == "force" for info in channels)
    places = outline.missing_force_places({info.at for info in channels}, forces)
    if not places:
        return None
    shaker = scene.driven_shaker
    assert shaker is not None
    names = ["force" if shaker.kind == "force" else place.replace(" ", "") for place in places]
    missing = " and ".join(
        f"{{name: {name}, at: {place}}}" for name, place in zip(names, places, strict=True)
    )
    return (
        "no channel measures the force on the structure, so `analysis frf` has no reference. "
        f"Add {missing} to the scene's channels."
    )
