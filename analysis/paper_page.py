"""The page on the reproduction, as Markdown and as HTML."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np

from analysis.paper_claims import Claim
from analysis.paper_figures import Parts
from rig.errors import RunError

TITLE = "The paper, reproduced"
INTRODUCTION = (
    "Inoue, Yokomichi and Hiraki, Particle damping with granular materials for multi degree of freedom system, "
    "Shock and Vibration 18 (2011) 245-256. Recordings come from the virtual rig: shaker, coil spring, sensors, "
    "amplifiers, converter; analysis reads nothing else. Simulation is the exact event-driven motion under a pure "
    "force. Damping of 0.5 % in each mode, sensors and converter are our assumptions: the text does not give them."
)
CAPTIONS = {
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
}
COMMAND = "analysis paper"


def write_pages(folder: Path, judged: Sequence[Claim], parts: Parts) -> list[Path]:
    """Write index.md and index.html; the figures lie beside them."""
    beyond = beyond_the_paper(parts)
    page = Template((files("analysis") / "report.html").read_text(encoding="utf-8"))
    written = []
    for name, text in (
        ("index.md", _markdown(judged, beyond)),
        ("index.html", page.substitute(title=escape(TITLE), body=_html(judged, beyond))),
    ):
        target = folder / name
        try:
            target.write_text(text, encoding="utf-8")
        except OSError as error:
            raise RunError(
                f"cannot write {target}: {error.strerror}; choose another place with --output"
            ) from None
        written.append(target)
    return written


def beyond_the_paper(parts: Parts) -> list[str]:
    """Sentences on the optimum, the exact orbits, and the two weightings of the mass ratio."""
    best = [parts[name] for name in sorted(parts) if name.startswith("best-")]
    found = "; ".join(
        f"{100 * float(b['mass_ratio']):.0f} %: {1e3 * float(b['best']):.2f} mm (worst peak "
        f"{1e6 * float(b['peak']):.0f} µm/N)"
        for b in best
    )
    exact = parts["orbit-fig9"]
    specials = [
        f"{kind} at {f:.4f} Hz" for kind, f in zip(exact["special"], exact["special_frequency"], strict=True)
    ]
    kinds = sorted(set(exact["type"].tolist()))
    lines = [
        "Best clearance of a damper in body 2 for the third mode, robust for 0.8 to 1.25 times 3.3 N, by mass "
        f"ratio: {found}.",
        f"Exact orbits of Fig 9: {int(exact['branch'].max()) + 1} branches with motions {', '.join(kinds)}; "
        f"{len(specials)} special points, among them {'; '.join(specials[:6])}.",
        *_weights(parts),
    ]
    lines += [f"Not found: {text}" for text in exact["failures"]]
    return lines


def _weights(parts: Parts) -> list[str]:
    """Say how either weight of the mass ratio fares against the simulation."""
    rows, errors = [], []
    for name in sorted(name for name in parts if name.startswith("weights-")):
        data = parts[name]
        for column, mode in enumerate(data["mode"]):
            off = 100 * (data["peak"][1:, column] / data["peak"][0, column] - 1)
            errors.append(off)
            printed = f"{off[0]:+.0f} %" if np.isfinite(off[0]) else "no positive mass"
            rows.append(
                f"{name.removeprefix('weights-').replace('-', ' ')}, mode {mode}: {printed} against {off[1]:+.0f} %"
            )
    both = np.array([off for off in errors if np.isfinite(off).all()])
    usable = f"{len(both)} of {len(errors)} cases"
    median = np.median(np.abs(both), axis=0)
    better = "energy-consistent" if median[1] < median[0] else "printed"
    return [
        "Weight of the dampers in the approximate method: Eq 13 as printed is a signed sum of the shape, which is a "
        f"positive mass in {usable} of Fig 8; the energy-consistent weight (shape squared) always is. Error of the "
        f"peak against the simulation, printed against energy-consistent: {'; '.join(rows)}. Where both exist the "
        f"{better} one is nearer (median error {median[0]:.0f} % against {median[1]:.0f} %)."
    ]


def _commands(claim: Claim) -> str:
    return f"{COMMAND}, figures {', '.join(f'{name}.png' for name in claim.figures)}"


def _markdown(judged: Sequence[Claim], beyond: Sequence[str]) -> str:
    lines = [f"# {TITLE}", "", INTRODUCTION, "", "| claim | verdict | command |", "|---|---|---|"]
    lines += [f"| {c.name} | {c.verdict} | `{_commands(c)}` |" for c in judged]
    for c in judged:
        lines += ["", f"## {c.name}", "", f"> {c.text}", "", f"**{c.verdict}**", ""]
        lines += [f"- {text}" for text in c.evidence if text]
        lines += [line for name in c.figures for line in ("", f"![{CAPTIONS[name]}]({name}.png)")]
    lines += ["", "## Beyond the paper", ""] + [f"- {text}" for text in beyond]
    lines += [
        line for name in ("design", "optimum", "trust") for line in ("", f"![{CAPTIONS[name]}]({name}.png)")
    ]
    return "\n".join(lines) + "\n"


def _html(judged: Sequence[Claim], beyond: Sequence[str]) -> str:
    rows = "".join(
        "<tr><td><a "
        f"href='#{c.name}'>{c.name}</a></td><td>{escape(c.verdict)}</td><td><code>{escape(_commands(c))}</code></td></tr>"
        for c in judged
    )
    out = [
        f"<p>{escape(INTRODUCTION)}</p><table><tr><th>claim</th><th>verdict</th><th>command</th></tr>{rows}</table>"
    ]
    for c in judged:
        points = "".join(f"<li>{escape(text)}</li>" for text in c.evidence if text)
        out.append(
            "<h2 "
            f"id='{c.name}'>{c.name}</h2><blockquote>{escape(c.text)}</blockquote><p><strong>{escape(c.verdict)}</strong></p><ul>{points}</ul>{_images(c.figures)}"
        )
    points = "".join(f"<li>{escape(text)}</li>" for text in beyond)
    out.append(f"<h2>Beyond the paper</h2><ul>{points}</ul>{_images(('design', 'optimum', 'trust'))}")
    return "\n".join(out)


def _images(names: Sequence[str]) -> str:
    return "".join(
        f"<figure><img src='{name}.png' "
        f"alt='{escape(CAPTIONS[name])}'><figcaption>{escape(CAPTIONS[name])}</figcaption></figure>"
        for name in names
    )
