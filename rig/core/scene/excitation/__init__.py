"""Settings of a test: kind, level and duration of the excitation. Each kind has a module with the name of the kind."""

from typing import Annotated, get_args

from rig.core.scene.excitation.constant_response import ConstantResponse as ConstantResponse
from rig.core.scene.excitation.continuation import Continuation as Continuation
from rig.core.scene.excitation.free import Free as Free
from rig.core.scene.excitation.impulse import DoubleHit as DoubleHit
from rig.core.scene.excitation.impulse import Impulse as Impulse
from rig.core.scene.excitation.kind import FORCE_TOLERANCE as FORCE_TOLERANCE
from rig.core.scene.excitation.kind import KindOfTest as KindOfTest
from rig.core.scene.excitation.kind import Settle as Settle
from rig.core.scene.excitation.kind import spaced_frequencies as spaced_frequencies
from rig.core.scene.excitation.multisine import Multisine as Multisine
from rig.core.scene.excitation.phase_resonance import PhaseResonance as PhaseResonance
from rig.core.scene.excitation.random import Random as Random
from rig.core.scene.excitation.random_control import RandomControl as RandomControl
from rig.core.scene.excitation.shock import Shock as Shock
from rig.core.scene.excitation.sine import Sine as Sine
from rig.core.scene.excitation.sine_control import SineControl as SineControl
from rig.core.scene.excitation.stepped_sine import Measure as Measure
from rig.core.scene.excitation.stepped_sine import SteppedSine as SteppedSine
from rig.core.scene.excitation.swept_sine import SweptSine as SweptSine
from rig.core.settings.alternatives import Alternatives, by_kind

Test = Annotated[
    Sine
    | SteppedSine
    | SweptSine
    | Random
    | Multisine
    | Impulse
    | ConstantResponse
    | PhaseResonance
    | Continuation
    | Free
    | Shock
    | RandomControl
    | SineControl,
    Alternatives(by_kind),
]
#: The classes of all kinds of test.
KINDS: tuple[type[KindOfTest], ...] = get_args(get_args(Test)[0])
