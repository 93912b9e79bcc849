"""Check before a random test with profile control: spacing of the lines, and limits that end next to a resonance."""

from collections.abc import Iterable
from math import ceil, pi

import numpy as np

from daq.core.signal_chain.channel import ChannelInfo
from rig.core.scene.excitation.profile_control import ProfileControl
from rig.core.scene.scene import Scene
from rig.core.system.open_loop_drive import accelerations_per_drive

# Largest change of the drive density from line to line [dB]: the largest slope at a resonance, 20 / ln(10) dB over half
# of its half-power width, if the width contains two lines.
_MAX_STEP_DB = 8.69 / 2.0
# Number of frequencies per line, so the peak between two lines is resolved.
_OVERSAMPLING = 8
# Largest reduction of the drive density by a limit at its end [dB].
_MAX_END_DB = 3.0


def line_warnings(test: ProfileControl, scene: Scene, channels: Iterable[ChannelInfo]) -> Iterable[str]:
    """Yield warnings from the linear response with resting dampers; `test`: one with densities."""
    assert test.resolution is not None
    low, high = test.profile.frequencies[0], test.profile.frequencies[-1]
    count = round((high - low) / test.resolution)
    frequency, places = np.linspace(low, high, _OVERSAMPLING * count + 1), {info.name: info.at for info in channels}
    amplitudes = accelerations_per_drive(scene, [places[name] for _, name in test.named_channels], 2.0 * pi * frequency)
    required = test.decibels(test.required(amplitudes**2, frequency))
    # Where another channel begins to determine the drive, its density may jump.
    determining, drive = required.argmin(axis=0), required.min(axis=0)
    steps = _OVERSAMPLING * np.where(np.diff(determining) == 0, abs(np.diff(drive)), 0.0)
    worst = int(np.argmax(steps))
    if steps[worst] > _MAX_STEP_DB:
        yield (
            f"near {frequency[worst]:.4g} Hz the drive density changes by {steps[worst]:.1f} dB from line to line: the "
            "lines do not resolve the response, and channels deviate between them. Give test.lines of "
            f"{ceil(count * steps[worst] / _MAX_STEP_DB)} or more."
        )
    for limit, row in zip(test.limits, required[1:], strict=True):
        inside = np.flatnonzero(np.isfinite(row))
        for end in (int(inside[0]), int(inside[-1])) if inside.size else ():
            reduction = float(required[0, end] - row[end])
            if 0 < end < frequency.size - 1 and reduction > _MAX_END_DB:
                yield (
                    f"the limit of {limit.channel} ends at {frequency[end]:.4g} Hz, where it reduces the drive density "
                    f"by {reduction:.1f} dB: beyond this frequency, the channel exceeds the limit. Extend the "
                    "limit beyond the resonance."
                )
