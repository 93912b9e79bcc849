"""Virtual experiments of the reproduction: recordings of scenes with the virtual rig, and their evaluation."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import daq
from analysis.damper_motion.impact_detection import detect_impacts
from analysis.decays.free_decay import decay
from analysis.modal.identification import identify
from analysis.reproduction.store import Arrays, partial_name
from analysis.responses.frequency_responses import frequency_responses
from analysis.responses.measurands import reference_of
from daq.recording.recording import Recording
from rig.errors import RecordingError, ShotrigError
from rig.scene.scene import Scene

BODIES = ("body1", "body2", "body3")


def open_or_record(scene: Scene, path: Path) -> Recording:
    """Open the recording of a scene; record it first unless a complete recording of the same scene exists."""
    try:
        recording = daq.open(path)
        if recording.scene == scene and not recording.gaps:
            return recording
        recording.close()
    except ShotrigError:
        # The recording is missing or was interrupted: record it again.
        pass
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = partial_name(path)
    with warnings.catch_warnings():
        # Warnings of the test are stored as markers of the recording and reported by the analysis.
        warnings.simplefilter("ignore", daq.RunWarning)
        daq.record(scene, partial, overwrite=True)
    partial.replace(path)
    return daq.open(path)


def sweep(scene: Scene, path: Path) -> Arrays:
    """Estimate the compliances of the bodies, X_j / F_1, from a stepped-sine recording.

    Returns `frequency` [Hz] (points,), and `compliance`, `error` [m/N] and `coherence` (bodies, points).
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
    """Estimate compliances as `sweep`, transmissibilities X_j / X_0, and modal parameters from a recording.

    Returns the entries of `sweep`; `transfer` (bodies, points), the transmissibilities; `omega` and `omega_error`
    [rad/s], and `damping` (modes,); and mode `shapes` (bodies, modes) with largest element 1.
    """
    with open_or_record(scene, path) as recording:
        arrays = sweep(scene, path)
        curves = frequency_responses(recording, BODIES, reference="table")[0]
        arrays["transfer"] = np.array([curve.value for curve in curves])
        modes = identify(frequency_responses(recording, BODIES)[0], count=3)
        shapes = modes.residue.imag
        arrays["omega"], arrays["omega_error"] = (2 * np.pi * modes.frequency, 2 * np.pi * modes.frequency_error)
        arrays["damping"] = modes.damping
        largest = np.take_along_axis(shapes, np.abs(shapes).argmax(axis=0)[None], axis=0)
        arrays["shapes"] = shapes / largest
        return arrays


def damper_sweep(scene: Scene, path: Path) -> Arrays:
    """Estimate compliances as `sweep`, and as ``impact_...`` the results of `impact_phases`."""
    phases = impact_phases(scene, path)
    return sweep(scene, path) | {f"impact_{key}": values for key, values in phases.items()}


def impact_phases(scene: Scene, path: Path) -> Arrays:
    """Estimate impact phases of the damper in body 2 over frequency, from the channel on it and the spring force.

    Returns arrays of shape (points,): `frequency` [Hz]; `phi`, phase lag of the force at the floor impact [rad];
    `tau_1`, phase of the ceiling impact after the floor impact [rad]; `floor` and `ceiling`, impacts per period. A
    phase is NaN unless there is about one impact per period, with small scatter. Take-off causes no velocity jump, so
    tau_0 cannot be measured.
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
            phase = _force_phase(recording, channels, frequency, first, stop)
            floor, ceiling = _impact_phases(recording, "body2", frequency, first, stop)
            phi = _mean_phase(floor, periods)
            frequencies.append(frequency)
            floors.append(len(floor) / periods)
            ceilings.append(len(ceiling) / periods)
            # The force is sin(theta + pi/2 + phase) at the time phase theta, and sin(-phi) at the impact.
            phis.append((-(phi + phase + np.pi / 2)) % (2 * np.pi))
            taus.append((_mean_phase(ceiling, periods) - phi) % (2 * np.pi))
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
    """Compute the phases [rad] of floor and ceiling impacts in a section of the recording."""
    try:
        detected = detect_impacts(recording, channel, first, stop)
    except RecordingError:
        return np.zeros(0), np.zeros(0)
    in_section = (detected.time >= first / recording.rate) & (detected.time < stop / recording.rate)
    phases = (2 * np.pi * frequency * detected.time) % (2 * np.pi)
    return phases[in_section & (detected.wall == "floor")], phases[in_section & (detected.wall == "ceiling")]


def _mean_phase(phases: NDArray[np.float64], periods: float) -> float:
    """Compute the circular mean of phases; NaN unless there is about one per period with small scatter."""
    if not 0.85 * periods < len(phases) < 1.15 * periods:
        return float("nan")
    mean = np.exp(1j * phases).mean()
    return float(np.angle(mean)) if abs(mean) > 0.98 else float("nan")


def _force_phase(recording: Recording, channels: list[str], frequency: float, first: int, stop: int) -> float:
    """Estimate the phase of the spring force, with sample 0 as the time origin."""
    phase_factor = np.exp(-2j * np.pi * frequency * np.arange(first, stop) / recording.rate)
    amplitudes = np.array([(recording.read(name, first, stop) * phase_factor).mean() for name in channels])
    row = reference_of(recording, "force").row(recording, channels, np.array([frequency]))[:, 0]
    return float(np.angle(amplitudes @ row))


def ring_down(scene: Scene, path: Path) -> Arrays:
    """Compute the free decay of body 3's acceleration after the first hit.

    Returns `time` [s], `acceleration` and `envelope` [m/s²] (samples,); `time_of_6_db`, in which the energy falls by
    6 dB [s]; `time_below_1_g`, from which the acceleration stays below 1 g [s].
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
