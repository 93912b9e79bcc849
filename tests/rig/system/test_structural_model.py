"""Matrices and modes of the structure, compared with closed forms and with Inoue, Yokomichi, Hiraki (2011)."""

import numpy as np
import pytest

import rig
from rig.core.base.errors import SceneError
from rig.core.scene.structure import Structure
from rig.core.system.natural_modes import natural_modes
from rig.core.system.structural_model import chain_matrix, structural_model, structure_matrices

# The structure of Inoue, Yokomichi, Hiraki (2011).
MASSES = (0.74, 0.71, 0.64)  # kg
SPRINGS = (24300.0, 21800.0, 19800.0)  # N/m


def test_paper_structure_has_published_modes() -> None:
    mass, _, stiffness = structure_matrices(Structure(masses=MASSES, springs=SPRINGS))
    omega, shapes = natural_modes(mass, stiffness)
    np.testing.assert_allclose(omega, [81.911, 218.512, 312.041], atol=5e-4)
    np.testing.assert_allclose(
        shapes.T, [[0.4150, 0.7831, 1.0], [1.0, 0.4939, -0.9090], [-0.8400, 1.0, -0.4657]], atol=5e-5
    )


def test_uniform_chain_frequencies_are_closed_form() -> None:
    n, m, k = 40, 0.5, 2000.0
    structure = Structure(masses=(m,) * n, springs=(k,) * n)
    mass, _, stiffness = structure_matrices(structure)
    omega, _ = natural_modes(mass, stiffness)
    mode = np.arange(1, n + 1)
    expected = 2.0 * np.sqrt(k / m) * np.sin((2 * mode - 1) * np.pi / (2 * (2 * n + 1)))
    np.testing.assert_allclose(omega, expected, rtol=1e-11)


def test_modes_of_extreme_masses_are_accurate() -> None:
    # Body 1 is quasi-static in the slow modes: its springs act in series, between ground and the heavy body 2.
    omega, shapes = natural_modes(np.diag([1e-9, 1e9, 1.0]), chain_matrix((100.0, 200.0, 300.0)))
    expected = np.sqrt([200.0 / 3.0 / (1e9 + 1.0), 300.0 * (1.0 + 1e-9), 300.0 / 1e-9])
    np.testing.assert_allclose(omega, expected, rtol=1e-6)
    np.testing.assert_allclose(shapes[:, 0], [2.0 / 3.0, 1.0, 1.0], rtol=1e-6)


def test_spring_joins_neighboring_bodies() -> None:
    np.testing.assert_array_equal(
        chain_matrix(SPRINGS), [[46100.0, -21800.0, 0.0], [-21800.0, 41600.0, -19800.0], [0.0, -19800.0, 19800.0]]
    )


@pytest.mark.parametrize("ratio", [0.005, (0.001, 0.02, 1.0)])
def test_modal_damping_sets_each_ratio(ratio: float | tuple[float, ...]) -> None:
    structure = Structure(masses=MASSES, springs=SPRINGS, damping={"modal": ratio})
    mass, damping, stiffness = structure_matrices(structure)
    omega, shapes = natural_modes(mass, stiffness)
    modal_damping = shapes.T @ damping @ shapes
    modal_masses = np.diag(shapes.T @ mass @ shapes)
    expected = np.diag(2.0 * np.broadcast_to(ratio, 3) * omega * modal_masses)
    np.testing.assert_allclose(modal_damping, expected, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_array_equal(damping, damping.T)


def test_rayleigh_damping_is_the_weighted_sum() -> None:
    structure = Structure(masses=MASSES, springs=SPRINGS, damping={"rayleigh": {"alpha": "0.1 1/s", "beta": "1e-5 s"}})
    mass, damping, stiffness = structure_matrices(structure)
    np.testing.assert_allclose(damping, 0.1 * mass + 1e-5 * stiffness, rtol=1e-15)


def test_dashpots_are_parallel_to_springs() -> None:
    structure = Structure(masses=MASSES, springs=SPRINGS, damping={"dashpots": (0.5, 0.0, 2.0)})
    np.testing.assert_array_equal(
        structure_matrices(structure)[1], [[0.5, 0.0, 0.0], [0.0, 2.0, -2.0], [0.0, -2.0, 2.0]]
    )


def test_default_damping_is_zero() -> None:
    assert not structure_matrices(Structure(masses=MASSES, springs=SPRINGS))[1].any()


def test_given_matrices_are_used() -> None:
    mass, stiffness = [[2.0, 0.5], [0.5, 1.0]], [[3.0, -1.0], [-1.0, 1.0]]
    damping = [[0.1, 0.05], [-0.05, 0.1]]
    structure = Structure(matrices={"mass": mass, "stiffness": stiffness, "damping": damping})
    for expected, assembled in zip((mass, damping, stiffness), structure_matrices(structure), strict=True):
        np.testing.assert_array_equal(assembled, expected)


def test_modal_damping_of_matrices_equals_the_chain() -> None:
    inline = {"mass": np.diag(MASSES), "stiffness": chain_matrix(SPRINGS)}
    matrix_structure = Structure(matrices=inline, damping={"modal": 0.01})
    chain = Structure(masses=MASSES, springs=SPRINGS, damping={"modal": 0.01})
    np.testing.assert_array_equal(structure_matrices(matrix_structure)[1], structure_matrices(chain)[1])


def test_floating_chain_has_undamped_zero_frequency() -> None:
    structure = Structure(masses=(1.0, 2.0, 1.5), springs=(0.0, 1e4, 1e9), damping={"modal": 0.05})
    mass, damping, stiffness = structure_matrices(structure)
    omega, shapes = natural_modes(mass, stiffness)
    assert omega[0] == 0.0
    np.testing.assert_allclose(shapes[:, 0], 1.0, rtol=1e-9)
    np.testing.assert_allclose(damping @ np.ones(3), 0.0, atol=1e-9 * np.abs(damping).max())


@pytest.mark.parametrize("n", [1, 9, 10, 11, 60])
def test_floating_uniform_chain_is_closed_form(n: int) -> None:
    m, k = 0.5, 2e6
    omega, shapes = natural_modes(m * np.eye(n), chain_matrix((0.0, *[k] * (n - 1))))
    expected = 2.0 * np.sqrt(k / m) * np.sin(np.arange(n) * np.pi / (2 * n))
    assert omega[0] == 0.0
    np.testing.assert_allclose(omega[1:], expected[1:], rtol=1e-9)
    np.testing.assert_allclose(np.abs(shapes).max(axis=0), 1.0)
    np.testing.assert_array_equal(shapes.max(axis=0), 1.0)


@pytest.mark.parametrize("deficit", [1e-9, 1e-3])
def test_slightly_negative_stiffness_is_reported(deficit: float) -> None:
    with pytest.raises(SceneError, match="not positive semidefinite"):
        natural_modes(np.eye(3), np.diag([1.0, 2.0, -deficit]))


def test_negative_stiffness_is_reported() -> None:
    with pytest.raises(SceneError, match="not positive semidefinite"):
        natural_modes(np.eye(2), np.diag([1.0, -2.0]))


def test_damper_mass_follows_from_mass_or_mass_ratio() -> None:
    scene = rig.load("fig9").replace(
        dampers=[{"body": 3, "mass_ratio": "10 %", "clearance": ".inf"}, {"body": 1, "mass": "30 g", "clearance": 1e-3}]
    )
    # 10 % of body 3 (0.64 kg), and 30 g.
    np.testing.assert_allclose(structural_model(scene).damper_mass, [0.064, 0.03], rtol=1e-15)
    np.testing.assert_array_equal(structural_model(scene).damper_body, [2, 0])
    assert structural_model(scene.replace(dampers=())).damper_mass.shape == (0,)


def test_modes_of_negative_masses_are_rejected() -> None:
    with pytest.raises(SceneError, match="natural modes cannot be computed"):
        natural_modes(-np.eye(2), np.eye(2))
