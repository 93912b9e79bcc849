"""The demonstration: record the tests of Inoue, Yokomichi, Hiraki (2011) and reproduce its Figs 8 and 10b from them."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from analysis.commands.presentation.decay_findings import present_decay
from analysis.commands.presentation.frf_findings import present_frf
from analysis.commands.presentation.mode_findings import present_modes
from daq.core.measurement.run_report import is_recorded
from rig.core.base.errors import SceneError
from rig.core.base.output_files import allow_overwriting, create_folder
from rig.core.base.workers import Workers
from rig.core.scene.scene import Scene

# Built-in scenes of the stepped sines and of the impact tests, which are also the names of the recordings.
STEPPED_SINES = ("fig8-no-damper", "fig8-three-dampers")
IMPACT_TESTS = ("fig10b-no-damper", "fig10b-three-dampers")

# Coarse frequency grid over the band [Hz].
_COARSE_HZ = np.linspace(8.0, 60.0, 34)
# Fine grids [Hz] around the resonances, wide enough for the resonances that resting dampers lower by their mass.
_FINE_HZ = (np.linspace(11.8, 13.6, 14), np.linspace(32.0, 35.6, 13), np.linspace(45.5, 51.0, 12))


def frequencies() -> list[float]:
    """Return the frequencies of the demonstration's stepped sines [Hz].

    >>> frequencies()[0], frequencies()[-1]
    (8.0, 60.0)
    """
    return [float(f) for f in np.unique(np.round(np.concatenate([_COARSE_HZ, *_FINE_HZ]), 3))]


def demonstrate(
    folder: Path, print_line: Callable[[str], None], sweep_hz: Sequence[float] | None = None, overwrite: bool = False
) -> list[Path]:
    """Record two stepped sines and two impact tests in parallel, analyze them, and suggest next commands.

    Figures and tables of an earlier demonstration are replaced.

    `folder`: output folder for recordings, figures and tables; `print_line`: called with each line of text; `sweep_hz`:
    frequencies of the stepped sines [Hz]; default: `frequencies`; `overwrite`: whether other recordings may be
    replaced. Returns all files written.
    """
    start = time.monotonic()
    create_folder(folder)
    print_line("Recording two stepped sines (without and with three dampers) and two impact tests ...")
    recordings = {name: folder / f"{name}.mcap" for name in (*STEPPED_SINES, *IMPACT_TESTS)}
    # The long stepped sines start first; the short impact tests then use the first core that becomes free.
    jobs = [(name, path, tuple(sweep_hz or frequencies())) for name, path in recordings.items()]
    for name, path, frequencies_hz in jobs:
        if path.exists() and not (overwrite or is_recorded(_scene(name, frequencies_hz), path)):
            raise SceneError(
                f"{path} exists and is not a recording of the demonstration. Choose another folder with --output, or "
                "pass --overwrite."
            )
    with Workers() as workers:
        for number, seconds in workers.compute(_record, jobs):
            elapsed = time.monotonic() - start
            print_line(f"  {jobs[number][1]}: {seconds:.0f} s of test, recorded {elapsed:.0f} s after the start")
    files = list(recordings.values())
    print_line("Estimating compliance, decay and modes from the recordings alone ...")
    stepped_sines, impact_tests = (
        [recordings[name] for name in STEPPED_SINES],
        [recordings[name] for name in IMPACT_TESTS],
    )
    with allow_overwriting(True):
        results = (
            present_frf(stepped_sines, folder, theory=True),
            present_decay(impact_tests, folder, "body3"),
            present_modes(stepped_sines[:1], folder),
        )
    for result in results:
        for line in result.lines:
            print_line(f"  {line}")
        for warning in result.warnings:
            print_line(f"  warning: {warning}")
        files += result.files
    print_line(f"Done in {time.monotonic() - start:.0f} s. Written:")
    for path in files:
        print_line(f"  {path}")
    print_line("Next commands:")
    for command in (
        f"daq replay {recordings['fig8-three-dampers']}",
        f"daq info {recordings['fig10b-three-dampers']}",
        f"analysis report {' '.join(str(path) for path in stepped_sines)}",
        "rig scenes",
    ):
        print_line(f"  {command}")
    return files


def _scene(name: str, sweep_hz: tuple[float, ...]) -> Scene:
    """Return a built-in scene; a stepped sine has the frequencies `sweep_hz` [Hz]."""
    import rig

    scene = rig.load(name)
    if name not in STEPPED_SINES:
        return scene
    # The force is that of Fig. 8. The longest wait is 20 s: after this time even the slowest transient has decayed.
    test = {"kind": "stepped_sine", "frequencies": sweep_hz, "force": 2.6, "settle": {"longest": 20.0}}
    return scene.replace(test=test)


def _record(job: tuple[str, Path, tuple[float, ...]]) -> float:
    """Record one scene and return the duration of the recording in s."""
    import warnings

    import daq

    name, path, sweep_hz = job
    with warnings.catch_warnings():
        # The recording's markers contain the same warnings, and the analysis reports them.
        warnings.simplefilter("ignore", daq.RunWarning)
        daq.record(_scene(name, sweep_hz), path, overwrite=True)
    with daq.open(path) as rec:
        return rec.samples / rec.rate
