"""Compare results with pyFRF, sdypy-EMA and pyYeti, and a UFF file with a minimal reader (`make peers`).

    python tests/peers/theirs.py FOLDER

It runs in an environment with these programs. FOLDER contains the files of `tests.peers.ours`.
"""

import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

# Compared quantity, difference, largest allowed difference, remark.
Row = tuple[str, float, float, str]


def compare_frfs(ours: dict[str, np.ndarray]) -> Iterator[Row]:
    """Compare H1, H2, Hv and coherence with those of pyFRF from the same blocks."""
    from pyFRF import FRF

    def estimate(blocks: np.ndarray, window: str) -> FRF:
        block_size = blocks.shape[2]
        peer = FRF(int(ours["rate"]), exc_type="d", resp_type="d", window=window, fft_len=block_size)
        peer.add_data(blocks[:, 3:4], blocks[:, :3])
        return peer

    peer = estimate(ours["blocks"], "none")
    is_common = np.isin(np.round(peer.get_f_axis(), 6), np.round(ours["random_frequency"], 6))
    h1, h2, hv = (getattr(peer, f"get_{name}")()[:, 0, is_common] for name in ("H1", "H2", "Hv"))
    yield "H1, pyFRF", largest(ours["H1"], h1), 1e-9, "same blocks and window"
    yield "H2, pyFRF", largest(ours["H2"], h2), 1e-9, "same blocks and window"
    geometric_mean = np.sqrt(abs(h1) * abs(h2)) * np.exp(1j * np.angle(h1))
    yield "Hv, pyFRF's H1 and H2", largest(ours["Hv"], geometric_mean), 1e-9, "ours is their geometric mean"
    relative_to_interval = largest(ours["Hv"], hv) / largest(h2, h1)
    yield (
        "Hv, pyFRF's own / (H2 - H1)", relative_to_interval, 1.0,
        "pyFRF assumes equal noise in both channels, ours proportional noise: both lie between H1 and H2",
    )  # fmt: skip
    coherence = peer.get_coherence()
    coherence = coherence[:, 0, is_common] if coherence.ndim == 3 else coherence[:, is_common]
    yield ("coherence, pyFRF", float(np.max(abs(ours["coherence"] - coherence))), 1e-9, "same blocks and window")
    windowed = estimate(ours["raw_blocks"], "hann")
    yield (
        "H1, pyFRF with its window (median)", largest(ours["H1"], windowed.get_H1()[:, 0, is_common], np.median), 2e-3,
        "its Hann window is symmetric, ours periodic: the difference is inversely proportional to the block length",
    )  # fmt: skip


def compare_modes(ours: dict[str, np.ndarray]) -> Iterator[Row]:
    """Compare poles and mode shapes with those of sdypy-EMA."""
    below_70_hz = ours["hit_frequency"] <= 70.0
    frequency, damping, shapes = poles_of_sdypy(
        ours["accelerance"][:, below_70_hz], ours["hit_frequency"][below_70_hz], ours["pole_Hz"], (8.0, 60.0), 20
    )
    # The curves include the damping of the exponential window; only our damping ratios are corrected for it.
    for mode in range(frequency.size):
        yield (
            f"mode {mode + 1}, frequency, sdypy-EMA", abs(frequency[mode] / ours["pole_Hz"][mode] - 1), 2e-4,
            f"{frequency[mode]:.5f} and {ours['pole_Hz'][mode]:.5f} Hz",
        )  # fmt: skip
        yield (
            f"mode {mode + 1}, damping ratio, sdypy-EMA", abs(damping[mode] / ours["pole_damping"][mode] - 1), 2e-2,
            f"{100 * damping[mode]:.4f} and {100 * ours['pole_damping'][mode]:.4f} %",
        )  # fmt: skip
    for mode in range(frequency.size):
        value = 1.0 - mac(shapes[:, mode], ours["shapes"][:, mode])
        yield f"mode {mode + 1}, 1 - MAC, sdypy-EMA", value, 1e-3, "shapes of both"


def compare_measured(ours: dict[str, np.ndarray]) -> Iterator[Row]:
    """Compare curves and modes of recordings of other people: hits on a steel part, and a grid of rulers.

    On a curve in closed form, the damping ratios of both programs are right within 1 % (`compare_known`). Larger
    differences are due to measured curves that no linear model explains, and to poles that are not separate in them.
    """
    if "hits" in ours:
        from pyFRF import FRF

        peer = FRF(25600, exc_type="d", resp_type="d", window="none", fft_len=ours["hits"].shape[2])
        peer.add_data(ours["hits"][:, :1], ours["hits"][:, 1:])
        in_band = np.isin(peer.get_f_axis(), ours["hammer frequency"])
        difference = largest(ours["hammer frf"], peer.get_H1()[0][:, in_band])
        yield "hammer, H1, pyFRF", difference, 1e-9, "five measured hits"
        yield from compare_poles(ours, "hammer", 40)
    if "ruler frf" in ours:
        yield from compare_poles(ours, "ruler", 40)


def compare_known(ours: dict[str, np.ndarray]) -> Iterator[Row]:
    """Compare damping ratios of both programs with those of a curve in closed form."""
    natural, lines, curve = ours["closed form natural"], ours["closed form frequency"], ours["closed form frf"]
    _, theirs, _ = poles_of_sdypy(curve, lines, natural, (1.05 * lines[0], 0.95 * lines[-1]), 40)
    for mode, true in enumerate(ours["closed form damping"]):
        label, bound = f"closed form {natural[mode]:.0f} Hz, damping", ours["closed form pole_damping_expanded"][mode]
        for name, ratio in (("ours", ours["closed form pole_damping"][mode]), ("sdypy-EMA", theirs[mode])):
            remark = f"{100 * ratio:.4f} %, true {100 * true:.4f} %" + f" ± {100 * bound:.2g} %" * (name == "ours")
            yield f"{label}, {name}", abs(ratio / true - 1.0), bound / true if name == "ours" else 0.1, remark


def compare_poles(ours: dict[str, np.ndarray], name: str, order: int) -> Iterator[Row]:
    """Compare our modes of a set of curves with those of sdypy-EMA."""
    expected, ratio, lines = ours[f"{name} pole_Hz"], ours[f"{name} pole_damping"], ours[f"{name} frequency"]
    band = 1.05 * lines[0], 0.95 * lines[-1]
    frequency, damping, shapes = poles_of_sdypy(ours[f"{name} frf"], lines, expected, band, order)
    for mode, f in enumerate(expected):
        label, bound = f"{name} {f:.0f} Hz", ours[f"{name} pole_Hz_expanded"][mode]
        yield (
            f"{label}, frequency, sdypy-EMA", abs(frequency[mode] - f) / (2 * ratio[mode] * f), 0.2,
            f"in bandwidths: {frequency[mode]:.3f} and {f:.3f} Hz ± {bound:.2g} Hz",
        )  # fmt: skip
        bound = ours[f"{name} pole_damping_expanded"][mode]
        yield (
            f"{label}, damping ratio, sdypy-EMA", abs(damping[mode] / ratio[mode] - 1.0),
            max(0.3, 2.0 * bound / ratio[mode]),
            f"{100 * damping[mode]:.3f} and {100 * ratio[mode]:.3f} % ± {100 * bound:.2g} %",
        )  # fmt: skip
        if len(shapes) > 1:
            value = 1.0 - mac(shapes[:, mode], ours[f"{name} shapes"][:, mode])
            yield f"{label}, 1 - MAC, sdypy-EMA", value, 0.05, f"shapes of {len(shapes)} points"


def poles_of_sdypy(frf, frequency, near, band, order):
    """Return frequencies, damping ratios and shapes by sdypy-EMA: the poles of its highest order nearest to `near`."""
    from sdypy.EMA import Model

    # sdypy-EMA assumes that the first line is at 0 Hz: shift all frequencies by that of the first line.
    shift = float(frequency[0])
    peer = Model(
        frf, frequency - shift, lower=band[0] - shift, upper=band[1] - shift, pol_order_high=order,
        frf_form="accelerance",
    )  # fmt: skip
    peer.get_poles(show_progress=False)
    highest = len(peer.pole_freq) - 1
    chosen = [
        int(np.argmin(abs(peer.pole_freq[highest] + shift - f) + 1e3 * (peer.pole_xi[highest] <= 0))) for f in near
    ]
    peer.pole_ind = [[highest, pole] for pole in chosen]
    shifted, damping = peer.pole_freq[highest][chosen], peer.pole_xi[highest][chosen]
    _, constants = peer.get_constants()
    # The shift changes only the imaginary part of a pole.
    return shifted + shift, damping * shifted / (shifted + shift), constants


def mac(first: np.ndarray, second: np.ndarray) -> float:
    """Return the modal assurance criterion of two shapes."""
    return float(abs(np.vdot(first, second)) ** 2 / (np.vdot(first, first).real * np.vdot(second, second).real))


def compare_shock_spectrum(ours: dict[str, np.ndarray]) -> Iterator[Row]:
    """Compare the shock response spectrum with that of pyYeti, from the same samples."""
    from pyyeti import srs

    rate, q = float(ours["shock_rate"]), float(ours["shock_q"])
    samples = np.append(ours["shock"], np.zeros(int(rate / ours["shock_frequency"][0]) + 1))
    for name, peak in (("positive", "pos"), ("negative", "neg")):
        theirs = srs.srs(samples, rate, ours["shock_frequency"], q, ic="zero", peak=peak)
        yield f"SRS, {name}, pyYeti", largest(ours[f"shock_{name}"], abs(theirs)), 1e-2, "half sine of 11 ms"


def compare_uff(ours: dict[str, np.ndarray], path: Path) -> Iterator[Row]:
    """Compare every sample of the UFF file with the recording."""
    for name, interval, values in read_uff(path):
        samples = ours[f"samples {name}"]
        if samples.size != values.size:
            yield f"UFF, {name}", np.inf, 0.0, f"{values.size} samples read, {samples.size} written"
            continue
        error = float(np.max(abs(values - samples)) / np.max(abs(samples)))
        yield f"UFF, {name}", error, 1e-11, f"{values.size} samples, interval {interval:g} s"


def read_uff(path: Path) -> Iterator[tuple[str, float, np.ndarray]]:
    """Yield name, sample interval [s] and values of each dataset 58: eleven records of 80 columns, then the values."""
    lines = path.read_text(encoding="utf-8").splitlines()
    line = 0
    while line < len(lines):
        if lines[line].strip() != "-1" or lines[line + 1].strip() != "58":
            line += 1
            continue
        header = lines[line + 2 : line + 13]
        data_type, count, is_even = (int(header[6][10 * k : 10 * k + 10]) for k in range(3))
        interval = float(header[6][43:56])
        if is_even != 1 or data_type not in (2, 4):
            raise SystemExit(f"{path}: data type {data_type}, spacing {is_even}: expected real values at even spacing")
        width = 20 if data_type == 4 else 13
        begin = end = line + 13
        while lines[end].strip() != "-1":
            end += 1
        values = [float(text[k : k + width]) for text in lines[begin:end] for k in range(0, len(text.rstrip()), width)]
        yield header[0].split(":")[0].strip(), interval, np.array(values[:count])
        line = end + 1


def largest(ours: np.ndarray, theirs: np.ndarray, statistic: Callable[[np.ndarray], float] = np.max) -> float:
    """Return the largest (or another statistic) of the differences, relative to the value of each line."""
    return float(statistic(abs(ours - theirs) / abs(theirs)))


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    warnings.simplefilter("ignore")
    ours = dict(np.load(folder / "ours.npz"))
    rows = [
        *compare_frfs(ours),
        *compare_modes(ours),
        *compare_known(ours),
        *compare_measured(ours),
        *compare_shock_spectrum(ours),
        *compare_uff(ours, folder / "hits.uff"),
    ]
    print(f"{'compared':38s}{'difference':>12s}{'allowed':>10s}   remark")
    for quantity, difference, allowed, remark in rows:
        mark = "" if difference <= allowed else "   <-- TOO LARGE"
        print(f"{quantity:38s}{difference:12.1e}{allowed:10.0e}   {remark}{mark}")
    sys.exit(any(not difference <= allowed for _, difference, allowed, _ in rows))
