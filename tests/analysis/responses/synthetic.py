"""Recordings with known content: linear motion computed with scipy, written by the real recorder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy import signal

import rig
from daq.recording.recorder import Recorder
from daq.signal_chain.channel import ChannelInfo
from rig.system.structural_model import natural_modes, receptance, structure_matrices

RATE = 2560.0
PLACES = {"body1": "body 1", "body2": "body 2", "body3": "body 3", "table": "table"}
SPRING = 6600.0

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
    """Steady motion at each frequency in turn, as channel readings."""
    infos = channels() if infos is None else infos
    structure_scene = scene(name=name)
    random = np.random.default_rng(seed)
    blocks, marks, first = [], [], 0
    for frequency in frequencies:
        count = round(periods * RATE / frequency)
        motion = receptance(structure_scene, [frequency])[:, 0] * level
        motion = np.append(motion, level / SPRING + motion[0])
        orders = [{"displacement": 0, "velocity": 1, "acceleration": 2}[info.quantity] for info in infos]
        readings = [
            x * (2j * np.pi * frequency) ** order * info.response(frequency)
            for x, order, info in zip(motion, orders, infos, strict=True)
        ]
        phase_factor = np.exp(2j * np.pi * frequency / RATE * np.arange(count))
        blocks.append(
            (np.array(readings)[:, None] * phase_factor).real + noise * random.standard_normal((len(infos), count))
        )
        fields = {"frequency": float(frequency), "level": level, "direction": "up", "settled": True}
        marks.append(("measure", first, first + count - 1, fields))
        first += count
    return write(path, structure_scene, infos, np.concatenate(blocks, axis=1), marks)


def simulate(force, rate=RATE, structure_scene=None, quantity="acceleration"):
    """Motion of the three bodies under a sampled force on body 1, exact between samples; (3, samples)."""
    structure_scene = scene() if structure_scene is None else structure_scene
    mass, damping, stiffness = structure_matrices(structure_scene.structure)
    _, shapes = natural_modes(mass, stiffness)
    out = np.zeros((len(mass), force.size))
    for shape in shapes.T:
        m, c, k = (shape @ matrix @ shape for matrix in (mass, damping, stiffness))
        a, b = np.array([[0.0, 1.0], [-k / m, -c / m]]), np.array([[0.0], [shape[0] / m]])
        row, direct = (a[1:], b[1:]) if quantity == "acceleration" else (np.eye(1, 2), np.zeros((1, 1)))
        discrete = signal.cont2discrete((a, b, row, direct), 1.0 / rate, "foh")
        numerator, denominator = signal.ss2tf(*discrete[:4])
        out += np.outer(shape, signal.lfilter(numerator[0], denominator, force))
    return out


def impulses(path, hits=1, interval=6.0, noise=0.0, name="linear", hammer=True, rebound=(), seed=0):
    """Half-sine hits on body 1 and the free decays after them."""
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
    rows = simulate(force)
    if hammer:
        infos.append(ChannelInfo("hammer", "hammer", "force", sensitivity=1.0, rate=RATE))
        rows = np.vstack([rows, force])
    rows = rows + noise * np.random.default_rng(seed).standard_normal(rows.shape)
    structure_scene = scene("{kind: impulse, body: 1, peak: 50 N, width: 6.25 ms}", name=name)
    return write(path, structure_scene, infos, rows, marks)


OVERSAMPLED = 4


def band_noise(seconds, low, high, seed=0, rate=RATE * OVERSAMPLED):
    """Gaussian noise in a band, rms 1, periodic."""
    count = int(seconds * rate)
    random = np.random.default_rng(seed)
    frequency = np.fft.rfftfreq(count, 1 / rate)
    inside = (frequency >= low) & (frequency <= high)
    spectrum = np.where(inside, random.standard_normal(inside.size) + 1j * random.standard_normal(inside.size), 0)
    wave = np.fft.irfft(spectrum, count)
    return wave / wave.std()


def driven(path, force, test, marks, noise=0.0, seed=1, settle=0, name="linear"):
    """Response of the bodies to a force given at 4 times the rate, with the force as a channel."""
    rows = np.vstack([simulate(force, RATE * OVERSAMPLED, quantity="displacement"), force])[:, ::OVERSAMPLED]
    rows = rows[:, settle:]
    size = np.sqrt(np.mean(rows**2, axis=1, keepdims=True))
    rows = rows + noise * size * np.random.default_rng(seed).standard_normal(rows.shape)
    infos = [info for info in channels() if info.at != "table"]
    infos.append(ChannelInfo("force", "hammer", "force", sensitivity=1.0, rate=RATE))
    return write(path, scene(test, shaker="force", name=name), infos, rows, marks)
