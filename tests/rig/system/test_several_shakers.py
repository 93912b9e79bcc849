"""Several shakers in one scene: their motions superpose, and each keeps its own properties."""

import numpy as np
import pytest

import rig
from rig.core.base.errors import SceneError
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import with_ideal_force
from rig.core.system.structural_model import receptance

STRUCTURE = "structure: {masses: [1 kg, 2 kg], springs: [10 kN/m, 20 kN/m], damping: {modal: 1 %}}\n"
FORCE = "{kind: force, body: 1}"
TABLE = "{kind: table, body: 2, spring: 3 kN/m}"
COIL = "{kind: electrodynamic, body: 1, spring: 5 kN/m, amplifier: {gain: 2}}"
HEAVY = "{kind: electrodynamic, body: 2, spring: 6 kN/m, coil: {inductance: 1 mH}, armature: {mass: 0.4 kg}}"
CURRENT = "{kind: electrodynamic, body: 2, spring: 4 kN/m, amplifier: {mode: current, gain: 0.5 A/V}}"


def scene(*shakers: str, test: str = "") -> rig.Scene:
    shaker_text = shakers[0] if len(shakers) == 1 else f"[{', '.join(shakers)}]"
    return rig.loads(f"{STRUCTURE}shaker: {shaker_text}\n{test}")


@pytest.mark.parametrize("shaker", [FORCE, TABLE, COIL, CURRENT])
def test_list_of_one_shaker_equals_the_shaker(shaker: str) -> None:
    single, listed = scene(shaker), rig.loads(f"{STRUCTURE}shaker: [{shaker}]\n")
    single_system, listed_system = assemble(single), assemble(listed)
    for name, value in vars(single_system).items():
        assert np.array_equal(value, getattr(listed_system, name)), name


def test_shakers_of_all_kinds_superpose() -> None:
    combined = scene(COIL, HEAVY, TABLE, FORCE, CURRENT)
    random = np.random.default_rng(1)
    drive = random.standard_normal((5, 400)) * np.array([[1.0], [1.0], [1e-3], [2.0], [1.0]])
    run = rig.simulate(combined, duration=0.1, rate=4000.0, drive=drive)
    assert run.points == ("body 1", "body 2", "table 1", "table 2", "table 3", "table 5")
    parts = [
        rig.simulate(combined, duration=0.1, rate=4000.0, drive=drive * (np.arange(5) == k)[:, None]) for k in range(5)
    ]
    total = sum(part.displacement for part in parts)
    assert run.displacement == pytest.approx(total, abs=1e-12 * np.abs(total).max())
    assert abs(run.energy.residual) < 1e-12 * abs(run.energy.work)


def test_second_shaker_without_drive_has_no_effect() -> None:
    drive = np.random.default_rng(2).standard_normal((1, 300))
    single_shaker = rig.simulate(scene(HEAVY), duration=0.1, rate=4000.0, drive=drive)
    both_shakers = rig.simulate(scene(FORCE, HEAVY), duration=0.1, rate=4000.0, drive=np.vstack([0.0 * drive, drive]))
    assert both_shakers.displacement == pytest.approx(
        single_shaker.displacement, abs=1e-13 * np.abs(single_shaker.displacement).max()
    )


def test_force_acts_at_the_named_shaker() -> None:
    test = "test: {kind: sine, frequency: 20 Hz, force: 2 N, shaker: 2, duration: 4 s}\n"
    named = scene(COIL, TABLE, test=test)
    assert named.driven == 2 and named.at_driven("table") == "table 2"
    run = rig.simulate(named, duration=6.0, rate=2000.0)
    steady_samples = slice(8000, None)
    # Rows: body 1, body 2, table 1, table 2. The spring of table 2 has 3 kN/m.
    force = 3000.0 * (run.displacement[3] - run.displacement[1])[steady_samples]
    assert np.abs(force).max() == pytest.approx(2.0, rel=1e-3)
    ideal = with_ideal_force(named)
    assert [shaker.kind for shaker in ideal.shakers] == ["electrodynamic", "force"]


def test_response_without_named_shaker_is_rejected() -> None:
    without_test = scene(COIL, FORCE)
    with pytest.raises(SceneError, match=r"2 shakers\. Set test\.shaker"):
        rig.frequency_response(without_test.replace(test=None), [20.0])
    for loaded in (without_test, scene(COIL, CURRENT), scene(FORCE, TABLE)):
        with pytest.raises(SceneError, match="coil springs add stiffness"):
            receptance(loaded, [20.0])


def test_receptance_belongs_to_the_named_force() -> None:
    named = scene(FORCE, "{kind: force, body: 2}", test="test: {kind: sine, frequency: 20 Hz, force: 2 N, shaker: 2}\n")
    assert np.array_equal(receptance(named, [20.0]), receptance(scene("{kind: force, body: 2}"), [20.0]))
