"""Claim C4 of the paper, about Fig 9: motion types; agreement of approximate method, exact motion and recording."""

from __future__ import annotations

import numpy as np

from analysis.reproduction.claim import Claim, Evidence
from analysis.reproduction.figures import Columns, Parts

# Largest relative difference of peaks that agree: the reading accuracy of a figure.
MAX_PEAK_DIFFERENCE = 0.05


def fig9_claim(parts: Parts) -> Claim:
    """Assess C4 by approximation, exact orbits and recording."""
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
    phi, tau = _phase_distance(exact, measured, "phi"), _phase_distance(exact, measured, "tau_1")
    only_type_2 = not ((exact["type"] == "III") & exact["stable"]).any()
    over_damping = parts["fig9-damping"]
    column = int(np.abs(over_damping["clearance"] - 0.98e-3).argmin())
    dampings_without_iii = over_damping["damping"][~over_damping["has_type_iii"][:, column]]
    absent_for = (
        f"damping of {100 * dampings_without_iii.min():g} % and more"
        if dampings_without_iii.size
        else "none of the damping ratios tried"
    )
    evidence = (
        Evidence(
            f"Type II: approximate method {ranges['II'][0]}, exact orbits {ranges['II'][1]}. Type III: approximate "
            f"{ranges['III'][0]}, exact orbits {ranges['III'][1]}.",
            ("approx-fig9", "orbit-fig9"),
        ),
        Evidence(
            f"Peak compliance of body 2: approximate {1e6 * approximate_peak:.1f}, exact {1e6 * exact_peak:.1f}, "
            f"recording {1e6 * measured_peak:.1f} µm/N ({100 * (approximate_peak / exact_peak - 1):+.1f} % and "
            f"{100 * (measured_peak / exact_peak - 1):+.1f} % of the exact).",
            ("approx-fig9", "orbit-fig9", "rec-fig9"),
        ),
        Evidence(
            f"Recording and exact stable orbits differ by {100 * curve_distance:.2f} % (median over the sweep) in "
            f"compliance, {np.degrees(phi):.1f}° in impact phase and {np.degrees(tau):.1f}° in ceiling-impact time "
            "(medians).",
            ("orbit-fig9", "rec-fig9"),
        ),
        Evidence(compare_directions(measured, parts["rec-fig9-down"]), ("rec-fig9", "rec-fig9-down")),
        Evidence("tau_0 is not measured, because leaving the floor causes no jump of the velocity.", ()),
        Evidence(
            f"Without Type III about the resonance, by damping ratio: {_without_type_iii(over_damping)}.",
            ("fig9-damping",),
        ),
    )
    errors = {
        "approximate method": abs(approximate_peak / exact_peak - 1),
        "recording": abs(measured_peak / exact_peak - 1),
    }
    disagreements = [
        f"the {name}'s peak deviates by {100 * error:.0f} % from the exact one"
        for name, error in errors.items()
        if error > MAX_PEAK_DIFFERENCE
    ]
    agreements = [name for name, error in errors.items() if error <= MAX_PEAK_DIFFERENCE]
    reasons = [
        "only Type II appears inside the resonance"
        if only_type_2
        else "Type III, with a short stay at the ceiling, takes the top of the resonance at 0.98 mm for our damping of "
        f"0.5 %, but is absent there for {absent_for}",
        *(f"the {name}'s peak agrees with exact motion within {100 * MAX_PEAK_DIFFERENCE:g} %" for name in agreements),
        *disagreements,
    ]
    return Claim(
        "C4",
        "One damper on body 2, 6 %, 0.98 mm, 3.3 N: only Type II inside the third resonance; approximate method, "
        "simulation and experiment agree.",
        evidence,
        ("holds: " if only_type_2 and not disagreements else "holds in part: ") + "; ".join(reasons),
        ("fig9",),
    )


def compare_directions(up: Columns, down: Columns) -> str:
    """Compare a downward sweep with an upward sweep, body 2."""
    rising, falling = np.argsort(up["frequency"]), np.argsort(down["frequency"])
    upward, downward = abs(up["compliance"][1][rising]), abs(down["compliance"][1][falling])
    change = 100.0 * abs(downward / upward - 1.0)
    ambiguous = up["frequency"][rising][change > 100.0 * MAX_PEAK_DIFFERENCE]
    listed = ", ".join(f"{f:.2f}" for f in ambiguous)
    extent = f"more than {100 * MAX_PEAK_DIFFERENCE:g} % at {listed} Hz, where two motions are possible"
    return (
        "The compliance of body 2 swept downward differs from the compliance swept upward by "
        f"{np.median(change):.2f} % in the median, "
        f"{extent if ambiguous.size else f'at most {change.max():.1f} %: no branch depends on the direction'}."
    )


def _without_type_iii(over_damping: Columns) -> str:
    """Report the clearances without Type III, by damping ratio."""
    rows = []
    for damping, third in zip(over_damping["damping"], over_damping["has_type_iii"], strict=True):
        clearances = [f"{1e3 * c:g}" for c in over_damping["clearance"][~third]]
        rows.append(
            f"{100 * damping:g} %: {'/'.join(clearances) + ' mm' if clearances else 'none of the clearances tried'}"
        )
    return "; ".join(rows)


def _frequency_range(data: Columns, selected: np.ndarray, kind: str) -> str:
    """Return the frequency range of a motion type."""
    frequency = data["frequency"][selected & (data["type"] == kind)]
    return f"{frequency.min():.2f} to {frequency.max():.2f} Hz" if frequency.size else "nowhere"


def _nearest_orbit(exact: Columns, frequency: float, value: complex) -> tuple[int, float]:
    """Return the stable exact orbit nearest to a measured compliance of body 2, and the relative distance."""
    candidates = exact["stable"] & (np.abs(exact["frequency"] - frequency) < 0.06)
    if not candidates.any():
        return -1, np.nan
    index = np.flatnonzero(candidates)
    distance = np.abs(np.abs(exact["compliance"][index, 1]) - abs(value)) / abs(value)
    closest = int(distance.argmin())
    return int(index[closest]), float(distance[closest])


def _phase_distance(exact: Columns, measured: Columns, name: str) -> float:
    """Return the median deviation of the measured impact phase `phi` or `tau_1` from exact orbits, rad."""
    distances = []
    rows = zip(measured["frequency"], measured["compliance"][1], measured[f"impact_{name}"], strict=True)
    for frequency, value, phase in rows:
        index, _ = _nearest_orbit(exact, frequency, value)
        if index < 0 or not np.isfinite(phase):
            continue
        exact_phase = exact["phi"][index] if name == "phi" else exact["tau"][index, 1]
        distances.append(abs(np.angle(np.exp(1j * (phase - exact_phase)))))
    return float(np.nanmedian(distances)) if distances else float("nan")
