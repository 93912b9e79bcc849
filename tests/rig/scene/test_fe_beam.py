"""The bundled scene whose matrices come from finite elements."""

from __future__ import annotations

import runpy

import numpy as np

import rig
from rig.scene.scene_files import SCENES
from rig.system.structural_model import natural_modes, structure_matrices


def test_beam_script_reproduces_the_matrices_of_the_scene() -> None:
    script = runpy.run_path(str(SCENES / "fe_beam.py"))
    mass, _, stiffness = structure_matrices(rig.load("fe-beam").structure)
    for printed, made in zip((mass, stiffness), script["reduced"](), strict=True):
        np.testing.assert_allclose(printed, made, rtol=1e-9)
    inertia, line = script["WIDTH"] * script["THICKNESS"] ** 3 / 12, script["WIDTH"] * script["THICKNESS"]
    speed = np.sqrt(script["YOUNG"] * inertia / (script["DENSITY"] * line))
    exact = np.array([1.87510407, 4.69409113, 7.85475744]) ** 2 * speed / script["LENGTH"] ** 2
    frequencies, _ = natural_modes(mass, stiffness)
    # Condensation stiffens a beam, the more the higher the mode.
    assert np.all(frequencies[:3] >= exact * (1 - 1e-6)) and np.all(frequencies[:3] <= exact * [1.0005, 1.005, 1.03])
