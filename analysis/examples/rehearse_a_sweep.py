"""
Settling time of a stepped sine
===============================

A stepped sine waits at each frequency until the transient of the previous step has decayed.

A longer wait costs bench time; a shorter wait leaves an error. This example records the same test with three settings
on the virtual bench, and compares duration and error, before the test takes place on a real bench.
"""

# %%
# The structure of Inoue, Yokomichi and Hiraki (2011) without dampers; 15 points around its second resonance
# (34.8 Hz, 0.5 % damping).
import matplotlib.pyplot as plt

import analysis
import daq
import rig

changes = {"test.from": "33 Hz", "test.to": "36.5 Hz", "test.points": 15, "converter.rate": "800 Hz"}
scene = rig.load("fig8-no-damper", changes)
print(rig.explain(scene))

# %%
# Record the test with three tolerances of the transient. As on a bench, the controller uses only the channels.
durations, frfs = {}, {}
for tolerance in ("10 %", "0.1 %", "0.001 %"):
    variant = rig.load("fig8-no-damper", {**changes, "test.settle": {"tolerance": tolerance}})
    path = daq.record(variant, "sweep.mcap", overwrite=True)
    with daq.open(path) as recording:
        durations[tolerance], frfs[tolerance] = recording.duration, analysis.frfs(recording)

# %%
# The error is the deviation from the exact response of the scene.
errors = {}
axes = plt.subplots(layout="constrained")[1]
for tolerance, response in frfs.items():
    frf = response["body3"]
    exact = rig.frequency_response(scene, frf.frequency).compliance[2]
    error = abs(frf.value / exact - 1.0)
    errors[tolerance] = float(error.max())
    axes.semilogy(frf.frequency, 100 * error, "o-", label=f"{tolerance} ({durations[tolerance]:.0f} s)")
    print(f"transient up to {tolerance}: test of {durations[tolerance]:.0f} s, largest error {100 * error.max():.2g} %")
axes.set(xlabel="frequency / Hz", ylabel="error of the compliance of body 3 / %")
axes.set_title("no damper, 2.6 N; legend: tolerance of the transient")
axes.figure.legend(loc="outside lower left", ncols=3)

# %%
# The modes of the last recording, with their uncertainties.
modes = analysis.identify(frfs["0.001 %"], count=1)
print(modes)
