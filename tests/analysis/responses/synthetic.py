"""Recordings with known content: linear motion of three bodies, computed with scipy, written by the recorder."""

from itertools import product
from pathlib import Path

import numpy as np
from scipy import signal

import rig
from daq.core.recording.recorder import Recorder
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.system.natural_modes import natural_modes
from rig.core.system.structural_model import receptance, structure_matrices

RATE = 2560.0  # Hz
NATURAL_FREQUENCIES = (13.0365, 34.7773, 49.6629)  # Hz
PLACES = {"body1": "body 1", "body2": "body 2", "body3": "body 3", "table": "table"}
SPRING = 6600.0  # N/m, between table and body 1
OVERSAMPLING = 4  # of the force in `band_noise` and `record_response`

STRUCTURE = """
name: {name}
structure:
  masses: [0.74 kg, 0.71 kg, 0.64 kg]
  springs: [24.3 kN/m, 21.8 kN/m, 19.8 kN/m]
  damping: {{modal: 0.5 %}}
shaker: {{kind: {shaker}, body: 1{spring}}}
test: {test}
converter: {{rate: 2560 Hz}}
recording: {{display: false}}
"""


def scene(test="{kind: sine, frequency: 10 Hz, force: 1 N}", shaker="table", name="linear"):
    spring = ", spring: 6.6 kN/m" if shaker == "table" else ""
    return rig.loads(STRUCTURE.format(name=name, shaker=shaker, spring=spring, test=test), where="a test")


def channels(quantity="displacement", rate=RATE, **chain):
    return [ChannelInfo(name, at, quantity, sensitivity=1.0, rate=rate, **chain) for name, at in PLACES.items()]


def write(path, scene, infos, samples, marks, rate=RATE):
    """Write samples (channels, n) in physical units and marks (kind, first, last, fields)."""
    with Recorder(path, scene, infos, rate, overwrite=True) as recorder:
        for kind, first, last, fields in sorted(marks, key=lambda mark: mark[1]):
            recorder.mark(kind, first, last, **fields)
        recorder.write(np.ascontiguousarray(samples))
    return Path(path)


def stepped_sine(path, frequencies, periods=20, level=2.6, noise=0.0, infos=None, seed=0, name="linear"):
    """Record the steady-state motion at each frequency in turn, for each spring force of `level` in N.

    `infos`: channels of the bodies, and of the table or of the force.
    """
    infos = channels() if infos is None else infos
    structure_scene = scene(name=name)
    random = np.random.default_rng(seed)
    blocks, marks, first = [], [], 0
    for force, frequency in product(np.atleast_1d(level).tolist(), frequencies):
        count = round(periods * RATE / frequency)
        motion = receptance(structure_scene, [frequency])[:, 0] * force
        motion = np.append(motion, force if infos[-1].quantity == "force" else force / SPRING + motion[0])
        orders = [info.derivative or 0 for info in infos]
        amplitudes = [
            displacement * (2j * np.pi * frequency) ** order * info.response(frequency)
            for displacement, order, info in zip(motion, orders, infos, strict=True)
        ]
        phasor = np.exp(2j * np.pi * frequency / RATE * np.arange(count))
        tones = (np.array(amplitudes)[:, None] * phasor).real
        blocks.append(tones + noise * random.standard_normal((len(infos), count)))
        fields = {"frequency": float(frequency), "level": force, "direction": "up", "settled": True}
        marks.append(("measure", first, first + count - 1, fields))
        first += count
    return write(path, structure_scene, infos, np.concatenate(blocks, axis=1), marks)


def swept_sine(path, low, high, seconds, noise=0.0):
    """Record the displacements during a logarithmic sweep of a force of 1 N between two frequencies in Hz."""
    time = np.arange(round(seconds * RATE * OVERSAMPLING)) / (RATE * OVERSAMPLING)
    force = signal.chirp(time, low, seconds, high, method="logarithmic", phi=-90)
    fields = {"from": low, "to": high, "duration": seconds, "spacing": "log", "level": 1.0, "settled": True}
    marks = [("measure", 0, round(seconds * RATE) - 1, fields)]
    test = f"{{kind: swept_sine, from: {low} Hz, to: {high} Hz, duration: {seconds} s, force: 1 N}}"
    return record_response(path, force, test, marks, noise)


def simulate(force, rate=RATE, structure_scene=None, quantity="acceleration"):
    """Return the motion of the bodies (3, samples) under a force on body 1 in N, which is linear between samples."""
    structure_scene = scene() if structure_scene is None else structure_scene
    mass, damping, stiffness = structure_matrices(structure_scene.structure)
    _, shapes = natural_modes(mass, stiffness)
    motion = np.zeros((len(mass), force.size))
    for shape in shapes.T:
        m, c, k = (shape @ matrix @ shape for matrix in (mass, damping, stiffness))
        a, b = np.array([[0.0, 1.0], [-k / m, -c / m]]), np.array([[0.0], [shape[0] / m]])
        output, feedthrough = (a[1:], b[1:]) if quantity == "acceleration" else (np.eye(1, 2), np.zeros((1, 1)))
        discrete = signal.cont2discrete((a, b, output, feedthrough), 1.0 / rate, "foh")
        numerator, denominator = signal.ss2tf(*discrete[:4])
        motion += np.outer(shape, signal.lfilter(numerator[0], denominator, force))
    return motion


def impulses(path, hits=1, interval=6.0, noise=0.0, name="linear", hammer=True, rebound=()):
    """Record half-sine hits on body 1 and the free decays after them; hits listed in `rebound` are double hits."""
    # Samples from hit to hit, of a hit, and before the first hit.
    count, width, samples_before = round(interval * RATE), 16, 640
    force = np.zeros(samples_before + hits * count)
    marks = []
    for hit in range(hits):
        first = samples_before + hit * count
        force[first : first + width] = 50.0 * np.sin(np.pi * np.arange(width) / width)
        if hit + 1 in rebound:
            force[first + 60 : first + 60 + width] += 20.0 * np.sin(np.pi * np.arange(width) / width)
        marks.append(("hit", first, first + width - 1, {"number": hit + 1, "body": 1}))
    infos = [info for info in channels("acceleration") if info.at != "table"]
    samples = simulate(force)
    if hammer:
        infos.append(ChannelInfo("hammer", "hammer", "force", sensitivity=1.0, rate=RATE))
        samples = np.vstack([samples, force])
    samples = samples + noise * np.random.default_rng(0).standard_normal(samples.shape)
    structure_scene = scene("{kind: impulse, body: 1, peak: 50 N, width: 6.25 ms}", name=name)
    return write(path, structure_scene, infos, samples, marks)


def band_noise(seconds, low, high, seed=0):
    """Return periodic Gaussian noise between two frequencies in Hz, with an rms value of 1, at the oversampled rate."""
    rate = RATE * OVERSAMPLING
    count = int(seconds * rate)
    random = np.random.default_rng(seed)
    frequency = np.fft.rfftfreq(count, 1 / rate)
    in_band = (frequency >= low) & (frequency <= high)
    spectrum = np.where(in_band, random.standard_normal(in_band.size) + 1j * random.standard_normal(in_band.size), 0)
    noise = np.fft.irfft(spectrum, count)
    return noise / noise.std()


def record_response(path, force, test, marks, noise=0.0):
    """Record displacements and force, which is given at `OVERSAMPLING` times the rate; noise is relative to the rms."""
    motion = simulate(force, RATE * OVERSAMPLING, quantity="displacement")
    samples = np.vstack([motion, force])[:, ::OVERSAMPLING]
    rms = np.sqrt(np.mean(samples**2, axis=1, keepdims=True))
    samples = samples + noise * rms * np.random.default_rng(1).standard_normal(samples.shape)
    infos = [info for info in channels() if info.at != "table"]
    infos.append(ChannelInfo("force", "hammer", "force", sensitivity=1.0, rate=RATE))
    return write(path, scene(test, shaker="force"), infos, samples, marks)
