"""Cost of the measurement chain: error of the measured compliance, and computing time of recording and analysis.

Short stepped-sine tests are recorded through the whole chain of the scene, in closed loop and into a file. One part
of the chain is changed at a time. Each measured compliance is compared with the exact compliance.
"""

import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from analysis.core.responses.frequency_responses import frequency_responses
from analysis.studies.cost.variants import Variant, expand_chain, variants, without_noise
from daq.core.measurement.run import record
from daq.core.recording.recording import Recording
from daq.core.recording.recording import open as open_recording
from rig.core.base.arrays import ComplexArray
from rig.core.base.errors import RunError, ShotrigError
from rig.core.base.output_files import temporary_folder
from rig.core.base.progress import CountProgress
from rig.core.scene.excitation import Measure, Settle, SteppedSine
from rig.core.scene.scene import Scene
from rig.core.settings.quantities import FREQUENCY, positive_values
from rig.core.steady_response.frequency_response import frequency_response
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import accelerations_per_level, drive_per_level, level_of, with_ideal_force
from rig.core.system.structural_model import receptance, structural_model
from rig.studies.motion_map.grid import select_frequencies

#: Number of frequencies at which a motion that repeats every period is searched.
CANDIDATE_FREQUENCIES = 15
#: A measurement starts when the transient is at most this fraction of the amplitude.
SETTLE_TOLERANCE = 1e-5
#: The wait for steady state ends after this number of decay times of the slowest mode.
MAX_WAIT_DECAY_TIMES = 10.0
#: Minimum of the permitted wait for steady state [s].
MIN_TIMEOUT_S = 20.0
#: The wait for steady state ends after this time [s].
MAX_TIMEOUT_S = 60.0
#: Number of periods in a measurement.
PERIODS = 50
#: Each recording is repeated this many times; the shortest time is reported.
REPEATS = 2
#: The reference motion is in steady state if it changes by at most this fraction from period to period.
REFERENCE_TOLERANCE = 1e-10
#: A frequency is used if the responses of upward and downward sweep differ by at most this fraction, so that only one
#: motion exists there.
SAME_MOTION_TOLERANCE = 1e-4
#: Message for a scene whose unchanged chain gives no result.
UNMEASURABLE = "the unchanged scene cannot be measured: {}"


@dataclass(frozen=True)
class Measurement:
    """Measured error and time of a chain variant."""

    group: str  # changed part of the chain; "" for the scene itself
    setting: str  # setting of the changed part
    cpu: float  # CPU time of recording and analysis [s]; NaN after a failure
    duration: float  # length of the test [s]
    error: float
    """Largest error of the compliance over measured bodies and frequencies, relative to the largest compliance.
    Channels are corrected for the frequency response of sensor, amplifier and converter from the data sheets.
    """
    correction: float
    """Size of this correction: largest relative error of a displacement without correction. In a compliance, most of
    the error cancels if all channels are identical.
    """
    note: str = ""  # warnings about overloads, or the reason of a failure


@dataclass(frozen=True)
class ChainStudy:
    """Result of `chain_study`."""

    scene: Scene  # with presets expanded and all channels named
    frequency: tuple[float, ...]  # Hz
    unchanged: Measurement  # the unchanged scene
    without_noise: Measurement
    """The scene without noise, quantization, sensor tolerances and bias, which no data sheet can correct; the
    baseline of all changes."""
    points: tuple[Measurement, ...]  # results with one part of the chain changed at a time
    reference: str  # reference of the errors, and its origin


def chain_study(
    scene: Scene, frequencies: Sequence[float] | None = None, progress: CountProgress | None = None
) -> ChainStudy:
    """Measure the effect of each part of a measurement chain on the compliance, and its computing time.

    A structure without moving dampers is linear: the reference is its exact compliance. With dampers the compliance
    depends on the level. The reference is then the engine's steady-state motion under the recorded drive amplitude that
    the controller reached. This motion is computed until it repeats within 1e-10. `rig cost` compares the engine with
    arithmetic of 40 digits. Both references are independent of the measurement chain.

    `scene`: has a shaker and a test with a level. `frequencies`: Hz; None: `steady_frequencies` selects them from the
    range of the test. Raises `SceneError` if nothing drives the scene, or its channels do not measure the force. Raises
    `RunError` if no motion repeats every period, or the unchanged scene cannot be measured.
    """
    expanded = expand_chain(scene)
    level_of(expanded)
    test_frequencies = (
        tuple(np.unique(positive_values(frequencies, FREQUENCY, "frequencies")).tolist())
        if frequencies
        else steady_frequencies(expanded)
    )
    expanded = expanded.replace(
        test=_test(expanded, test_frequencies), recording=expanded.recording.replace(display=False, truth=False)
    )
    peak_frequency = test_frequencies[int(np.argmax(_accelerations(expanded, test_frequencies)))]
    linear = assemble(expanded).dampers == 0
    with temporary_folder() as folder:
        bench = _Bench(folder, linear)
        # A run without measurement excludes compilation from the cost, and yields the largest voltage.
        try:
            largest_voltage = bench.largest_voltage(expanded)
        except ShotrigError as error:
            raise type(error)(UNMEASURABLE.format(error)) from None
        all_variants = [
            Variant("", "as it is", expanded),
            Variant("", "without noise and tolerances", without_noise(expanded)),
            *variants(expanded, min(test_frequencies), peak_frequency, max(test_frequencies), largest_voltage),
        ]
        measured: list[Measurement] = []
        for number, variant in enumerate(all_variants):
            if progress is not None:
                progress(number, len(all_variants))
            measured.append(bench.measurement(variant))
            if np.isnan(measured[0].error):
                raise RunError(UNMEASURABLE.format(measured[0].note))
    reference = (
        "the exact solution of the linear equations"
        if linear
        else f"the engine's steady motion under the drive stated in the recording, repeating "
        f"within {REFERENCE_TOLERANCE:.0e}"
    )
    return ChainStudy(expanded, test_frequencies, measured[0], measured[1], tuple(measured[2:]), reference)


def steady_frequencies(scene: Scene) -> tuple[float, ...]:
    """Select frequencies with the same period-1 motion in upward and downward sweeps.

    Returns, in Hz and in ascending order, the lowest and the highest of these frequencies in the test's range, and the
    frequency of largest acceleration. Raises `RunError` if there are none.
    """
    motion = with_ideal_force(scene)
    candidates = select_frequencies(motion, points=CANDIDATE_FREQUENCIES)
    if assemble(motion).dampers == 0:
        is_steady = np.ones(len(candidates), dtype=bool)
    else:
        response = frequency_response(motion, candidates, direction="both", tolerance=1e-6, longest=6000)
        upward, downward = slice(len(candidates)), slice(None, len(candidates) - 1, -1)
        up, down = response.compliance[:, upward], response.compliance[:, downward]
        is_period_1 = response.converged & (response.repetition == 1)
        is_steady = is_period_1[upward] & is_period_1[downward]
        is_steady &= np.abs(up - down).max(axis=0) < SAME_MOTION_TOLERANCE * np.abs(up).max(axis=0)
    if not is_steady.any():
        raise RunError(
            f"{scene.name}: at none of {len(candidates)} frequencies from {candidates[0]:.4g} to "
            f"{candidates[-1]:.4g} Hz does the motion repeat every period and agree in an upward and a downward sweep. "
            "Without such a motion, there is no exact compliance. Choose other frequencies (`frequency`), or "
            "change the level (test.force or test.drive)."
        )
    steady = candidates[is_steady]
    peak_frequency = steady[int(np.argmax(_accelerations(motion, steady)))]
    return tuple(sorted({float(f"{f:.4g}") for f in (steady[0], peak_frequency, steady[-1])}))


def _accelerations(scene: Scene, frequencies: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the largest acceleration of any body per unit of the level, without impacts, at each frequency."""
    system = assemble(scene)
    return np.array([accelerations_per_level(scene, system, 2.0 * np.pi * f).max() for f in frequencies])


def _test(scene: Scene, frequencies: tuple[float, ...]) -> SteppedSine:
    """Return a stepped-sine test at the scene's level, with more complete settling than usual."""
    slowest_decay_rate = max(
        float(structural_model(scene).modes.decay_rate.min()), MAX_WAIT_DECAY_TIMES / MAX_TIMEOUT_S
    )
    level_key = "force" if scene.level_key == "force" else "drive"
    return SteppedSine(
        **{level_key: level_of(scene)},
        frequencies=frequencies,
        settle=Settle(
            tolerance=SETTLE_TOLERANCE, longest=max(MAX_WAIT_DECAY_TIMES / slowest_decay_rate, MIN_TIMEOUT_S)
        ),
        measure=Measure(periods=PERIODS),
    )


class _Bench:
    """Records variants of a scene in `folder`; the exact compliance of a `linear` scene is the reference."""

    def __init__(self, folder: Path, linear: bool) -> None:
        self._folder, self._linear = folder, linear

    def largest_voltage(self, scene: Scene) -> float:
        """Record the test and return the largest voltage at the converter."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            path = self._record(scene)
        with open_recording(path) as rec:
            return max(
                float(np.nanmax(np.abs(rec.read(name)))) * info.sensitivity for name, info in rec.channels.items()
            )

    def measurement(self, variant: Variant) -> Measurement:
        """Record and analyze a variant, and compare with the reference."""
        times, notes = [], []
        try:
            for _ in range(REPEATS):
                start = time.process_time()
                with warnings.catch_warnings(record=True) as raised_warnings:
                    warnings.simplefilter("always")
                    path = self._record(variant.scene)
                    with open_recording(path) as rec:
                        curves = frequency_responses(rec)[0]
                times.append(time.process_time() - start)
            # A warning about settling is omitted, because the error includes the residual transient.
            notes += [str(warning.message) for warning in raised_warnings if "overload" in str(warning.message)]
            notes += [warning for curve in curves for warning in curve.warnings if "overload" in warning]
            with open_recording(path) as rec:
                reference = self._reference_compliance(rec)
                measured = np.array([curve.value for curve in curves])
                frequencies = [float(mark.fields["frequency"]) for mark in rec.markers if mark.kind == "measure"]
                correction = max(
                    float(np.abs(info.response(frequencies) - 1.0).max()) for info in rec.channels.values()
                )
                duration = rec.samples / rec.rate
                if measured.shape != reference.shape or not np.isfinite(measured).all():
                    raise RunError(
                        " ".join(dict.fromkeys(notes))
                        or "a channel measured no response. Check the sensitivity of each channel in the scene."
                    )
        except ShotrigError as failure:
            nan = float("nan")
            return Measurement(variant.group, variant.setting, nan, nan, nan, nan, str(failure))
        # The errors of all bodies are relative to the largest compliance at that frequency.
        errors = np.abs(measured - reference).max(axis=0) / np.abs(reference).max(axis=0)
        note = " ".join(dict.fromkeys(notes))
        return Measurement(variant.group, variant.setting, min(times), duration, float(errors.max()), correction, note)

    def _record(self, scene: Scene) -> Path:
        return record(scene, self._folder / "chain.mcap", overwrite=True)

    def _reference_compliance(self, rec: Recording) -> ComplexArray:
        """Compute the exact compliance of the measured bodies, in the order of the recording's channels."""
        scene = rec.scene
        marks = [marker.fields for marker in rec.markers if marker.kind == "measure"]
        frequencies = [float(mark["frequency"]) for mark in marks]
        if self._linear:
            compliance = receptance(scene, frequencies)
        else:
            compliance = np.stack(
                [
                    _steady_compliance(scene, f, float(mark["drive"]))
                    for f, mark in zip(frequencies, marks, strict=True)
                ],
                axis=1,
            )
        return compliance[[info.body - 1 for info in rec.channels.values() if info.body]]


def _steady_compliance(scene: Scene, frequency: float, drive: float) -> ComplexArray:
    """Compute the compliance of all bodies under a drive of given amplitude."""
    level_key = "force" if scene.driven_shaker is not None and scene.driven_shaker.drive_is_force else "drive"
    test = SteppedSine(**{level_key: drive}, frequencies=(frequency,))
    scene = scene.replace(test=test)
    # Linear interpolation between samples reduces the amplitude of a sinusoid by this factor. The drive of a table is
    # the actual position of the table for the engine, and the commanded position for the servo.
    amplitude_ratio = float(np.sinc(frequency / scene.converter.sample_rate)) ** 2
    amplitude_ratio /= abs(drive_per_level(scene, assemble(scene), 2.0 * np.pi * frequency))
    scene = scene.replace(test=test.replace(**{level_key: drive * amplitude_ratio}))
    response = frequency_response(scene, [frequency], tolerance=REFERENCE_TOLERANCE)
    if not response.converged[0]:
        raise RunError(
            f"no steady state at {frequency:g} Hz, so there is no reference for the compliance. Choose other "
            "frequencies with `frequency`."
        )
    return response.compliance[:, 0]
