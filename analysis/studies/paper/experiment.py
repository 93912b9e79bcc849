"""Virtual experiments of the reproduction: recordings of scenes, and the results of their analysis."""

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import daq
from analysis.core.damper_motion.impact_detection import detect_impacts
from analysis.core.decays.free_decay import decay
from analysis.core.modal.identification import identify
from analysis.core.responses.frequency_responses import frequency_responses
from analysis.core.responses.measurands import reference_of
from analysis.studies.paper.store import Arrays
from daq.core.measurement.run_report import is_recorded
from daq.core.recording.recording import Recording
from rig.core.base.errors import RecordingError
from rig.core.base.output_files import atomic_write
from rig.core.scene.scene import Scene

BODIES = ("body1", "body2", "body3")


def open_or_record(scene: Scene, path: Path) -> Recording:
    """Open the recording of a scene; record it first, unless this version of shotrig recorded it completely."""
    if is_recorded(scene, path):
        recording = daq.open(path)
        if not recording.gaps:
            return recording
        recording.close()
    with warnings.catch_warnings(), atomic_write(path, overwrite=True) as partial:
        # The recording stores the warnings of the test as markers, and the analysis reports the markers.
        warnings.simplefilter("ignore", daq.RunWarning)
        daq.record(scene, partial, overwrite=True)
    return daq.open(path)


def sweep(scene: Scene, path: Path) -> Arrays:
    """Record a stepped sine, and estimate the compliances X_j / F_1 of the bodies.

    Returns `frequency` in Hz, shape (points,); `compliance` and its `error` in m/N, and `coherence`, each of shape
    (bodies, points).
    """
    with open_or_record(scene, path) as recording:
        curves = frequency_responses(recording, BODIES)[0]
        return {
            "frequency": curves[0].frequency,
            "compliance": np.array([curve.value for curve in curves]),
            "error": np.array([curve.error for curve in curves]),
            "coherence": np.array([curve.coherence for curve in curves]),
        }


def bare_sweep(scene: Scene, path: Path) -> Arrays:
    """Record a stepped sine of a structure without dampers; estimate compliances, transmissibilities and modes.

    Returns the entries of `sweep`; `transfer`, the transmissibilities X_j / X_0, shape (bodies, points); `omega` and
    `omega_error` in rad/s, and `damping`, the damping ratios, each of shape (modes,); and the mode `shapes`, with a
    largest component of 1, shape (bodies, modes).
    """
    with open_or_record(scene, path) as recording:
        arrays = sweep(scene, path)
        curves = frequency_responses(recording, BODIES, reference="table")[0]
        arrays["transfer"] = np.array([curve.value for curve in curves])
        modes = identify(frequency_responses(recording, BODIES)[0], count=3)
        shapes = modes.residue.imag
        arrays["omega"], arrays["omega_error"] = 2 * np.pi * modes.frequency, 2 * np.pi * modes.frequency_std
        arrays["damping"] = modes.damping
        largest = np.take_along_axis(shapes, np.abs(shapes).argmax(axis=0)[None], axis=0)
        arrays["shapes"] = shapes / largest
        return arrays


def damper_sweep(scene: Scene, path: Path) -> Arrays:
    """Record a stepped sine of a structure with a damper in body 2; estimate compliances and impact phases.

    Returns the entries of `sweep`, and the entries of `impact_phases` with the prefix ``impact_``.
    """
    phases = impact_phases(scene, path)
    return sweep(scene, path) | {f"impact_{key}": values for key, values in phases.items()}


def impact_phases(scene: Scene, path: Path) -> Arrays:
    """Estimate the impact phases of the damper in body 2 at each frequency.

    The impacts are detected in the acceleration of body 2. The reference of the phases is the spring force. Returns
    arrays of shape (points,): `frequency` in Hz; `phi`, the phase lag of the force at the floor impact [rad]; `tau_1`,
    the phase from the floor impact to the ceiling impact [rad]; `floor` and `ceiling`, the numbers of impacts per
    period. A phase is NaN unless there is about one impact per period and the phases scatter little. The phase tau_0 of
    the take-off cannot be measured, because a take-off causes no velocity jump.
    """
    frequencies, phis, taus, floors, ceilings = [], [], [], [], []
    with open_or_record(scene, path) as recording:
        channels = list(reference_of(recording, "force").channels)
        for marker in recording.markers:
            if marker.kind != "measure" or "frequency" not in marker.fields or marker.last_sample is None:
                continue
            frequency = float(marker.fields["frequency"])
            first, stop = marker.first_sample, marker.last_sample + 1
            periods = (stop - first) / recording.rate * frequency
            force_phase = _force_phase(recording, channels, frequency, first, stop)
            floor, ceiling = _impact_phases(recording, "body2", frequency, first, stop)
            floor_phase = _mean_phase(floor, periods)
            frequencies.append(frequency)
            floors.append(len(floor) / periods)
            ceilings.append(len(ceiling) / periods)
            # At the phase theta = 2 pi f t, the force is sin(theta + force_phase + pi/2). At the impact: sin(-phi).
            phis.append((-(floor_phase + force_phase + np.pi / 2)) % (2 * np.pi))
            taus.append((_mean_phase(ceiling, periods) - floor_phase) % (2 * np.pi))
    return {
        "frequency": np.array(frequencies),
        "phi": np.array(phis),
        "tau_1": np.array(taus),
        "floor": np.array(floors),
        "ceiling": np.array(ceilings),
    }


def _impact_phases(
    recording: Recording, channel: str, frequency: float, first: int, stop: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the phases of the floor impacts and of the ceiling impacts in a section of a recording [rad]."""
    try:
        detected = detect_impacts(recording, channel, first, stop)
    except RecordingError:
        return np.zeros(0), np.zeros(0)
    in_section = (detected.time >= first / recording.rate) & (detected.time < stop / recording.rate)
    phases = (2 * np.pi * frequency * detected.time) % (2 * np.pi)
    return phases[in_section & (detected.wall == "floor")], phases[in_section & (detected.wall == "ceiling")]


def _mean_phase(phases: NDArray[np.float64], periods: float) -> float:
    """Compute the circular mean of phases; NaN unless there is about one phase per period and the scatter is small."""
    if not 0.85 * periods < len(phases) < 1.15 * periods:
        return float("nan")
    mean = np.exp(1j * phases).mean()
    return float(np.angle(mean)) if abs(mean) > 0.98 else float("nan")


def _force_phase(recording: Recording, channels: list[str], frequency: float, first: int, stop: int) -> float:
    """Estimate the phase of the spring force in rad; the phase of its cosine is zero at sample 0."""
    phase_factor = np.exp(-2j * np.pi * frequency * np.arange(first, stop) / recording.rate)
    amplitudes = np.array([(recording.read(name, first, stop) * phase_factor).mean() for name in channels])
    row = reference_of(recording, "force").row(recording, channels, np.array([frequency]))[:, 0]
    return float(np.angle(amplitudes @ row))


def ring_down(scene: Scene, path: Path) -> Arrays:
    """Record an impact test, and evaluate the free decay of the acceleration of body 3 after the first impact.

    Returns `time` in s, `acceleration` and `envelope` in m/s², each of shape (samples,); `time_of_6_db`, the time in
    which the energy decreases by 6 dB, s; and `time_below_1_g`, the time after which the acceleration stays below
    1 g [s].
    """
    with open_or_record(scene, path) as recording:
        measured = decay(recording, "body3")
        return {
            "time": measured.time,
            "acceleration": measured.acceleration,
            "envelope": measured.envelope,
            "time_of_6_db": np.array(measured.halving),
            "time_below_1_g": np.array(measured.quiet_from),
        }
