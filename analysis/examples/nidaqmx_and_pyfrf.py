"""
FRFs with nidaqmx and pyFRF
===========================

A script for NI hardware writes noise to the shaker, reads force and acceleration, and hands the samples to pyFRF.

The device is simulated; the package `nidaqmx` is NI's own (pip install pyFRF).
"""

# %%
# The bench: a bracket with a shaker that applies a force, and three sensors without IEPE supply.
import matplotlib.pyplot as plt
import nidaqmx
import numpy as np
from nidaqmx.constants import AcquisitionType
from pyFRF import FRF

import daq
import rig

scene = rig.loads("""
name: bracket
structure: {masses: [4.2 kg, 1.1 kg], springs: [839 kN/m, 964 kN/m], damping: {modal: 0.7 %}}
shaker: {kind: force, body: 1}
channels:
  - {name: base, at: body 1, accelerometer: &sensor {sensitivity: 100 mV/g, noise: 20 ug/sqrt(Hz)}}
  - {name: arm, at: body 2, accelerometer: *sensor}
  - {name: force, at: shaker, hammer: {sensitivity: 11 mV/N}}
converter: {rate: 10240 Hz, bits: 24, range: 5 V}
""")
RATE, BLOCK, BLOCKS = 10240.0, 40960, 6
# Pseudo-random excitation: one block of noise from 30 to 250 Hz is repeated, so there is no leakage.
frequencies = np.fft.rfftfreq(BLOCK, 1 / RATE)
phases = np.random.default_rng(1).uniform(0.0, 2 * np.pi, frequencies.size)
block = np.fft.irfft(np.where((frequencies > 30) & (frequencies < 250), np.exp(1j * phases), 0.0))
noise = np.tile(block / block.std(), BLOCKS)

# %%
# Output and inputs on one clock; `clock="fast"` computes as quickly as the machine can.
with (
    daq.connect(scene, clock="fast") as bench,
    nidaqmx.Task(grpc_options=bench) as output,
    nidaqmx.Task(grpc_options=bench) as inputs,
):
    output.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
    output.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.FINITE, samps_per_chan=noise.size)
    output.triggers.start_trigger.cfg_dig_edge_start_trig("/cDAQ1/ai/StartTrigger")
    output.write(noise)
    output.start()
    inputs.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0:2")
    inputs.timing.cfg_samp_clk_timing(RATE, samps_per_chan=BLOCK * BLOCKS)
    volts = np.array(inputs.read(BLOCK * BLOCKS, timeout=200.0))
# Sensitivities: 100 mV/g and 11 mV/N.
acceleration, force = volts[:2] / (0.1 / 9.80665), volts[2:] / 0.011

# %%
# H1 of all blocks except the first, which contains the transient, and the exact response of the scene.
frf = FRF(int(RATE), exc_type="f", resp_type="a", window="none", fft_len=BLOCK)
blocks = [values.reshape(-1, BLOCKS, BLOCK).swapaxes(0, 1)[1:] for values in (force, acceleration)]
frf.add_data(*blocks)
band = (frf.get_f_axis() > 40) & (frf.get_f_axis() < 220)
frequency, receptance = frf.get_f_axis()[band], frf.get_H1()[1, 0, band]
# `rig.frequency_response` needs a sine test; its level and frequency do not affect the linear response.
sine_scene = scene.replace(test={"kind": "sine", "frequency": "62 Hz", "force": "1 N"})
exact = rig.frequency_response(sine_scene, frequency).compliance[1]
axes = plt.subplots(layout="constrained")[1]
axes.semilogy(frequency, 1e6 * abs(receptance), label="nidaqmx and pyFRF, H1")
axes.semilogy(frequency, 1e6 * abs(exact), "k--", label="exact")
axes.set(xlabel="frequency / Hz", ylabel="compliance of the arm / (µm/N)", title="shaker, pseudo-random, 1 V rms")
axes.figure.legend(loc="outside lower left", ncols=2)
magnitude_error = np.median(abs(abs(receptance) / abs(exact) - 1.0))
peak = frequency[np.argmax(abs(receptance))]
print(f"resonance at {peak:.2f} Hz; median magnitude error of H1 {100 * magnitude_error:.1f} %")
