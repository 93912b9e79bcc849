"""The paper's figures, drawn from the parts of the reproduction."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from analysis.core.decays.free_decay import upper_bound
from analysis.studies.paper.parts import FIGURE_5_SETTING, NOISES
from rig.core.base.figure_style import COLORS, frequency_axis, log_axis, new_figure, set_log_scale
from rig.core.base.figure_types import Axes, Figure
from rig.core.base.palette import BODIES
from rig.core.scene.scene import STANDARD_GRAVITY

# Results of a part by name, and of all parts by their names (`analysis.studies.paper.parts`).
Columns = Mapping[str, np.ndarray]
Parts = Mapping[str, Columns]

BLUE, RED, GREEN, _, _, ORANGE, GRAY, BLACK = COLORS
# Natural frequency of the first mode [Hz]; the envelope is computed over its period.
LOWEST_MODE_HZ = 12.4
_WAVEFORM_LABEL = "time / ms     (solid: body and floor; dashed: damper; shaded: cavity)"
COMPLIANCE_LABEL = "compliance |X/F₁| / (µm/N)"


def plot_body(axes: Axes, data: Columns, body: int, mark: str = "-", **style: Any) -> None:
    """Draw the compliance of a body (from 0) against frequency."""
    axes.plot(data["frequency"], abs(data["compliance"][body]), mark, **style)


def figure_4(parts: Parts) -> Figure:
    """Draw Fig 4b: frequency responses of the three bodies without dampers, per force and per table motion."""
    theory, measured = parts["structure"], parts["rec-bare"]
    with new_figure(6.6) as figure:
        upper, lower = figure.subplots(2, 1)
        for body, shade in enumerate(BODIES[:3]):
            plot_body(upper, theory, body, color=shade, lw=0.9)
            plot_body(upper, measured, body, "o", color=shade, ms=2.2, label=f"body {body + 1}")
            lower.plot(measured["frequency"], abs(measured["transfer"][body]), "o-", color=shade, ms=2.2, lw=0.7)
        for omega in theory["omega"]:
            upper.axvline(omega / (2 * np.pi), color=GRAY, lw=0.7, ls=":")
            upper.annotate(
                f"{omega:.1f} rad/s", (omega / (2 * np.pi), 0.0), xycoords=("data", "axes fraction"),
                xytext=(3, 4), textcoords="offset points", va="bottom", ha="left", fontsize=7.5, rotation=90,
            )  # fmt: skip
        log_axis(upper, [abs(measured["compliance"])])
        set_log_scale(upper.yaxis, factor=1e6)
        log_axis(lower, [abs(measured["transfer"])])
        upper.set_title("Fig 4b: no dampers. Dots: recording; lines: exact")
        upper.set_ylabel(COMPLIANCE_LABEL)
        lower.set_title("The same recording, per table motion: the coil spring shifts the peaks")
        lower.set_ylabel("|X/X₀|")
        upper.legend(loc="upper right", ncols=3)
        for axes in (upper, lower):
            frequency_axis(axes, 8.0, 60.0, axes is lower)
    return figure


def figure_5(parts: Parts) -> Figure:
    """Draw Fig 5: one damper against three with one clearance, third mode."""
    single, three, theory = parts["sim-fig5-single"], parts["sim-fig5-three"], parts["structure"]
    with new_figure(4.4) as figure:
        axes = figure.subplots()
        in_band = (theory["frequency"] >= 45) & (theory["frequency"] <= 54)
        axes.plot(
            theory["frequency"][in_band], abs(theory["compliance"][1][in_band]), color=GRAY, lw=0.9, ls="--",
            label="no damper",
        )  # fmt: skip
        for data, shade, label in ((single, RED, "one damper, body 2"), (three, BLUE, "three dampers")):
            plot_body(axes, data, 1, color=shade, label=label)
        for letter in "abc":
            wave = parts[f"wave-{letter}"]
            data = single if letter == "a" else three
            height = np.interp(wave["frequency"], data["frequency"], abs(data["compliance"][1]))
            axes.plot(wave["frequency"], height, "o", color=BLACK, ms=4)
            axes.annotate(
                f"{letter} ({wave['type']})", (float(wave["frequency"]), height), textcoords="offset points",
                xytext=(6, 2) if letter == "a" else (-12, -14),
            )  # fmt: skip
        log_axis(axes, [abs(single["compliance"][1]), abs(three["compliance"][1]), [6.5e-4]], max_decades=2.0)
        axes.set_xlim(45, 54)
        axes.set_xlabel("frequency / Hz")
        set_log_scale(axes.yaxis, factor=1e6)
        axes.set_ylabel("compliance of body 2 |X₂/F₁| / (µm/N)")
        force, clearance = FIGURE_5_SETTING
        axes.set_title(
            f"Fig 5: third mode; mass ratio 10 %, clearance {1e3 * clearance:g} mm, force {force:g} N (our choice)"
        )
        axes.legend()
    return figure


def figure_3(parts: Parts) -> Figure:
    """Draw Fig 3: the types of motion of one body with a damper."""
    with new_figure(6.6) as figure:
        for axes, kind in zip(figure.subplots(3, 1, sharex=True), ("I", "II", "III"), strict=True):
            _draw_waveforms(axes, parts[f"type-{kind}"])
            axes.set_title(f"Type {kind}: clearance {1e3 * parts[f'type-{kind}']['clearance'][0]:g} mm")
        axes.set_xlabel(_WAVEFORM_LABEL)
    return figure


def figure_6(parts: Parts) -> Figure:
    """Draw Fig 6: waveforms at the points a, b and c of Fig 5."""
    with new_figure(6.6) as figure:
        for axes, letter in zip(figure.subplots(3, 1), "abc", strict=True):
            wave = parts[f"wave-{letter}"]
            _draw_waveforms(axes, wave)
            axes.legend(loc="upper right", ncols=3)
            axes.set_title(f"({letter}) {float(wave['frequency']):.2f} Hz: Type {wave['type']}")
        axes.set_xlabel(_WAVEFORM_LABEL)
    return figure


def _draw_waveforms(axes: Axes, wave: Columns) -> None:
    """Draw the displacements of bodies and damper masses over time."""
    t = 1e3 * wave["time"]
    for k, body in enumerate(wave["damper_body"]):
        floor = 1e3 * wave["body"][body]
        shade = BODIES[int(body)]
        axes.fill_between(t, floor, floor + 1e3 * wave["clearance"][k], color=shade, alpha=0.10, lw=0)
        axes.plot(t, floor, color=shade, label=f"body {body + 1}: {wave['types'][k]}")
        axes.plot(t, floor + 1e3 * wave["gap"][k], color=shade, lw=0.9, ls="--")
    axes.set_ylabel("displacement / mm")
    axes.set_xlim(0, t.max())
    axes.margins(y=0.22)


def figure_8(parts: Parts) -> Figure:
    """Draw Fig 8: measured response with none, one, two and three dampers."""
    curves = (
        ("rec-bare", "A: no damper", GRAY), ("rec-one", "B: one (body 1)", RED), ("rec-two", "C: two", ORANGE),
        ("rec-three", "D: three", BLUE),
    )  # fmt: skip
    with new_figure(4.8) as figure:
        axes = figure.subplots()
        for name, label, shade in curves:
            order = np.argsort(parts[name]["frequency"])
            rising = {key: parts[name][key][..., order] for key in ("frequency", "compliance")}
            plot_body(axes, rising, 2, ":" if name == "rec-bare" else "-", color=shade, label=label, lw=1.2)
        log_axis(axes, [abs(parts["rec-bare"]["compliance"][2])])
        frequency_axis(axes, 8.0, 60.0, True)
        set_log_scale(axes.yaxis, factor=1e6)
        axes.set_ylabel("compliance of body 3 |X₃/F₁| / (µm/N)")
        axes.set_title("Fig 8: recordings; mass ratio 10 %, no ceiling, force 2.6 N")
        axes.legend(loc="lower left")
    return figure


def figure_9(parts: Parts) -> Figure:
    """Draw Fig 9: one damper in body 2, third mode: approximate method, exact orbits, recording."""
    approximate, exact, measured = parts["approx-fig9"], parts["orbit-fig9"], parts["rec-fig9"]
    with new_figure(7.6) as figure:
        upper, lower = figure.subplots(2, 1, height_ratios=[1.1, 1], sharex=True)
        for name, mark, label in (("bare", "--", "no damper"), ("riding", ":", "mⱼ + mdⱼ")):
            upper.plot(approximate["dense_frequency"], abs(approximate[name]), mark, color=GRAY, lw=0.8, label=label)
        magnitude = abs(approximate["compliance"])
        _draw_branches(upper, approximate, magnitude, ORANGE, "approximate method", approximate["valid"])
        magnitude = abs(exact["compliance"][:, 1])
        _draw_branches(upper, exact, magnitude, BLUE, "exact orbits", np.isfinite(exact["frequency"]))
        plot_body(upper, measured, 1, "o", color=BLACK, ms=2.4, label="recording")
        hollow = {"mfc": "none", "color": RED, "ms": 4.5, "mew": 0.7}
        plot_body(upper, parts["rec-fig9-down"], 1, "o", label="recording, swept down", **hollow)
        upper.set_ylim(0, 2.4e-4)
        upper.yaxis.set_major_formatter(lambda value, _: f"{1e6 * value:g}")
        upper.set_ylabel("compliance of body 2 |X₂/F₁| / (µm/N)")
        upper.set_title("Fig 9: mass ratio 6 %, clearance 0.98 mm, force 3.3 N (thin: unstable)")
        upper.legend(loc="upper right")
        for data, shade, selected in (
            (approximate, ORANGE, approximate["valid"]), (exact, BLUE, np.isin(exact["type"], ["I", "II", "III"]))
        ):  # fmt: skip
            for phase in (data["phi"], data["tau"][:, 0], data["tau"][:, 1]):
                _draw_branches(lower, data, phase, shade, "", selected)
        lower.plot(measured["impact_frequency"], measured["impact_phi"], "o", color=BLACK, ms=2.4)
        lower.plot(measured["impact_frequency"], measured["impact_tau_1"], "s", color=BLACK, ms=2.4)
        for text, xy in (("φ, force phase lag at floor impact", (46.1, 5.4)), ("τ₁, ceiling impact", (49.6, 4.35)),
                            ("τ₀, leaves floor", (48.75, 0.6))):  # fmt: skip
            lower.annotate(text, xy, fontsize=8.5)
        lower.set_ylim(0, 2 * np.pi)
        lower.set_yticks(np.arange(5) * np.pi / 2, ["0", "π/2", "π", "3π/2", "2π"])
        lower.set_xlim(46, 54)
        lower.set_ylabel("phase / rad")
        lower.set_xlabel("frequency / Hz")
    return figure


def figure_10a(parts: Parts) -> Figure:
    """Draw Fig 10a: simulation against experiment, three dampers."""
    simulated, measured = parts["sim-three"], parts["rec-three"]
    with new_figure(5.4) as figure:
        upper, lower = figure.subplots(2, 1, height_ratios=[2, 1])
        plot_body(upper, simulated, 0, color=BLUE, label="simulation")
        plot_body(upper, measured, 0, "o", color=BLACK, ms=2.2, label="recording")
        magnitude, error = abs(measured["compliance"][0]), np.nan_to_num(measured["error"][0])
        low, high = np.maximum(magnitude - 2 * error, 1e-3 * magnitude), magnitude + 2 * error
        upper.fill_between(measured["frequency"], low, high, color=GRAY, alpha=0.3, lw=0)
        log_axis(upper, [abs(simulated["compliance"][0])])
        set_log_scale(upper.yaxis, factor=1e6)
        upper.set_ylabel("compliance of body 1 |X₁/F₁| / (µm/N)")
        upper.set_title("Fig 10a: three dampers, mass ratio 10 %, no ceiling, force 2.6 N")
        upper.legend(loc="lower left")
        exact = parts["sim-noise"]
        magnitude = abs(exact["compliance"][0])
        for noise, shade, mark in zip(NOISES, (BLUE, GREEN, RED), "o^s", strict=True):
            deviation = 100 * abs(abs(parts[f"rec-noise-{noise}"]["compliance"][0]) / magnitude - 1.0)
            lower.semilogy(exact["frequency"], deviation, mark, color=shade, ms=3, label=f"{noise} µg/√Hz")
        lower.set_ylabel("difference / %")
        lower.set_title("Difference between recordings and exact motion, by accelerometer noise")
        # Leave space for the legend above the points.
        lower.set_ylim(1e-3, 1e4)
        lower.legend(loc="upper left", ncols=3)
        for axes in (upper, lower):
            frequency_axis(axes, 8.0, 60.0, axes is lower)
    return figure


def figure_10b(parts: Parts) -> Figure:
    """Draw Fig 10b: free decay of body 3's acceleration after an impact on body 1."""
    with new_figure(4.2) as figure:
        axes = figure.subplots()
        for name, shade, label in (("none", GRAY, "no damper"), ("three", BLUE, "three dampers")):
            data = parts[f"rec-hit-{name}"]
            axes.plot(data["time"], data["acceleration"], color=shade, lw=0.5)
            envelope = upper_bound(data["acceleration"], 1.0 / (LOWEST_MODE_HZ * (data["time"][1] - data["time"][0])))
            for bound, entry in ((envelope, label), (-envelope, "")):
                axes.plot(data["time"], bound, color=shade, lw=1.4, label=entry)
        limits: dict[str, Any] = {"color": ORANGE, "alpha": 0.2, "lw": 0, "label": "within 1 g: dampers rest"}
        axes.axhspan(-STANDARD_GRAVITY, STANDARD_GRAVITY, **limits)
        axes.set(xlim=(0, 2.0), xlabel="time / s", ylabel="acceleration of body 3 / (m/s²)")
        axes.set_title("Fig 10b: impulse response, mass ratio 10 %, no ceiling")
        axes.legend(loc="upper right")
    return figure


def _draw_branches(axes: Axes, data: Columns, values: np.ndarray, shade: str, label: str, selected: Any) -> None:
    """Draw each branch, stable sections bold and unstable sections thin; wrapped phases are not joined."""
    for number in np.unique(data["branch"]):
        on_branch = data["branch"] == number
        for stable in (True, False):
            in_section = on_branch & selected & (data["stable"] == stable)
            # A section includes the following point, so bold and thin lines connect.
            y = np.where(in_section | (np.roll(in_section, 1) & on_branch & selected), values, np.nan)[on_branch]
            x = data["frequency"][on_branch]
            if not np.isfinite(y).any():
                continue
            jumps = np.flatnonzero(np.abs(np.diff(y)) > 3) + 1
            axes.plot(
                np.insert(x, jumps, np.nan), np.insert(y, jumps, np.nan), color=shade,
                lw=1.5 if stable else 0.6, label=label if stable else None, zorder=2,
            )  # fmt: skip
            label = "" if stable else label
