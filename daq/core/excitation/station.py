"""Interface of a test to the bench (its station): sample clock, drive inputs, channels, marks and messages."""

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any
from zlib import crc32

import numpy as np

from daq.core.excitation.lock_in import lock_in
from daq.core.signal_chain.channel import ChannelInfo
from rig import Scene
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RunError, SceneError
from rig.core.base.progress import FractionProgress
from rig.core.scene.presets import complete_from_preset
from rig.core.scene.shaker import DRIVE_PER_VOLT, at_shaker

# A test as a coroutine: it yields the drive of the next window, shape (inputs, samples), and receives the readings of
# the channels in that window, shape (channels, samples), in physical units.
Excitation = Generator[Array, Array, None]


class AbortedTest(RunError):
    """A test cannot continue; the loop that runs it then ramps the drive to zero."""


@dataclass
class Station:
    """Access of a test to the bench: scene, sample clock, channels, drive inputs, marks and messages."""

    scene: Scene
    channels: Sequence[ChannelInfo]  # in the order of the rows of the readings
    inputs: Sequence[str]  # drive inputs of the bench, in the order of the rows of drives
    rate: float  # samples per second
    # ``mark(kind, first, stop, **fields)`` marks the samples `first` to `stop` - 1 in the recording.
    mark: Callable[..., Any]
    report: FractionProgress = lambda fraction, message: None  # reports the progress of the test
    warn: Callable[[str], None] = lambda message: None  # adds a warning that is shown after the test
    # Number of samples by which the readings lag behind the drive: the corrected delay of the converter's filter, and
    # the length of a device's queue. With a window of the drive, the readings of samples that many earlier arrive.
    latency: int = 0
    now: int = 0  # index of the first sample of the next window
    # Whether the amplitudes of the force in marked measurements are evaluated; a rehearsal does not need them.
    evaluates_marks: bool = True

    def samples(self, seconds: float) -> int:
        """Return the number of samples in a time in s, rounded, at least 1."""
        return max(1, round(seconds * self.rate))

    def generator(self, purpose: str) -> np.random.Generator:
        """Return a random generator that depends only on the scene's seed and on the purpose, such as "multisine"."""
        seeds = np.random.SeedSequence([self.scene.seed, crc32(purpose.encode())])
        return np.random.Generator(np.random.PCG64(seeds))

    @property
    def level(self) -> float:
        """Level of the test: its force in N, or its drive in the shaker's unit; without a controller `drive_level`."""
        levels = () if self.scene.test is None else self.scene.test.levels
        return levels[0] if levels else 0.0

    def level_text(self, level: float) -> str:
        """Return a level of the test with its unit, such as "2 N"."""
        test, shaker = self.scene.test, self.scene.driven_shaker
        return f"{level:g} {'' if test is None else test.level_unit(shaker)}".rstrip()

    @property
    def drive_level(self) -> float:
        """Level of a test without a controller, in the unit of the drive [V, m or N]."""
        assert not self.is_controlled, "the level is not a drive: control it, or set level_keys = ('drive',)"
        return self.level

    @cached_property
    def driven_input(self) -> str:
        """Name of the drive input of the driven shaker."""
        return self.scene.at_driven("shaker")

    @property
    def force_is_drive(self) -> bool:
        """Whether the drive is the force on the structure itself."""
        return self.scene.driven_shaker is not None and self.scene.driven_shaker.drive_is_force

    @cached_property
    def is_controlled(self) -> bool:
        """Whether the test runs in closed loop: the channels measure a prescribed spring force or motion."""
        return bool(self.scene.controlled_terms)

    def drive(self, wave: Array, name: str | None = None) -> Array:
        """Return a drive with a wave at one input, by default the driven shaker; shape (inputs, samples)."""
        name = self.driven_input if name is None else name
        if name not in self.inputs:
            existing_inputs = f"only the {' and the '.join(self.inputs)}" if self.inputs else "no drive input"
            raise SceneError(
                f"test: drives the {name}, but the scene has {existing_inputs}. "
                + ("Add a shaker to the scene." if name != "hammer" else "Choose another test.")
            )
        rows = np.zeros((len(self.inputs), wave.size))
        rows[list(self.inputs).index(name)] = wave
        return rows

    @property
    def shakers(self) -> tuple[int, ...]:
        """Numbers of the shakers that the test drives, the main shaker first."""
        return (self.scene.driven or 1, *(() if self.scene.test is None else self.scene.test.also_driven))

    def drives(self, waves: Array) -> Array:
        """Return a drive with waves, shape (shakers, samples), at the driven shakers, and zeros elsewhere."""
        names = [at_shaker("shaker", number, len(self.scene.shakers)) for number in self.shakers]
        return np.asarray(sum(self.drive(wave, name) for name, wave in zip(names, waves, strict=True)))

    def zero_drive(self, samples: int) -> Array:
        """Return a zero drive for a number of samples."""
        return np.zeros((len(self.inputs), samples))

    def amplitudes(self, readings: Array, frequencies: Sequence[float], phases: Sequence[float]) -> ComplexArray:
        """Return the complex amplitudes of the channels at simultaneous tones of the drive, shape (channels, tones).

        `readings`: those of a window of at least `min_samples`; `frequencies`: Hz; `phases`: of the tones in the first
        sample of the drive of this window [rad]. The converter's delay is removed.
        """
        delay_phases = 2.0 * np.pi * np.asarray(frequencies) * self.latency / self.rate
        return lock_in(readings, frequencies, self.rate, np.asarray(phases) - delay_phases)

    def displacement_factor(self, row: int, frequency: Array | float) -> ComplexArray:
        """Return the factor from a channel's complex amplitude to its displacement in m, at frequencies in Hz."""
        info = self.channels[row]
        frequency = np.asarray(frequency, dtype=float)
        response = info.response(frequency) * (2j * np.pi * frequency) ** (info.derivative or 0)
        return np.asarray(1.0 / response, dtype=complex)

    @cached_property
    def drive_limit(self) -> float:
        """Largest drive within the range of the shaker's amplifier; V, m or N."""
        return np.inf if self.scene.driven_shaker is None else self.scene.driven_shaker.drive_limit

    @property
    def output_limit(self) -> float:
        """Largest drive within the ranges of the amplifier and of the output; V, m, N or m/s²."""
        shaker = self.scene.driven_shaker
        volts = None if shaker is None else complete_from_preset(shaker.output).range
        if shaker is None or volts is None:
            return self.drive_limit
        return min(self.drive_limit, volts * DRIVE_PER_VOLT[shaker.drive_unit])

    def check_output(self, drive: float, requiring: str, remedy: str) -> None:
        """Raise `AbortedTest` if a drive exceeds `output_limit`; `requiring`: subject of the message."""
        shaker = self.scene.driven_shaker
        assert shaker is not None
        if drive > self.output_limit:
            unit = shaker.drive_unit
            raise AbortedTest(
                f"{requiring} requires a drive of {drive:.3g} {unit}; the output gives {self.output_limit:.3g} {unit}. "
                f"{remedy}"
            )

    def row_of(self, channel: str) -> int:
        """Return the row of a channel in the readings."""
        return next(row for row, info in enumerate(self.channels) if info.name == channel)

    def acceleration_factor(self, row: int, frequency: Array | float) -> ComplexArray:
        """Return the factor from a channel's complex amplitude to its acceleration in m/s², at frequencies in Hz."""
        omega = 2j * np.pi * np.asarray(frequency, dtype=float)
        return np.asarray(self.displacement_factor(row, frequency) * omega**2)

    @property
    def cautious_drive(self) -> float:
        """Initial drive per newton of spring force: a fifth of a rough static estimate, to start below the level."""
        assert self.scene.driven_shaker is not None
        return 0.2 / self.scene.driven_shaker.newtons_per_drive
