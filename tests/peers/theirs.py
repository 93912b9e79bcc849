"""The peers' side, run in their own environment: pyFRF, sdypy-EMA and a bare reader of UFF beside our numbers."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

Row = tuple[str, float, float, str]


def estimators(ours: dict[str, np.ndarray]) -> Iterator[Row]:
    """Compare H1, H2, Hv and coherence with pyFRF's, block by block."""
    from pyFRF import FRF

    def theirs(blocks: np.ndarray, window: str) -> FRF:
        size = blocks.shape[2]
        peer = FRF(int(ours["rate"]), exc_type="d", resp_type="d", window=window, fft_len=size)
        peer.add_data(blocks[:, 3:4], blocks[:, :3])
        return peer

    peer = theirs(ours["blocks"], "none")
    keep = np.isin(np.round(peer.get_f_axis(), 6), np.round(ours["random_frequency"], 6))
    h1, h2, hv = (getattr(peer, f"get_{name}")()[:, 0, keep] for name in ("H1", "H2", "Hv"))
    yield "H1, pyFRF", largest(ours["H1"], h1), 1e-9, "same blocks and window"
    yield "H2, pyFRF", largest(ours["H2"], h2), 1e-9, "same blocks and window"
    mean = np.sqrt(abs(h1) * abs(h2)) * np.exp(1j * np.angle(h1))
    yield "Hv, pyFRF's H1 and H2", largest(ours["Hv"], mean), 1e-9, "ours is their geometric mean"
    middle = largest(ours["Hv"], hv) / largest(h2, h1)
    yield (
        "Hv, pyFRF's own / (H2 - H1)", middle, 1.0,
        "theirs takes noise of the same size in both channels, ours in proportion: both lie between H1 and H2",
    )  # fmt: skip
    coherence = peer.get_coherence()
    coherence = coherence[:, 0, keep] if coherence.ndim == 3 else coherence[:, keep]
    yield ("coherence, pyFRF", float(np.max(abs(ours["coherence"] - coherence))), 1e-9, "same blocks and window")
    window = theirs(ours["raw_blocks"], "hann")
    off = largest(ours["H1"], window.get_H1()[:, 0, keep], np.median)
    yield (
        "H1, pyFRF with its window (median)", off, 2e-3,
        "its Hann window is symmetric, ours periodic: they differ by a part in the block's length",
    )  # fmt: skip


def poles(ours: dict[str, np.ndarray]) -> Iterator[Row]:
    """Compare poles and shapes with sdypy-EMA's."""
    from sdypy.EMA import Model

    keep = ours["hit_frequency"] <= 70.0
    frequency, frf = ours["hit_frequency"][keep], ours["accelerance"][:, keep]
    # It takes the first line for that of 0 Hz, which ours is not: frequencies count from there.
    shift = float(frequency[0])
    frequency = frequency - shift
    peer = Model(frf, frequency, lower=8.0 - shift, upper=60.0 - shift, pol_order_high=20, frf_form="accelerance")
    peer.get_poles(show_progress=False)
    # Of its stabilization chart the highest order, and in that the poles nearest to ours.
    order = len(peer.pole_freq) - 1
    chosen = [
        int(np.argmin(abs(peer.pole_freq[order] + shift - f) + 1e3 * (peer.pole_xi[order] <= 0)))
        for f in ours["pole_Hz"]
    ]
    peer.pole_ind = [[order, one] for one in chosen]
    result, damping = peer.pole_freq[order][chosen], peer.pole_xi[order][chosen]
    damping, result = damping * result / (result + shift), result + shift
    # The exponential window of the hits is in the curves that both were given; ours has been taken off.
    for mode in range(result.size):
        yield (
            f"mode {mode + 1}, frequency, sdypy-EMA", abs(result[mode] / ours["pole_Hz"][mode] - 1), 2e-4,
            f"{result[mode]:.5f} and {ours['pole_Hz'][mode]:.5f} Hz",
        )  # fmt: skip
        yield (
            f"mode {mode + 1}, damping ratio, sdypy-EMA", abs(damping[mode] / ours["pole_damping"][mode] - 1), 2e-2,
            f"{100 * damping[mode]:.4f} and {100 * ours['pole_damping'][mode]:.4f} %",
        )  # fmt: skip
    _, constants = peer.get_constants()
    for mode in range(result.size):
        a, b = constants[:, mode], ours["shapes"][:, mode]
        mac = abs(np.vdot(a, b)) ** 2 / (np.vdot(a, a).real * np.vdot(b, b).real)
        yield f"mode {mode + 1}, 1 - MAC, sdypy-EMA", 1.0 - mac, 1e-3, "shapes of both"


def uff(ours: dict[str, np.ndarray], path: Path) -> Iterator[Row]:
    """Read the UFF file by its columns, with no package, and compare every sample."""
    for name, step, values in sets(path):
        samples = ours[f"samples {name}"]
        if samples.size != values.size:
            yield f"UFF, {name}", np.inf, 0.0, f"{values.size} samples read, {samples.size} written"
            continue
        off = float(np.max(abs(values - samples)) / np.max(abs(samples)))
        yield f"UFF, {name}", off, 1e-11, f"{values.size} samples, one every {step:g} s"


def sets(path: Path) -> Iterator[tuple[str, float, np.ndarray]]:
    """Read data sets 58: eleven records of eighty columns, then the values."""
    lines = path.read_text(encoding="utf-8").splitlines()
    at = 0
    while at < len(lines):
        if lines[at].strip() != "-1" or lines[at + 1].strip() != "58":
            at += 1
            continue
        head = lines[at + 2 : at + 13]
        kind, count, even = (int(head[6][10 * k : 10 * k + 10]) for k in range(3))
        step = float(head[6][43:56])
        if even != 1 or kind not in (2, 4):
            raise SystemExit(f"{path}: data type {kind}, spacing {even}: expected even, real values")
        width = 20 if kind == 4 else 13
        begin = end = at + 13
        while lines[end].strip() != "-1":
            end += 1
        values = [float(line[k : k + width]) for line in lines[begin:end] for k in range(0, len(line.rstrip()), width)]
        yield head[0].split(":")[0].strip(), step, np.array(values[:count])
        at = end + 1


def largest(ours: np.ndarray, theirs: np.ndarray, of: object = np.max) -> float:
    """Largest difference, relative to each curve's value."""
    return float(of(abs(ours - theirs) / abs(theirs)))  # type: ignore[operator]


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    warnings.simplefilter("ignore")
    numbers = dict(np.load(folder / "ours.npz"))
    rows = [*estimators(numbers), *poles(numbers), *uff(numbers, folder / "hits.uff")]
    print(f"{'compared':38s}{'difference':>12s}{'allowed':>10s}   remark")
    for what, difference, allowed, remark in rows:
        mark = "" if difference <= allowed else "   <-- TOO FAR"
        print(f"{what:38s}{difference:12.1e}{allowed:10.0e}   {remark}{mark}")
    sys.exit(any(not difference <= allowed for _, difference, allowed, _ in rows))
