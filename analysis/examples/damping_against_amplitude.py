"""
Damping against amplitude
=========================

Particle dampers increase the damping of a free decay until the acceleration of their body falls below 1 g.
"""

# %%
# Two hammer tests: without dampers and with three.
import matplotlib.pyplot as plt

import analysis
import daq

bare = daq.open("recordings/demo-impulse-no-damper.mcap")
damped = daq.open("recordings/demo-impulse-three-dampers.mcap")
decays = [analysis.decay(recording, "body3") for recording in (bare, damped)]
print(*decays, sep="\n")

# %%
# Both decays in one figure.
axes = plt.subplots(layout="constrained")[1]
for decay in decays:
    decay.plot(axes)

# %%
# Damping ratio of each mode over its amplitude: constant without dampers, larger with them above 1 g.
for decay in decays:
    for mode in decay.modes:
        points = zip(mode.amplitude[::4], mode.damping[::4], strict=True)
        text = ", ".join(f"{100 * ratio:.2f} % at {level:.2g} m/s²" for level, ratio in points)
        print(f"{decay.label}, {mode.frequency:.1f} Hz: {text}")
print(
    f"With dampers, the acceleration of body3 stays below 1 g from {decays[1].quiet_from:.2f} s on; "
    f"without dampers, from {decays[0].quiet_from:.2f} s on."
)
