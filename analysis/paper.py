"""Reproduce the paper: its figures, a verdict on each claim, and what goes beyond it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

from analysis import paper_charts, paper_figures
from analysis.figures import save
from analysis.paper_claims import claims
from analysis.paper_page import write_pages
from analysis.paper_parts import all_parts
from analysis.paper_store import Arrays, Part
from rig.errors import SceneError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIGURES: dict[str, Callable[[paper_figures.Parts], Figure]] = {
    "fig4b": paper_figures.figure_4,
    "fig5": paper_figures.figure_5,
    "fig6": paper_figures.figure_6,
    "fig8": paper_figures.figure_8,
    "fig9": paper_figures.figure_9,
    "fig10a": paper_figures.figure_10a,
    "fig10b": paper_figures.figure_10b,
    "c2-region": paper_charts.region,
    "design": paper_charts.design,
    "optimum": paper_charts.optimum,
    "trust": paper_charts.trust,
}


def reproduce(folder: Path, say: Callable[[str], None], fresh: Sequence[str] = ()) -> list[Path]:
    """Compute what is not there yet, draw all figures, and write the page.

    Parameters
    ----------
    folder : Path
        Where recordings, data, figures and pages go. What an earlier run left there is used, if it is of the
        same inputs.
    say : callable
        Takes one line of text at a time.
    fresh : sequence of str
        Names of parts to compute again.

    Returns
    -------
    list of Path
        Figures and pages.

    Raises
    ------
    SceneError
        If `fresh` names no part.
    RunError
        If the folder cannot be written.
    """
    began = time.monotonic()
    parts = all_parts(folder)
    unknown = set(fresh) - {part.name for part in parts}
    if unknown:
        raise SceneError(
            f"no part {', '.join(sorted(unknown))}; there are {', '.join(part.name for part in parts)}"
        )
    stored: dict[str, Arrays] = {}
    missing: list[Part] = []
    for part in parts:
        found = None if part.name in fresh else part.stored(folder)
        if found is None:
            missing.append(part)
        else:
            stored[part.name] = found
    say(f"{len(stored)} of {len(parts)} parts are there, {len(missing)} to do, on two cores.")
    if missing:
        with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
            jobs = {pool.submit(part.run, folder): part for part in missing}
            for done, job in enumerate(as_completed(jobs), 1):
                job.result()
                part = jobs[job]
                say(
                    f"  [{done}/{len(missing)}] {part.title} ({part.name}), {time.monotonic() - began:.0f} s after "
                    "the start"
                )
                arrays = part.stored(folder)
                assert arrays is not None
                stored[part.name] = arrays
    files: list[Path] = []
    for name, draw in FIGURES.items():
        files += save(draw(stored), folder / name)
    judged = claims(stored)
    files += write_pages(folder, judged, stored)
    for claim in judged:
        say(f"  {claim.name}: {claim.verdict}")
    say(f"Done in {time.monotonic() - began:.0f} s. Read {folder / 'index.html'} or {folder / 'index.md'}.")
    return files
