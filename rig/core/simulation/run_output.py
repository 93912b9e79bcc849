"""Output of `rig simulate`: a summary as text, and files for other programs."""

import csv
from collections import Counter
from pathlib import Path

import numpy as np

from rig.core.base.errors import SceneError
from rig.core.base.escaping import escape_cell
from rig.core.base.output_files import atomic_write, prepare_outputs
from rig.core.base.progress import CountProgress
from rig.core.laws.events import EVENT_NAMES
from rig.core.scene.scene import Scene
from rig.core.simulation.simulate import Run, simulate

#: File name extensions that `write_run` supports.
SUFFIXES = (".npz", ".csv")


def default_duration(scene: Scene) -> float:
    """Return the open-loop duration of a scene's test [s]; two seconds if the test has none."""
    return 2.0 if scene.test is None else scene.test.simulated


def check_suffix(path: Path) -> None:
    """Raise `SceneError` if the extension of a file name is unknown."""
    if path.suffix not in SUFFIXES:
        raise SceneError(
            f"{path}: unknown extension {path.suffix!r}. Give a name that ends in {' or '.join(SUFFIXES)}."
        )


def simulate_to_file(
    output: Path | None,
    scene: Scene,
    duration: float | str | None,
    rate: float | str,
    frequency: float | str | None,
    progress: CountProgress,
) -> Run:
    """Simulate a scene and write the run; with grains, a checkpoint is kept next to the file until it is written.

    `output`: file for `write_run`; None: no file and no checkpoint are written. Raises `ShotrigError` if `simulate`
    raises an error, or a file cannot be written.
    """
    if output is not None:
        check_suffix(output)
        prepare_outputs(output)
    checkpoint = None if output is None else output.with_name(f"{output.name}.kept")
    duration = default_duration(scene) if duration is None else duration
    try:
        run = simulate(scene, duration, rate, frequency=frequency, keep=checkpoint, progress=progress)
    except KeyboardInterrupt as interrupt:
        if checkpoint is not None and checkpoint.exists():
            interrupt.add_note(
                f"{checkpoint} contains the part computed so far. To continue from there, give the same command again."
            )
        raise
    if output is not None and checkpoint is not None:
        write_run(run, output)
        checkpoint.unlink(missing_ok=True)
    return run


def summary(run: Run) -> str:
    """Return a summary in a few lines: largest samples, events, energy."""
    rate = (len(run.time) - 1) / run.time[-1]
    lines = [f"{run.scene.name}: {run.time[-1]:.6g} s, {len(run.time)} samples", ""]
    lines.append(f"largest samples at {rate:.4g} Hz; the motion between samples can be larger")
    lines.append(f"{'point':10}{'m':>12}{'m/s':>12}{'m/s²':>12}")
    for row, point in enumerate(run.points):
        largest = (np.abs(motion[row]).max() for motion in (run.displacement, run.velocity, run.acceleration))
        lines.append(f"{point:10}" + "".join(f"{value:12.4g}" for value in largest))
    lines.append("")
    for noun in [name for name in ("damper", "joint") if name in (run.events.dtype.names or ())]:
        for number in sorted({int(number) for number in run.events[noun]} - {0}):
            events = run.events[run.events[noun] == number]
            counts = Counter(str(kind) for kind in events["kind"])
            event_counts = [f"{kind} {counts[kind]}" for kind in dict.fromkeys(EVENT_NAMES.tolist()) if counts[kind]]
            fastest = events["speed"].max()  # slips and stops are no impacts, and have the speed zero
            impact = f"; fastest impact {fastest:.4g} m/s" if fastest else ""
            lines.append(f"{noun} {number}: {', '.join(event_counts)}{impact}")
    lines.append(f"events: {len(run.events)}; contacts decided by rounding errors: {run.ambiguous}")
    energy = run.energy
    lines += [
        "",
        f"work of the drive      {energy.work:12.6g} J",
        f"dissipated in damping  {energy.dissipated:12.6g} J",
        f"lost in damper impacts {energy.impacts:12.6g} J",
        f"lost in contacts       {energy.contacts:12.6g} J",
        *([f"transferred to grains  {energy.grains:12.6g} J"] if energy.grains else []),
        f"increase of stored     {energy.stored - energy.stored_before:12.6g} J",
        f"residual of balance    {energy.residual:12.2g} J",
    ]
    return "\n".join(lines)


def write_run(run: Run, path: Path) -> None:
    """Write a run: everything as .npz, or time, motion and gaps as columns of a .csv.

    `path`: the extension selects the format. Raises `SceneError` if the extension is not supported, or the file
    cannot be written.
    """
    check_suffix(path)
    with atomic_write(path) as temporary:
        if path.suffix == ".npz":
            fields = ("time", "displacement", "velocity", "acceleration", "gap", "contact")
            arrays = {name: getattr(run, name) for name in fields}
            # Files do not store the metadata of record arrays, so the count is a separate array.
            events = run.events.astype(np.dtype(run.events.dtype.descr))
            np.savez_compressed(
                temporary, points=np.array(run.points), events=events, ambiguous=run.ambiguous, **arrays
            )
        else:
            _write_columns(run, temporary)


def _write_columns(run: Run, path: Path) -> None:
    """Write time, motion and gaps as columns of a .csv file."""
    motion = {
        "displacement_m": run.displacement,
        "velocity_m_per_s": run.velocity,
        "acceleration_m_per_s2": run.acceleration,
    }
    header = ["time_s", *(f"{point.replace(' ', '')}_{name}" for name in motion for point in run.points)]
    header += [f"gap{k + 1}_m" for k in range(len(run.gap))]
    table = np.column_stack([run.time, *(rows.T for rows in motion.values()), run.gap.T])
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(map(escape_cell, header))
        # The text of `repr` gives the identical value when it is read again.
        writer.writerows([[repr(float(value)) for value in row] for row in table])
