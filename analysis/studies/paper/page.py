"""Page with the verdicts and figures of the reproduction, as Markdown and as HTML."""

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np

from analysis.studies.paper.claim import Claim, Evidence
from analysis.studies.paper.figures import Columns, Parts
from rig.core.base.escaping import escape_html
from rig.core.base.output_files import atomic_write

TITLE = "The paper, reproduced"
INTRODUCTION = (
    "Inoue, Yokomichi and Hiraki, Particle damping with granular materials for multi degree of freedom system, Shock "
    "and Vibration 18 (2011) 245-256. Recordings come from the virtual rig: shaker, coil spring, sensors, amplifiers "
    "and converter. The analysis reads nothing else. Simulation means the exact event-driven motion under a sinusoidal "
    "force. The damping ratio of 0.5 % in each mode, the sensors and the converter are our assumptions, because the "
    "paper does not give them."
)
CAPTIONS = {
    "fig3": "Fig 3",
    "fig4b": "Fig 4b",
    "fig5": "Fig 5",
    "fig6": "Fig 6",
    "fig8": "Fig 8",
    "fig9": "Fig 9",
    "fig10a": "Fig 10a",
    "fig10b": "Fig 10b",
    "c2-region": "Where claim C2 holds",
    "design": "Design chart",
    "optimum": "Best clearance",
    "trust": "Where the approximate method can be trusted",
    "c7-beds": "Deviation of beds of grains from the single mass, instantaneous and finite-duration contact, in %",
    "c7-modes": "Deviation of beds of grains from the single mass at the paper's first and second resonance, in %",
}
# Figures of results in addition to the paper.
BEYOND = ("design", "optimum", "trust")
COMMAND = "analysis paper"


def _mass_ratio_remark(optimum: Columns) -> str:
    """Note that the peak decreases with the mass ratio, if the heaviest computed damper is the best."""
    ratios = optimum["mass_ratios"]
    if optimum["mass_ratio"] < ratios.max():
        return ""
    peaks = [f"{100 * r:.3g} % {1e6 * optimum['worst'][ratios == r].min():.0f}" for r in np.unique(ratios)]
    return f" The lowest such peak falls with the mass ratio. Peaks in µm/N: {', '.join(peaks)}."


def pages(folder: Path) -> tuple[Path, Path]:
    """Return the paths of the pages, as Markdown and as HTML."""
    return folder / "index.md", folder / "index.html"


def write_pages(folder: Path, assessed: Sequence[Claim], parts: Parts) -> list[Path]:
    """Write index.md and index.html into the folder of the figures."""
    beyond = beyond_the_paper(parts)
    page = Template((files("analysis.studies.paper") / "page.html").read_text(encoding="utf-8"))
    written = []
    texts = (_markdown(assessed, beyond), page.substitute(title=escape_html(TITLE), body=_html(assessed, beyond)))
    for target, text in zip(pages(folder), texts, strict=True):
        with atomic_write(target) as temporary:
            temporary.write_text(text, encoding="utf-8")
        written.append(target)
    return written


def beyond_the_paper(parts: Parts) -> list[Evidence]:
    """Return results in addition to the paper: optimum, exact orbits, and both weightings of the mass ratio."""
    best_by_ratio = [parts[name] for name in sorted(parts) if name.startswith("best-")]
    optima = "; ".join(
        f"{100 * float(b['mass_ratio']):.0f} %: {1e3 * float(b['best']):.2f} mm ({1e6 * float(b['peak']):.0f} µm/N)"
        for b in best_by_ratio
    )
    optimum = parts["optimum"]
    scans = (parts["scan-single"]["exact"], parts["scan-three"]["exact"])
    exact_cells = " and ".join(f"{int(cells.sum())} of {cells.size}" for cells in scans)
    exact = parts["orbit-fig9"]
    specials = [f"{kind} at {f:.4f} Hz" for kind, f in zip(exact["special"], exact["special_frequency"], strict=True)]
    kinds = sorted(set(exact["type"].tolist()))
    clearances = tuple(name for name in sorted(parts) if name.startswith("best-"))
    lines = [
        Evidence(
            "Clearance of a damper in body 2 with the lowest peak of the third mode, by mass ratio (in parentheses: "
            f"the highest peak at forces of 0.8 to 1.25 times 3.3 N): {optima}. The peaks are those of exact orbits "
            f"at {100 * np.mean([b['orbit_share'] for b in best_by_ratio]):.0f} % of the frequencies. At the others "
            "the motion is irregular, and its average was taken.",
            clearances,
        ),
        Evidence(
            "Clearance and mass ratio with the lowest peak at these forces, up to a mass ratio of "
            f"{100 * optimum['mass_ratios'].max():.0f} %: {100 * float(optimum['mass_ratio']):.1f} % with "
            f"{1e3 * float(optimum['best']):.2f} mm ({1e6 * float(optimum['peak']):.0f} µm/N, "
            f"{len(optimum['worst'])} trials).{_mass_ratio_remark(optimum)}",
            ("optimum",),
        ),
        Evidence(
            f"Design chart: the motion at the peak is an exact stable orbit in {exact_cells} cells with one and three "
            "dampers. In the other cells (~) it is irregular, and was simulated and averaged.",
            ("scan-single", "scan-three"),
        ),
        Evidence(
            f"Exact orbits of Fig 9: {int(exact['branch'].max()) + 1} branches with motions {', '.join(kinds)}; "
            f"{len(specials)} special points, among them {'; '.join(specials[:6])}.",
            ("orbit-fig9",),
        ),
        Evidence(_compare_weightings(parts), tuple(name for name in sorted(parts) if name.startswith("weights-"))),
    ]
    lines += [Evidence(f"Not found: {text}", ("orbit-fig9",)) for text in exact["failures"]]
    return lines


def _compare_weightings(parts: Parts) -> str:
    """Compare both weightings of the mass ratio with the simulation."""
    rows, errors = [], []
    for name in sorted(name for name in parts if name.startswith("weights-")):
        data = parts[name]
        for column, mode in enumerate(data["mode"]):
            deviations = 100 * (data["peak"][1:, column] / data["peak"][0, column] - 1)
            errors.append(deviations)
            printed = f"{deviations[0]:+.0f} %" if np.isfinite(deviations[0]) else "no positive mass"
            rows.append(
                f"{name.removeprefix('weights-').replace('-', ' ')}, mode {mode}: {printed} against "
                f"{deviations[1]:+.0f} %"
            )
    usable_errors = np.array([deviations for deviations in errors if np.isfinite(deviations).all()])
    usable = f"{len(usable_errors)} of {len(errors)} cases"
    median = np.median(np.abs(usable_errors), axis=0)
    better = "energy-consistent" if median[1] < median[0] else "printed"
    return (
        "Weight of the dampers in the approximate method: Eq 13 as printed sums the mode shape with its sign. The "
        f"resulting mass is positive in {usable} of Fig 8; the energy-consistent weight (shape squared) is always "
        "positive. Error of the peak relative to the simulation, printed against energy-consistent: "
        f"{'; '.join(rows)}. Where both exist, the {better} weight has the smaller error (median {median[0]:.0f} % "
        f"against {median[1]:.0f} %)."
    )


def command(parts: Sequence[str]) -> str:
    """Return the command that recomputes some parts of the reproduction and rewrites the page and its figures."""
    return " ".join([COMMAND, *(f"--fresh {name}" for name in dict.fromkeys(parts))])


def _parts(claim: Claim) -> list[str]:
    return [name for evidence in claim.evidence for name in evidence.parts]


def _markdown(assessed: Sequence[Claim], beyond: Sequence[Evidence]) -> str:
    def item(evidence: Evidence) -> str:
        return f"- {evidence.text}" + (f" (`{command(evidence.parts)}`)" if evidence.parts else "")

    lines = [f"# {TITLE}", "", INTRODUCTION, "", "| claim | verdict | command |", "|---|---|---|"]
    lines += [f"| {c.name} | {c.verdict} | `{command(_parts(c))}` |" for c in assessed]
    for c in assessed:
        lines += ["", f"## {c.name}", "", f"> {c.text}", "", f"**{c.verdict}**", ""]
        lines += [item(evidence) for evidence in c.evidence]
        lines += [line for name in c.figures for line in ("", f"![{CAPTIONS[name]}]({name}.png)")]
    lines += ["", "## Beyond the paper", ""] + [item(evidence) for evidence in beyond]
    lines += [line for name in BEYOND for line in ("", f"![{CAPTIONS[name]}]({name}.png)")]
    return "\n".join(lines) + "\n"


def _html(assessed: Sequence[Claim], beyond: Sequence[Evidence]) -> str:
    def items(all_evidence: Sequence[Evidence]) -> str:
        return "".join(
            f"<li>{escape_html(e.text)}"
            + (f" <code>{escape_html(command(e.parts))}</code>" if e.parts else "")
            + "</li>"
            for e in all_evidence
        )

    rows = "".join(
        f"<tr><td><a href='#{c.name}'>{c.name}</a></td><td>{escape_html(c.verdict)}</td>"
        f"<td><code>{escape_html(command(_parts(c)))}</code></td></tr>"
        for c in assessed
    )
    sections = [
        f"<p>{escape_html(INTRODUCTION)}</p><table><tr><th>claim</th><th>verdict</th><th>command</th></tr>{rows}</table>"
    ]
    for c in assessed:
        sections.append(
            f"<h2 id='{c.name}'>{c.name}</h2><blockquote>{escape_html(c.text)}</blockquote>"
            f"<p><strong>{escape_html(c.verdict)}</strong></p><ul>{items(c.evidence)}</ul>{_images(c.figures)}"
        )
    sections.append(f"<h2>Beyond the paper</h2><ul>{items(beyond)}</ul>{_images(BEYOND)}")
    return "\n".join(sections)


def _images(names: Sequence[str]) -> str:
    return "".join(
        f"<figure><img src='{name}.png' "
        f"alt='{escape_html(CAPTIONS[name])}'><figcaption>{escape_html(CAPTIONS[name])}</figcaption></figure>"
        for name in names
    )
