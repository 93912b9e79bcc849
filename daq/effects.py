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
from daq.signal_chain.converter import volt_effect
from daq.signal_chain.oversampling import oversampling
from daq.virtual_bench.bench import Bench
from rig.arrays import Array
from rig.effects.effect_cost import EffectStep, bench_drive
from rig.effects.explanation import Effect, motion_effects
from rig.scene.measurement_chain import Channel, Converter
from rig.scene.presets import complete_from_preset
from rig.scene.scene import Scene
from rig.system.assembly import assemble


def measurement_effects(scene: Scene) -> Iterable[Effect]:
    """List the effects of each channel, from the chain itself, and those of the recording."""
    # Before the chain is there: matrices of thousands of bodies take the memory of both.
    intervals = oversampling(scene)
    system = assemble(scene)
    chain = Chain(scene, scene.converter.true_rate, system.points, system.inputs)
    for channel in chain.channels:
        part = f"channel {channel.name} ({channel.quantity} at {scene.structure.label(channel.at)})"
        for name, states in chain.effects[channel.name].items():
            yield Effect(part, name, states)
        yield Effect(part, "sample clock", 0, f"{scene.converter.sample_rate:.6g} Hz")
    for number in range(1, len(scene.shakers) + 1):
        yield Effect("outputs", f"ao{number - 1}", 0, volt_effect(scene, number))
    if intervals > 1:
        yield Effect("converter", "oversampling", 0, f"{intervals} intervals a sample, for fast parts")
    recording = scene.recording
    yield Effect("recording", "samples", 0, stored_as(scene, chain.channels))
    if recording.display:
        yield Effect("recording", "display", 0, "channels thinned out for plots")
    if recording.truth:
        yield Effect("recording", "truth", 0, "the true motion in addition to the channels")


# Keys of a device that are switched on together, in the order of the signal.
_STEPS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    (
        "sensor",
        "sensitivity",
        ("sensitivity", "sensitivity_tolerance", "temperature_drift", "temperature_change"),
    ),
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
    ("converter", "quantisation", ("bits", "range")),
)


def measurement_steps(scene: Scene) -> Iterator[EffectStep]:
    """Give the steps of the chain and of the recording, on top of the whole motion."""
    on: dict[str, set[str]] = {"sensor": set(), "integrator": set(), "converter": {"rate"}}
    before = _with(scene, on)
    yield _step("channels, ideal", before)
    for device, name, keys in _STEPS:
        on[device].update(keys)
        after = _with(scene, on)
        if after != before:
            yield _step(name, after)
        before = after
    plain = scene.recording.replace(display=False, truth=False)
    yield _step("recording", scene.replace(recording=plain), True)
    if scene.recording.display:
        yield _step("display", scene.replace(recording=plain.replace(display=True)), True)
    if scene.recording.truth:
        yield _step("truth", scene, True)


def _with(scene: Scene, on: dict[str, set[str]]) -> Scene:
    """Reduce channels and converter to the keys that are on."""
    converter = complete_from_preset(scene.converter)
    kept = {key: getattr(converter, key) for key in on["converter"]}
    if kept.get("bits") is None and scene.recording.samples == "counts":
        scene = scene.replace(recording=scene.recording.replace(samples=None))
    channels = None if scene.channels is None else tuple(_channel(channel, on) for channel in scene.channels)
    return scene.replace(channels=channels, converter=Converter(**kept))


def _channel(channel: Channel, on: dict[str, set[str]]) -> Channel:
    # Limits are in the unit that the channel reads with everything on.
    changes: dict[str, Any] = {"alarm": None, "abort": None}
    for name in ("accelerometer", "hammer"):
        device = getattr(channel, name)
        if device is not None:
            sheet = complete_from_preset(device)
            given = {key: value for key in on["sensor"] if (value := getattr(sheet, key, None)) is not None}
            changes[name] = type(device)(**given)
    if channel.integrator is not None:
        off = {name: None for name in ("noise", "saturation") if name not in on["integrator"]}
        changes["integrator"] = channel.integrator.replace(**off) if on["integrator"] else None
    return channel.replace(**changes)


def _step(name: str, scene: Scene, recorded: bool = False) -> EffectStep:
    bench = Bench(scene)
    states = sum(effect.states for effect in motion_effects(scene))
    states += sum(effect.states for effect in measurement_effects(scene))

    def start() -> AbstractContextManager[Callable[[Array], object]]:
        return _recorded(scene) if recorded else nullcontext(Bench(scene).acquire)

    return EffectStep(name, states, start, bench_drive(scene, bench.rate), bench.rate)


@contextmanager
def _recorded(scene: Scene) -> Iterator[Callable[[Array], object]]:
    """Acquire and write into a temporary file."""
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
