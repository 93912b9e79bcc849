"""Cost of the measurement chain: error of the measured compliance against the time that record and analysis take.

Short stepped sines run through the whole chain of the scene, closed loop and into a file, with one thing in the
chain changed at a time. Each compliance is compared with the exact one.
"""

from __future__ import annotations

import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.chain_cost.variants import Variant, plain, quiet, variants
from analysis.responses.frequency_responses import frequency_responses
from daq.measurement.run import record
from daq.recording.recording import open as open_recording
from rig.errors import RunError, ShotrigError
from rig.motion_map.grid import columns
from rig.scene.excitation import Measure, Settle, SteppedSine
from rig.scene.quantities import FREQUENCY, positives
from rig.scene.scene import Scene
from rig.steady_response.frequency_response import frequency_response
from rig.system.assembly import assemble
from rig.system.open_loop_drive import accelerations_per_level, drive_per_level, level_of, with_ideal_force
from rig.system.structural_model import receptance, structural_model

if TYPE_CHECKING:
    from daq.recording.recording import Recording

#: Frequencies tried for a steady motion that repeats every period.
CANDIDATES = 15
#: The test waits until no more than this share of any amplitude is still to come,
SETTLED = 1e-5
#: or for this number of decay times of the slowest mode,
DECAYS = 10.0
#: but at least this time, s,
SHORTEST = 20.0
#: and at most this time, s.
LONGEST = 60.0
#: Periods in a measurement.
PERIODS = 50
#: Every recording is made so many times; the quickest counts.
REPEATS = 2
#: Residual to which the engine waits for the steady motion that a recording is compared with.
EXACT = 1e-10
#: Two motions agree, for the choice of frequencies.
SAME = 1e-4

Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class Measurement:
    """One chain, measured."""

    group: str
    setting: str
    """What is changed, and to what."""
    cpu: float
    """CPU time to record and to analyse, s; NaN if that failed."""
    duration: float  # Length of the test, s
    error: float
    """Of the compliance of any measured body at any of the frequencies, relative to the largest there, each
    channel corrected by its data sheet: the frequency response of sensor, amplifier and converter."""
    corrected: float
    """What that correction takes away: largest error of a displacement read by the channels' nominal
    sensitivities alone, relative. In a compliance much of it cancels where all channels are alike."""
    note: str = ""
    """Warnings of the test and of the analysis; why it failed."""


@dataclass(frozen=True)
class ChainStudy:
    """What `chain_study` found."""

    scene: Scene  # With its chain written out
    frequency: tuple[float, ...]  # Hz
    own: Measurement  # The scene as it is
    quiet: Measurement
    """The same without what no data sheet can correct (noise, quantisation, tolerances and bias of the
    sensors): from here one thing is changed at a time."""
    points: tuple[Measurement, ...]
    """One thing changed at a time."""
    reference: str
    """What the errors refer to, and how it is known."""


def chain_study(
    scene: Scene,
    frequencies: Sequence[float] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> ChainStudy:
    """Measure what every part of a scene's measurement chain does to the compliance, and what it costs.

    Parameters
    ----------
    scene : Scene
        With a shaker, and a test that gives a level and, unless one is given, a frequency.
    frequencies : sequence of float, optional
        Hz; None: the lowest, the highest and the hardest (largest acceleration) of the test's range at which the
        motion repeats every period, whichever way one comes there.
    progress : callable, optional
        Called with (recordings done, in all).

    Raises
    ------
    SceneError
        If nothing drives the scene, or its channels do not measure the force.
    RunError
        If the motion repeats nowhere, or the scene as it is cannot be measured.

    Notes
    -----
    A structure without working dampers is linear: its exact compliance is the solution of the equations at the
    frequency (`receptance`). With dampers the compliance depends on the level. The recording notes the drive
    amplitude that the controller arrived at; the engine's own steady motion under that very drive, followed until it
    repeats within 1e-10, is what the sensors had before them (`rig cost` measures the engine itself against
    arithmetic of 40 digits). Neither sees the chain.
    """
    base = plain(scene)
    level_of(base)
    chosen = (
        tuple(np.unique(positives(frequencies, FREQUENCY, "frequencies")).tolist())
        if frequencies
        else steady_frequencies(base)
    )
    base = base.replace(
        test=_test(base, chosen), recording=base.recording.replace(display=False, truth=False)
    )
    hardest = chosen[int(np.argmax(_accelerations(base, chosen)))]
    linear = assemble(base).dampers == 0
    with tempfile.TemporaryDirectory() as folder:
        bench = _Bench(Path(folder), linear)
        # What is compiled or loaded at first use is no part of the cost; the voltages are found on the way.
        try:
            volts = bench.largest_volts(base)
        except ShotrigError as error:
            raise type(error)(f"the scene as it is cannot be measured: {error}") from None
        todo = [
            Variant("", "as it is", base),
            Variant("", "without the uncorrectable", quiet(base)),
            *variants(base, min(chosen), hardest, max(chosen), volts),
        ]
        found: list[Measurement] = []
        for number, variant in enumerate(todo):
            if progress is not None:
                progress(number, len(todo))
            found.append(bench.measurement(variant))
            if np.isnan(found[0].error):
                raise RunError(f"the scene as it is cannot be measured: {found[0].note}")
    reference = (
        "the exact solution of the linear equations"
        if linear
        else f"the engine's steady motion under the drive that the recording notes, repeating within {EXACT:.0e}"
    )
    return ChainStudy(base, chosen, found[0], found[1], tuple(found[2:]), reference)


def steady_frequencies(scene: Scene) -> tuple[float, ...]:
    """Find frequencies at which the motion repeats every period, the same upwards and downwards.

    Returns
    -------
    tuple of float
        The lowest, the hardest and the highest of some in the test's range, Hz; rising.

    Raises
    ------
    RunError
        If there are none.
    """
    motion = with_ideal_force(scene)
    candidates = columns(motion, points=CANDIDATES)
    if assemble(motion).dampers == 0:
        good = np.ones(len(candidates), dtype=bool)
    else:
        response = frequency_response(motion, candidates, direction="both", tolerance=1e-6, longest=6000)
        up, down = (
            response.compliance[:, : len(candidates)],
            response.compliance[:, : len(candidates) - 1 : -1],
        )
        repeats = response.converged & (response.repetition == 1)
        good = repeats[: len(candidates)] & repeats[: len(candidates) - 1 : -1]
        good &= np.abs(up - down).max(axis=0) < SAME * np.abs(up).max(axis=0)
    if not good.any():
        raise RunError(
            "the motion repeats every period at none of the frequencies tried: there is no compliance to compare "
            "with; try others with --frequency, or another level"
        )
    kept = candidates[good]
    hardest = kept[int(np.argmax(_accelerations(motion, kept)))]
    return tuple(sorted({float(f"{f:.4g}") for f in (kept[0], hardest, kept[-1])}))


def _accelerations(scene: Scene, frequencies: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    system = assemble(scene)
    return np.array([accelerations_per_level(scene, system, 2.0 * np.pi * f).max() for f in frequencies])


def _test(scene: Scene, frequencies: tuple[float, ...]) -> SteppedSine:
    """Make a short stepped sine at the scene's level that waits longer than usual."""
    slowest = max(float(structural_model(scene).modes.decay_rate.min()), DECAYS / LONGEST)
    name = "force" if getattr(scene.test, "force", None) is not None else "drive"
    return SteppedSine(
        **{name: level_of(scene)},
        frequencies=frequencies,
        settle=Settle(tolerance=SETTLED, longest=max(DECAYS / slowest, SHORTEST)),
        measure=Measure(periods=PERIODS),
    )


class _Bench:
    """Records and analyses in a folder."""

    def __init__(self, folder: Path, linear: bool) -> None:
        self._folder, self._linear = folder, linear

    def largest_volts(self, scene: Scene) -> float:
        """Largest voltage at the converter during the test."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            path = self._record(scene)
        with open_recording(path) as rec:
            return max(
                float(np.nanmax(np.abs(rec.read(name)))) * info.sensitivity
                for name, info in rec.channels.items()
            )

    def measurement(self, variant: Variant) -> Measurement:
        """Record and analyse a variant, and compare with the truth."""
        times, notes = [], []
        try:
            for _ in range(REPEATS):
                begun = time.process_time()
                with warnings.catch_warnings(record=True) as caught:
                    warnings.simplefilter("always")
                    path = self._record(variant.scene)
                    with open_recording(path) as rec:
                        curves = frequency_responses(rec)[0]
                times.append(time.process_time() - begun)
            # That some steps have not settled to 1e-5 shows in their errors.
            notes += [str(warning.message) for warning in caught if "overload" in str(warning.message)]
            notes += [warning for curve in curves for warning in curve.warnings if "overload" in warning]
            with open_recording(path) as rec:
                true = self._truth(rec)
                measured = np.array([curve.value for curve in curves])
                corrected = _correction(rec)
                duration = rec.samples / rec.rate
                if measured.shape != true.shape or not np.isfinite(measured).all():
                    raise RunError("; ".join(dict.fromkeys(notes)) or "the channels read nothing")
        except ShotrigError as error:
            nan = float("nan")
            return Measurement(variant.group, variant.setting, nan, nan, nan, nan, str(error))
        return Measurement(
            variant.group,
            variant.setting,
            min(times),
            duration,
            _miss(measured, true),
            corrected,
            " ".join(dict.fromkeys(notes)),
        )

    def _record(self, scene: Scene) -> Path:
        return record(scene, self._folder / "chain.mcap", overwrite=True)

    def _truth(self, rec: Recording) -> Complex:
        """Exact compliance of the measured bodies, in the order of the recording's channels."""
        scene = rec.scene
        marks = [marker.fields for marker in rec.markers if marker.kind == "measure"]
        frequencies = [float(mark["frequency"]) for mark in marks]
        if self._linear:
            bodies = receptance(scene, frequencies)
        else:
            bodies = np.stack(
                [_driven(scene, f, float(mark["drive"])) for f, mark in zip(frequencies, marks, strict=True)],
                axis=1,
            )
        places = [info.at for info in rec.channels.values() if info.at.startswith("body")]
        return bodies[[int(place.removeprefix("body ")) - 1 for place in places]]


def _driven(scene: Scene, frequency: float, drive: float) -> Complex:
    """Compliance of all bodies under a drive of given amplitude."""
    name = "force" if scene.driven_shaker is not None and scene.driven_shaker.kind == "force" else "drive"
    test = SteppedSine(**{name: drive}, frequencies=(frequency,))
    scene = scene.replace(test=test)
    # Samples joined by straight lines are a tone of this much less; and to the engine, a table's drive is where the
    # table goes, to its servo at its commanded position.
    smaller = float(np.sinc(frequency / scene.converter.sample_rate)) ** 2
    smaller /= abs(drive_per_level(scene, assemble(scene), 2.0 * np.pi * frequency))
    scene = scene.replace(test=test.replace(**{name: drive * smaller}))
    response = frequency_response(scene, [frequency], tolerance=EXACT)
    if not response.converged[0]:
        raise RunError(f"no steady motion at {frequency:g} Hz to compare with")
    return response.compliance[:, 0]


def _correction(rec: Recording) -> float:
    """Largest relative error of any channel, at the frequencies measured, as its data sheet says."""
    frequencies = [float(mark.fields["frequency"]) for mark in rec.markers if mark.kind == "measure"]
    return max(float(np.abs(info.response(frequencies) - 1.0).max()) for info in rec.channels.values())


def _miss(value: Complex, true: Complex) -> float:
    """Largest error of any body, relative to the largest at that frequency."""
    return float((np.abs(value - true).max(axis=0) / np.abs(true).max(axis=0)).max())
