"""
Damping against amplitude
=========================

Particle dampers increase the damping of a free decay until the acceleration of their body falls below 1 g.
"""

# %%
# Two impact tests: without dampers and with three.
import matplotlib.pyplot as plt

import analysis
import daq

bare = daq.open("recordings/demo-impulse-no-damper.mcap")
damped = daq.open("recordings/demo-impulse-three-dampers.mcap")
decays = [analysis.decay(recording, "body3") for recording in (bare, damped)]
print(*decays, sep="\n")

# %%
# Both decays in one figure.
colors = ("#404040", "#AA4499")
axes = plt.subplots(layout="constrained")[1]
for decay, color in zip(decays, colors, strict=True):
    decay.plot(axes, color=color)

# %%
# Damping ratio of each mode over its own amplitude, with bands of 95 %. Without dampers it is constant. With them it is
# larger while the acceleration, the sum of all modes, exceeds 1 g.
# sphinx_gallery_thumbnail_number = 2
panels = plt.subplots(3, 1, sharex=True, sharey=True, layout="constrained")[1]
for decay, color in zip(decays, colors, strict=True):
    for number, mode in enumerate(sorted(decay.modes, key=lambda mode: mode.frequency)):
        axes = panels[number]
        mode.draw(axes, color=color, label=decay.label)
        axes.set(xlabel="", ylabel="ζ / %", ylim=(0.0, 8.0))
        axes.text(0.98, 0.75, f"mode {number + 1}", ha="right", transform=axes.transAxes)
panels[-1].set(xlabel="amplitude / (m/s²)")
panels[0].set_title("impact test, 200 N")
panels[0].figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower left", ncols=2)
print(
    f"With dampers, the acceleration of body3 stays below 1 g from {decays[1].quiet_from:.2f} s on;\n"
    f"without dampers, from {decays[0].quiet_from:.2f} s on."
)
