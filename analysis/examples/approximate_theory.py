"""
Approximate theory: Types I to III
==================================

Inoue, Yokomichi and Hiraki (2011) reduce the structure to one mode and predict three types of periodic motion.

Type I: the damper flies and lands on the floor. Type II: it also hits the ceiling and leaves it immediately. Type III:
it stays at the ceiling for a while. Exact orbits of the full structure show the accuracy of the reduction.
"""

# %%
# The approximate method for mode 3 of the scene of Fig. 9, with one damper in a cavity of finite clearance. As
# the theory assumes, a force without a coil spring acts on body 1.
import matplotlib.pyplot as plt
import numpy as np

import rig

scene = rig.load("fig9", {"shaker": {"kind": "force", "body": 1}, "channels": None})
theory = rig.approximate_response(scene, 3, ("47 Hz", "52 Hz"))
print(theory)

# %%
# Exact periodic orbits over the same band, at the force of the scene, 3.3 N.
frequencies = np.linspace(47.5, 51.5, 17)
exact = rig.orbit_response(scene, frequencies)
# `theory` shows the body with the largest motion in the mode.
body = int(np.argmax(abs(theory.mode.shape)))
axes = plt.subplots(layout="constrained")[1]
theory.draw(axes)
axes.plot(frequencies, 1e6 * abs(exact.compliance[body]), "k.", label="exact orbits")
axes.set(xscale="linear", title="one damper, 3.3 N")
axes.figure.legend(loc="outside lower left", ncols=4)
highest = 1e6 * float(np.nanmax(abs(exact.compliance[body])))
print(f"highest exact compliance of body {body + 1} in the band: {highest:.0f} µm/N")
