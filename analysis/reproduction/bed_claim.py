"""Claim C7, the bed as one mass without rebound: assessed by grain simulations, setting by setting."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.reproduction.bed_study import BEDS, BLOCK, BLOCK_WITH_CEILING, FREQUENCY, point_of, settings
from analysis.reproduction.charts import trust_error
from analysis.reproduction.claim import Claim, Evidence
from analysis.reproduction.contact_study import (
    at_shaking_frequency,
    ceiling_impulse_on_contact,
    cross_validated_deviation,
    deviation_on_contact,
    fit_contact,
    select,
    with_ceiling,
)
from analysis.reproduction.figures import Columns, Parts

#: Largest relative deviation at which one mass describes grains well.
NEAR = 0.05
#: Largest relative deviation at which one mass describes grains acceptably.
NOT_FAR = 0.10
#: Energy below which a mass counts as riding, relative to its weight times 1 mm.
_NOTHING = 1e-3
#: Phase difference below which landings appear as one in a figure, degrees.
SAME_LANDING = 20.0


def bed_claim(parts: Parts, consequences: Sequence[Claim]) -> Claim:
    """Assess C7: deviations of a bed of grains from one mass, and the verdicts on the consequences."""
    beds, error = parts["beds"], np.abs(trust_error(parts))
    verdicts = ", ".join(f"{claim.name} {claim.verdict.split(':')[0]}" for claim in consequences)
    of_beds = [
        _settings(beds),
        *(
            _deviation(beds, name, words)
            for name, words in (
                ("compliance", "Compliance of the body at its peak"),
                ("floor_impulse", "Impulse of the floor in a period"),
                ("energy", "Energy dissipated in a period"),
            )
        ),
        _landing(beds),
        _counts(beds),
        *(
            _at_mode(beds, frequency)
            for frequency in np.unique(beds["frequency"]).tolist()
            if frequency != FREQUENCY
        ),
    ]
    return Claim(
        "C7",
        "Restitution zero and a single mass describe the bed of 2 mm lead shot well enough.",
        (
            *(Evidence(text, ("beds",)) for text in of_beds),
            Evidence(_on_contact(at_shaking_frequency(beds), parts["contacts"]), ("beds", "contacts")),
            Evidence(
                "Verdicts on the consequences of the model, which the paper measured and our experiment with that "
                f"model: {verdicts}.",
                (),
            ),
            Evidence(
                "Error of the approximate method for the same model with all modes: its peak deviates by "
                f"{np.nanmedian(error):.0f} % (median) and at most {np.nanmax(error):.0f} % over the scanned forces "
                "and clearances.",
                ("approx-peaks", "scan-single"),
            ),
        ),
        verdict(beds),
        ("c7-beds", "c7-modes", "trust"),
    )


def deviation(beds: Columns, name: str) -> NDArray[np.float64]:
    """Compute the relative deviation of grains from one mass, shape (settings,); NaN where the mass has no value."""
    return _over(beds[f"grains_{name}"] - beds[f"mass_{name}"], beds[f"mass_{name}"])


def deviation_error(beds: Columns, name: str) -> NDArray[np.float64]:
    """Compute the standard error of `deviation` over seeds, shape (settings,)."""
    return _over(beds[f"error_{name}"], beds[f"mass_{name}"])


def _over(values: np.ndarray, of_mass: np.ndarray) -> NDArray[np.float64]:
    return np.divide(values, of_mass, out=np.full(len(values), np.nan), where=of_mass > _NOTHING)


def _within(values: np.ndarray, bound: float) -> int:
    return int((np.abs(values) <= bound).sum())


def verdict(beds: Columns) -> str:
    """Return the verdict on the claim, from the compliance."""
    off = deviation(beds, "compliance")
    count, far = len(off), _within(off, NOT_FAR)
    words = (
        f"the body's compliance is that of one mass within {100 * NEAR:g} % in {_within(off, NEAR)}, within "
        f"{100 * NOT_FAR:g} % in {far} of {count} settings of frequency, acceleration, clearance and depth at which "
        "beds of grains were simulated"
    )
    whole = len({point_of(setting) for setting in settings()})
    if count < whole:
        words += f", of {whole} in the study: the others are not computed yet"
    if far == count:
        return f"holds: {words}"
    return f"{'holds in part' if 2 * far > count else 'does not hold'}: {words}"


def _settings(beds: Columns) -> str:
    several, most = int((beds["seeds"] > 1).sum()), int(beds["seeds"].max())
    packings = f"; {several} of them with up to {most} packings, which give the errors" if several else ""
    counts = [BEDS[layers][0] for layers in np.unique(beds["layers"]).tolist()]
    level, depth, clearance = (
        f"{values.min():.3g} to {values.max():.3g}"
        for values in (beds["level"], beds["depth"], 1e3 * with_ceiling(beds)["clearance"])
    )
    frequencies = ", ".join(
        f"{count} at {frequency:g} Hz"
        for frequency, count in zip(*np.unique(beds["frequency"], return_counts=True), strict=True)
    )
    return (
        "Beds of spheres, simulated by discrete elements, were compared with the same beds as one mass at "
        f"{len(beds['level'])} settings: {frequencies} (the paper's resonances are at 13, 34.8 and 49.6 Hz), "
        f"acceleration {level} g, clearance {clearance} mm or no ceiling, depth {depth} diameters{packings}. "
        f"{min(counts)} to {max(counts)} grains in a cavity with a smooth side represent a piece of a wide bed; the "
        "effect of a rough side is not included. The compliance is that of a body ten times as heavy as its bed, "
        f"damped by 0.5 %, at the peak and that acceleration. Grains were simulated for {3 * BLOCK} periods without a "
        f"ceiling and {3 * BLOCK_WITH_CEILING} below a ceiling, and averaged over the last two thirds. A clearance is "
        "measured from the highest grain; most others are lower. It differs between packings by a tenth of a "
        "diameter, which matters for small clearances. Clearances that one mass does not cross are omitted, except no "
        "ceiling. `analysis beds` computes the table again; with `--points 6` a small table in minutes."
    )


def _counts(beds: Columns) -> str:
    near = np.abs(deviation(beds, "compliance")) <= NOT_FAR
    texts = []
    for axis, words, unit, factor in (
        ("frequency", "by frequency", " Hz", 1.0),
        ("level", "by acceleration", " g", 1.0),
        ("clearance", "by clearance", " mm", 1e3),
        ("layers", "by depth", " layers", 1.0),
    ):
        cells = [(value, near[beds[axis] == value]) for value in np.unique(beds[axis])]
        counts = (f"{factor * value:g}{unit} {int(cell.sum())} of {cell.size}" for value, cell in cells)
        texts.append(f"{words}: {', '.join(counts)}")
    return f"Compliance within {100 * NOT_FAR:g} % {'; '.join(texts)}."


def _at_mode(beds: Columns, frequency: float) -> str:
    """Compare grains with one mass at another resonance."""
    own = select(beds, beds["frequency"] == frequency)
    off, high = 100.0 * deviation(own, "compliance"), np.isinf(own["clearance"])
    parts = (
        f"{words} {_within(off[where], 100 * NOT_FAR)} of {int(where.sum())} within {100 * NOT_FAR:g} %, median "
        f"{np.median(off[where]):+.0f} %, from {off[where].min():+.0f} to {off[where].max():+.0f} %"
        for words, where in (("without a ceiling", high), ("below a ceiling", ~high))
        if where.any()
    )
    return f"At {frequency:g} Hz, compliance of grains relative to one mass: {'; '.join(parts)}."


def _deviation(beds: Columns, name: str, words: str) -> str:
    off, error = deviation(beds, name), deviation_error(beds, name)
    off, error = off[np.isfinite(off)], error[np.isfinite(off)]
    known = np.isfinite(error)
    sure = int((np.abs(off[known]) - 2.0 * error[known] > NOT_FAR).sum())
    scatter = (
        f"; standard error {100 * np.median(error[known]):.1f} % (median), so {sure} of {int(known.sum())} with "
        "several packings exceed this by more than two standard errors"
        if known.any()
        else "; of one packing each"
    )
    return (
        f"{words}, grains relative to one mass: median {100 * np.median(off):+.1f} %, from {100 * off.min():+.0f} to "
        f"{100 * off.max():+.0f} %. Within {100 * NEAR:g} % in {_within(off, NEAR)}, within {100 * NOT_FAR:g} % in "
        f"{_within(off, NOT_FAR)} of {len(off)} settings{scatter}."
    )


def _on_contact(beds: Columns, contacts: Columns) -> str:
    """Assess one mass on finite-duration contact, the model between instantaneous contact and grains."""
    below = with_ceiling(beds)
    one = fit_contact(below, contacts)
    off, unseen = deviation_on_contact(one, below, contacts), cross_validated_deviation(below, contacts)
    everywhere, lumped = deviation_on_contact(one, beds, contacts), deviation(beds, "compliance")
    under = np.isfinite(beds["clearance"])
    ceiling = ceiling_impulse_on_contact(one, below, contacts)
    floor = (1.0 + below["grains_ceiling_impulse"]) / (1.0 + ceiling) - 1.0
    return (
        f"One mass with finite-duration contact: of those computed, a landing in {1e3 * one.duration:g} ms with a "
        f"restitution of {one.restitution:g}, and {100 * one.share:g} % of the bed moving, agrees best with the beds "
        f"below a ceiling. Compliance there is within {100 * NEAR:g} % in {_within(off, NEAR)}, within "
        f"{100 * NOT_FAR:g} % in {_within(off, NOT_FAR)} of {len(off)} settings (one mass with instantaneous contact: "
        f"{_within(lumped[under], NEAR)} and {_within(lumped[under], NOT_FAR)}); at each acceleration by the contact "
        f"fitted to the others, in {_within(unseen, NEAR)} and {_within(unseen, NOT_FAR)}. The floor's impulse is "
        f"within {100 * NOT_FAR:g} % in {_within(floor, NOT_FAR)}. Without a ceiling the same contact is within "
        f"{100 * NOT_FAR:g} % in {_within(everywhere[~under], NOT_FAR)} of {int((~under).sum())} (instantaneous "
        f"contact: {_within(lumped[~under], NOT_FAR)}): there, instantaneous contact is the better model. "
        "`analysis contacts` computes the table of contacts again."
    )


def _landing(beds: Columns) -> str:
    flies = beds["mass_type"] != "riding"
    both = np.array(["riding" in types for types in beds["grains_type"]]) == ~flies
    grains, mass = (beds[f"{who}_ceiling_impulse"] > 0.01 for who in ("grains", "mass"))
    late = (beds["grains_landing"] - beds["mass_landing"])[flies]
    return (
        f"Where the mass flies, grains land {np.median(late):+.0f}° later in the period (median; within "
        f"{SAME_LANDING:g}° in {_within(late, SAME_LANDING)} of {len(late)}). Both ride or both fly in "
        f"{int(both.sum())} of {len(both)} settings; both or neither hit the ceiling in {int((grains == mass).sum())}."
    )
