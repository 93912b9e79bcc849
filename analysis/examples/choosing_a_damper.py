"""
Choose a damper
===============

The worst peak over a band depends on the clearance above the damper.

Exact steady-state motions show which clearance gives the lowest worst peak. `rig design` also optimizes locations and
masses, for several force levels.
"""

# %%
# One damper in body 2. A force of constant amplitude acts on body 1, as with an ideal controller.
import matplotlib.pyplot as plt
import numpy as np

import rig

frequencies = np.linspace(47.0, 51.0, 9)
clearances = np.array([0.3, 0.6, 0.98, 1.3, 1.6, 2.2, 3.0])  # mm


def highest_peak(clearance_mm: float) -> float:
    """Return the highest compliance of any body in the band, µm/N."""
    scene = rig.load(
        "fig9", {"shaker": {"kind": "force", "body": 1}, "channels": None, "dampers.clearance": f"{clearance_mm} mm"}
    )
    return 1e6 * float(abs(rig.orbit_response(scene, frequencies).compliance).max())


# %%
# The best of these clearances has the lowest peak.
peaks = np.array([highest_peak(float(clearance)) for clearance in clearances])
best = clearances[np.argmin(peaks)]
print(f"lowest peak of these clearances: at {best} mm ({peaks.min():.0f} µm/N)")
axes = plt.subplots(layout="constrained")[1]
axes.plot(clearances, peaks, "o-", label="one damper in body 2")
axes.plot(best, peaks.min(), "o", markersize=13, fillstyle="none", label=f"optimum: {best} mm")
axes.legend()
axes.set(xlabel="clearance / mm", ylabel="highest compliance / (µm/N)", ylim=(0.0, None))
