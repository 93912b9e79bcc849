"""The text page of a replay: the test, the bench, and the drawing."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rig.escaping import code_fence, escape_markdown

if TYPE_CHECKING:
    from daq.drawing.rig_view import RigView
    from daq.recording.recording import Recording
    from daq.viewing.recorded_motion import RecordedMotion


def about(recording: Recording, motion: RecordedMotion, view: RigView) -> str:
    """Describe a recording in Markdown."""
    scene, rate = recording.scene, recording.rate
    lines = [
        f"# {escape_markdown(scene.name)}",
        f"{recording.samples / rate:.3f} s at {rate:g} Hz, {len(recording.channels)} channels",
        "",
        f"## In the drawing, motion is {view.magnification:g} times as large",
        *[
            f"- {escape_markdown(source.point)}: {escape_markdown(source.sentence)}"
            for source in motion.sources
        ],
    ]
    if scene.dampers:
        source = "recorded truth"
        if not motion.gaps_known:
            source = (
                "not recorded, drawn on their floors (a scene with recording: {truth: true} records them)"
            )
        lines.append(f"- dampers: {source}")
        lines += [
            "",
            "## Dampers",
            "| damper | body | mass | clearance | restitution | contact |",
            "|---|---|---|---|---|---|",
        ]
        for place, (damper, mass) in enumerate(zip(scene.dampers, view.damper_masses, strict=True), start=1):
            clearance = "no ceiling" if math.isinf(damper.clearance) else f"{damper.clearance * 1e3:.4g} mm"
            lines.append(
                f"| {place} | {damper.body} | {mass * 1e3:.4g} g | {clearance} | {damper.restitution:g} "
                f"| {'grains' if damper.grains else 'instant' if damper.contact is None else 'finite'} |"
            )
    lines += ["", "## Channels", "| channel | at | quantity | unit | V per unit |", "|---|---|---|---|---|"]
    for name, info in recording.channels.items():
        lines.append(
            f"| {escape_markdown(name)} | {escape_markdown(info.at)} | {info.quantity} | {info.unit} "
            f"| {info.sensitivity:.4g} |"
        )
    if recording.gaps:
        lost = sum(gap.last_sample + 1 - gap.first_sample for gap in recording.gaps)
        lines += ["", f"**{lost} samples lost, in {len(recording.gaps)} gap(s)** (see the markers)"]
    lines += ["", "## Scene", code_fence(scene.to_yaml().rstrip(), "yaml")]
    return "\n".join(lines) + "\n"
