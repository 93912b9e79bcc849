"""
Nonlinear structures and shaker tables
======================================

Where a structure has particle dampers, its resonance depends on the amplitude.

A phase-locked tone follows the resonance (backbone), and control-based continuation follows the response at constant
force. Exact orbits show how accurate both are. On a shaker table, profiles prescribe the motion: random vibration with
notches, and shocks.
"""

# %%
# The frequency at which body 1 lags the force by 90 degrees, at three levels of force: the backbone.
import matplotlib.pyplot as plt
import numpy as np

import analysis
import daq
import rig

scene = rig.load("backbone", {"test.force": [0.5, 1.0, 1.3]})
backbone = analysis.backbone(daq.record(scene, "backbone.mcap", overwrite=True))
print(backbone)

# %%
# The response at a constant force of 1 N, measured from 51 Hz downward, and the exact orbits at this force. The
# figure has the excitation frequency of phase resonance; its error bars are smaller than the marks. Other modes
# contribute to its phase; the natural frequency printed above is corrected for them, and is about 0.1 Hz higher at
# the highest level.
band = (48.0, 51.0)
curve_test = {"kind": "continuation", "from": band[1], "to": band[0], "at": "body 1", "force": 1.0}
curve = analysis.continuation(daq.record(scene.replace(test=curve_test), "curve.mcap", overwrite=True))
tone = {"kind": "sine", "frequency": band[0], "force": 1.0}
orbits = rig.follow_orbits(scene.replace(test=tone, channels=None), "frequency", band)

axes = plt.subplots(layout="constrained")[1]
amplitudes = [abs(b.frf[0]) * [orbit.reference_amplitude for orbit in b.orbits] for b in orbits.branches]
for number, (branch, amplitude) in enumerate(zip(orbits.branches, amplitudes, strict=True)):
    label = None if number else "exact orbits"
    axes.plot(branch.value, 1e3 * amplitude, "#777777", lw=0.9, zorder=1, label=label)
axes.plot(curve.frequency, 1e3 * curve.amplitude, "s", color="#AA4499", ms=3.5, label="measured at 1 N")
backbone.draw(axes, label="backbone", color="black")
axes.figure.legend(loc="outside lower left", ncols=3)
exact = np.concatenate(amplitudes)
exact_frequency = np.concatenate([branch.value for branch in orbits.branches])
order = np.argsort(exact_frequency)
inside = (curve.frequency > band[0]) & (curve.frequency < band[1])
deviation = curve.amplitude / np.interp(curve.frequency, exact_frequency[order], exact[order]) - 1.0
largest = abs(deviation[inside]).max()
print(f"largest deviation of the {inside.sum()} measured points from exact orbits: {largest:.2%}")

# %%
# Random vibration of a shaker table with a profile. Where a limited channel would exceed its limit, the drive has a
# notch.
table = rig.load("shaker-table-random", {"test.duration": "30 s"})
profile = analysis.profile(daq.record(table, "random.mcap", overwrite=True))
axes = plt.subplots(layout="constrained")[1]
profile.draw(axes)
axes.set_ylim(0.003)
axes.legend()
print(profile)
notches = [f"{name} from {low:.4g} to {high:.4g} Hz" for name, low, high in profile.notches()]
print("notches:", ", ".join(notches))

# %%
# A shock of the table, and the shock response spectra of the table and of the unit.
shock = daq.record("shaker-table-shock", "shock.mcap", overwrite=True)
axes = plt.subplots(layout="constrained")[1]
spectra = [analysis.srs(shock, channel) for channel in ("table", "unit")]
for spectrum, color in zip(spectra, ("#CC79A7", "#009E73"), strict=True):
    spectrum.draw(axes, label=spectrum.channel, color=color)
axes.set_title("Shock response spectra (dashed: positive, dotted: negative)")
axes.legend()
print(*spectra, sep="\n")
