"""Charts in addition to those of Inoue, Yokomichi, Hiraki (2011).

They show the region in which claim C2 holds, the best designs, and the error of the approximate method.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from analysis.studies.paper.figures import BLACK, BLUE, GRAY, GREEN, RED, Columns, Parts
from rig.core.base.figure_style import new_figure
from rig.core.base.figure_types import Axes, Figure

if TYPE_CHECKING:
    from matplotlib.image import AxesImage


def region_of_c2(parts: Parts) -> Figure:
    """Draw the region in which three dampers reduce the single damper's peak by a factor of 2.5 to 4."""
    from matplotlib.patches import Rectangle

    single, three = parts["scan-single"], parts["scan-three"]
    ratio = single["peak"] / three["peak"]
    with new_figure(4.0) as figure:
        axes = figure.subplots()
        texts = np.vectorize("{:.1f}".format)(ratio)
        image = _draw_map(axes, single, ratio, "viridis", 1.0, 5.0, texts, ratio < 3.4, 8)
        for i, j in np.argwhere(holds_c2(parts)):
            axes.add_patch(Rectangle((j - 0.47, i - 0.45), 0.94, 0.90, fill=False, ec=RED, lw=2))
        axes.set_title("C2: peak with one damper over peak with three (framed: the claim holds)")
        figure.colorbar(image, ax=axes, label="ratio of peaks, body 2", extend="max")
    return figure


def holds_c2(parts: Parts) -> np.ndarray:
    """Return the cells of the scan in which all statements of claim C2 are true.

    The peak ratio is 2.5 to 4. One damper shows motion of Type III. Three dampers show Types I and II, and at the peak
    only these types, or rest on the floor.
    """
    single, three = parts["scan-single"], parts["scan-three"]
    ratio = single["peak"] / three["peak"]
    has_types_i_and_ii = np.vectorize(lambda text: {"I", "II"} <= set(text.split()))(three["types"])
    only_these_at_peak = np.vectorize(lambda text: set(text.split("/")) <= {"I", "II", "riding"})(three["type_at_peak"])
    return (ratio >= 2.5) & (ratio <= 4.0) & has_type_iii(single) & has_types_i_and_ii & only_these_at_peak


def has_type_iii(scan: Columns) -> np.ndarray:
    """Return the cells in which a damper shows Type III at some frequency."""
    return np.vectorize(lambda text: "III" in text.split())(scan["types"])


def design(parts: Parts) -> Figure:
    """Draw the design chart: peak compliance and type of motion at the peak, against clearance and force."""
    with new_figure(6.8) as figure:
        rows = figure.subplots(2, 1)
        for axes, name, title in (
            (rows[0], "scan-single", "Third mode, one damper in body 2"),
            (rows[1], "scan-three", "Third mode, three dampers"),
        ):  # fmt: skip
            data = parts[name]
            # A tilde marks peaks of irregular motion, which are simulated and averaged; all others are exact orbits.
            cells = zip(data["peak"].flat, abbreviate_types(data["type_at_peak"]).flat, data["exact"].flat, strict=True)
            labels = [f"{'' if exact else '~'}{1e6 * peak:.0f}\n{kind}" for peak, kind, exact in cells]
            texts, peak = np.array(labels).reshape(data["peak"].shape), data["peak"]
            image = _draw_map(axes, data, 1e6 * peak, "magma_r", 40.0, 450.0, texts, peak > 2.4e-4, 7)
            axes.set_title(f"{title}: peak |X₂/F₁|, and the motion there (~ irregular)")
            figure.colorbar(image, ax=axes, label="µm/N", extend="max")
    return figure


def abbreviate_types(types: np.ndarray) -> np.ndarray:
    """Abbreviate types of motion for a cell; types except riding and I to III become "other"."""

    def abbreviate(text: str) -> str:
        kinds = text.split("/")
        named = [kind for kind in kinds if kind in ("I", "II", "III", "riding")]
        printed = named if len(named) == len(kinds) else [*named, "other"]
        return "/".join("r" if kind == "riding" else kind for kind in dict.fromkeys(printed))

    return np.vectorize(abbreviate)(types)


def approximation_error_chart(parts: Parts) -> Figure:
    """Draw the error of the peak of the approximate method, relative to exact orbits or simulation."""
    error = approximation_error(parts)
    with new_figure(3.8) as figure:
        axes = figure.subplots()
        texts = np.where(np.isfinite(error), np.vectorize("{:+.0f} %".format)(error), "none")
        image = _draw_map(axes, parts["scan-single"], error, "RdBu_r", -30.0, 30.0, texts, abs(error) > 18, 7.5)
        axes.set_title("Approximate method: error of its peak (one damper in body 2, third mode)")
        figure.colorbar(image, ax=axes, label="% of the simulated peak", extend="both")
    return figure


def approximation_error(parts: Parts) -> np.ndarray:
    """Compute the error of the approximate peak in % of the simulated peak, (forces, clearances)."""
    return np.asarray(100 * (parts["approx-peaks"]["peak"] / parts["scan-single"]["peak"] - 1))


def optimum(parts: Parts) -> Figure:
    """Draw the worst peak over a range of forces against clearance, for several mass ratios."""
    with new_figure(3.8) as figure:
        axes = figure.subplots()
        names = sorted(name for name in parts if name.startswith("best-"))
        for name, shade in zip(names, (BLUE, GREEN, RED), strict=False):
            data = parts[name]
            order = np.argsort(data["clearance"])
            axes.semilogx(
                1e3 * data["clearance"][order], 1e6 * data["worst"][order], "o-", color=shade, ms=3,
                label=f"mass ratio {100 * data['mass_ratio']:.0f} %: best {1e3 * data['best']:.2f} mm",
            )  # fmt: skip
        best = parts["optimum"]
        ratios = best["mass_ratios"]
        axes.plot(
            1e3 * best["best"], 1e6 * best["peak"], "*", color=BLACK, ms=11,
            label=f"{'heaviest' if best['mass_ratio'] >= ratios.max() else 'best'} of {100 * ratios.min():.0f} to "
            f"{100 * ratios.max():.0f} %: {100 * best['mass_ratio']:.0f} %, {1e3 * best['best']:.2f} mm",
        )  # fmt: skip
        axes.axvline(0.98, color=GRAY, ls=":", lw=0.9, label="paper: 0.98 mm")
        ticks = [0.3, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0]
        axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
        axes.set_xticks([], minor=True)
        axes.set(xlabel="clearance / mm", ylabel="worst peak of |X₂/F₁| / (µm/N)")
        axes.set_title("Best clearance for the third mode, for forces of 0.8 to 1.25 times 3.3 N")
        axes.legend()
    return figure


def _draw_map(
    axes: Axes,
    data: Columns,
    values: np.ndarray,
    colormap: str,
    low: float,
    high: float,
    texts: np.ndarray,
    has_white_text: np.ndarray,
    font_size: float,
) -> AxesImage:
    """Draw values as colors against clearance and force, with a text in each cell."""
    image = axes.imshow(values, origin="lower", aspect="auto", cmap=colormap, vmin=low, vmax=high)
    for (i, j), text in np.ndenumerate(texts):
        axes.text(
            j, i, text, ha="center", va="center", fontsize=font_size, color="white" if has_white_text[i, j] else BLACK
        )
    axes.grid(False)
    axes.set_xticks(range(values.shape[1]), [f"{1e3 * c:g}" for c in data["clearance"]])
    axes.set_yticks(range(values.shape[0]), [f"{f:g}" for f in data["force"]])
    axes.set(xlabel="clearance / mm", ylabel="force F₁ / N")
    return image
