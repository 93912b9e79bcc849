"""Claim C7, the bed as one mass without rebound: assessed by grain simulations, setting by setting."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

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
from analysis.reproduction.figures import Parts

Arrays = Mapping[str, np.ndarray]
Cells = NDArray[np.bool_]

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
    beds = parts["beds"]
    error = trust_error(parts)
    became = ", ".join(f"{claim.name} {claim.verdict.split(':')[0]}" for claim in consequences)
    off = deviation(beds, "compliance")
    return Claim(
        "C7",
        "Restitution zero and a single mass describe the bed of 2 mm lead shot well enough.",
        (
            Evidence(_study(beds), ("beds",)),
            *(
                Evidence(_deviation(beds, name, words), ("beds",))
                for name, words in (
                    ("compliance", "Compliance of the body at its peak"),
                    ("floor_impulse", "Impulse of the floor in a period"),
                    ("energy", "Energy taken in a period"),
                )
            ),
            Evidence(_landing(beds), ("beds",)),
            Evidence(
                f"Compliance within {100 * NOT_FAR:g} % "
                + "; ".join(
                    _by(beds, np.abs(off) <= NOT_FAR, axis, words, unit, factor)
                    for axis, words, unit, factor in (
                        ("frequency", "by frequency", " Hz", 1.0),
                        ("level", "by acceleration", " g", 1.0),
                        ("clearance", "by clearance", " mm", 1e3),
                        ("layers", "by depth", " layers", 1.0),
                    )
                )
                + ".",
                ("beds",),
            ),
            *(
                Evidence(_at_mode(beds, frequency), ("beds",))
                for frequency in np.unique(beds["frequency"]).tolist()
                if frequency != FREQUENCY
            ),
            Evidence(_on_contact(at_shaking_frequency(beds), parts["contacts"]), ("beds", "contacts")),
            Evidence(
                f"The model's consequences, which the paper measured and our experiment with that model: {became}.", ()
            ),
            Evidence(
                "How far the approximate method follows the same model with all modes: its peak is off by "
                f"{np.nanmedian(np.abs(error)):.0f} % (median) and at most {np.nanmax(np.abs(error)):.0f} % over the "
                "scanned forces and clearances.",
                ("approx-peaks", "scan-single"),
            ),
        ),
        verdict(beds),
        ("c7-beds", "c7-modes", "trust"),
    )  # fmt: skip


def deviation(beds: Arrays, name: str) -> NDArray[np.float64]:
    """Compute the relative deviation of grains from one mass, shape (settings,); NaN where the mass has no value."""
    return _over(beds[f"grains_{name}"] - beds[f"mass_{name}"], beds[f"mass_{name}"])


def deviation_error(beds: Arrays, name: str) -> NDArray[np.float64]:
    """Compute the standard error of `deviation` over seeds, shape (settings,)."""
    return _over(beds[f"error_{name}"], beds[f"mass_{name}"])


def _over(values: np.ndarray, of_mass: np.ndarray) -> NDArray[np.float64]:
    return np.divide(values, of_mass, out=np.full(len(values), np.nan), where=of_mass > _NOTHING)


def verdict(beds: Arrays) -> str:
    """Return the verdict on the claim, from the compliance."""
    off = np.abs(deviation(beds, "compliance"))
    count, near, far = len(off), int((off <= NEAR).sum()), int((off <= NOT_FAR).sum())
    words = (
        f"the body's compliance is that of one mass within {100 * NEAR:g} % in {near}, within {100 * NOT_FAR:g} % in "
        f"{far} of {count} settings of frequency, acceleration, clearance and depth at which beds of grains were "
        "simulated"
    )
    whole = len({point_of(setting) for setting in settings()})
    if count < whole:
        words += f", of {whole} in the study: the others are not computed yet"
    if far == count:
        return f"holds: {words}"
    return f"{'holds in part' if 2 * far > count else 'does not hold'}: {words}"


def _study(beds: Arrays) -> str:
    several, most = int((beds["seeds"] > 1).sum()), int(beds["seeds"].max())
    packings = f"; {several} of them with up to {most} packings, from which the errors are" if several else ""
    ceilings = beds["clearance"][np.isfinite(beds["clearance"])]
    counts = [BEDS[layers][0] for layers in np.unique(beds["layers"]).tolist()]
    return (
        "Beds of spheres, by discrete elements, were held against the same beds as one mass at "
        f"{len(beds['level'])} settings: {_frequencies(beds)}, acceleration {_span(beds['level'])} g, clearance "
        f"{_span(1e3 * ceilings)} mm or no ceiling, depth {_span(beds['depth'])} diameters{packings}. "
        f"{min(counts)} to {max(counts)} grains in a cavity with a smooth side, which stands for a piece of a wide "
        "one: what the rough side of a cavity adds "
        "is not in it. The compliance is that of a body ten times as heavy as its bed, damped by 0.5 %, at the peak "
        f"and that acceleration. Grains were followed for {3 * BLOCK} periods without a ceiling and "
        f"{3 * BLOCK_WITH_CEILING} below one, and averaged over the last two thirds. A clearance counts from the "
        "highest grain, which most others are below; packings differ there by a tenth of a diameter, which small "
        "clearances feel. Clearances "
        "that one mass does not fly through are left out but for no ceiling. "
        "`analysis beds` makes the table again; with `--points 6` a small one in minutes."
    )


def _frequencies(beds: Arrays) -> str:
    found = np.unique(beds["frequency"])
    counts = (f"{int((beds['frequency'] == one).sum())} at {one:g} Hz" for one in found)
    return f"{', '.join(counts)} (the paper's resonances lie at 13, 34.8 and 49.6 Hz)"


def _at_mode(beds: Arrays, frequency: float) -> str:
    """Compare grains with one mass at another resonance."""
    own = select(beds, beds["frequency"] == frequency)
    off, high = 100.0 * deviation(own, "compliance"), np.isinf(own["clearance"])
    parts = (
        f"{words} {_within(off[where], 100 * NOT_FAR)} of {int(where.sum())} within {100 * NOT_FAR:g} %, median "
        f"{np.median(off[where]):+.0f} %, from {off[where].min():+.0f} to {off[where].max():+.0f} %"
        for words, where in (("without a ceiling", high), ("below one", ~high))
        if where.any()
    )
    return f"At {frequency:g} Hz, compliance of grains against one mass: {'; '.join(parts)}."


def _deviation(beds: Arrays, name: str, words: str) -> str:
    off, error = deviation(beds, name), deviation_error(beds, name)
    seen = np.isfinite(off)
    off, error = off[seen], error[seen]
    known = np.isfinite(error)
    sure = int((np.abs(off[known]) - 2.0 * error[known] > NOT_FAR).sum())
    scatter = (
        f"; standard error {100 * np.median(error[known]):.1f} % (median), so {sure} of {int(known.sum())} with "
        "several packings are beyond it by more than two errors"
        if known.any()
        else "; of one packing each"
    )
    return (
        f"{words}, grains against one mass: median {100 * np.median(off):+.1f} %, from {100 * off.min():+.0f} to "
        f"{100 * off.max():+.0f} %. Within {100 * NEAR:g} % in {int((np.abs(off) <= NEAR).sum())}, within "
        f"{100 * NOT_FAR:g} % in {int((np.abs(off) <= NOT_FAR).sum())} of {len(off)} settings{scatter}."
    )


def _on_contact(beds: Arrays, contacts: Arrays) -> str:
    """Assess one mass on finite-duration contact, the model between instantaneous contact and grains."""
    below = with_ceiling(beds)
    one = fit_contact(below, contacts)
    off, unseen = deviation_on_contact(one, below, contacts), cross_validated_deviation(below, contacts)
    everywhere, lumped = deviation_on_contact(one, beds, contacts), deviation(beds, "compliance")
    under = np.isfinite(beds["clearance"])
    floor = (1.0 + below["grains_ceiling_impulse"]) / (
        1.0 + ceiling_impulse_on_contact(one, below, contacts)
    ) - 1.0
    return (
        f"One mass on a floor and a ceiling that give way: of those tried, {1e3 * one.duration:g} ms a landing with a "
        f"restitution of {one.restitution:g}, and {100 * one.share:g} % of the bed moving, stand best for the beds "
        f"below a ceiling. Compliance there is within {100 * NEAR:g} % in {_within(off, NEAR)}, within "
        f"{100 * NOT_FAR:g} % in {_within(off, NOT_FAR)} of {len(off)} settings (one mass that lands at once: "
        f"{_within(lumped[under], NEAR)} and {_within(lumped[under], NOT_FAR)}); at each acceleration by the contact "
        f"fitted to the others, in {_within(unseen, NEAR)} and {_within(unseen, NOT_FAR)}. The floor's impulse is "
        f"within {100 * NOT_FAR:g} % in {_within(floor, NOT_FAR)}. Without a ceiling the same contact is within "
        f"{100 * NOT_FAR:g} % in {_within(everywhere[~under], NOT_FAR)} of {int((~under).sum())} (one mass that lands "
        f"at once: {_within(lumped[~under], NOT_FAR)}): there, the landing at once is the better model. "
        "`analysis contacts` makes the table of contacts again."
    )


def _within(off: np.ndarray, bound: float) -> int:
    return int((np.abs(off) <= bound).sum())


def _landing(beds: Arrays) -> str:
    late = beds["grains_landing"] - beds["mass_landing"]
    flies = beds["mass_type"] != "riding"
    both = np.array(["riding" in types for types in beds["grains_type"]]) == ~flies
    ceiling = beds["grains_ceiling_impulse"] > 0.01
    same_ceiling = ceiling == (beds["mass_ceiling_impulse"] > 0.01)
    late = late[flies]
    return (
        f"Where the mass flies, grains land {np.median(late):+.0f}° later in the period (median; within "
        f"{SAME_LANDING:g}° in {int((np.abs(late) <= SAME_LANDING).sum())} of {len(late)}). Both ride or both fly in "
        f"{int(both.sum())} of {len(both)} settings; both or neither hit the ceiling in {int(same_ceiling.sum())}."
    )


def _by(beds: Arrays, held: Cells, axis: str, words: str, unit: str, factor: float) -> str:
    counts = [
        f"{factor * value:g}{unit} {int(held[beds[axis] == value].sum())} of {int((beds[axis] == value).sum())}"
        for value in np.unique(beds[axis])
    ]
    return f"{words}: {', '.join(counts)}"


def _span(values: np.ndarray) -> str:
    return f"{values.min():.3g} to {values.max():.3g}"
