"""Claim C7 of Inoue, Yokomichi, Hiraki (2011), assessed by simulations of grains.

The claim: a bed of grains moves as a single mass without rebound (the single-mass model).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.studies.paper.bed_study import (
    BEDS,
    BLOCK_PERIODS,
    BLOCK_PERIODS_WITH_CEILING,
    FREQUENCY,
    point_of,
    settings,
)
from analysis.studies.paper.charts import approximation_error
from analysis.studies.paper.claim import Claim, Evidence
from analysis.studies.paper.contact_study import (
    at_shaking_frequency,
    ceiling_impulse_on_contact,
    cross_validated_deviation,
    deviation_on_contact,
    fit_contact,
    select,
    with_ceiling,
)
from analysis.studies.paper.figures import Columns, Parts

#: The single-mass model describes grains well up to this relative deviation.
GOOD_DEVIATION = 0.05
#: The single-mass model describes grains acceptably up to this relative deviation.
MAX_DEVIATION = 0.10
#: A deviation is computed if the value of the single mass (see `summary_row`) is at least this value. Smaller energies
#: and impulses are negligible: the mass rests on the floor, or does not hit the ceiling.
_MIN_MASS_VALUE = 1e-3
#: Two landings are indistinguishable in a figure if their phases differ by less than this value [degrees].
SAME_LANDING_DEG = 20.0


def bed_claim(parts: Parts, consequences: Sequence[Claim]) -> Claim:
    """Assess C7: deviations of a bed of grains from the single mass, and verdicts on consequences of the claim."""
    beds, error = parts["beds"], np.abs(approximation_error(parts))
    verdicts = ", ".join(f"{claim.name} {claim.verdict.split(':')[0]}" for claim in consequences)
    bed_sentences = [
        _describe_settings(beds),
        *(
            _describe_deviation(beds, name, label)
            for name, label in (
                ("compliance", "Compliance of the body at its peak"),
                ("floor_impulse", "Impulse of the floor in a period"),
                ("energy", "Energy dissipated in a period"),
            )
        ),
        _describe_landing(beds),
        _describe_counts(beds),
        *(
            _describe_mode(beds, frequency)
            for frequency in np.unique(beds["frequency"]).tolist()
            if frequency != FREQUENCY
        ),
    ]
    return Claim(
        "C7",
        "Restitution zero and a single mass describe the bed of 2 mm lead shot well enough.",
        (
            *(Evidence(text, ("beds",)) for text in bed_sentences),
            Evidence(_describe_contact(at_shaking_frequency(beds), parts["contacts"]), ("beds", "contacts")),
            Evidence(
                "Verdicts on the consequences of the model, which the paper measured, and which our experiment with "
                f"that model repeats: {verdicts}.",
                (),
            ),
            Evidence(
                "Error of the approximate method relative to the same model with all modes: its peak deviates by "
                f"{np.nanmedian(error):.0f} % (median) and by at most {np.nanmax(error):.0f} % over the scanned "
                "forces and clearances.",
                ("approx-peaks", "scan-single"),
            ),
        ),
        verdict(beds),
        ("c7-beds", "c7-modes", "trust"),
    )


def deviation(beds: Columns, name: str) -> NDArray[np.float64]:
    """Compute the relative deviation of a bed of grains from the single mass, shape (settings,); NaN if negligible."""
    return _relative_to_mass(beds[f"grains_{name}"] - beds[f"mass_{name}"], beds[f"mass_{name}"])


def deviation_error(beds: Columns, name: str) -> NDArray[np.float64]:
    """Compute the standard uncertainty of `deviation` over seeds, shape (settings,)."""
    return _relative_to_mass(beds[f"error_{name}"], beds[f"mass_{name}"])


def _relative_to_mass(values: np.ndarray, mass_values: np.ndarray) -> NDArray[np.float64]:
    return np.divide(values, mass_values, out=np.full(len(values), np.nan), where=mass_values > _MIN_MASS_VALUE)


def _count_within(values: np.ndarray, bound: float) -> int:
    """Return the number of values whose magnitude is at most `bound`."""
    return int((np.abs(values) <= bound).sum())


def verdict(beds: Columns) -> str:
    """Return the verdict on C7: the number of settings in which grains and single mass nearly agree."""
    deviations = deviation(beds, "compliance")
    count, acceptable = len(deviations), _count_within(deviations, MAX_DEVIATION)
    agreement = (
        f"the compliance of the body with grains agrees with the single-mass model within {100 * GOOD_DEVIATION:g} % "
        f"at {_count_within(deviations, GOOD_DEVIATION)}, and within {100 * MAX_DEVIATION:g} % at {acceptable} of "
        f"{count} simulated operating points (frequency, acceleration, clearance and depth)"
    )
    setting_count = len({point_of(setting) for setting in settings()})
    if count < setting_count:
        agreement += f"; the study has {setting_count} operating points, and the others are not computed yet"
    if acceptable == count:
        return f"holds: {agreement}"
    return f"{'holds in part' if 2 * acceptable > count else 'does not hold'}: {agreement}"


def _describe_settings(beds: Columns) -> str:
    """Report the simulated settings, and the method."""
    repeated, max_seeds = int((beds["seeds"] > 1).sum()), int(beds["seeds"].max())
    packings = ""
    if repeated:
        packings = f" At {repeated} operating points, up to {max_seeds} packings give the standard uncertainties."
    grain_counts = [BEDS[layers][0] for layers in np.unique(beds["layers"]).tolist()]
    level, depth, clearance = (
        f"{values.min():.3g} to {values.max():.3g}"
        for values in (beds["level"], beds["depth"], 1e3 * with_ceiling(beds)["clearance"])
    )
    frequencies = ", ".join(
        f"{count} at {frequency:g} Hz"
        for frequency, count in zip(*np.unique(beds["frequency"], return_counts=True), strict=True)
    )
    return (
        "Beds of spheres, simulated by discrete elements, were compared with the single-mass model at "
        f"{len(beds['level'])} operating points: {frequencies} (the paper's resonances are at 13, 34.8 and 49.6 Hz), "
        f"acceleration {level} g, clearance {clearance} mm or no ceiling, depth {depth} diameters.{packings} "
        f"{min(grain_counts)} to "
        f"{max(grain_counts)} grains in a cavity with a smooth side represent a section of a wide bed; the effect of a "
        "rough side is not included. The compliance is the peak compliance, at that acceleration, of a body ten times "
        f"as heavy as its bed, with a damping ratio of 0.5 %. Grains were simulated for {3 * BLOCK_PERIODS} periods "
        f"without a ceiling and {3 * BLOCK_PERIODS_WITH_CEILING} below a ceiling, and averaged over the last two "
        "thirds. The clearance is measured from the highest grain; most others are lower. The height of this grain "
        "differs between packings by a tenth of a diameter, which matters for small clearances. Clearances at which "
        "the single mass does not reach the ceiling are omitted, because they are equivalent to no ceiling. `analysis "
        "beds` computes the table again; `analysis beds --points 6` computes a small table in minutes."
    )


def _describe_counts(beds: Columns) -> str:
    """Report the number of settings with an acceptable deviation, by each parameter."""
    acceptable = np.abs(deviation(beds, "compliance")) <= MAX_DEVIATION
    texts = []
    for axis, label, unit, factor in (
        ("frequency", "by frequency", " Hz", 1.0),
        ("level", "by acceleration", " g", 1.0),
        ("clearance", "by clearance", " mm", 1e3),
        ("layers", "by depth", " layers", 1.0),
    ):
        groups = [(value, acceptable[beds[axis] == value]) for value in np.unique(beds[axis])]
        counts = (
            f"{'no ceiling' if np.isinf(value) else f'{factor * value:g}{unit}'} {int(group.sum())} of {group.size}"
            for value, group in groups
        )
        texts.append(f"{label}: {', '.join(counts)}")
    return (
        f"Operating points at which the compliance deviates by at most {100 * MAX_DEVIATION:g} % from that with one "
        f"mass, {'; '.join(texts)}."
    )


def _describe_mode(beds: Columns, frequency: float) -> str:
    """Compare grains with the single-mass model at a different resonance."""
    at_frequency = select(beds, beds["frequency"] == frequency)
    deviations, without_ceiling = 100.0 * deviation(at_frequency, "compliance"), np.isinf(at_frequency["clearance"])
    texts = (
        f"{label} {_count_within(deviations[selected], 100 * MAX_DEVIATION)} of {int(selected.sum())} within "
        f"{100 * MAX_DEVIATION:g} %, median {np.median(deviations[selected]):+.0f} %, from "
        f"{deviations[selected].min():+.0f} to {deviations[selected].max():+.0f} %"
        for label, selected in (("without a ceiling", without_ceiling), ("below a ceiling", ~without_ceiling))
        if selected.any()
    )
    return f"At {frequency:g} Hz, compliance with grains relative to the single-mass model: {'; '.join(texts)}."


def _describe_deviation(beds: Columns, name: str, label: str) -> str:
    """Report the deviation of a measure (`MEASURES`) of grains from the single mass over all settings."""
    deviations, error = deviation(beds, name), deviation_error(beds, name)
    deviations, error = deviations[np.isfinite(deviations)], error[np.isfinite(deviations)]
    has_error = np.isfinite(error)
    significant = int((np.abs(deviations[has_error]) - 2.0 * error[has_error] > MAX_DEVIATION).sum())
    scatter = (
        f"The standard uncertainty is {100 * np.median(error[has_error]):.1f} % (median). Of the "
        f"{int(has_error.sum())} operating points with several packings, {significant} deviate by more than "
        f"{100 * MAX_DEVIATION:g} % plus two standard uncertainties."
        if has_error.any()
        else "Each operating point has one packing, so the standard uncertainty is unknown."
    )
    return (
        f"{label}, grains relative to the single-mass model: median {100 * np.median(deviations):+.1f} %, from "
        f"{100 * deviations.min():+.0f} to {100 * deviations.max():+.0f} %. Within {100 * GOOD_DEVIATION:g} % at "
        f"{_count_within(deviations, GOOD_DEVIATION)}, within {100 * MAX_DEVIATION:g} % at "
        f"{_count_within(deviations, MAX_DEVIATION)} of {len(deviations)} operating points. {scatter}"
    )


def _describe_contact(beds: Columns, contacts: Columns) -> str:
    """Assess the single mass with finite-duration contact, a model between instantaneous contact and grains."""
    beds_with_ceiling = with_ceiling(beds)
    contact = fit_contact(beds_with_ceiling, contacts)
    deviations = deviation_on_contact(contact, beds_with_ceiling, contacts)
    cross_validated = cross_validated_deviation(beds_with_ceiling, contacts)
    all_deviations, instantaneous = deviation_on_contact(contact, beds, contacts), deviation(beds, "compliance")
    has_ceiling = np.isfinite(beds["clearance"])
    ceiling_impulse = ceiling_impulse_on_contact(contact, beds_with_ceiling, contacts)
    # In units of weight times period, the impulse of the floor in a period is 1 plus the impulse of the ceiling.
    floor_deviations = (1.0 + beds_with_ceiling["grains_ceiling_impulse"]) / (1.0 + ceiling_impulse) - 1.0
    return (
        "Single-mass model with contacts of finite duration, fitted to the beds below a ceiling at "
        f"{len(deviations)} operating points: contact duration {1e3 * contact.duration:g} ms, restitution "
        f"{contact.restitution:g}, moving fraction of the bed {100 * contact.share:g} %. The compliance agrees with "
        f"grains within {100 * GOOD_DEVIATION:g} % at {_count_within(deviations, GOOD_DEVIATION)} of these points, "
        f"and within {100 * MAX_DEVIATION:g} % at {_count_within(deviations, MAX_DEVIATION)}. With instantaneous "
        f"contact, it agrees at {_count_within(instantaneous[has_ceiling], GOOD_DEVIATION)} and "
        f"{_count_within(instantaneous[has_ceiling], MAX_DEVIATION)}. In cross-validation, the contact for each "
        "acceleration is fitted to the other accelerations. The compliance then agrees at "
        f"{_count_within(cross_validated, GOOD_DEVIATION)} and {_count_within(cross_validated, MAX_DEVIATION)}. The "
        f"impulse of the floor agrees within {100 * MAX_DEVIATION:g} % at "
        f"{_count_within(floor_deviations, MAX_DEVIATION)}. Without a ceiling there are {int((~has_ceiling).sum())} "
        f"other operating points. There the fitted contact agrees within {100 * MAX_DEVIATION:g} % at "
        f"{_count_within(all_deviations[~has_ceiling], MAX_DEVIATION)}, and instantaneous contact at "
        f"{_count_within(instantaneous[~has_ceiling], MAX_DEVIATION)}. Instantaneous contact is therefore the better "
        "model without a ceiling. `analysis contacts` computes the table of contacts again."
    )


def _describe_landing(beds: Columns) -> str:
    mass_flies = beds["mass_type"] != "riding"
    same_state = np.array(["riding" in types for types in beds["grains_type"]]) == ~mass_flies
    grains, mass = (beds[f"{bed}_ceiling_impulse"] > 0.01 for bed in ("grains", "mass"))
    phase_lag = (beds["grains_landing"] - beds["mass_landing"])[mass_flies]
    return (
        f"The single mass flies at {len(phase_lag)} operating points. There, the phase of the grains' landing is "
        f"{np.median(phase_lag):+.0f}° relative to the mass (median; positive: later), and within "
        f"±{SAME_LANDING_DEG:g}° at {_count_within(phase_lag, SAME_LANDING_DEG)} of them. Grains and mass have the "
        f"same state, at rest or in flight, at {int(same_state.sum())} of {len(same_state)} operating points. Both or "
        f"neither hit the ceiling at {int((grains == mass).sum())}."
    )
