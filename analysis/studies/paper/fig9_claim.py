"""Claim C4 of Inoue, Yokomichi, Hiraki (2011), about Fig 9.

The claim concerns the types of motion, and the agreement of the approximate method, the exact orbits and the recording.
"""

import numpy as np

from analysis.studies.paper.claim import Claim, Evidence
from analysis.studies.paper.figures import Columns, Parts

# Two peaks agree if they differ by at most this fraction, which is the accuracy of reading a figure.
MAX_PEAK_DIFFERENCE = 0.05


def fig9_claim(parts: Parts) -> Claim:
    """Assess claim C4 by results of the approximate method, exact orbits and a recording."""
    approximate, exact, measured = parts["approx-fig9"], parts["orbit-fig9"], parts["rec-fig9"]
    admissible = approximate["valid"] & approximate["stable"]
    ranges = {
        kind: [_frequency_range(approximate, admissible, kind), _frequency_range(exact, exact["stable"], kind)]
        for kind in ("II", "III")
    }
    approximate_peak = np.abs(approximate["compliance"][admissible]).max()
    exact_peak = np.abs(exact["compliance"][exact["stable"], 1]).max()
    measured_peak = np.abs(measured["compliance"][1]).max()
    pairs = zip(measured["frequency"], measured["compliance"][1], strict=True)
    curve_distance = np.nanmedian([_nearest_orbit(exact, frequency, value)[1] for frequency, value in pairs])
    phi_error, tau_error = _phase_error(exact, measured, "phi"), _phase_error(exact, measured, "tau_1")
    only_type_2 = not ((exact["type"] == "III") & exact["stable"]).any()
    over_damping = parts["fig9-damping"]
    column = int(np.abs(over_damping["clearance"] - 0.98e-3).argmin())
    dampings_without_iii = over_damping["damping"][~over_damping["has_type_iii"][:, column]]
    dependence_on_damping = (
        f"does not occur at this clearance with damping ratios of {100 * dampings_without_iii.min():g} % or more"
        if dampings_without_iii.size
        else "occurs at this clearance with every damping ratio tried"
    )
    evidence = (
        Evidence(
            f"Type II occurs at {ranges['II'][0]} (approximate method) and {ranges['II'][1]} (exact orbits). Type III "
            f"occurs at {ranges['III'][0]} (approximate method) and {ranges['III'][1]} (exact orbits).",
            ("approx-fig9", "orbit-fig9"),
        ),
        Evidence(
            f"The peak compliance of body 2 is {1e6 * exact_peak:.1f} µm/N for the exact orbits, "
            f"{1e6 * approximate_peak:.1f} µm/N for the approximate method "
            f"({100 * (approximate_peak / exact_peak - 1):+.1f} %), and {1e6 * measured_peak:.1f} µm/N in the "
            f"recording ({100 * (measured_peak / exact_peak - 1):+.1f} %).",
            ("approx-fig9", "orbit-fig9", "rec-fig9"),
        ),
        Evidence(
            "Recording and stable exact orbits differ, in the median over the sweep, by "
            f"{100 * curve_distance:.2f} % in compliance, {np.degrees(phi_error):.1f}° in the phase of the floor "
            f"impact, and {np.degrees(tau_error):.1f}° in the phase of the ceiling impact.",
            ("orbit-fig9", "rec-fig9"),
        ),
        Evidence(
            compare_directions(measured, parts["rec-fig9-down"], exact), ("rec-fig9", "rec-fig9-down", "orbit-fig9")
        ),
        Evidence("tau_0 cannot be measured, because the take-off from the floor causes no velocity jump.", ()),
        Evidence(
            "Clearances at which Type III does not occur near the resonance, for each damping ratio: "
            f"{_without_type_iii(over_damping)}.",
            ("fig9-damping",),
        ),
    )
    errors = {
        "approximate method": abs(approximate_peak / exact_peak - 1),
        "recording": abs(measured_peak / exact_peak - 1),
    }
    disagreements = [
        f"the peak of the {name} differs from the peak of the exact orbits by {100 * error:.0f} %"
        for name, error in errors.items()
        if error > MAX_PEAK_DIFFERENCE
    ]
    agreements = [name for name, error in errors.items() if error <= MAX_PEAK_DIFFERENCE]
    reasons = [
        "only Type II occurs inside the resonance"
        if only_type_2
        else "at 0.98 mm with our damping of 0.5 %, the motion at the peak of the resonance is Type III, with a short "
        f"stay at the ceiling; Type III {dependence_on_damping}",
        *(
            f"the peak of the {name} agrees with the peak of the exact orbits within {100 * MAX_PEAK_DIFFERENCE:g} %"
            for name in agreements
        ),
        *disagreements,
    ]
    return Claim(
        "C4",
        "One damper on body 2 (mass ratio 6 %, clearance 0.98 mm) at 3.3 N: inside the third resonance, only Type II "
        "occurs. Approximate method, simulation and experiment agree.",
        evidence,
        ("holds: " if only_type_2 and not disagreements else "holds in part: ") + "; ".join(reasons),
        ("fig9",),
    )


def compare_directions(up: Columns, down: Columns, exact: Columns) -> str:
    """Compare the compliances of body 2 in a downward and an upward sweep, and state the folds of the exact orbits."""
    order_up, order_down = np.argsort(up["frequency"]), np.argsort(down["frequency"])
    upward, downward = abs(up["compliance"][1][order_up]), abs(down["compliance"][1][order_down])
    change = 100.0 * abs(downward / upward - 1.0)
    ambiguous = up["frequency"][order_up][change > 100.0 * MAX_PEAK_DIFFERENCE]
    listed = ", ".join(f"{f:.2f}" for f in ambiguous)
    extent = f"by more than {100 * MAX_PEAK_DIFFERENCE:g} % at {listed} Hz, where two motions are possible"
    largest = f"by at most {change.max():.1f} %, at {up['frequency'][order_up][int(np.argmax(change))]:.2f} Hz"
    folds = [f"{f:.2f}" for f in _folds(exact) if up["frequency"].min() <= f <= up["frequency"].max()]
    at_folds = (
        f"The exact orbits have folds, next to which the motion depends on the direction, at {', '.join(folds)} Hz"
    )
    return (
        "The compliances of body 2 in the downward and the upward sweep differ by "
        f"{np.median(change):.2f} % in the median, and {extent if ambiguous.size else largest}. "
        f"{at_folds if folds else 'The exact orbits have no fold in this band'}."
    )


def _folds(exact: Columns) -> list[float]:
    """Return the frequencies at which branches turn back [Hz]."""
    folds = []
    for number in np.unique(exact["branch"]):
        frequency = exact["frequency"][exact["branch"] == number]
        turns = np.flatnonzero(np.diff(np.sign(np.diff(frequency)))) + 1
        folds += frequency[turns].tolist()
    return sorted(folds)


def _without_type_iii(over_damping: Columns) -> str:
    """Return, for each damping ratio, the clearances at which Type III does not occur, as text."""
    rows = []
    for damping, third in zip(over_damping["damping"], over_damping["has_type_iii"], strict=True):
        clearances = [f"{1e3 * c:g}" for c in over_damping["clearance"][~third]]
        rows.append(
            f"{100 * damping:g} %: {'/'.join(clearances) + ' mm' if clearances else 'none of the clearances tried'}"
        )
    return "; ".join(rows)


def _frequency_range(data: Columns, selected: np.ndarray, kind: str) -> str:
    """Return the frequency range of a type of motion, as text."""
    frequency = data["frequency"][selected & (data["type"] == kind)]
    return f"{frequency.min():.2f} to {frequency.max():.2f} Hz" if frequency.size else "no frequency"


def _nearest_orbit(exact: Columns, frequency: float, value: complex) -> tuple[int, float]:
    """Return the index of the stable orbit (-1: none) nearest to a compliance of body 2, and the relative deviation."""
    candidates = exact["stable"] & (np.abs(exact["frequency"] - frequency) < 0.06)
    if not candidates.any():
        return -1, np.nan
    index = np.flatnonzero(candidates)
    distance = np.abs(np.abs(exact["compliance"][index, 1]) - abs(value)) / abs(value)
    closest = int(distance.argmin())
    return int(index[closest]), float(distance[closest])


def _phase_error(exact: Columns, measured: Columns, name: str) -> float:
    """Return the median deviation of a measured impact phase from exact orbits [rad]; `name`: ``phi`` or ``tau_1``."""
    distances = []
    rows = zip(measured["frequency"], measured["compliance"][1], measured[f"impact_{name}"], strict=True)
    for frequency, value, phase in rows:
        index, _ = _nearest_orbit(exact, frequency, value)
        if index < 0 or not np.isfinite(phase):
            continue
        exact_phase = exact["phi"][index] if name == "phi" else exact["tau"][index, 1]
        distances.append(abs(np.angle(np.exp(1j * (phase - exact_phase)))))
    return float(np.nanmedian(distances)) if distances else float("nan")
