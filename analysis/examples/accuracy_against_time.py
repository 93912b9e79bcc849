"""
Accuracy against time
=====================

The longer a tone is measured, the smaller is the error due to noise.

The rehearsal shows which duration is sufficient. `analysis cost SCENE` compares integrators, filters, rates and bits in
the same manner.
"""

# %%
# A weak tone on a bracket, measured with a noisy accelerometer.
import matplotlib.pyplot as plt
import numpy as np

import analysis
import daq
import rig

BRACKET = """
name: bracket
structure: {masses: [4.2 kg, 1.1 kg], springs: [839 kN/m, 964 kN/m], damping: {modal: 0.7 %}}
shaker: {kind: force, body: 1}
test:
  {kind: stepped_sine, frequencies: [100 Hz], force: 0.2 N, settle: {tolerance: 0.01 %}, measure: {periods: PERIODS}}
channels:
  - {name: arm, at: body 2, accelerometer: {sensitivity: 100 mV/g, noise: 100 ug/sqrt(Hz)}}
  - {name: force, at: shaker, hammer: {sensitivity: 11 mV/N}}
converter: {rate: 2560 Hz, bits: 24, range: 5 V}
seed: SEED
"""


def measured(periods: int, seed: int) -> complex:
    """Return the compliance of the arm at 100 Hz from a test with one realization of the noise [m/N]."""
    scene = rig.loads(BRACKET.replace("PERIODS", str(periods)).replace("SEED", str(seed)))
    with daq.open(daq.record(scene, "tone.mcap", overwrite=True)) as recording:
        return complex(analysis.frfs(recording)["arm"].value[0])


# %%
# The error of twelve tests of each duration (root mean square). The noise is white, so that the error falls with
# 1 / √duration.
scene = rig.loads(BRACKET.replace("PERIODS", "40").replace("SEED", "0"))
exact = rig.frequency_response(scene, ["100 Hz"]).compliance[1, 0]
periods = np.array([40, 160, 640, 2560])
errors = [np.sqrt(np.mean([abs(measured(count, seed) / exact - 1.0) ** 2 for seed in range(12)])) for count in periods]
for count, error in zip(periods, errors, strict=True):
    print(f"{count} periods, {count / 100.0:.1f} s: error {100.0 * error:.2g} %")
axes = plt.subplots(layout="constrained")[1]
axes.loglog(periods / 100.0, errors, "o-", label="measured")
axes.loglog(periods / 100.0, errors[0] * np.sqrt(periods[0] / periods), "k:", label="1 / √duration")
axes.set(xlabel="duration / s", ylabel="relative error of the compliance", title="tone of 100 Hz, 0.2 N")
axes.figure.legend(loc="outside lower left", ncols=2)
