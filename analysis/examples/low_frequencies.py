"""
Integrators and AC coupling at low frequencies
==============================================

Accelerometers, integrating amplifiers and AC-coupled inputs act as high-pass filters.

The analysis divides the readings by the known response of these filters. The remaining error is noise.
"""

# %%
# Three measuring chains from acceleration to the recording: DC-coupled input, AC-coupled input, double integrator.
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
without_integrator = [channel.replace(integrator=None) for channel in base.channels or ()]
chains = {
    "accelerometer, DC input": base.replace(channels=without_integrator),
    "accelerometer, AC input": base.replace(
        channels=without_integrator, converter=base.converter.replace(coupling="AC", ac_corner="3 Hz")
    ),
    "accelerometer and double integrator": base,
}

# %%
# Response of each chain to the true quantity, and the error of the compliance relative to the exact compliance.
figure, (above, below) = plt.subplots(2, sharex=True, layout="constrained")
frequency, errors = np.geomspace(0.2, 20, 200), {}
for name, scene in chains.items():
    with daq.open(daq.record(scene, "low.mcap", overwrite=True)) as recording:
        response = recording.channels["body3"].response(frequency)
        frf = analysis.frfs(recording)["body3"]
    exact = rig.frequency_response(scene, frf.frequency).compliance[2]
    errors[name] = abs(frf.value / exact - 1)
    above.loglog(frequency, abs(response), label=name)
    below.loglog(frf.frequency, errors[name], "o-", label=name)
    print(
        f"{name}: reading / true value {abs(response[0]):.2f} at 0.2 Hz; compliance error {errors[name][0]:.1e} at 1 Hz"
    )
above.set(ylabel="reading / true value", ylim=(1e-3, 2))
above.set_title("no damper, drive of 0.5 V")
figure.legend(*above.get_legend_handles_labels(), loc="outside lower left", ncols=2)
below.set(xlabel="frequency / Hz", ylabel="relative error")
