"""Forces of several shakers that are driven simultaneously: the inputs of a response matrix."""

from collections.abc import Sequence

import numpy as np

from daq.core.recording.recording import Recording
from rig.core.base.errors import RecordingError
from rig.core.results.response import Point

# A shaker counts as driven if the power of its force exceeds this value, relative to the largest force [dB].
_MIN_RELATIVE_FORCE_DB = -40.0


def driven_forces(rec: Recording) -> tuple[Point, ...]:
    """Return the force channels of the shakers that were driven simultaneously; empty if there are fewer than two."""
    return strong_forces(relative_forces(rec))


def strong_forces(forces: Sequence[tuple[Point, float]]) -> tuple[Point, ...]:
    """Return the forces that are strong enough to be inputs; `forces`: from `relative_forces`."""
    return tuple(force for force, relative in forces if relative > _MIN_RELATIVE_FORCE_DB)


def weak_force_warnings(forces: Sequence[tuple[Point, float]]) -> list[str]:
    """Return a warning for each force that is too weak to be an input; `forces`: from `relative_forces`."""
    used = ", ".join(force.name for force in strong_forces(forces))
    return [
        f"{force.name} at {force.place} is "
        f"{'zero' if np.isinf(relative) else f'{-relative:.0f} dB below the largest'}. "
        f"It is neglected as an input, so the responses are those to {used} alone. Check its amplifier and sensor."
        for force, relative in forces
        if relative <= _MIN_RELATIVE_FORCE_DB
    ]


def relative_forces(rec: Recording) -> list[tuple[Point, float]]:
    """Return the force channel of each of several shakers, and its power relative to the largest force [dB]."""
    marker = next((marker for marker in rec.markers if "shakers" in marker.fields and marker.kind == "measure"), None)
    if marker is None:
        return []
    forces: list[Point] = []
    for number in marker.fields["shakers"]:
        at = f"shaker {number}"
        name = next((info.name for info in rec.channels.values() if info.at == at), None)
        if name is None:
            raise RecordingError(
                f"{rec.path}: no channel measures the force of shaker {number}. Add "
                f"{{name: force{number}, at: {at}}} to the scene's channels."
            )
        bodies = (rec.scene.structure.label(body) for body in rec.scene.shakers[number - 1].bodies)
        forces.append(Point(name, "force", " and ".join(bodies)))
    stop = min(marker.stop, rec.samples)
    power = [float(np.nanvar(rec.read(point.name, marker.first_sample, stop))) for point in forces]
    with np.errstate(divide="ignore", invalid="ignore"):
        decibels = 10.0 * np.log10(np.array(power) / max(power))
    return list(zip(forces, np.nan_to_num(decibels, nan=-np.inf, neginf=-np.inf).tolist(), strict=True))
