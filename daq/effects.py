"""What a scene turns on in the measurement chain and the recording, for `rig.explain`."""

from __future__ import annotations

from collections.abc import Iterable

from daq.chain import Chain
from daq.converter import SampleClock
from daq.oversampling import oversampling
from rig.assembly import assemble
from rig.effects import Effect
from rig.scene import Scene


def measurement_effects(scene: Scene) -> Iterable[Effect]:
    """List the effects of each channel, from the chain itself, and those of the recording.

    Parameters
    ----------
    scene : rig.Scene
        The scene.
    """
    system = assemble(scene)
    clock = SampleClock.of(scene.converter)
    chain = Chain(scene, clock.true_rate, system.points, system.inputs)
    for channel in chain.channels:
        part = f"channel {channel.name} ({channel.quantity} at {channel.at})"
        for name, states in chain.effects[channel.name].items():
            yield Effect(part, name, states)
        yield Effect(part, "sample clock", 0, f"{clock.rate:.6g} Hz")
    intervals = oversampling(scene, clock)
    if intervals > 1:
        yield Effect("converter", "oversampling", 0, f"{intervals} intervals a sample, for what is fast")
    recording = scene.recording
    samples = recording.samples or ("float64" if scene.converter.bits is None else "counts")
    yield Effect("recording", "samples", 0, samples)
    if recording.display:
        yield Effect("recording", "display", 0, "channels thinned out for plots")
    if recording.truth:
        yield Effect("recording", "truth", 0, "the true motion beside the channels")
