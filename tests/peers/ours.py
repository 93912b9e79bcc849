"""Recordings and results of this project, to compare with other programs: `python -m tests.peers.ours FOLDER`.

Writes `ours.npz` and `hits.uff`, which `theirs.py` reads in an environment with the other programs.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy import signal

import analysis
import daq
import rig
from analysis.core.recordings.slices import Slice
from analysis.extras.formats.export import export
from daq.core.dsp.shock_response import shock_response
from daq.core.recording.recording import Recording
from rig.core.results.response import Response
from rig.core.results.uncertainty import expand

BLOCK_S = 8.0  # length of the blocks of the FRF estimate
BODIES = ("body1", "body2", "body3")
# Recordings of other people, if they are at hand, and the bands in which their modes are compared, Hz.
MEASURED = Path(__file__).parents[3] / "shared" / "data" / "measured"
HAMMER_BAND = (600.0, 1300.0)
RULER_BAND = (60.0, 450.0)


def record(path: Path, shaker: dict[str, Any] | None, test: dict[str, Any], input_channel: dict[str, Any]) -> Recording:
    """Record a test of the structure without dampers; its sensors are ideal except for noise."""
    sensor = {"sensitivity": 0.05, "noise": 2e-3}
    channels = [{"name": name, "at": f"body {name[-1]}", "accelerometer": sensor} for name in BODIES]
    scene = rig.load("fig4-structure").replace(
        shaker=shaker,
        test=test,
        channels=[*channels, input_channel],
        converter={"rate": 2560.0, "bits": 24, "range": 10.0},
        recording={"display": False},
    )
    return daq.open(daq.record(scene, path, overwrite=True))


def estimate_frfs(folder: Path) -> dict[str, np.ndarray]:
    """Record a random test with a shaker table; return the blocks of its channels with and without window, and FRFs."""
    shaker = {"kind": "table", "body": 1, "spring": 6600.0}
    test = {"kind": "random", "from": 5.0, "to": 70.0, "duration": 120.0, "force": 1.0}
    table = {"name": "table", "at": "table", "accelerometer": {"sensitivity": 0.05, "noise": 2e-3}}
    results: dict[str, np.ndarray] = {}
    with record(folder / "random.mcap", shaker, test, table) as recording:
        for estimator in ("H1", "H2", "Hv"):
            [curves] = analysis.frequency_responses(
                recording, BODIES, reference="table", estimator=estimator, block=BLOCK_S
            )
            results[estimator] = np.stack([curve.value for curve in curves])
        results["coherence"] = np.stack([curve.coherence for curve in curves])
        results["random_frequency"] = curves[0].frequency
        [marker] = [marker for marker in recording.markers if marker.kind == "measure"]
        block_size = int(BLOCK_S * recording.rate)
        starts = range(marker.first_sample, marker.end + 2 - block_size, block_size // 2)
        blocks = np.stack(
            [[recording.read(name, start, start + block_size) for name in (*BODIES, "table")] for start in starts]
        )
        results["raw_blocks"] = blocks
        results["blocks"] = (blocks - blocks.mean(axis=2, keepdims=True)) * signal.get_window("hann", block_size)
        results["rate"] = np.array(recording.rate)
    return results


def identify_modes(folder: Path) -> dict[str, np.ndarray]:
    """Record hits with a hammer; return samples, accelerances and modes, and write the channels as a UFF file."""
    test = {"kind": "impulse", "body": 1, "peak": 100.0, "width": 4e-3, "repeats": 4, "interval": 16.0}
    hammer = {"name": "hammer", "at": "hammer", "hammer": {"sensitivity": 2e-3, "noise": 5e-3}}
    results: dict[str, np.ndarray] = {}
    with record(folder / "hits.mcap", None, test, hammer) as recording:
        [curves] = analysis.frequency_responses(recording, motion="acceleration")
        modes = analysis.identify(curves, count=3)
        export(Slice.of(recording), folder / "hits.uff", overwrite=True)
        for name in recording.channels:
            results[f"samples {name}"] = recording.read(name)
    results["hit_frequency"] = curves[0].frequency
    results["accelerance"] = np.stack([curve.value for curve in curves])
    results["pole_Hz"], results["pole_damping"], results["shapes"] = modes.frequency, modes.damping, modes.shapes
    return results


def identify_measured() -> dict[str, np.ndarray]:
    """Return hits and FRFs that were measured by other people, and our modes; empty if they are not at hand."""
    results: dict[str, np.ndarray] = {}
    hits = sorted(MEASURED.glob("pyfrf-hammer/m*.npy"))
    if hits:
        results["hits"] = np.stack([np.load(hit)[1:] for hit in hits])
        force, acceleration = np.moveaxis(np.fft.rfft(results["hits"]), 1, 0)
        h1 = np.sum(force.conj() * acceleration, axis=0) / np.sum(abs(force) ** 2, axis=0)
        lines = np.arange(1.0, h1.size)
        results |= _modes_of("hammer", [Response.curve(lines, h1[1:], "tip", motion="acceleration")], HAMMER_BAND)
    for file in MEASURED.glob("pydvma-ruler/*.mat"):
        results |= _modes_of("ruler", list(analysis.read_frfs(file, unit="m/s^2/N")), RULER_BAND)
    return results


def identify_known() -> dict[str, np.ndarray]:
    """Return a noisy curve in closed form, with modes like those of the measured hits, and our modes."""
    lines = np.arange(600.0, 1300.0)
    natural, damping = np.array([810.3, 851.6, 899.9]), np.array([1.3e-3, 1.1e-3, 1.4e-3])
    s, omega = 2j * np.pi * lines, 2 * np.pi * natural[:, None]
    value = np.sum([[1.0], [0.4], [2.0]] * s**2 / (s**2 + 2 * damping[:, None] * omega * s + omega**2), axis=0)
    random = np.random.default_rng(2)
    value += 0.1 * (random.standard_normal(lines.size) + 1j * random.standard_normal(lines.size))
    results = _modes_of("closed form", [Response.curve(lines, value, "tip", motion="acceleration")], (600.0, 1300.0))
    return results | {"closed form damping": damping, "closed form natural": natural}


def _modes_of(name: str, curves: list[Response], band: tuple[float, float]) -> dict[str, np.ndarray]:
    """Return the accelerances of a set of curves in a band, and our three most significant modes."""
    selected = [curve.to("acceleration").band(*band) for curve in curves]
    modes = analysis.identify(selected, count=3)
    return {
        f"{name} frequency": selected[0].frequency,
        f"{name} frf": np.stack([curve.value for curve in selected]),
        f"{name} pole_Hz": modes.frequency,
        f"{name} pole_damping": modes.damping,
        f"{name} pole_Hz_expanded": expand(modes.frequency_std),
        f"{name} pole_damping_expanded": expand(modes.damping_std),
        f"{name} shapes": modes.shapes,
    }


def shock_spectrum() -> dict[str, np.ndarray]:
    """Return a half sine of 100 m/s^2 and 11 ms, and its positive and negative shock response spectra."""
    rate, width, q = 20000.0, 11e-3, 10.0
    time = np.arange(round(width * rate) + 1) / rate
    frequency, pulse = np.geomspace(5.0, 1000.0, 60), 100.0 * np.sin(np.pi * time / width)
    positive, negative = shock_response([pulse], rate, frequency, q)
    return {
        "shock": pulse, "shock_rate": np.array(rate), "shock_q": np.array(q), "shock_frequency": frequency,
        "shock_positive": positive, "shock_negative": -negative,
    }  # fmt: skip


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    results = estimate_frfs(folder) | identify_modes(folder) | identify_measured()
    results |= identify_known() | shock_spectrum()
    np.savez(folder / "ours.npz", **results)  # type: ignore[arg-type]
