"""Random systems with joints and dampers of all laws against decimal arithmetic of forty digits.

The reference (`rig.studies.cost.high_precision`) shares the declarations of the laws and the matrices of the structure
with the engine, but no code that solves the equations or locates events.
"""

from collections.abc import Callable
from itertools import count, islice
from typing import Any

import numpy as np
import pytest

import rig
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import tone_drive
from rig.studies.cost.high_precision import CHECK_DIGITS, exact_motion
from tests.rig.laws.random_scenes import KINDS, random_friction, random_scene, random_stop

#: The engine's error may be as large as that of this number of rounding errors, each amplified by the motion.
ROUNDING_ERRORS = 100


@pytest.mark.thorough
@pytest.mark.parametrize("joint", [random_stop, random_friction])
def test_random_systems_move_as_in_decimal_arithmetic(joint: Callable[..., dict[str, Any]]) -> None:
    scenes = (random_scene(seed, *KINDS, joint=joint) for seed in count())
    for scene in islice((scene for scene in scenes if not assemble(scene).impacts_interact), 20):
        system = assemble(scene)
        tone = tone_drive(scene, system)
        assert tone is not None
        run = rig.simulate(scene, 3 / tone.frequency, 4 * tone.frequency)
        exact = exact_motion(system, tone, run, 4)
        # Rounding to fewer digits shows how much the motion amplifies rounding errors.
        amplification = exact.agreement * 10.0**CHECK_DIGITS
        tolerance = max(1e-10, ROUNDING_ERRORS * np.finfo(float).eps * amplification)
        np.testing.assert_allclose(run.events["time"], exact.event_time.astype(float), rtol=0.0, atol=tolerance)
