"""
Choose a damper
===============

The worst peak over a band depends on the clearance above the damper, and on the force.

Exact steady-state motions show which of several clearances gives the lowest worst peak at one force.
`rig design` also optimizes locations and masses, for several force levels.
"""

# %%
# One damper in body 2. A force of 3.3 N acts on body 1, as with an ideal controller. The response with dampers is
# nonlinear: at a different force, a different clearance may be the best.
import matplotlib.pyplot as plt
import numpy as np

import rig

force = "3.3 N"
frequencies = np.linspace(47.0, 51.0, 41)
clearances = np.array([0.3, 0.6, 0.98, 1.1, 1.2, 1.3, 1.4, 1.6, 2.2, 3.0])  # mm


def highest_peak(clearance_mm: float) -> float:
    """Return the highest compliance of any body in the band, µm/N."""
    changes = {"test.force": force, "dampers.clearance": f"{clearance_mm} mm"}
    scene = rig.load("fig9", {"shaker": {"kind": "force", "body": 1}, "channels": None, **changes})
    return 1e6 * float(abs(rig.orbit_response(scene, frequencies).compliance).max())


# %%
# The best of these clearances has the lowest peak. The optimum lies between its neighbors.
peaks = np.array([highest_peak(float(clearance)) for clearance in clearances])
best = clearances[np.argmin(peaks)]
print(f"best of these clearances: {best} mm, {peaks.min():.0f} µm/N at {force}")
axes = plt.subplots(layout="constrained")[1]
axes.plot(clearances, peaks, "o-", label="damper in body 2")
axes.plot(best, peaks.min(), "o", markersize=13, fillstyle="none", label=f"best of these: {best} mm")
axes.figure.legend(loc="outside lower left", ncols=2)
axes.set(xlabel="clearance / mm", ylabel="highest compliance / (µm/N)", ylim=(0.0, None), title=f"{force}, 47 to 51 Hz")
