"""
Accuracy against time
=====================

The longer a tone is measured, the smaller is the error due to noise.

The rehearsal shows which duration is sufficient. `analysis cost SCENE` compares integrators, filters, rates and bits in
the same manner.
"""

# %%
# One tone near the second resonance is measured over 40, 160 and 640 periods, each twelve times with different noise.
import matplotlib.pyplot as plt
import numpy as np

import analysis
import daq
import rig

tone = {
    "test": {"kind": "stepped_sine", "frequencies": ["34 Hz"], "force": "0.05 N", "settle": {"tolerance": "0.01 %"}},
    "converter.rate": "800 Hz",
}
exact = rig.frequency_response(rig.load("fig8-no-damper", tone), ["34 Hz"]).compliance[2, 0]
periods = [40, 160, 640]
seconds, errors = [], []
for count in periods:
    values = []
    for seed in range(12):
        scene = rig.load("fig8-no-damper", {**tone, "test.measure": {"periods": count}, "seed": seed})
        with daq.open(daq.record(scene, "tone.mcap", overwrite=True)) as recording:
            values.append(analysis.frfs(recording)["body3"].value[0])
    seconds.append(count / 34.0)
    errors.append(float(np.sqrt(np.mean(abs(np.array(values) / exact - 1.0) ** 2))))
    print(f"{count} periods, {seconds[-1]:.1f} s: error {100 * errors[-1]:.3g} %")

# %%
# The sensors integrate acceleration to displacement, so that most of the noise lies near 1 Hz, far below the tone.
# Its leakage to the tone falls with 1 / duration (dotted). White noise would fall with 1 / √duration (dashed).
axes = plt.subplots(layout="constrained")[1]
axes.loglog(seconds, errors, "o-", label="measured")
shorter = seconds[0] / np.array(seconds)
axes.loglog(seconds, errors[0] * shorter, "k:", label="1 / duration")
axes.loglog(seconds, errors[0] * np.sqrt(shorter), "k--", label="1 / √duration (white noise)")
axes.set(xlabel="duration of the measurement / s", ylabel="relative error of the compliance")
axes.legend()
