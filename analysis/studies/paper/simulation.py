"""Computed results of the reproduction of Inoue, Yokomichi, Hiraki (2011).

The results come from simulation to steady state, from exact orbits, and from the approximate method of the authors.
"""

import numpy as np

from analysis.studies.paper.scan import REPORTED_BODY
from analysis.studies.paper.store import Arrays
from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.orbits.branches import follow_orbits
from rig.core.orbits.orbit import Orbit
from rig.core.orbits.periodic_orbit import periodic_orbit
from rig.core.orbits.problem import OrbitProblem
from rig.core.results import join_columns
from rig.core.scene.scene import Scene
from rig.core.steady_response.frequency_response import frequency_response
from rig.core.system.open_loop_drive import with_ideal_force
from rig.core.system.structural_model import receptance, structural_model
from rig.studies.design.worst_peak import refined_peak, response_at_level
from rig.studies.single_mode.approximate_response import follow_mode
from rig.studies.single_mode.reduction import Weighting, single_mode


def linear_properties(scene: Scene, frequencies: Array) -> Arrays:
    """Compute modes and exact compliances of a linear structure.

    Returns the natural frequencies `omega` in rad/s; the mode `shapes`, shape (bodies, modes); and two compliances in
    m/N, shape (bodies, frequencies): `compliance` without dampers, and `riding` with the masses of the dampers fixed to
    their bodies.
    """
    modes = structural_model(scene).modes
    bare = scene.replace(dampers=[])
    return {
        "omega": modes.omega,
        "shapes": modes.shapes,
        "frequency": frequencies,
        "compliance": receptance(bare, frequencies),
        "riding": receptance(scene, frequencies, riding=range(1, len(scene.dampers) + 1)),
    }


def simulate_response(scene: Scene, frequencies: Array) -> Arrays:
    """Simulate the steady-state response to a sinusoidal force at ascending frequencies by `rig.frequency_response`."""
    response = frequency_response(with_ideal_force(scene), frequencies, tolerance=1e-6, longest=4000)
    return {
        "frequency": response.frequency,
        "compliance": response.compliance,
        "peak": response.peak,
        "type": response.motion_type,
        "damper_motion": response.damper_motion,
        "repetition": response.repetition,
    }


def exact_orbits(scene: Scene, band: tuple[float, float], searches: int = 5) -> Arrays:
    """Compute the stable and unstable exact orbits (periodic motions) over a frequency band, as one table.

    The column `branch` numbers the branches. `band`: Hz; `searches`: number of frequencies at which branches are
    searched.
    """
    orbits = follow_orbits(with_ideal_force(scene), "frequency", band, searches=searches)
    rows = []
    for branch_number, branch in enumerate(orbits.branches):
        omega = 2 * np.pi * branch.value
        phases = np.array([_contact_instants(orbit) for orbit in branch.orbits]) * omega[:, None]
        rows.append(
            {
                "branch": np.full(branch.value.size, branch_number),
                "frequency": branch.value,
                "compliance": branch.compliance.T,
                "stable": branch.stable,
                "type": np.full(branch.value.size, branch.motion_type, dtype="U24"),
                # Phase lag of the force at the floor impact: the force is sin(w t), and at the impact sin(-phi).
                "phi": (-phases[:, 0]) % (2 * np.pi),
                # Phases from the floor impact to take-off, ceiling impact and take-off from the ceiling.
                "tau": (phases[:, 1:] - phases[:, :1]) % (2 * np.pi),
            }
        )
    special_points = [
        (name, value)
        for branch in orbits.branches
        for name, values in (("fold", branch.folds), ("doubling", branch.doublings), ("torus", branch.toruses))
        for value in values
    ]
    return join_columns(rows) | {
        "special": np.array([name for name, _ in special_points], dtype="U10"),
        "special_frequency": np.array([value for _, value in special_points]),
        "failures": np.array(orbits.failures, dtype=np.str_),
    }


def _contact_instants(orbit: Orbit) -> list[float]:
    """Return the instants of floor and ceiling impacts and take-offs [s]; NaN for events that do not occur."""
    if orbit.motion_type not in ("I", "II", "III"):
        return [np.nan] * 4
    floor, ceiling, separations = (
        orbit.events["time"][orbit.events["kind"] == kind] for kind in ("floor", "ceiling", "separation")
    )
    take_offs = np.sort((separations - floor[0]) % (1 / orbit.frequency)) + floor[0]
    ceiling_take_off = take_offs[-1] if orbit.motion_type == "III" else np.nan
    return [floor[0], take_offs[0], ceiling[0] if len(ceiling) else np.nan, ceiling_take_off]


def approximate_branches(
    scene: Scene, mode: int, band: tuple[float, float], weighting: Weighting, searches: int = 13
) -> Arrays:
    """Compute the branches of the approximate method as one table, with the compliances of all bodies."""
    reduced = single_mode(with_ideal_force(scene), mode, weighting=weighting)
    response, dense_frequency = follow_mode(reduced, band, searches), np.linspace(*band, 801)
    rows = [
        {
            "branch": np.full(branch.frequency.size, branch_number),
            "frequency": branch.frequency,
            "compliance": branch.compliance,
            "stable": branch.stable,
            "valid": branch.valid,
            "type": np.full(branch.frequency.size, branch.motion_type, dtype="U4"),
            "phi": branch.phi,
            "tau": np.array([branch.tau_0, branch.tau_1, branch.tau_2]).T,
        }
        for branch_number, branch in enumerate(response.branches)
    ]
    return join_columns(rows) | {
        "shape": reduced.shape,
        "mass_ratio": np.array(reduced.mass_ratio),
        "dense_frequency": dense_frequency,
        "bare": reduced.receptance(dense_frequency),
        "riding": reduced.receptance(dense_frequency, riding=True),
        "failures": np.array(response.failures, dtype=np.str_),
    }


def waveforms(scene: Scene, frequency: float) -> Arrays:
    """Compute the displacements of the bodies and the gaps of the dampers over two periods of the drive [m]."""
    orbit = periodic_orbit(scene, frequency)
    orbit_time, *motion = orbit.columns().values()
    time = np.concatenate([orbit_time + k * orbit.repetition / frequency for k in range(-1, 3)])
    shown = (time >= 0) & (time <= 2 / frequency)
    displacement = np.tile(motion, 4)[:, shown]
    bodies, system = scene.structure.bodies, orbit.problem.system
    return {
        "time": time[shown],
        "body": displacement[:bodies],
        "gap": displacement[bodies:],
        "damper_body": system.damper_coordinate,
        "clearance": system.clearance,
        "type": np.array(orbit.motion_type),
        "types": np.array(orbit.damper_motion),
        "frequency": np.array(frequency),
    }


def peaks_by_weighting(scene: Scene, bands: dict[int, tuple[float, float]]) -> Arrays:
    """Compute the peak of each mode by exact orbits, and by the approximate method with both weightings of the mass.

    `bands`: frequency band in Hz around each mode (from 1). Returns the modes, and three arrays of shape (3, modes):
    the peak compliance of the body that moves most in the mode [m/N]; the frequency of the peak [Hz]; and the mass
    ratio. Row 0: exact orbits, for which the mass ratio is NaN. Row 1: weighting by Eq 13 as printed; NaN if this sum
    is not a positive mass. Row 2: energy-consistent weighting.
    """
    peak, peak_frequency, ratio = (np.full((3, len(bands)), np.nan) for _ in range(3))
    forced = with_ideal_force(scene)
    problem = OrbitProblem(scene)
    for column, (mode, band) in enumerate(bands.items()):
        frequencies = np.linspace(*band, 41)
        weights: tuple[Weighting, Weighting] = ("printed", "energy")
        body = 0
        for row, weighting in enumerate(weights, 1):
            try:
                reduced = single_mode(forced, mode, weighting=weighting)
            except SceneError:
                continue
            body = int(np.abs(reduced.shape).argmax())
            ratio[row, column] = reduced.mass_ratio
            for branch in follow_mode(reduced, band, searches=5).branches:
                compliance = np.where(branch.valid & branch.stable, np.abs(branch.compliance), 0)
                if not peak[row, column] >= compliance.max():
                    peak[row, column], peak_frequency[row, column] = (
                        compliance.max(),
                        branch.frequency[compliance.argmax()],
                    )
        response = response_at_level(problem, problem.level, frequencies)
        peak[0, column], peak_frequency[0, column] = refined_peak(problem, response, body + 1)
    return {"mode": np.array(list(bands)), "peak": peak, "frequency": peak_frequency, "mass_ratio": ratio}


def approximate_peaks(scene: Scene, forces: Array, clearances: Array, band: tuple[float, float]) -> Arrays:
    """Compute the peak of `REPORTED_BODY` near mode 3 by the approximate method, for each force and clearance.

    The rows of the result are forces, the columns clearances. The mass ratio has the energy-consistent weighting.
    """
    peak = np.full((len(forces), len(clearances)), np.nan)
    types = np.empty(peak.shape, dtype="U4")
    for column, clearance in enumerate(clearances):
        dampers = [d.replace(clearance=float(clearance)) for d in scene.dampers]
        with_clearance = with_ideal_force(scene.replace(dampers=dampers))
        for row, force in enumerate(forces):
            reduced = single_mode(with_clearance, 3, force=float(force), weighting="energy")
            for branch in follow_mode(reduced, band, searches=5).branches:
                admissible = branch.valid & branch.stable
                if not admissible.any():
                    continue
                largest = np.abs(reduced.shape[REPORTED_BODY - 1] * branch.compliance[admissible]).max()
                if not peak[row, column] >= largest:
                    peak[row, column], types[row, column] = largest, branch.motion_type
    return {"force": forces, "clearance": clearances, "peak": peak, "type": types}
