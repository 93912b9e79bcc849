"""
Impact test: double impacts and clipping
========================================

A rebound of the hammer and a range that is too small are the two common faults of an impact test.

Here both are simulated, so their effect on the response is known.
"""

# %%
# A bracket of two bodies, hit on its base. The second test has a rebound after 25 ms, the third a range of 1 V.
import matplotlib.pyplot as plt
import numpy as np

import analysis
import daq
import rig

BRACKET = """
name: bracket
structure: {masses: [4.2 kg, 1.1 kg], springs: [839 kN/m, 964 kN/m], damping: {modal: 0.7 %}}
test: {kind: impulse, body: 1, peak: 200 N, width: 2 ms, repeats: 3, interval: 2 s}
channels:
  - {name: base, at: body 1, accelerometer: &sensor {sensitivity: 100 mV/g, noise: 20 ug/sqrt(Hz)}}
  - {name: arm, at: body 2, accelerometer: *sensor}
  - {name: hammer, at: hammer, hammer: {sensitivity: 11 mV/N}}
converter: {rate: 5120 Hz, bits: 24, range: 5 V}
"""
tests = {
    "clean impacts": BRACKET,
    "double impacts": BRACKET.replace("interval: 2 s", "interval: 2 s, double_hit: {after: 25 ms, ratio: 0.5}"),
    "clipped": BRACKET.replace("range: 5 V", "range: 1 V"),
}

# %%
# Force and response of each test. The force spectrum of a double impact has deep minima, at which noise dominates.
figure, (above, below) = plt.subplots(2, layout="constrained")
overloads, peaks = {}, {}
for name, text in tests.items():
    path = daq.record(rig.loads(text), "hits.mcap", overwrite=True)
    with daq.open(path) as recording:
        hit = next(marker for marker in recording.markers if marker.kind == "hit").first_sample
        force, arm = (recording.read(channel, hit, hit + 4096) for channel in ("hammer", "arm"))
        overloads[name] = sum(marker.kind == "overload" for marker in recording.markers)
        # The spectrum of the force [N s] at 0 to 2560 Hz.
        spectrum = abs(np.fft.rfft(force)) / recording.rate
        frequency = np.fft.rfftfreq(force.size, 1 / recording.rate)
        above.semilogy(frequency, spectrum, label=name)
        try:
            frf = analysis.frfs(recording)["arm"]
        except rig.RecordingError as error:
            print(f"{name}: {error}")
            # The ratio of the clipped spectra: acceleration, hence the division by the squared angular frequency.
            shown = (frequency > 10) & (frequency < 400)
            ratio = (
                abs(np.fft.rfft(arm))[shown] / recording.rate / spectrum[shown] / (2 * np.pi * frequency[shown]) ** 2
            )
            below.semilogy(frequency[shown], 1e6 * ratio, "--")
            continue
    below.semilogy(frf.frequency, 1e6 * abs(frf.value), label=name)
    peaks[name] = float(frf.frequency[np.argmax(abs(frf.value))])
    print(
        f"{name}: highest peak at {peaks[name]:.2f} Hz, minimum of the force spectrum {spectrum[:1600].min():.1e} N s"
    )
above.set(xlim=(0, 400), ylim=(1e-2, 1), ylabel="force / (N s)")
below.set(xlim=(0, 400), ylim=(1e-3, 1e3), xlabel="frequency / Hz", ylabel="compliance / (µm/N)")
above.set_title("hammer, 200 N")
figure.legend(*above.get_legend_handles_labels(), loc="outside lower left", ncols=3)
