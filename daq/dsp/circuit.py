"""Linear analogue stages in series, as one state space.

A section is a first- or second-order circuit. Sections follow one another without loading each other; a
disturbance (noise, offset, what a clipped output lacks) may enter in front of any of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Names of sections with nonlinear effects: integrations, whose state an amplifier's supply limits, and the shift of
# zero behind a sensor, which only an overload drives.
INTEGRATION = "integration"
RECOVERY = "overload recovery"


@dataclass(frozen=True)
class Section:
    """A linear circuit ``x' = a x + b u``, ``y = c x + d u`` and the same as zeros, poles and gain."""

    name: str
    """Name in the terms of the field."""
    a: Array
    b: Array
    c: Array
    """State space; every state is a voltage, so that a limit on it means something; shapes (states, states),
    (states,), (states,)."""
    d: float  # Direct feedthrough
    zeros: tuple[complex, ...]
    poles: tuple[complex, ...]
    """Of the transfer function, rad/s."""
    gain: float
    """Factor of ``prod(s - zeros) / prod(s - poles)``."""

    @property
    def states(self) -> int:
        """Number of states."""
        return len(self.b)


def resonance(frequency: float, q: float) -> Section:
    """Second-order low pass ``w^2 / (s^2 + s w / q + w^2)``, frequency in Hz: a seismic mass on its piezo element."""
    w = 2 * np.pi * frequency
    roots = np.roots([1.0, w / q, w * w])
    return Section(
        "resonance",
        a=np.array([[0.0, w], [-w, -w / q]]),
        b=np.array([0.0, w]),
        c=np.array([1.0, 0.0]),
        d=0.0,
        zeros=(),
        poles=tuple(complex(root) for root in roots),
        gain=w * w,
    )


def high_pass(corner: float, name: str) -> Section:
    """First-order high pass ``s / (s + w)`` with its corner in Hz: a coupling capacitor."""
    w = 2 * np.pi * corner
    return Section(
        name,
        a=np.array([[-w]]),
        b=np.array([w]),
        c=np.array([-1.0]),
        d=1.0,
        zeros=(0j,),
        poles=(complex(-w),),
        gain=1.0,
    )


def integration(corner: float, gain: float) -> Section:
    """Integrating stage ``gain / (s + w)``, gain in 1/s: integration above the corner in Hz, constant gain below it."""
    w = 2 * np.pi * corner
    return Section(
        INTEGRATION,
        a=np.array([[-w]]),
        b=np.array([gain]),
        c=np.array([1.0]),
        d=0.0,
        zeros=(),
        poles=(complex(-w),),
        gain=gain,
    )


def recovery(time: float) -> Section:
    """Shift of zero that an overload leaves behind: it fades with a time constant in s, whatever the signal does."""
    return Section(
        RECOVERY,
        a=np.array([[-1.0 / time]]),
        b=np.zeros(1),
        c=np.array([-1.0]),
        d=1.0,
        zeros=(),
        poles=(),
        gain=1.0,
    )


@dataclass(frozen=True)
class Circuit:
    """Sections in series.

    >>> line = Circuit.series([high_pass(0.5, "low cut-off"), integration(0.0, 1.0)])
    >>> line.a.shape, line.d
    ((2, 2), array([0., 0., 1.]))
    """

    a: Array
    """State matrix; shape (states, states)."""
    b: Array
    """Row i: input in front of section i; the last row, behind the last section, is zero; shape (entries,
    states)."""
    c: Array
    """Output row; shape (states,)."""
    d: Array
    """Feedthrough from each entry to the output; the last is 1; shape (entries,)."""
    sections: tuple[int, ...]
    """First state of each section, and the number of states."""

    @classmethod
    def series(cls, sections: Sequence[Section]) -> Circuit:
        """Connect sections in the order given."""
        first = np.cumsum([0, *(section.states for section in sections)])
        a = np.zeros((first[-1], first[-1]))
        b = np.zeros((len(sections) + 1, first[-1]))
        c = np.zeros(first[-1])
        d = np.ones(len(sections) + 1)
        # `c` and `d` are those of the part connected so far: they feed the next section's input.
        for i, section in enumerate(sections):
            own = slice(first[i], first[i + 1])
            a[own] = np.outer(section.b, c)
            a[own, own] = section.a
            b[: i + 1, own] = np.outer(d[: i + 1], section.b)
            c *= section.d
            c[own] = section.c
            d[: i + 1] *= section.d
        return cls(a, b, c, d, tuple(int(state) for state in first))
