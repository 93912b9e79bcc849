"""Reproduction of Inoue, Yokomichi, Hiraki (2011): figures, a verdict on each claim, and further results."""

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from analysis.studies.paper import bed_chart
from analysis.studies.paper import charts as paper_charts
from analysis.studies.paper import figures as paper_figures
from analysis.studies.paper.claims import claims
from analysis.studies.paper.page import pages, write_pages
from analysis.studies.paper.parts import all_parts
from analysis.studies.paper.store import Arrays, PaperPart
from rig.core.base.errors import SceneError
from rig.core.base.figure_style import save_figure
from rig.core.base.figure_types import Figure
from rig.core.base.output_files import prepare_outputs
from rig.core.base.workers import Workers, cores, free_cores

FIGURES: dict[str, Callable[[paper_figures.Parts], Figure]] = {
    "fig3": paper_figures.figure_3,
    "fig4b": paper_figures.figure_4,
    "fig5": paper_figures.figure_5,
    "fig6": paper_figures.figure_6,
    "fig8": paper_figures.figure_8,
    "fig9": paper_figures.figure_9,
    "fig10a": paper_figures.figure_10a,
    "fig10b": paper_figures.figure_10b,
    "c2-region": paper_charts.region_of_c2,
    "design": paper_charts.design,
    "optimum": paper_charts.optimum,
    "trust": paper_charts.approximation_error_chart,
    "c7-beds": bed_chart.beds,
    "c7-modes": bed_chart.modes,
}


def reproduce(
    folder: Path, print_line: Callable[[str], None], fresh: Sequence[str] = (), cluster: str | None = None
) -> list[Path]:
    """Compute the parts that have no stored results, draw all figures, and write the page with the verdicts.

    `folder`: folder for recordings, data, figures and pages. Results of an earlier run with the same inputs are
    reused; `print_line`: called with one line of text at a time; `fresh`: names of parts to recompute; `cluster`: as
    for `rig.design`; its workers must have access to the folder under the same name. Returns figures and pages. Raises
    `SceneError` if `fresh` contains an unknown part, the folder cannot be written, or an output was changed by the
    user. Raises `RunError` if the disk is full or fails.
    """
    start = time.monotonic()
    # Workers on other machines have a different working folder.
    parts = all_parts(folder.resolve() if cluster else folder)
    unknown = set(fresh) - {part.name for part in parts}
    if unknown:
        raise SceneError(
            f"`fresh`: unknown part {', '.join(sorted(unknown))}. "
            f"Choose among {', '.join(part.name for part in parts)}."
        )
    outputs = [folder / f"{name}.{suffix}" for name in FIGURES for suffix in ("png", "svg")]
    prepare_outputs(*outputs, *pages(folder))
    stored: dict[str, Arrays] = {}
    missing: list[PaperPart] = []
    for part in parts:
        results = None if part.name in fresh else part.load(folder)
        if results is None:
            missing.append(part)
        else:
            stored[part.name] = results
    duration = sum(part.effort for part in missing) / free_cores()
    print_line(
        f"{len(stored)} of {len(parts)} parts are stored; {len(missing)} are computed now"
        + (
            f": about {_format_duration(duration)} on {cores()} cores at their present load, the longest parts first."
            if missing
            else "."
        )
    )
    if missing:
        total_effort, finished_effort, compute_start = sum(part.effort for part in missing), 0.0, time.monotonic()
        for n_finished, (part, arrays) in enumerate(compute(missing, folder, cluster), 1):
            stored[part.name] = arrays
            finished_effort += part.effort
            elapsed = time.monotonic() - compute_start
            remaining = elapsed * (total_effort - finished_effort) / finished_effort
            print_line(
                f"  [{n_finished}/{len(missing)}] {part.title} ({part.name}): "
                f"{100 * finished_effort / total_effort:.0f} % done after {_format_duration(elapsed)}, "
                + (f"about {_format_duration(remaining)} left" if n_finished < len(missing) else "the last part")
            )
    files: list[Path] = []
    assessed = claims(stored)
    for name, draw in FIGURES.items():
        files += save_figure(draw(stored), folder / name)
    files += write_pages(folder, assessed, stored)
    for claim in assessed:
        print_line(f"  {claim.name}: {claim.verdict}")
    print_line(f"Done in {time.monotonic() - start:.0f} s. Read {folder / 'index.html'} or {folder / 'index.md'}.")
    return files


def compute(parts: Sequence[PaperPart], folder: Path, cluster: str | None = None) -> Iterator[tuple[PaperPart, Arrays]]:
    """Compute parts on all cores or a cluster, longest first, and store each result when it is complete."""
    waiting = sorted(parts, key=lambda part: -part.effort)
    with Workers(cluster) as workers:
        for number, arrays in workers.compute(PaperPart.run, waiting):
            waiting[number].store(folder, arrays)
            yield waiting[number], arrays


def _format_duration(seconds: float) -> str:
    """Format a duration.

    >>> _format_duration(42.3), _format_duration(192)
    ('42 s', '3 min 12 s')
    """
    rounded = round(seconds)
    return f"{rounded // 60} min {rounded % 60} s" if rounded >= 60 else f"{rounded} s"
