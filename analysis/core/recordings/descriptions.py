"""Descriptions of the test of a recording in titles and captions: excitation, validity, averages and line spacing."""

import numpy as np

from daq.core.recording.markers import faults_of_impacts, impacts_of
from daq.core.recording.recording import Recording
from rig.core.results.response import Response


def excitation_text(rec: Recording) -> str:
    """Describe the test and its level, on which the response of a nonlinear structure depends: stepped sine, 2.6 N."""
    test = rec.scene.test
    if test is None:
        return ""
    level = test.level_text(rec.scene.driven_shaker)
    if test.held_motion is not None:
        level += f" at {rec.scene.structure.label(test.held_motion[0])}"
    return ", ".join(filter(None, [test.title, level]))


def validity_texts(rec: Recording) -> list[str]:
    """Describe the causes that limit the validity of responses: nonlinear parts, and impacts or samples with faults."""
    texts = ["nonlinear, valid only for this kind and level of excitation"] * (not rec.scene.is_linear)
    if faulty := faults_of_impacts(rec.markers):
        omitted = ", clipped samples omitted" * bool(rec.overloads)
        return [*texts, f"of {len(impacts_of(rec.markers))} impacts, {faulty}{omitted}"]
    count = len(rec.overloads)
    return [*texts, *[f"{count} overload{'s' * (count > 1)}"] * (count > 0)]


def acquisition_text(rec: Recording, frf: Response | None = None, estimate: str = "") -> str:
    """Describe number of averages or points, line spacing, estimate and sample rate: 3 impacts of 4 ms, Δf 0.33 Hz."""
    test = rec.scene.test
    details = () if test is None else (*test.details, test.duration_text)
    spacing = freedom = ""
    if frf is not None:
        spacing = line_spacing(frf)
        # Impacts and periods are averages; a continuous test has equivalent averages.
        if test is not None and test.duration_text and frf.degrees_of_freedom.any():
            freedom = f"{np.median(frf.degrees_of_freedom):.0f} degrees of freedom per line"
    return ", ".join(filter(None, [*details, spacing, estimate, freedom, f"sampled at {rec.rate:g} Hz"]))


def full_test_text(rec: Recording) -> str:
    """Describe test, level, averages and sample rate for the subtitle of a figure."""
    return ", ".join(filter(None, [excitation_text(rec), acquisition_text(rec)]))


def line_spacing(frf: Response) -> str:
    """Write the spacing of lines, or its range for unevenly spaced tones.

    >>> line_spacing(Response.curve(np.array([10.0, 10.5, 11.0, 12.5]), np.ones(4, dtype=complex), "a"))
    'Δf 0.5 Hz'
    >>> line_spacing(Response.curve(np.array([10.0, 10.5, 11.1]), np.ones(3, dtype=complex), "a"))
    'Δf 0.5 to 0.6 Hz'
    """
    steps = np.diff(np.sort(frf.frequency))
    if not steps.size or steps.min() <= 0.0:
        return ""
    lines = steps / steps.min()
    largest = "" if np.allclose(lines, np.round(lines), atol=1e-3) else f" to {steps.max():.2g}"
    return f"Δf {steps.min():.2g}{largest} Hz"
