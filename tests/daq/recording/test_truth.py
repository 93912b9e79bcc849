"""The true motion of dampers in recordings of simulated tests."""

import numpy as np

import daq
import rig

# Two bodies and the dampers of a test, which a hammer hit sets in motion.
SCENE = """
structure: {{masses: [1 kg, 1 kg], springs: [20 kN/m, 20 kN/m], damping: {{modal: 1 %}}}}
dampers: [{dampers}]
test: {{kind: impulse, body: 2, peak: 100 N, width: 2 ms, interval: 0.2 s}}
recording: {{truth: true}}
"""


def record_hit(tmp_path, *dampers):
    """Return the opened recording of a hit on the structure with these dampers."""
    scene = rig.loads(SCENE.format(dampers=", ".join(dampers)))
    return daq.open(daq.record(scene, tmp_path / "a.mcap"))


def test_locked_dampers_have_truth_on_floors(tmp_path):
    locked = "{body: 1, mass: 50 g, clearance: 1 mm, locked: true}"
    moving = "{body: 2, mass: 50 g, clearance: 1 mm}"
    filled = "{body: 2, mass: 50 g, clearance: 0}"
    with record_hit(tmp_path, locked, moving, filled) as rec:
        gap, contact = rec.truth("gap"), rec.truth("contact")
        assert gap.shape == contact.shape == (3, rec.samples)
        assert np.all(gap[[0, 2]] == 0.0)
        assert np.all(contact[[0, 2]] == 1)
        assert gap[1].max() > 1e-6
        assert set(rec.events["damper"]) == {2}


def test_finite_contacts_record_touch_and_release(tmp_path):
    with record_hit(tmp_path, "{body: 2, mass: 50 g, clearance: 1 mm, contact: {duration: 2 ms}}") as rec:
        rec.check()
        assert {"touch", "release"} <= set(rec.events["kind"])
