"""Receptances and transmissibilities, compared with independent closed forms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

import rig
import rig.core.system.structural_model as structural_model_module
from rig.core.base.errors import SceneError
from rig.core.scene.scene import Scene
from rig.core.system.structural_model import receptance, structural_model, transmissibility

FREQUENCIES = np.linspace(1.0, 60.0, 60)  # Hz
# Coil spring and spring of body 1 of the bundled scenes, N/m.
COIL_SPRING, FIRST_SPRING = 6600.0, 24300.0


def chain_response(masses, springs, dashpots, frequencies):
    """Return the receptances of a chain for a force on body 1, as a continued fraction (bodies, frequencies).

    The dynamic stiffness of all bodies above a body acts on it like a spring.
    """
    omega = 2.0 * np.pi * frequencies
    above = np.zeros_like(omega, dtype=complex)
    links, stiffness_above = [], []
    for mass, spring, dashpot in zip(reversed(masses), reversed(springs), reversed(dashpots), strict=True):
        link = spring + 1j * omega * dashpot
        stiffness_above.append(above)
        links.append(link)
        stiffness_at_body = above - mass * omega**2
        above = link * stiffness_at_body / (link + stiffness_at_body)
    links, stiffness_above = links[::-1], stiffness_above[::-1]
    response = [1.0 / (links[0] + stiffness_above[0] - masses[0] * omega**2)]
    for mass, link, above in zip(masses[1:], links[1:], stiffness_above[1:], strict=True):
        response.append(response[-1] * link / (link + above - mass * omega**2))
    return np.array(response)


positive = st.floats(min_value=0.1, max_value=10.0)


@given(st.lists(st.tuples(positive, positive, positive), min_size=1, max_size=6))
def test_chain_response_is_the_continued_fraction(parts: list[tuple[float, float, float]]) -> None:
    masses, thousands, dashpots = zip(*parts, strict=True)
    springs = tuple(1000.0 * k for k in thousands)
    structure = {"masses": masses, "springs": springs, "damping": {"dashpots": dashpots}}
    scene = Scene(structure=structure, shaker={"kind": "force", "body": 1})
    expected = chain_response(masses, springs, dashpots, FREQUENCIES)
    np.testing.assert_allclose(receptance(scene, FREQUENCIES), expected, rtol=1e-9)


def test_modally_damped_response_is_the_modal_sum() -> None:
    scene = rig.load("bare-structure")
    modes = structural_model(scene).modes
    omega = 2.0 * np.pi * FREQUENCIES
    terms = 1.0 / (modes.omega[:, None] ** 2 - omega**2 + 2j * 0.005 * modes.omega[:, None] * omega)
    expected = modes.shapes @ (modes.shapes[0][:, None] / modes.mass[:, None] * terms)
    np.testing.assert_allclose(receptance(scene, FREQUENCIES), expected, rtol=1e-10)


@pytest.mark.parametrize(
    ("response", "peaks"),
    # Natural angular frequencies, rad/s, of the structure of Inoue, Yokomichi, Hiraki (2011) without and with spring.
    [(receptance, (81.911, 218.512, 312.041)), (transmissibility, (86.776, 228.231, 318.003))],
)
def test_lightly_damped_peaks_are_at_natural_frequencies(response, peaks):
    scene = rig.load("bare-structure")
    scene = scene.replace(structure=scene.structure.replace(damping={"modal": 1e-4}))
    for peak in peaks:
        result = minimize_scalar(
            lambda w: -np.abs(response(scene, [w / (2.0 * np.pi)])[2, 0]),
            bounds=(peak - 0.5, peak + 0.5),
            method="bounded",
            options={"xatol": 1e-5},
        )
        assert result.x == pytest.approx(peak, abs=6e-4)


def test_transmissibility_follows_from_receptance() -> None:
    # With the spring force F = k (X_0 - X_1), the receptances R give X = R F, so X / X_0 = k R / (1 + k R_1).
    scene = rig.load("fig8-three-dampers")
    force_response = receptance(scene, FREQUENCIES)
    expected = COIL_SPRING * force_response / (1.0 + COIL_SPRING * force_response[0])
    np.testing.assert_allclose(transmissibility(scene, FREQUENCIES), expected, rtol=1e-9)


def test_block_size_does_not_change_the_response(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = rig.load("bare-structure")
    single_block = receptance(scene, FREQUENCIES)
    for elements in (1, 9, 70):
        monkeypatch.setattr(structural_model_module, "_MAX_ELEMENTS", elements)
        np.testing.assert_array_equal(receptance(scene, FREQUENCIES), single_block)


def test_two_beds_in_one_body_add_up() -> None:
    scene = rig.load("bare-structure")
    two_halves = scene.replace(dampers=[{"body": 3, "mass": "40 g", "clearance": "1 mm"}] * 2)
    single_bed = scene.replace(dampers=[{"body": 3, "mass": "80 g", "clearance": "1 mm"}])
    np.testing.assert_allclose(
        receptance(two_halves, FREQUENCIES, riding=[1, 2]), receptance(single_bed, FREQUENCIES, riding=[1]), rtol=1e-12
    )


def test_undamped_resonance_is_reported() -> None:
    structure = {"masses": [1.0], "springs": [(2.0 * np.pi) ** 2]}
    scene = Scene(structure=structure, shaker={"kind": "force", "body": 1})
    with pytest.raises(SceneError, match="response is infinite at one of the frequencies"):
        receptance(scene, [0.5, 1.0])


def test_response_at_zero_frequency_is_static() -> None:
    scene = rig.load("bare-structure")
    np.testing.assert_allclose(receptance(scene, [0.0])[:, 0], 1.0 / FIRST_SPRING, rtol=1e-12)
    expected = COIL_SPRING / (FIRST_SPRING + COIL_SPRING)
    np.testing.assert_allclose(transmissibility(scene, [0.0])[:, 0], expected, rtol=1e-12)


def test_driving_point_response_lags_the_force() -> None:
    assert (receptance(rig.load("bare-structure"), FREQUENCIES)[0].imag < 0.0).all()


def test_dampers_at_rest_add_their_mass() -> None:
    scene = rig.load("fig9").replace(
        structure={"masses": (0.74, 0.71, 0.64), "springs": (24300.0, 21800.0, 19800.0)},
        dampers=[{"body": 2, "mass": 0.1, "clearance": 1e-3}, {"body": 3, "mass": 0.05, "clearance": 1e-3}],
    )
    # The riding damper of 0.05 kg is added to body 3; the damper in body 2 flies.
    expected = chain_response((0.74, 0.71, 0.69), (24300.0, 21800.0, 19800.0), (0.0,) * 3, FREQUENCIES)
    np.testing.assert_allclose(receptance(scene, FREQUENCIES, riding=[2]), expected, rtol=1e-9)


@pytest.mark.parametrize("settings", [{"clearance": 0.0}, {"clearance": 1e-3, "locked": True}])
def test_locked_damper_adds_its_mass(settings: dict[str, object]) -> None:
    scene = rig.load("fig9")
    scene = scene.replace(dampers=[{"body": 2, "mass": 0.1, **settings}])
    np.testing.assert_array_equal(receptance(scene, [30.0]), receptance(scene, [30.0], riding=[1]))


def test_force_on_several_bodies_superposes() -> None:
    base = rig.load("reference-A").replace(dampers=())
    single_forces = [receptance(base.replace(shaker={"kind": "force", "body": body}), FREQUENCIES) for body in (1, 3)]
    both = receptance(base.replace(shaker={"kind": "force", "body": [1, 3]}), FREQUENCIES)
    np.testing.assert_allclose(both, single_forces[0] + single_forces[1], rtol=1e-11)


def test_hammer_force_acts_on_its_body() -> None:
    # Hammer and shaker of these scenes act on body 1 of the same structure.
    hammer = rig.load("fig10b-no-damper")
    np.testing.assert_array_equal(receptance(hammer, FREQUENCIES), receptance(rig.load("fig8-no-damper"), FREQUENCIES))


def test_error_names_the_cause_of_a_missing_response() -> None:
    table, force = rig.load("bare-structure"), rig.load("reference-B")
    with pytest.raises(SceneError, match="frequencies"):
        receptance(table, [-1.0])
    with pytest.raises(SceneError, match="frequencies"):
        receptance(table, [np.nan])
    with pytest.raises(SceneError, match=r"damper 2 does not exist.*from 1 to 1"):
        receptance(force, [1.0], riding=[2])
    with pytest.raises(SceneError, match="no coil spring"):
        transmissibility(force, [1.0])
    with pytest.raises(SceneError, match="neither shaker nor hammer"):
        receptance(table.replace(shaker=None, test=None), [1.0])
    undamped = Scene(structure={"masses": (1.0,), "springs": (0.0,)}, shaker={"kind": "force", "body": 1})
    with pytest.raises(SceneError, match="undamped resonance"):
        receptance(undamped, [0.0])
