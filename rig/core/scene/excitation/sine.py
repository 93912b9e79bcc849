"""A sine of constant frequency and amplitude."""

from typing import ClassVar, Literal

from rig.core.scene.excitation.kind import Drive, DrivenShaker, Duration, Force, Frequency, KindOfTest, Start


class Sine(KindOfTest):
    """A sine of constant frequency and amplitude: amplitude times sin(2 pi f t) from t = 0."""

    one_of: ClassVar = (("force", "drive"),)
    kind: Literal["sine"] = "sine"
    recorded_as: ClassVar = "tones"
    single_tone: ClassVar = True
    start: Start = "settled"
    frequency: Frequency
    """Frequency [Hz]."""
    force: Force | None = None
    """Amplitude of the force of the coil spring, which the controller keeps constant, or of a force shaker [N]."""
    drive: Drive | None = None
    """Instead of `force`: amplitude of the drive, open loop [V, m for a table shaker, or m/s² for a base]."""
    shaker: DrivenShaker = None
    duration: Duration = 2.0
    """Duration of the test [s]."""

    @property
    def dwells(self) -> tuple[float, ...]:
        """The single frequency of the test [Hz]."""
        return (self.frequency,)
