"""
Import a measured file and fit a model
======================================

Measurements of another program become a recording.

A first guess of the structure is then fitted, with 95 % intervals of its values.
"""

# %%
# In place of a file of another program, a recording of the repository is written as a CSV table of time histories.
import csv
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import analysis
import daq

with daq.open("recordings/demo-impulse-no-damper.mcap") as recording:
    scene, rate, names = recording.scene, recording.rate, list(recording.channels)
    samples = np.array([recording.read(name, 0, recording.samples) for name in names])
with Path("bench.csv").open("w", newline="", encoding="utf-8") as file:
    writer = csv.writer(file)
    writer.writerow(["time", *names])
    writer.writerows(np.column_stack([np.arange(samples.shape[1]) / rate, samples.T]).tolist())

# %%
# Import: the scene defines the channels, and an assignment columns and units. The impact is detected in the force.
units = {name: "N" if name == "hammer" else "m/s^2" for name in names}
assignment = "".join(f"{name}: {{column: {name}, unit: {unit}}}\n" for name, unit in units.items())
Path("channels.yaml").write_text(assignment, encoding="utf-8")
path = daq.import_files("bench.csv", scene, "bench.mcap", table="channels.yaml", overwrite=True)
with daq.open(path) as imported:
    hits = [marker for marker in imported.markers if marker.kind == "hit"]
    frfs = analysis.frfs(imported)
print(f"{len(hits)} impact, at {hits[0].first_sample / rate:.3f} s")

# %%
# Fit masses, springs and damping, from a guess with 10 % errors.
guess = scene.replace(structure=scene.structure.replace(masses=["0.81 kg", "0.64 kg", "0.70 kg"]))
fit = analysis.fit(path, guess)
print(fit)
axes = plt.subplots(layout="constrained")[1]
frf = frfs["body3"].band(5.0, 60.0)
axes.semilogy(frf.frequency, 1e6 * abs(frf.value), lw=4, alpha=0.35, label="imported")
# The model as the sensor of body 3 would read it.
(compared,) = fit.compared
order = np.argsort(compared.curves.frequency)
shown = order[abs(compared.curves.frequency[order] - 32.5) < 27.5]
axes.semilogy(compared.curves.frequency[shown], 1e6 * abs(compared.predicted[2, shown]), "--", label="fitted model")
axes.set(xlabel="frequency / Hz", ylabel="compliance of body 3 / (µm/N)", title="impact test without dampers, 200 N")
axes.figure.legend(loc="outside lower left", ncols=2)
