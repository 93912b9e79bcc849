"""
Integrators and AC coupling at low frequencies
==============================================

Accelerometers, integrating amplifiers and AC-coupled inputs are high-passes. The analysis divides by their known
response. What remains is noise.
"""

# %%
# Three chains from acceleration to the recording: a DC-coupled input, an AC-coupled one, and a double integrator.
import matplotlib.pyplot as plt
import numpy as np

import analysis
import daq
import rig

base = rig.load(
    "fig8-no-damper",
    {
        "test": {"kind": "stepped_sine", "from": "1 Hz", "to": "10 Hz", "points": 8, "spacing": "log", "drive": "0.5 V",
                 "measure": {"periods": 5}, "settle": {"tolerance": "1 %"}},
        "converter.rate": "800 Hz",
    },
)  # fmt: skip
plain = [channel.replace(integrator=None) for channel in base.channels or ()]
chains = {
    "accelerometer, DC input": base.replace(channels=plain),
    "accelerometer, AC input": base.replace(
        channels=plain, converter=base.converter.replace(coupling="AC", ac_corner="3 Hz")
    ),
    "accelerometer and double integrator": base,
}

# %%
# The response of each chain to the true quantity, and the compliance computed with it, against the exact one.
figure, (above, below) = plt.subplots(2, sharex=True, layout="constrained", figsize=(6.4, 6.4))
shown, errors = np.geomspace(0.2, 20, 200), {}
for name, scene in chains.items():
    with daq.open(daq.record(scene, "low.mcap", overwrite=True)) as recording:
        response = recording.channels["body3"].response(shown)
        frf = analysis.frfs(recording)["body3"]
    exact = rig.frequency_response(scene, frf.frequency).compliance[2]
    above.loglog(shown, abs(response), label=name)
    below.loglog(frf.frequency, abs(frf.value / exact - 1), "o-", label=name)
    errors[name] = abs(frf.value / exact - 1)
    print(f"{name}: reads {100 * abs(response[0]):.0f} % at 0.2 Hz; error {errors[name][0]:.1e} at 1 Hz")
above.set(ylabel="reading / true value", ylim=(1e-3, 2))
above.legend()
below.set(xlabel="frequency / Hz", ylabel="relative error of the compliance")
