"""The effects of a scene in the measurement chain and the recording, for `rig.explain`."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

from daq.recording.recorder import Recorder
from daq.recording.sample_block import stored_as
from daq.signal_chain.chain import Chain
from daq.signal_chain.converter import describe_clock, describe_output
from daq.signal_chain.oversampling import choose_oversampling
from daq.virtual_bench.bench import Bench
from rig.arrays import Array
from rig.effects.effect_cost import EffectStep, bench_drive
from rig.effects.explanation import Effect, motion_effects
from rig.scene.measurement_chain import Channel, Converter
from rig.scene.presets import complete_from_preset
from rig.scene.scene import Scene
from rig.system.assembly import assemble


def measurement_effects(scene: Scene) -> Iterable[Effect]:
    """Yield the effects of each channel, as its chain lists them, of the converter, and of the recording."""
    # Computed before the chain exists: with thousands of bodies, the matrices of both would exceed the memory.
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


# Steps of the cost measurement: device, name, and the keys that a step activates, in the order of the signal path.
_STEPS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("sensor", "sensitivity", ("sensitivity", "sensitivity_tolerance", "temperature_drift", "temperature_change")),
    ("sensor", "sensor resonance", ("resonance", "q")),
    ("sensor", "transverse sensitivity", ("transverse", "lateral")),
    ("sensor", "sensor low cut-off", ("low_cutoff",)),
    ("sensor", "sensor saturation", ("saturation", "overload_recovery")),
    ("sensor", "sensor bias", ("bias", "bias_settling")),
    ("sensor", "sensor noise", ("noise", "noise_corner")),
    ("integrator", "integrator", ("order", "corner", "gain", "low_cutoff")),
    ("integrator", "integrator noise", ("noise",)),
    ("integrator", "integrator saturation", ("saturation",)),
    ("converter", "coupling", ("coupling", "ac_corner", "excitation")),
    ("converter", "anti-alias filter", ("filter", "remove_delay")),
    ("converter", "skew", ("skew",)),
    ("converter", "clock error", ("clock_error",)),
    ("converter", "jitter", ("jitter",)),
    ("converter", "converter noise", ("noise",)),
    ("converter", "quantization", ("bits", "range")),
)


def measurement_steps(scene: Scene) -> Iterator[EffectStep]:
    """Yield the steps that add the effects of the chain, and of the recording, to the complete motion."""
    active_keys: dict[str, set[str]] = {"sensor": set(), "integrator": set(), "converter": {"rate"}}
    previous = _reduce_scene(scene, active_keys)
    yield _step("channels, ideal", previous)
    for device, name, keys in _STEPS:
        active_keys[device].update(keys)
        next_scene = _reduce_scene(scene, active_keys)
        if next_scene != previous:
            yield _step(name, next_scene)
        previous = next_scene
    minimal = scene.recording.replace(display=False, truth=False)
    yield _step("recording", scene.replace(recording=minimal), True)
    if scene.recording.display:
        yield _step("display", scene.replace(recording=minimal.replace(display=True)), True)
    if scene.recording.truth:
        yield _step("truth", scene, True)


def _reduce_scene(scene: Scene, active_keys: dict[str, set[str]]) -> Scene:
    """Return the scene with only the active keys of channels and converter."""
    converter = complete_from_preset(scene.converter)
    settings = {key: getattr(converter, key) for key in active_keys["converter"]}
    if settings.get("bits") is None and scene.recording.samples == "counts":
        scene = scene.replace(recording=scene.recording.replace(samples=None))
    channels = (
        None if scene.channels is None else tuple(_reduce_channel(channel, active_keys) for channel in scene.channels)
    )
    return scene.replace(channels=channels, converter=Converter(**settings))


def _reduce_channel(channel: Channel, active_keys: dict[str, set[str]]) -> Channel:
    # Limits are removed, because their unit is valid only for the channel with all effects.
    changes: dict[str, Any] = {"alarm": None, "abort": None}
    for name in ("accelerometer", "hammer"):
        device = getattr(channel, name)
        if device is not None:
            completed = complete_from_preset(device)
            settings = {
                key: value for key in active_keys["sensor"] if (value := getattr(completed, key, None)) is not None
            }
            changes[name] = type(device)(**settings)
    if channel.integrator is not None:
        removed = {name: None for name in ("noise", "saturation") if name not in active_keys["integrator"]}
        changes["integrator"] = channel.integrator.replace(**removed) if active_keys["integrator"] else None
    return channel.replace(**changes)


def _step(name: str, scene: Scene, is_recorded: bool = False) -> EffectStep:
    bench = Bench(scene)
    states = sum(effect.states for effect in motion_effects(scene))
    states += sum(effect.states for effect in measurement_effects(scene))

    def start() -> AbstractContextManager[Callable[[Array], object]]:
        return _recording_bench(scene) if is_recorded else nullcontext(Bench(scene).acquire)

    return EffectStep(name, states, start, bench_drive(scene, bench.rate), bench.rate)


@contextmanager
def _recording_bench(scene: Scene) -> Iterator[Callable[[Array], object]]:
    """Yield a function that acquires a block with a drive, and writes it to a temporary recording."""
    bench = Bench(scene)
    with (
        tempfile.TemporaryDirectory() as folder,
        Recorder(Path(folder) / "effects.mcap", scene, bench.channels, bench.rate) as recorder,
    ):

        def advance(drive: Array) -> None:
            block = bench.acquire(drive)
            if scene.recording.truth:
                recorder.write_truth(block.motion)
            recorder.write(block.samples)

        yield advance
