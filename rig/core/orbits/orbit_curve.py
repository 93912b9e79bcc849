"""Curves of orbits over a parameter: the results of continuation."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.base.figure_types import Axes
from rig.core.base.palette import motion_color
from rig.core.numerics import continuation
from rig.core.orbits.event_sequence import Plan
from rig.core.orbits.orbit import Orbit
from rig.core.orbits.problem import Axis
from rig.core.results import Result, complete_style, format_percent, join_columns
from rig.core.results.ratio_names import frf_display, per_force
from rig.core.steady_response.frequency_response import frf_columns


@dataclass(frozen=True, repr=False)
class OrbitBranch(Result):
    """Orbits with one sequence of events along a continuous curve.

    `value`, shape (points,): values of the parameter (Hz, N, m, or factor on the mass ratios), not monotonic at folds.

    `folds`, `doublings`, `toruses`: values of the parameter at folds (the curve turns back), at period doublings (a
    multiplier passes -1), and at torus bifurcations (a complex pair of multipliers leaves the unit circle).
    """

    axis: Axis = field(repr=False)
    value: Array
    orbits: tuple[Orbit, ...]
    ends: tuple[str, str]  # reasons for the ends of the curve, before its first and after its last point
    folds: Array
    doublings: Array
    toruses: Array
    plan: Plan = field(repr=False)  # the sequence of events
    curve: continuation.Curve = field(repr=False)  # unknowns and tangents of the orbits

    @property
    def parameter(self) -> str:
        """Name of the parameter."""
        return self.axis.name

    @property
    def motion_type(self) -> str:
        """Types of the dampers."""
        return self.orbits[0].motion_type

    @property
    def stable(self) -> NDArray[np.bool_]:
        """Return whether each orbit is stable."""
        return np.array([orbit.stable for orbit in self.orbits])

    @property
    def reference(self) -> str:
        """Reference of `frf`: "force" on the structure, or "table", its displacement."""
        return self.orbits[0].reference

    @property
    def frf(self) -> NDArray[np.complex128]:
        """First harmonic of each displacement divided by that of the reference [m/N or m/m], (bodies, points)."""
        return np.array([orbit.frf for orbit in self.orbits]).T

    @property
    def compliance(self) -> NDArray[np.complex128]:
        """`frf` with the force as reference [m/N]; raises `SceneError` with a different reference."""
        return per_force(self.frf, self.reference)

    @property
    def peak(self) -> Array:
        """Half the peak-to-peak displacement of each body [m], shape (bodies, points)."""
        return np.array([orbit.peak for orbit in self.orbits]).T

    @property
    def _labels(self) -> tuple[str, ...]:
        """Display names of the bodies."""
        return self.orbits[0].problem.scene.structure.labels

    def summary(self) -> str:
        """Return the type of motion, the range of the parameter and the stable fraction in words."""
        unit = self.axis.unit
        return (
            f"{self.motion_type}, {self.value.size} orbits, {self.axis.name} {self.value.min():.4g} to "
            f"{self.value.max():.4g} {unit}, {format_percent(self.stable.mean())} stable, {self.folds.size} folds"
        )

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return parameter, response of each body, type of motion, and stability."""
        return {
            self.axis.column: self.value,
            **frf_columns(self._labels, self.frf, self.reference),
            "motion_type": np.full(self.value.size, self.motion_type),
            "stable": self.stable,
        }

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw the response of the body with the largest motion; unstable orbits are dashed."""
        label, factor = self.axis.label, self.axis.factor
        name, unit, unit_factor = frf_display(self.reference)
        magnitude = unit_factor * abs(self.frf)
        body = int(magnitude.max(axis=1).argmax())
        (line,) = ax.loglog(
            factor * self.value,
            np.where(self.stable, magnitude[body], np.nan),
            **complete_style(style, label=self.motion_type),
        )
        ax.plot(factor * self.value, magnitude[body], "--", color=line.get_color(), lw=0.6 * line.get_linewidth())
        ax.set(xlabel=label, ylabel=f"|{name}| of {self._labels[body]} / ({unit})")


@dataclass(frozen=True, repr=False)
class OrbitCurve(Result):
    """All branches computed over a range of a parameter.

    Attributes
    ----------
    failures : tuple of str
        Where a branch may be missing, because no periodic orbit was found or an end was not passed: value of the
        parameter, and reason. The computed branches are not affected.
    """

    branches: tuple[OrbitBranch, ...]
    failures: tuple[str, ...]

    def summary(self) -> str:
        """Return the number of branches, their types of motion, and where a branch may be missing, in words."""
        types = ", ".join(dict.fromkeys(branch.motion_type for branch in self.branches))
        text = f"{len(self.branches)} branches: {types}"
        if self.failures:
            text += f"; a branch may be missing: {self.failures[0].removesuffix('.')}"
        return text + f" ({len(self.failures) - 1} more in `failures`)" * (len(self.failures) > 1)

    def columns(self) -> dict[str, NDArray[Any]]:
        """Join the columns of all branches, with the number of each."""
        return join_columns(
            [
                branch.columns() | {"branch": np.full(branch.value.size, number)}
                for number, branch in enumerate(self.branches, 1)
            ]
        )

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw every branch, with one color for each type of motion; unstable orbits are dashed."""
        for branch in self.branches:
            is_first = branch.motion_type not in {line.get_label() for line in ax.lines}
            color = motion_color(branch.motion_type)
            branch.draw(ax, **complete_style(style, color=color, label=branch.motion_type if is_first else "_again"))
