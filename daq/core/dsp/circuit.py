"""State-space model of a measurement chain: analog first- and second-order sections in series.

A section does not load the previous section. A disturbance may enter before any section: noise, an offset, or the
difference between a clipped and a linear output.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from rig.core.base.arrays import Array

# Names of sections with nonlinear effects: the amplifier's supply limits the state of
# integrators, and the zero shift of a sensor is zero until an overload.
INTEGRATION = "integration"
RECOVERY = "overload recovery"


@dataclass(frozen=True)
class Section:
    """A linear circuit ``x' = a x + b u``, ``y = c x + d u``, also given by zeros, poles and gain."""

    name: str  # name of the effect, such as "low cut-off"
    # State space. Every state is a voltage, so it can have a voltage limit.
    a: Array  # (states, states)
    b: Array  # (states,)
    c: Array  # (states,)
    d: float  # direct feedthrough
    zeros: tuple[complex, ...]  # zeros of the transfer function [rad/s]
    poles: tuple[complex, ...]  # rad/s
    gain: float  # factor of ``prod(s - zeros) / prod(s - poles)``

    @property
    def states(self) -> int:
        """Number of states."""
        return len(self.b)


def _first_order(
    name: str,
    w: float,
    b: float,
    c: float,
    d: float,
    gain: float,
    zeros: tuple[complex, ...] = (),
    poles: tuple[complex, ...] = (),
) -> Section:
    """Return the section ``x' = -w x + b u``, ``y = c x + d u``."""
    return Section(name, np.array([[-w]]), np.array([b]), np.array([c]), d, zeros, poles, gain)


def resonance(frequency: float, q: float) -> Section:
    """Second-order low-pass filter ``w^2 / (s^2 + s w / q + w^2)``, frequency in Hz: a seismic mass on its piezo."""
    w = 2 * np.pi * frequency
    poles = tuple(complex(root) for root in np.roots([1.0, w / q, w * w]))
    a = np.array([[0.0, w], [-w, -w / q]])
    return Section("resonance", a, np.array([0.0, w]), np.array([1.0, 0.0]), 0.0, (), poles, w * w)


def high_pass(corner: float, name: str) -> Section:
    """First-order high-pass filter ``s / (s + w)`` with its corner in Hz: a coupling capacitor."""
    w = 2 * np.pi * corner
    return _first_order(name, w, b=w, c=-1.0, d=1.0, gain=1.0, zeros=(0j,), poles=(complex(-w),))


def integration(corner: float, gain: float) -> Section:
    """Integrating stage ``gain / (s + w)``, gain in 1/s: integration above the corner in Hz, constant gain below it."""
    w = 2 * np.pi * corner
    return _first_order(INTEGRATION, w, b=gain, c=1.0, d=0.0, gain=gain, poles=(complex(-w),))


def recovery(time: float) -> Section:
    """Zero shift after an overload; it decays with a time constant in s, independently of the signal."""
    return _first_order(RECOVERY, 1.0 / time, b=0.0, c=-1.0, d=1.0, gain=1.0)


@dataclass(frozen=True)
class Circuit:
    """Filter sections in series, as one linear state-space system.

    >>> chain = Circuit.series([high_pass(0.5, "low cut-off"), integration(0.0, 1.0)])
    >>> chain.a.shape, chain.d
    ((2, 2), array([0., 0., 1.]))
    """

    a: Array  # state matrix; (states, states)
    # Row i: factors of an input that enters before section i, in the derivatives of the states. The last row, for an
    # input after the last section, is zero; (sections + 1, states).
    b: Array
    c: Array  # weights of the states in the output; (states,)
    d: Array  # feedthrough from each of these inputs to the output; the last is 1; (sections + 1,)
    sections: tuple[int, ...]  # first state of each section, and the number of states

    @classmethod
    def series(cls, sections: Sequence[Section]) -> Self:
        """Connect sections in the order given."""
        first = np.cumsum([0, *(section.states for section in sections)])
        a = np.zeros((first[-1], first[-1]))
        b = np.zeros((len(sections) + 1, first[-1]))
        c = np.zeros(first[-1])
        d = np.ones(len(sections) + 1)
        # `c` and `d` yield the output of the sections connected so far, which is the input of the next section.
        for i, section in enumerate(sections):
            states = slice(first[i], first[i + 1])
            a[states] = np.outer(section.b, c)
            a[states, states] = section.a
            b[: i + 1, states] = np.outer(d[: i + 1], section.b)
            c *= section.d
            c[states] = section.c
            d[: i + 1] *= section.d
        return cls(a, b, c, d, tuple(int(state) for state in first))
