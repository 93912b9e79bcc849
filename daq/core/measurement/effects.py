"""The effects of a scene in the measurement chain and the recording, for `rig.explain`."""

from collections.abc import Iterable

from daq.core.recording.sample_block import stored_as
from daq.core.signal_chain.chain import Chain
from daq.core.signal_chain.converter import describe_clock, describe_output
from daq.core.signal_chain.oversampling import choose_oversampling
from rig.core.effects.explanation import Effect
from rig.core.scene.scene import Scene
from rig.core.system.assembly import assemble


def measurement_effects(scene: Scene) -> Iterable[Effect]:
    """Yield the effects of the devices of each channel, the converter and the recording."""
    # Computed before the chain is created: with thousands of bodies, the matrices of both would exceed the memory.
    intervals = choose_oversampling(scene)
    system = assemble(scene)
    chain = Chain(scene, scene.converter.true_rate, system.points, system.inputs)
    for channel in chain.channels:
        part = f"channel {channel.name} ({channel.quantity} at {scene.structure.label(channel.at)})"
        for name, states in chain.effects[channel.name].items():
            yield Effect(part, name, states)
        yield Effect(part, "sample clock", 0, describe_clock(scene.converter))
    for number in range(1, len(scene.shakers) + 1):
        yield Effect("outputs", f"ao{number - 1}", 0, describe_output(scene, number))
    if intervals > 1:
        details = f"{intervals} simulation steps per sample, to resolve fast oscillations"
        yield Effect("converter", "oversampling", 0, details)
    recording = scene.recording
    yield Effect("recording", "samples", 0, stored_as(scene, chain.channels))
    if recording.display:
        yield Effect("recording", "display", 0, "decimated channels for plots")
    if recording.truth:
        yield Effect("recording", "truth", 0, "the true motion in addition to the channels")
