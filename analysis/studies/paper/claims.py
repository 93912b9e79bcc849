"""Claims C1 to C6 of Inoue, Yokomichi, Hiraki (2011), each with results of the reproduction and a verdict."""

import numpy as np

from analysis.core.damper_motion.comparison import resonance_peak
from analysis.studies.paper.bed_claim import bed_claim
from analysis.studies.paper.charts import has_type_iii, holds_c2
from analysis.studies.paper.claim import Claim, Evidence
from analysis.studies.paper.fig9_claim import fig9_claim
from analysis.studies.paper.figures import Columns, Parts
from analysis.studies.paper.parts import FIGURE_5_SETTING, NOISES
from rig.core.results import format_percent, format_quantity
from rig.core.results.response import Response
from rig.core.scene.scene import STANDARD_GRAVITY

# Natural frequencies stated in the paper [rad/s].
PAPER_OMEGA = np.array([81.9, 218.8, 312.4])
# Force of Fig 8.
FORCE_C3_N = 2.6
# C1 is true if the relative differences of the natural frequencies from those of the paper are below this value.
# Rounding of the paper's lowest frequency, 81.9 rad/s, alone is up to 0.06 %.
MAX_PAPER_DIFFERENCE = 2e-3
# Largest relative deviation of identified from computed natural frequencies in C1.
MAX_IDENTIFICATION_ERROR = 1e-3
# Largest difference of mode shapes from those of the paper in C1; the largest component of a shape is 1.
MAX_SHAPE_DIFFERENCE = 0.02
# C2: the paper states this range for the peak with one damper over the peak with three dampers.
C2_RATIOS = (2.5, 4.0)
# Smallest relative difference at antiresonances that counts as different; C5 gives no numbers.
MIN_DIFFERENCE = 0.1
# C5 also requires that the difference at antiresonances is at least this multiple of the difference at peaks.
MIN_DIFFERENCE_RATIO = 5.0
# C6 gives no number. The decay with dampers counts as faster if it is at least this number of times as fast.
MIN_SPEED_RATIO = 1.2
# Mode shapes of the paper, shape (bodies, modes).
PAPER_SHAPES = np.array([[0.415, 0.783, 1], [1, 0.498, -0.91], [-0.848, 1, -0.465]]).T


def claims(parts: Parts) -> list[Claim]:
    """Assess all claims."""
    tested = [_c1(parts), _c2(parts), _c3(parts), fig9_claim(parts), _c5(parts), _c6(parts)]
    return [*tested, bed_claim(parts, [claim for claim in tested if claim.name in ("C3", "C4", "C6")])]


def _c1(parts: Parts) -> Claim:
    """Assess natural frequencies and mode shapes of the structure without dampers."""
    theory, measured = parts["structure"], parts["rec-bare"]
    omega_error = np.abs(theory["omega"] / PAPER_OMEGA - 1).max()
    identified_error = np.abs(measured["omega"] / theory["omega"] - 1).max()
    shape_error = np.abs(theory["shapes"] - PAPER_SHAPES).max()
    identified_shape_error = np.abs(measured["shapes"] - theory["shapes"]).max()
    peaks = []
    for low, high in ((10, 16), (30, 40), (46, 55)):
        in_band = (measured["frequency"] > low) & (measured["frequency"] < high)
        highest = np.abs(measured["transfer"]).sum(axis=0)[in_band].argmax()
        peaks.append(2 * np.pi * measured["frequency"][in_band][highest])
    holds = (
        omega_error < MAX_PAPER_DIFFERENCE
        and identified_error < MAX_IDENTIFICATION_ERROR
        and shape_error < MAX_SHAPE_DIFFERENCE
    )
    return Claim(
        "C1",
        "Natural frequencies 81.9, 218.8, 312.4 rad/s and their shapes; responses of the three masses without dampers.",
        (
            Evidence(
                f"The chain of the paper's masses and springs has {_format_list(theory['omega'], 3)} rad/s, within "
                f"{100 * omega_error:.2f} % of the paper's; shapes differ by at most {shape_error:.3f}.",
                ("structure",),
            ),
            Evidence(
                f"Modes identified in the recording: {_format_list(measured['omega'], 3)} rad/s, within "
                f"{format_percent(identified_error)} of the chain's; shapes within {identified_shape_error:.3f}; "
                f"damping {_format_list(100 * measured['damping'], 2)} % (assumed: 0.5 %; the paper gives no value).",
                ("rec-bare", "structure"),
            ),
            Evidence(
                "The response to the table's motion in the same recording peaks at "
                f"{_format_list(np.array(peaks), 0)} rad/s. These are the modes of the structure with the coil "
                "spring; the paper reports the compliance without it.",
                ("rec-bare",),
            ),
        ),
        "holds" if holds else "does not hold: see the differences",
        ("fig4b",),
    )


def _c2(parts: Parts) -> Claim:
    """Assess the reduction of the third resonance by three dampers instead of one, and their types of motion."""
    holds = holds_c2(parts)
    single, three = parts["scan-single"], parts["scan-three"]
    ratio = single["peak"] / three["peak"]
    in_range = (ratio >= C2_RATIOS[0]) & (ratio <= C2_RATIOS[1])
    force, clearance = single["force"], single["clearance"]
    settings = [f"{force[i]:g} N with {1e3 * clearance[j]:g} mm" for i, j in np.argwhere(holds)]
    median_clearance = [np.median(clearance[row]) for row in holds if row.any()]
    trend = (
        ": the clearance grows with the force"
        if len(median_clearance) > 1 and (np.diff(median_clearance) > 0).all()
        else ""
    )
    cell_of_figure_5 = [
        int(np.abs(grid - value).argmin()) for grid, value in zip((force, clearance), FIGURE_5_SETTING, strict=True)
    ]
    verdict = (
        f"holds for these parameters: {int(holds.sum())} of {holds.size} combinations of force and clearance"
        if holds.any()
        else "does not hold in the scanned region"
    )
    return Claim(
        "C2",
        "With three dampers, the amplitude around the third resonance is 1/2.5 to 1/4 of that with a single damper. "
        "The single damper shows Type III, the three dampers show Types I and II.",
        (
            Evidence(
                f"The paper states no force and clearance. Scanned: forces of {force.min():g} to {force.max():g} N, "
                f"clearances of {1e3 * clearance.min():g} to {1e3 * clearance.max():g} mm, mass ratio 10 %. The peak "
                f"with one damper is {ratio.min():.2f} to {ratio.max():.2f} times the peak with three. This ratio is "
                f"2.5 to 4 for {int(in_range.sum())} of {in_range.size} combinations, and above 4 (better) "
                f"for {int((ratio > C2_RATIOS[1]).sum())}.",
                ("scan-single", "scan-three"),
            ),
            Evidence(
                "The complete claim, including only Types I and II at the peak with three dampers, is true for "
                f"{', '.join(settings) or 'no combination'}{trend}. Our Figs 5 and 6 use "
                f"{'one of these' if cell_of_figure_5 in np.argwhere(holds).tolist() else 'another combination'}: "
                f"{FIGURE_5_SETTING[0]:g} N with {1e3 * FIGURE_5_SETTING[1]:g} mm.",
                ("scan-single", "scan-three"),
            ),
            Evidence(
                f"Type III appears for {int(has_type_iii(single).sum())} combinations with one damper and for "
                f"{int(has_type_iii(three).sum())} with three. All dampers have the same clearance, so the damper "
                "in body 2, which moves most, may still show Type III at some frequencies, in addition to Types I and "
                "II. The paper shows two of these motions, b and c.",
                ("scan-single", "scan-three"),
            ),
            Evidence(_describe_type_iii(single), ("scan-single",)),
        ),
        verdict,
        ("fig3", "fig5", "fig6", "c2-region"),
    )


def _describe_type_iii(single: Columns) -> str:
    """Compare peaks of Type III with peaks of other types at the same force (paper: Type III enhances the motion)."""
    factors = []
    for peak, kind in zip(single["peak"], single["type_at_peak"], strict=True):
        is_type_iii = kind == "III"
        if is_type_iii.any() and not is_type_iii.all():
            factors.append(np.median(peak[is_type_iii]) / np.median(peak[~is_type_iii]))
    if not factors:
        return "No force has both peaks of Type III and peaks of other types."
    return (
        f"With one damper, at the same force, the median peak of Type III is {min(factors):.1f} to "
        f"{max(factors):.1f} times the median peak of the other types: Type III "
        + ("enhances the motion, as the paper says." if min(factors) > 1.0 else "does not always enhance the motion.")
    )


def resonance_peaks(data: Columns) -> np.ndarray:
    """Estimate the peak compliance of body 3 at each resonance, and its expanded uncertainty [m/N], shape (modes, 2).

    Peaks are interpolated between the points. The uncertainty is infinite if the curve does not determine the peak.
    """
    curve = Response.curve(data["frequency"], data["compliance"][2], "body3", error=data["error"][2])
    found = [resonance_peak(curve, *band) for band in ((10.5, 15.0), (30.0, 37.0), (45.0, 52.0))]
    return np.array([(np.nan, np.inf) if highest is None else (highest.value, highest.expanded) for highest in found])


def _c3(parts: Parts) -> Claim:
    """Assess which modes are damped by one, two and three dampers."""
    names = ("rec-bare", "rec-one", "rec-two", "rec-three")
    peaks, expanded = np.moveaxis(np.array([resonance_peaks(parts[name]) for name in names]), 2, 0)
    ratios_to_bare = peaks / peaks[0]
    # The errors of two recordings are independent.
    ratio_expanded = ratios_to_bare * np.hypot(expanded / peaks, expanded[0] / peaks[0])
    ratio_expanded[0] = 0.0
    # If the uncertainty of a peak is unbounded, its highest measured point is a lower bound of the peak.
    lower = ratios_to_bare - np.where(np.isfinite(ratio_expanded), ratio_expanded, 0.0)
    upper = ratios_to_bare + ratio_expanded
    least_affected = [_largest(*limits) for limits in zip(lower[1:], upper[1:], strict=True)]
    not_damped = [mode for mode in (2, 3) if not upper[1, mode - 1] < 1.0]
    not_lowered = int(np.sum(~(upper[1:] < lower[:-1])))
    peak_acceleration = peaks[0] * FORCE_C3_N * parts["structure"]["omega"] ** 2 / STANDARD_GRAVITY
    rows = [
        f"{label}: {', '.join(with_unit(*pair) for pair in zip(100.0 * row, 100.0 * errors, strict=True))}"
        for label, row, errors in zip(
            ("one damper", "two", "three"), ratios_to_bare[1:], ratio_expanded[1:], strict=True
        )
    ]
    scanned = parts["least-affected"]
    first_is_least = scanned["peak_ratio"][..., 0] > scanned["peak_ratio"][..., 1:].max(axis=-1)
    at_level = first_is_least[:, :, int(np.abs(scanned["force"] - FORCE_C3_N).argmin())]
    up_to_force = np.logical_and.accumulate(first_is_least.all(axis=(0, 1)))
    force_range = (
        f"up to {scanned['force'][up_to_force].max():g} N" if up_to_force.any() else "at none of the forces tried"
    )
    by_force = ", ".join(
        f"{force:g} N {int(cells.sum())} of {cells.size}"
        for force, cells in zip(scanned["force"], np.moveaxis(first_is_least, 2, 0), strict=True)
    )
    dampings, ratios = (", ".join(f"{100 * value:g}" for value in scanned[name]) for name in ("damping", "mass_ratio"))
    failures = [
        text
        for is_true, text in (
            (
                not not_damped,
                "the recording does not show that the single damper damps mode "
                f"{' and mode '.join(map(str, not_damped))}",
            ),
            (
                not not_lowered,
                f"{not_lowered} of {lower[1:].size} peaks are not lower than with one damper less by more than the "
                "uncertainties",
            ),
            (
                least_affected == ["1"] * 3,
                "in the recordings with one, two and three dampers, the least affected mode is "
                f"{', '.join(least_affected)}",
            ),
            (
                bool(at_level.all()),
                "with three dampers, the first mode is the least affected with every damping ratio and mass ratio "
                f"{force_range}; at {FORCE_C3_N:g} N, it is the least affected with {int(at_level.sum())} of "
                f"{at_level.size} combinations",
            ),
        )
        if not is_true
    ]
    return Claim(
        "C3",
        "With mass ratio 10 %, no ceiling and a force of 2.6 N, a single damper in body 1 already damps modes 2 and 3. "
        "More dampers increase the damping. Mode 1 is the least affected.",
        (
            Evidence(
                "Recorded peaks of body 3 at modes 1, 2 and 3, interpolated between the points, relative to the peaks "
                f"without dampers, with expanded uncertainties (95 %): {'; '.join(rows)}. The least affected mode is "
                f"{least_affected[0]} with one damper, {least_affected[1]} with two, {least_affected[2]} with three "
                "(undetermined if the 95 % intervals overlap).",
                ("rec-bare", "rec-one", "rec-two", "rec-three"),
            ),
            Evidence(
                "The paper's reason is a low acceleration in mode 1. With our damping of 0.5 %, the peaks of the bare "
                f"structure reach {', '.join(f'{a:.1f}' for a in peak_acceleration)} g at body 3, which "
                "is not low in mode 1.",
                ("rec-bare", "structure"),
            ),
            Evidence(
                f"With three dampers the first mode is the least affected in {int(first_is_least.sum())} of "
                f"{first_is_least.size} combinations of damping ratio ({dampings} %), mass ratio ({ratios} %) and "
                f"force: {by_force}.",
                ("least-affected",),
            ),
        ),
        "holds" if not failures else "holds in part: " + "; ".join(failures),
        ("fig8",),
    )


def _largest(lower: np.ndarray, upper: np.ndarray) -> str:
    """Return the number, from 1, of the largest value; "undetermined" if its interval overlaps another interval.

    >>> _largest(np.array([0.1, 0.3]), np.array([0.2, np.inf])), _largest(np.array([0.1, 0.3]), np.array([0.4, 0.5]))
    ('2', 'undetermined')
    """
    largest = int(np.argmax(lower))
    return str(largest + 1) if lower[largest] > np.delete(upper, largest).max() else "undetermined"


def with_unit(percent: float, expanded: float) -> str:
    """Format a percentage with its expanded uncertainty, or with "at least" if the uncertainty is unbounded.

    >>> with_unit(54.32, 1.24), with_unit(54.32, np.inf)
    ('(54.3 ± 1.2) %', 'at least 54 %')
    """
    return format_quantity(percent, expanded, "%") if np.isfinite(expanded) else f"at least {percent:.0f} %"


def _c5(parts: Parts) -> Claim:
    """Assess the differences of simulation and experiment at resonances and antiresonances."""
    exact = parts["sim-noise"]
    rows, differing_noises = [], []
    for noise in NOISES:
        at_antiresonances, at_peaks = differences(exact, parts[f"rec-noise-{noise}"])
        rows.append(
            f"{noise} ug/√Hz: {format_percent(at_peaks)} at peaks, {format_percent(at_antiresonances)} at "
            "antiresonances"
        )
        if at_antiresonances > MIN_DIFFERENCE and at_antiresonances > MIN_DIFFERENCE_RATIO * at_peaks:
            differing_noises.append(noise)
    names = ("sim-noise", *(f"rec-noise-{noise}" for noise in NOISES))
    return Claim(
        "C5",
        "Three dampers, mass ratio 10 %, no ceiling, 2.6 N: simulation and experiment agree near resonances and "
        "differ at antiresonances, because of the noise of the accelerometers.",
        (
            Evidence(
                "Median difference of the recorded from the exact compliance of bodies 1 and 2, for each noise density "
                f"of the accelerometers: {'; '.join(rows)}.",
                names,
            ),
            Evidence(
                "The recordings differ only in this noise. It therefore causes the differences that grow with it.",
                names,
            ),
        ),
        f"holds for accelerometers of {min(differing_noises)} ug/√Hz and more, of those tried; the paper names none"
        if differing_noises
        else f"does not hold with accelerometers of up to {max(NOISES)} ug/√Hz",
        ("fig10a",),
    )


def differences(exact: Columns, measured: Columns) -> tuple[float, float]:
    """Compute the median relative difference of compliances near antiresonances, and near peaks.

    Frequencies near antiresonances are the fifth of all frequencies with the smallest compliance of bodies 1 and 2;
    frequencies near peaks are the fifth with the largest.
    """
    at_antiresonances, at_peaks = [], []
    for body in range(2):
        magnitude = np.abs(exact["compliance"][body])
        deviation = np.abs(np.abs(measured["compliance"][body]) / magnitude - 1.0)
        order, fifth = np.argsort(magnitude), max(magnitude.size // 5, 1)
        at_antiresonances.append(deviation[order[:fifth]])
        at_peaks.append(deviation[order[-fifth:]])
    return float(np.median(at_antiresonances)), float(np.median(at_peaks))


def _c6(parts: Parts) -> Claim:
    """Assess the decay of the impulse response with dampers."""
    bare, three = parts["rec-hit-none"], parts["rec-hit-three"]
    speed_ratio = float(bare["time_of_6_db"] / three["time_of_6_db"])
    return Claim(
        "C6",
        "Impulse response: with three dampers the free oscillation dies out faster.",
        (
            Evidence(
                "After an impact on body 1 the energy of body 3's acceleration falls by 6 dB in "
                f"{1e3 * bare['time_of_6_db']:.0f} ms without dampers and in {1e3 * three['time_of_6_db']:.0f} ms "
                f"with three: {speed_ratio:.1f} times faster. It stays below 1 g from {bare['time_below_1_g']:.2f} "
                f"s and from {three['time_below_1_g']:.2f} s.",
                ("rec-hit-none", "rec-hit-three"),
            ),
        ),
        "holds" if speed_ratio > MIN_SPEED_RATIO else "does not hold",
        ("fig10b",),
    )


def _format_list(values: np.ndarray, digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)
