"""The approximate method of Inoue, Yokomichi and Hiraki (2011): all periodic motions of one mode, at all frequencies.

At selected frequencies all solutions of Types I, II and III are computed (`rig.studies.single_mode.motion_search`).
Each is continued over frequency, through folds, as a *branch*. Every point of a branch is checked for admissibility
(the motion is possible) and stability. Inadmissible solutions are continued too, because a branch may become admissible
at another frequency. Branches without an admissible point are discarded.
"""

from dataclasses import dataclass
from itertools import product
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.base.errors import SceneError
from rig.core.base.figure_types import Axes
from rig.core.base.palette import motion_color
from rig.core.numerics import continuation
from rig.core.results import Result, complete_style, join_columns
from rig.core.scene.body_names import body_number
from rig.core.scene.loading import SceneLike, scene_of
from rig.core.settings.quantities import FORCE, FREQUENCY, ascending_pair, number
from rig.studies.single_mode.admissibility import Batch, first_harmonic, flaws, multipliers, peak_to_peak
from rig.studies.single_mode.motion_search import END_REASONS, ordering_margins, solutions
from rig.studies.single_mode.periodic_motion import INSTANTS, PERIOD, MotionParameters, MotionType, jacobian
from rig.studies.single_mode.reduction import SingleMode, Weighting, single_mode

_SOLVER_STEPS = continuation.Steps(max_iterations=25)
_CONTINUATION_STEPS = continuation.Steps(first_step=3e-3, max_step=0.1, max_angle_rad=0.15)


@dataclass(frozen=True)
class Branch:
    """Periodic motions of one type along a continuous curve.

    `tau_0`, `tau_1`, `tau_2`, shape (points,): phases of the force [rad], counted from the floor impact, of take-off
    from the floor, impact on the ceiling and take-off from the ceiling; NaN for an event that the type does not have.

    `compliance`: first harmonic of the mode's coordinate over the force, with the force's phase as reference [m/N],
    shape (points,); `phi`: phase lag of the force with respect to the floor impact, force = F sin(tau - phi) [rad, 0
    to 2 pi], shape (points,); `unknowns`: q_0, q'_0, a, b and instants, dimensionless, as in
    `rig.studies.single_mode.periodic_motion`, shape (4 + instants, points).
    """

    motion_type: MotionType  # 'I', 'II' or 'III'
    frequency: Array  # excitation frequency [Hz]; not monotonic where the curve folds, shape (points,)
    compliance: NDArray[np.complex128]
    peak: Array  # half the peak-to-peak of the coordinate over the force's amplitude [m/N], shape (points,)
    phi: Array
    tau_0: Array
    tau_1: Array
    tau_2: Array
    multipliers: NDArray[np.complex128]  # Floquet multipliers, shape (2, points)
    stable: NDArray[np.bool_]  # both multipliers inside the unit circle, shape (points,)
    flaw: NDArray[np.str_]  # reason why the motion is inadmissible; "" if it is admissible, shape (points,)
    unknowns: Array
    ends: tuple[str, str]  # reasons for the ends of the curve, before its first and after its last point
    folds: Array  # frequencies [Hz] of the fold bifurcations, shape (folds,)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Whether each point is an admissible motion."""
        return np.asarray(self.flaw == "")


@dataclass(frozen=True, repr=False)
class Approximation(Result):
    """Result of the approximate method for one mode.

    Attributes
    ----------
    mode : SingleMode
        The reduced system; its `receptance` gives the compliance without dampers and with riding dampers.
    branches : tuple of Branch
        Branches with at least one admissible motion.
    riding : tuple of float or None
        Frequency band [Hz] in which the linear response with a riding damper exceeds 1 g, so the damper takes
        off. Types I to III occur in and near this band. None if the damper never takes off.
    failures : tuple of str
        Branches whose continuation ended inside the range: location, reason and last converged point.
    """

    mode: SingleMode
    branches: tuple[Branch, ...]
    riding: tuple[float, float] | None
    failures: tuple[str, ...]

    def summary(self) -> str:
        """Summarize the mode, and the frequency ranges of its types of motion."""
        ranges = ", ".join(
            f"{b.motion_type} {b.frequency[b.valid].min():.4g} to {b.frequency[b.valid].max():.4g} Hz"
            for b in self.branches
        )
        return f"mode at {self.mode.frequency:.4g} Hz, {len(self.branches)} branches: {ranges or 'none'}"

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return all points of all branches: frequency, compliance, type, stability and admissibility."""
        return join_columns(
            [
                {
                    "frequency_Hz": b.frequency,
                    "compliance_m/N": b.compliance,
                    "peak_m/N": b.peak,
                    "motion_type": np.full(b.frequency.size, b.motion_type),
                    "stable": b.stable,
                    "valid": b.valid,
                    "branch": np.full(b.frequency.size, number),
                }
                for number, b in enumerate(self.branches, 1)
            ]
        )

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the compliance of admissible motions; unstable motions are dashed."""
        for branch in self.branches:
            color, magnitude = motion_color(branch.motion_type), 1e6 * abs(branch.compliance)
            labels = {line.get_label() for line in ax.lines}
            label = f"Type {branch.motion_type}"
            for selected, line_style in ((branch.stable, "-"), (~branch.stable, "--")):
                values = np.where(branch.valid & selected, magnitude, np.nan)
                legend_label = label if line_style == "-" and label not in labels else "_again"
                ax.loglog(
                    branch.frequency, values, line_style, **complete_style(style, color=color, label=legend_label)
                )
        ax.set(xlabel="frequency / Hz", ylabel="|compliance| / (µm/N)")


def approximate_response(
    scene: SceneLike,
    mode: int,
    band: tuple[float | str, float | str],
    *,
    force: float | str | None = None,
    weighting: Weighting = "printed",
    at: int | str | None = None,
) -> Approximation:
    """Compute the periodic motions of a scene by the approximate method for one mode.

    Parameters
    ----------
    scene : Scene, str, Path or mapping
        A scene, or an argument of `rig.load`. Dampers need one common clearance, instantaneous contact and
        restitution 0.
    mode : int
        Number of the retained mode, from 1.
    band : tuple of float or str
        Lowest and highest frequency, in Hz or as strings with units.
    force : float or str, optional
        Force amplitude, in N or as text with its unit; default the force of the scene's test.
    weighting : {'printed', 'energy'}
        Weighting of the damper masses, see `rig.studies.single_mode.reduction`.
    at : int or str, optional
        Body, by number or name, at which the mode shape is 1; default the body with the largest displacement.

    Returns
    -------
    Approximation
        Coordinates refer to the body where the shape is 1; multiply by `mode.shape` for other bodies.
    """
    band_ends, level = ascending_pair(band, FREQUENCY, "band"), number(force, FORCE, "force")
    if not isinstance(mode, int):
        raise SceneError(f"mode: got {mode!r:.60}; expected the number of a mode, from 1")
    if weighting not in get_args(Weighting):
        raise SceneError(f"weighting: got {weighting!r:.60}; expected one of {', '.join(get_args(Weighting))}")
    loaded_scene = scene_of(scene)
    body = None if at is None else body_number(at, loaded_scene.structure.names, loaded_scene.structure.bodies)
    return follow_mode(single_mode(loaded_scene, mode, force=level, weighting=weighting, at=body), band_ends)


def follow_mode(mode: SingleMode, band: tuple[float, float], searches: int = 13) -> Approximation:
    """Compute all periodic motions between frequencies [Hz], searched at `searches` frequencies."""
    low, high = (f / mode.frequency for f in band)
    if not 0 < low < high:
        raise SceneError(f"band: got {band[0]:g} to {band[1]:g} Hz; expected two ascending frequencies above 0")
    if not mode.mass_ratio > 0:
        raise SceneError("mode: no damper can move in this mode. Choose another mode, or unlock a damper.")
    if not mode.force > 0 or mode.participation == 0:
        raise SceneError("mode: no force acts on this mode. Choose another mode, or drive another body.")
    riding = take_off_band(mode, band)
    curves: dict[MotionType, list[continuation.Curve]] = {"I": [], "II": [], "III": []}
    kinds: list[MotionType] = ["I"] if np.isinf(mode.clearance) else ["I", "II", "III"]
    if mode.clearance > 0:
        for kind, frequency_ratio in product(kinds, _search_ratios(mode, low, high, searches)):
            for candidate in solutions(kind, dimensionless(mode, frequency_ratio)):
                solution = continuation.solve_at(
                    _equations(mode, kind), np.append(candidate, frequency_ratio), frequency_ratio, _scale(mode, kind)
                )
                if not any(_passes_through(mode, kind, curve, solution) for curve in curves[kind]):
                    curves[kind].append(_follow(mode, kind, solution, (low, high)))
        for solution in _motions_with_short_stay(mode, curves["II"]):
            if not any(_passes_through(mode, "III", curve, solution) for curve in curves["III"]):
                curves["III"].append(_follow(mode, "III", solution, (low, high)))
    branches, failures = [], []
    for kind in kinds:
        for curve in curves[kind]:
            branch = _branch(mode, kind, curve)
            if not branch.valid.any():
                continue
            branches.append(branch)
            for end, index in zip(branch.ends, (0, -1), strict=True):
                if end.startswith("no convergence") or end == continuation.POINT_LIMIT:
                    failures.append(f"the branch of Type {kind} ends at {branch.frequency[index]:.6g} Hz: {end}")
    return Approximation(mode, tuple(branches), riding, tuple(failures))


def dimensionless(mode: SingleMode, ratio: float | Array) -> MotionParameters:
    """Return the dimensionless parameters at the ratio of excitation frequency to natural frequency."""
    return MotionParameters(
        ratio=ratio,
        damping=mode.damping_ratio,
        mass_ratio=mode.mass_ratio,
        force=abs(mode.participation) * mode.force / (mode.mass * mode.gravity),
        clearance=mode.clearance * mode.omega**2 / mode.gravity,
    )


def take_off_band(mode: SingleMode, band: tuple[float, float]) -> tuple[float, float] | None:
    """Compute the band [Hz] in which the acceleration of a riding damper exceeds 1 g; None without such a band."""
    frequency = np.union1d(np.linspace(*band, 2001), np.clip(mode.riding_frequency, *band))
    acceleration = np.abs(mode.receptance(frequency, riding=True)) * mode.force * (2 * np.pi * frequency) ** 2
    exceeds_gravity = np.flatnonzero(acceleration > mode.gravity)
    if not exceeds_gravity.size:
        return None
    return float(frequency[exceeds_gravity[0]]), float(frequency[exceeds_gravity[-1]])


def _equations(mode: SingleMode, kind: MotionType) -> continuation.Equations:
    def equations(x: Array) -> tuple[Array, Array]:
        return jacobian(kind, x[:-1], dimensionless(mode, float(x[-1])), "ratio")

    return equations


def _motions_with_short_stay(mode: SingleMode, curves: list[continuation.Curve]) -> list[Array]:
    """Locate Type III motions with short stays from points of Type II where the damper begins to stay."""
    located = []
    for curve in curves:
        points = curve.points.T
        parameters = MotionParameters(*(np.broadcast_to(f, points.shape[1:]) for f in dimensionless(mode, points[-1])))
        stays_at_ceiling = flaws(Batch("II", points[:-1], parameters)) == "stays at the ceiling"
        borders = np.flatnonzero(stays_at_ceiling[:-1] != stays_at_ceiling[1:])
        for i in (int(b) + int(stays_at_ceiling[b + 1]) for b in borders):
            x, ratio = curve.points[i], float(curve.points[i, -1])
            for stay in (0.02, 0.05, 0.1, 0.2):
                start = np.array([*x[:-1], x[-2] + stay, ratio])
                try:
                    solution = continuation.solve_at(
                        _equations(mode, "III"), start, ratio, _scale(mode, "III"), _SOLVER_STEPS
                    )
                except continuation.NoConvergence:
                    continue
                if (ordering_margins("III", solution[4:-1]) > 0).all():
                    located.append(solution)
                    break
    return located


def _scale(mode: SingleMode, kind: MotionType) -> Array:
    """Return the scale of the unknowns and of the frequency ratio, for the arclength."""
    parameters = dimensionless(mode, 1.0)
    amplitude = max(1.0, parameters.force)
    # Relative width of the resonance, or its shift due to the damper.
    width = max(mode.damping_ratio, 0.3 * mode.mass_ratio, 1e-3)
    return np.array([amplitude, amplitude, parameters.force, parameters.force, *[1.0] * INSTANTS[kind], 5 * width])


def _search_ratios(mode: SingleMode, low: float, high: float, count: int) -> Array:
    """Return the frequency ratios at which searches start: `count` in the take-off band, and a coarser grid outside."""
    band = take_off_band(mode, (low * mode.frequency, high * mode.frequency))
    if band is None:
        return np.linspace(low, high, count + 2)[1:-1]
    first, last = (f / mode.frequency for f in band)
    inside = np.linspace(first, last, count + 2)[1:-1]
    outside = np.linspace(low, high, count // 2 + 2)[1:-1]
    return np.concatenate([inside, outside[(outside < first) | (outside > last)]])


def _follow(mode: SingleMode, kind: MotionType, start: Array, bounds: tuple[float, float]) -> continuation.Curve:
    def margins(x: Array) -> tuple[Array, tuple[str, ...]]:
        return ordering_margins(kind, x[4:-1]), END_REASONS

    return continuation.trace(_equations(mode, kind), start, bounds, _scale(mode, kind), _CONTINUATION_STEPS, margins)


def _passes_through(mode: SingleMode, kind: MotionType, curve: continuation.Curve, solution: Array) -> bool:
    """Return whether a curve already contains a solution."""
    offset = curve.points[:, -1] - solution[-1]
    for i in np.flatnonzero(offset[:-1] * offset[1:] <= 0):
        fraction = offset[i] / (offset[i] - offset[i + 1]) if offset[i] != offset[i + 1] else 0.0
        guess = curve.points[i] + fraction * (curve.points[i + 1] - curve.points[i])
        if np.abs((guess - solution) / curve.scale).max() > 0.1:
            continue
        try:
            on_curve = continuation.solve_at(_equations(mode, kind), guess, float(solution[-1]), curve.scale)
        except continuation.NoConvergence:
            continue
        if np.abs((on_curve - solution) / curve.scale).max() < 1e-6:
            return True
    return False


def _branch(mode: SingleMode, kind: MotionType, curve: continuation.Curve) -> Branch:
    """Evaluate response, admissibility and stability at every point of a curve."""
    points = curve.points.T
    ratio = points[-1]
    parameters = MotionParameters(*(np.broadcast_to(f, ratio.shape) for f in dimensionless(mode, ratio)))
    batch = Batch(kind, points[:-1], parameters)
    length = mode.gravity / (2 * np.pi * mode.frequency * ratio) ** 2
    # A positive force is sin(tau - phi) = Re(-i exp(-i phi) exp(i tau)). If the participation is negative, the
    # force on the modal coordinate has the opposite sign.
    sign = np.sign(mode.participation)
    phi = np.arctan2(-sign * points[3], sign * points[2]) % PERIOD
    compliance = first_harmonic(batch) * length / (-1j * np.exp(-1j * phi) * mode.force)
    floquet = multipliers(batch)
    instants = np.full((3, ratio.size), np.nan)
    instants[: INSTANTS[kind]] = points[4:-1]
    folds = continuation.locate_folds(_equations(mode, kind), curve, _CONTINUATION_STEPS)[:, -1] * mode.frequency
    return Branch(
        motion_type=kind,
        frequency=ratio * mode.frequency,
        compliance=compliance,
        peak=0.5 * peak_to_peak(batch) * length / mode.force,
        phi=phi,
        tau_0=instants[0],
        tau_1=instants[1],
        tau_2=instants[2],
        multipliers=floquet,
        stable=np.asarray((np.abs(floquet) < 1).all(axis=0)),
        flaw=flaws(batch),
        unknowns=points[:-1],
        ends=curve.ends,
        folds=folds,
    )
