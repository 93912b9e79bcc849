"""One self-contained HTML page about recordings: what was tested, with what, what came out, what to doubt."""

from __future__ import annotations

import base64
import shlex
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib.resources import files
from math import isfinite
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

from analysis.presentation.comparison import present_compare
from analysis.presentation.damper_findings import present_dampers
from analysis.presentation.output_names import output_stem, with_ending
from analysis.presentation.presentation import (
    Progress,
    Result,
    present_decay,
    present_frf,
    present_modes,
)
from analysis.recordings.names import opened
from rig.errors import ShotrigError
from rig.escaping import html
from rig.output_files import make_ready, replacing
from rig.provenance import made_from, refuse_others, relative
from rig.results import plainly

if TYPE_CHECKING:
    from daq.recording.recording import Recording
    from rig.scene.damper import Damper


def write_report(
    paths: Sequence[Path], output: Path | None = None, progress: Progress | None = None
) -> Result:
    """Write the page beside the first recording, into the folder `output`, or as that file if it ends in .html."""
    sweeps: list[Path] = []
    decays: list[Path] = []
    damped: list[Path] = []
    body: list[str] = []
    commands: list[str] = []
    notes: list[str] = []
    for path in paths:
        with opened(path) as rec:
            body.append(_tested(path, rec))
            stepped = any(m.kind == "measure" and "frequency" in m.fields for m in rec.markers)
            if stepped and rec.scene.dampers:
                damped.append(path)
            free = rec.scene.test is not None and rec.scene.test.kind == "free"
            has_hits = free or any(marker.kind == "hit" for marker in rec.markers)
        (decays if has_hits else sweeps).append(path)
    with _page(paths, output):
        # Refused before the work, not after it.
        pass
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        if sweeps:
            names = _typed(sweeps)
            body.append(
                _part(
                    "Frequency responses",
                    lambda: present_frf(sweeps, folder, theory=True, progress=progress),
                    notes,
                )
            )
            commands.append(f"analysis frf --theory {names}")
            for path in sweeps:
                body.append(_part(f"Modes: {path.name}", partial(present_modes, [path], folder), notes))
            commands.append(f"analysis modes {names}")
        for path in damped:
            body.append(_part(f"Dampers: {path.name}", partial(present_dampers, [path], folder), notes))
            commands.append(f"analysis dampers {_typed([path])}")
        if len(sweeps) > 1:
            body.append(_part("What the dampers are worth", partial(present_compare, sweeps, folder), notes))
            commands.append(f"analysis compare {names}")
        if decays:
            body.append(_part("Free decays", partial(present_decay, decays, folder), notes))
            commands.append(f"analysis decay {_typed(decays)}")
    if notes:
        unique = dict.fromkeys(notes)
        items = "".join(f"<li>{html(note)}</li>" for note in unique)
        body.append(f'<h2>Warnings</h2><ul class="warnings">{items}</ul>')
    commands.append(f"analysis report {_typed(paths)}")
    body.append(f"<h2>To get the same again</h2><pre>{html(chr(10).join(commands))}</pre>")
    title = f"Vibration test: {', '.join(path.stem for path in paths)}"
    page = Template((files("analysis.presentation") / "report.html").read_text(encoding="utf-8"))
    with _page(paths, output) as target:
        make_ready(target.parent)
        with replacing(target) as part:
            part.write_text(page.substitute(title=html(title), body="\n".join(body)), encoding="utf-8")
    return Result((target,), (), tuple(dict.fromkeys(notes)))


@contextmanager
def _page(paths: Sequence[Path], output: Path | None) -> Iterator[Path]:
    """Name the page, which follows the rule for outputs inside the `with`."""
    if output is not None and output.suffix.lower() in {".html", ".htm"} and not output.is_dir():
        with made_from("report", *relative(paths, output.parent)):
            refuse_others(output)
            yield output
        return
    with output_stem(paths, output, "report", "html") as stem:
        yield with_ending(stem, "html")


def _typed(paths: Sequence[Path]) -> str:
    """Files as they are typed in a shell."""
    return " ".join(shlex.quote(str(path)) for path in paths)


def _part(heading: str, make: Callable[[], Result], notes: list[str]) -> str:
    """One section: findings and figures, or why there are none."""
    try:
        result = make()
    except ShotrigError as error:
        notes.append(f"{heading}: {error}")
        return f"<h2>{html(heading)}</h2><p>Not available: {html(str(error))}</p>"
    notes += result.warnings
    out = [f"<h2>{html(heading)}</h2>"]
    if result.lines:
        out.append(f"<pre>{html(chr(10).join(result.lines))}</pre>")
    for path in result.files:
        if path.suffix == ".png":
            data = base64.b64encode(path.read_bytes()).decode()
            out.append(f'<figure><img alt="{html(path.stem)}" src="data:image/png;base64,{data}"></figure>')
    return "\n".join(out)


def _tested(path: Path, rec: Recording) -> str:
    """Tell what was tested: scene, test, channels with calibration, overloads, gaps."""
    scene = rec.scene
    test = "none" if scene.test is None else scene.test.kind.replace("_", " ")
    shaker = ", ".join(each.kind for each in scene.shakers) or "none"
    dampers = "; ".join(_damper(damper, scene.structure.label(damper.body)) for damper in scene.dampers)
    facts = [
        ("recording", str(path)),
        ("scene", scene.name),
        ("test", test),
        ("shaker", shaker),
        ("dampers", dampers or "none"),
        ("length", f"{rec.samples / rec.rate:.2f} s at {rec.rate:g} Hz"),
        ("overloads", _ranges(rec, [(m.first_sample, m.fields.get("channel", "?")) for m in rec.overloads])),
        ("lost samples", _ranges(rec, [(gap.first_sample, ", ".join(gap.channels)) for gap in rec.gaps])),
    ]
    rows = "".join(f"<tr><th>{html(key)}</th><td>{html(value)}</td></tr>" for key, value in facts)
    heading = "".join(
        f"<th>{text}</th>" for text in ("channel", "at", "reads", "sensitivity", "range", "gain at 10 Hz")
    )
    channels = "".join(
        f"<tr><td>{html(info.name)}</td><td>{html(info.at)}</td><td>{info.quantity} / "
        f"{html(info.unit)}</td>"
        f"<td>{info.sensitivity:.5g} V per {html(info.unit)}</td>"
        f"<td>{'unlimited' if info.range is None else f'± {info.range:g} V'}</td>"
        f"<td>{abs(complex(info.response(10.0))):.4f}</td></tr>"
        for info in rec.channels.values()
    )
    return (
        f"<h2>{html(path.name)}</h2><table>{rows}</table><table><tr>{heading}</tr>{channels}</table>"
        f"<details><summary>scene file</summary><pre>{html(scene.to_yaml())}</pre></details>"
    )


def _damper(damper: Damper, body: str) -> str:
    mass = f"{damper.mass:.4g} kg" if damper.mass is not None else f"mass ratio {damper.mass_ratio:.3g}"
    ceiling = (
        f"clearance {plainly(1e3 * damper.clearance)} mm" if isfinite(damper.clearance) else "no ceiling"
    )
    return f"{body}: {mass}, {ceiling}{', locked' if damper.locked else ''}"


def _ranges(rec: Recording, found: Sequence[tuple[int, object]]) -> str:
    if not found:
        return "none"
    first = "; ".join(f"{sample / rec.rate:.3f} s ({name})" for sample, name in found[:5])
    return f"{len(found)}: {first}{' ...' if len(found) > 5 else ''}"
