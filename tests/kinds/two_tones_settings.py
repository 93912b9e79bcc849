"""Two tones at once: the settings of a kind of test that exists only in the test suite."""

from collections.abc import Iterable
from typing import ClassVar, Literal

import numpy as np

from rig.core.scene.excitation.kind import Drive, DrivenShaker, Duration, Frequency, KindOfTest, Pulses, Settle, Start
from rig.core.settings.problems import Problem


class TwoTones(KindOfTest):
    """Two tones at once, in open loop."""

    recorded_as: ClassVar = "tones"
    level_keys: ClassVar = ("drive",)
    kind: Literal["two_tones"] = "two_tones"
    start: Start = "settled"
    frequencies: tuple[Frequency, Frequency]
    """Both frequencies, ascending [Hz]."""
    drive: Drive
    """Amplitude of the drive of each tone [V, or m for a table shaker]."""
    shaker: DrivenShaker = None
    duration: Duration = 2.0
    """Duration of the test [s]."""

    settle: Settle = Settle()
    """Criterion for the steady state."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check the distance of the tones."""
        yield from self.settle.check_spacing(("frequencies",), self.frequencies)

    def tones(self, points: int) -> tuple[float, ...]:
        """Return both frequencies, Hz."""
        return self.frequencies

    def wave(self, samples: int, rate: float) -> Pulses:
        """Return the sum of both tones."""
        time = np.arange(samples) / rate
        return Pulses("shaker", self.drive * sum(np.sin(2.0 * np.pi * f * time) for f in self.frequencies))
