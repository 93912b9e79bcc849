"""A motion to forty digits: what the engine's and every other method's error is measured against.

The list of events comes from the engine; each event is found again here as the root of its own guard, in decimal
arithmetic of any precision, and the flow between events is summed as a Taylor series. Only the compiled system is
shared with the engine. Two runs at different precision say how many digits are right.
"""

from __future__ import annotations

import decimal
from dataclasses import dataclass
from decimal import Decimal

import numpy as np
from numpy.typing import NDArray

from rig.errors import RunError
from rig.simulation.simulate import Run
from rig.system.hybrid_system import HybridSystem
from rig.system.open_loop_drive import ToneDrive

Array = NDArray[np.float64]
Vector = list[Decimal]
Rows = list[list[tuple[int, Decimal]]]

PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459")
#: Digits of the reference, and of the run that checks it.
DIGITS, CHECK_DIGITS = 40, 30
#: Rate times step up to which the series loses no digits worth mentioning.
REACH = 3.0
#: Overlap up to which a bed whose contact lasts has only just touched a wall, m; a float64 leaves 1e-18.
TOUCHING = 1e-13
#: Newton's iteration starts within rounding of the engine; this many doublings of the digits are plenty.
ITERATIONS = 8


@dataclass(frozen=True)
class Exact:
    """A motion known far beyond float64."""

    displacement: NDArray[np.object_]
    """m; Decimal, shape (coordinates, samples)."""
    event_time: NDArray[np.object_]
    """s; Decimal, shape (events,)."""
    agreement: float
    """Largest difference to the same motion computed with fewer digits, relative to the motion."""


def exact_motion(system: HybridSystem, tone: ToneDrive, run: Run, samples_per_period: int) -> Exact:
    """Repeat a run under a tone to forty digits.

    Parameters
    ----------
    run : Run
        The engine's run with `samples_per_period` samples in each period of the tone.

    Raises
    ------
    RunError
        If an event of the run is no event of the motion.
    """
    coarse, _ = DecimalMotion(system, tone, CHECK_DIGITS).follow(run, samples_per_period)
    fine, fine_times = DecimalMotion(system, tone, DIGITS).follow(run, samples_per_period)
    scale = np.abs(fine).max()
    return Exact(fine, fine_times, float(np.abs(coarse - fine).max() / scale))


class DecimalMotion:
    """The system in decimal arithmetic: state (q, q', further, cos, sin, 1), and dampers on ballistic paths."""

    def __init__(self, system: HybridSystem, tone: ToneDrive, digits: int) -> None:
        self.context = decimal.Context(prec=digits)
        self.system, self.tone = system, tone
        self.smallest = Decimal(10) ** (-digits - 5)
        with decimal.localcontext(self.context):
            self.omega = 2 * PI * Decimal(tone.frequency)
            self.gravity = Decimal(system.gravity)
        self.flows: dict[int, Rows] = {}
        # The wall that each bed whose contact lasts is at, or was at last.
        self.walls = ["floor"] * system.dampers

    def follow(self, run: Run, per_period: int) -> tuple[NDArray[np.object_], NDArray[np.object_]]:
        """Displacements of the points at the samples, and times of the events."""
        with decimal.localcontext(self.context):
            return self._follow(run, per_period)

    def _follow(self, run: Run, per_period: int) -> tuple[NDArray[np.object_], NDArray[np.object_]]:
        system, n = self.system, self.system.coordinates
        state = [Decimal(float(value)) for value in self.tone.state] + [Decimal(1), Decimal(0), Decimal(1)]
        number = {int(k): j for j, k in enumerate(system.damper_number)}
        events = [(float(e["time"]), number[int(e["damper"])], str(e["kind"])) for e in run.events]
        wall = ["floor"] * system.dampers
        flight: dict[int, tuple[Decimal, Decimal]] = {}
        now, taken, out, times = Decimal(0), 0, [], []
        sample_times = [
            Decimal(k) / (per_period * Decimal(self.tone.frequency)) for k in range(len(run.time))
        ]
        rebounds = self.rebounds(events, [bool(mode) for mode in run.contact[:, -1]])
        last_guess = -1.0
        for (guess, j, kind), restitution in zip(
            [*events, (float("inf"), -1, "end")], [*rebounds, Decimal(0)], strict=True
        ):
            while taken < len(sample_times) and float(sample_times[taken]) < guess:
                state, flight = self.carry(state, flight, sample_times[taken] - now)
                now = sample_times[taken]
                out.append(state[: len(system.points)])
                taken += 1
            if j < 0:
                break
            if system.lasting[j]:
                state, flight, now = self.to_change(state, flight, now, Decimal(guess), j, kind)
                last_guess = guess
                times.append(now)
                continue
            # Separations that an impact or the start brings about have no root of their own.
            forced = kind == "separation" and (guess == last_guess or guess == 0.0)
            if not forced:
                state, flight, now = self.to_event(state, flight, now, Decimal(guess), j, kind, wall[j])
            last_guess = guess
            times.append(now)
            if kind == "separation":
                flight[j] = (state[self.row(j)] + self.lift(j, wall[j]), state[n + self.row(j)])
            else:
                self.collide(state, flight, j, kind, restitution)
                if j not in flight:
                    wall[j] = kind
        return np.array(out, dtype=object).T, np.array(times, dtype=object)

    def row(self, j: int) -> int:
        """Coordinate that damper j (from 0) sits in."""
        return int(self.system.damper_coordinate[j])

    def lift(self, j: int, wall: str) -> Decimal:
        """Height of a wall above the floor, m."""
        return Decimal(float(self.system.clearance[j])) if wall == "ceiling" else Decimal(0)

    def rebounds(self, events: list[tuple[float, int, str]], riding: list[bool]) -> list[Decimal]:
        """Restitution of each event: none in the impact that ends a sequence of bounces with the damper riding.

        Parameters
        ----------
        events : list of tuple
            Time, damper (from 0), kind.
        riding : list of bool
            Whether each damper rides after the last of them.
        """
        after = dict(enumerate(riding))
        found: list[Decimal] = []
        for _, j, kind in reversed(events):
            found.append(Decimal(0) if after[j] else Decimal(float(self.system.restitution[j])))
            after[j] = kind == "separation"
        return found[::-1]

    def collide(
        self,
        state: Vector,
        flight: dict[int, tuple[Decimal, Decimal]],
        j: int,
        kind: str,
        restitution: Decimal,
    ) -> None:
        """Newton's impact law at one damper; with restitution it flies on."""
        n, row = self.system.coordinates, self.row(j)
        _, speed = flight.pop(j)
        closing = speed - state[n + row]
        own, bed = Decimal(float(self.system.mass[row, row])), Decimal(float(self.system.damper_mass[j]))
        state[n + row] += (1 + restitution) * closing * bed / (own + bed)
        if restitution:
            flight[j] = (state[row] + self.lift(j, kind), state[n + row] - restitution * closing)

    def to_event(
        self, state: Vector, flight: dict[int, tuple[Decimal, Decimal]], now: Decimal, guess: Decimal, j: int,
        kind: str, wall: str,
    ) -> tuple[Vector, dict[int, tuple[Decimal, Decimal]], Decimal]:  # fmt: skip
        """Carry everything to the root of the event's guard near `guess`."""
        state, flight = self.carry(state, flight, guess - now)
        now = guess
        for _ in range(ITERATIONS):
            value, slope = self._guard(state, flight, j, kind)
            if slope == 0:
                break
            step = -value / slope
            state, flight = self.carry(state, flight, step)
            now += step
            if abs(step) < self.smallest * 10**4:
                break
        if abs(now - guess) > Decimal("1e-9"):
            raise RunError(
                f"event {kind} of damper {j + 1} at {guess:.9f} s is not found again; report the scene"
            )
        return state, flight, now

    def to_change(
        self, state: Vector, flight: dict[int, tuple[Decimal, Decimal]], now: Decimal, guess: Decimal, j: int,
        kind: str,
    ) -> tuple[Vector, dict[int, tuple[Decimal, Decimal]], Decimal]:  # fmt: skip
        """Carry everything to a touch or release near `guess` of a bed whose contact lasts, and change the contact.

        An open contact counts as a flight, whose height and speed mean nothing: the gap is part of the state.
        """
        zero = "release"
        if kind == "touch":
            clearance = float(self.system.clearance[j])
            gap = float(self.carry(state, flight, guess - now)[0][int(self.system.bed[j])])
            self.walls[j] = "ceiling" if gap > 0.5 * clearance else "floor"
            overlap = gap - clearance if self.walls[j] == "ceiling" else -gap
            # A bed that has not left the wall is pressed again where the force, not the gap, is zero.
            zero = "touch" if overlap < TOUCHING else "release"
        state, flight, now = self.to_event(state, flight, now, guess, j, zero, self.walls[j])
        if kind == "touch":
            del flight[j]
        else:
            flight[j] = (Decimal(0), Decimal(0))
        return state, flight, now

    def wall(self, j: int) -> tuple[Decimal, Decimal, Decimal]:
        """Stiffness, damping and height of the wall that a bed whose contact lasts is at."""
        side = int(self.walls[j] == "ceiling")
        stiffness, damping = self.system.wall_stiffness[j, side], self.system.wall_damping[j, side]
        return Decimal(float(stiffness)), Decimal(float(damping)), self.lift(j, self.walls[j])

    def _guard(
        self, state: Vector, flight: dict[int, tuple[Decimal, Decimal]], j: int, kind: str
    ) -> tuple[Decimal, Decimal]:
        """Guard of an event and its rate of change."""
        n, row = self.system.coordinates, self.row(j)
        if self.system.lasting[j]:
            bed = int(self.system.bed[j])
            stiffness, damping, height = self.wall(j)
            if kind == "touch":
                stiffness, damping = Decimal(1), Decimal(0)
            bend = self._rates(self._flow(flight), state)[n + bed]
            value = stiffness * (state[bed] - height) + damping * state[n + bed]
            return value, stiffness * state[n + bed] + damping * bend
        if kind == "separation":
            flow = self._flow(flight)
            rate = self._rates(flow, state)
            return rate[n + row] + self.gravity, self._rates(flow, rate)[n + row]
        height, speed = flight[j]
        return height - state[row] - self.lift(j, kind), speed - state[n + row]

    def carry(
        self, state: Vector, flight: dict[int, tuple[Decimal, Decimal]], duration: Decimal
    ) -> tuple[Vector, dict[int, tuple[Decimal, Decimal]]]:
        """Everything a time later, no contact changing."""
        flow = self._flow(flight)
        fastest = max(self.system.fastest, self.tone.omega)
        steps = max(1, int(np.ceil(abs(float(duration)) * fastest / REACH)))
        for _ in range(steps):
            term, order = state, 0
            while True:
                order += 1
                part = duration / (steps * order)
                term = [part * value for value in self._rates(flow, term)]
                state = [value + change for value, change in zip(state, term, strict=True)]
                if max(map(abs, term)) < self.smallest:
                    break
        fall = self.gravity * duration
        moved = {j: (y + duration * (v - fall / 2), v - fall) for j, (y, v) in flight.items()}
        return state, moved

    @staticmethod
    def _rates(flow: Rows, state: Vector) -> Vector:
        return [sum((value * state[k] for k, value in row), Decimal(0)) for row in flow]

    def _flow(self, flight: dict[int, tuple[Decimal, Decimal]]) -> Rows:
        """Sparse rows of the generator while the dampers not in flight ride, or their contacts are closed."""
        closed = [j for j in range(self.system.dampers) if j not in flight]
        riding = sum(1 << j for j in closed)
        for j in closed:
            if self.system.lasting[j] and self.walls[j] == "ceiling":
                riding |= 1 << self.system.dampers + j
        if riding not in self.flows:
            self.flows[riding] = self._make_flow(riding)
        return self.flows[riding]

    def _make_flow(self, riding: int) -> Rows:
        system, n, ns = self.system, self.system.coordinates, self.system.states
        drive = np.column_stack([self.tone.amplitudes.real, -self.tone.amplitudes.imag])
        exact = np.vectorize(lambda value: Decimal(float(value)), otypes=[object])
        force = np.hstack(
            [
                exact(system.force_state),
                exact(system.force_drive) @ exact(drive),
                exact(system.force_constant)[:, None],
            ]
        )
        rate = np.hstack(
            [
                exact(system.rate_state),
                exact(system.rate_drive) @ exact(drive),
                exact(np.zeros((ns - 2 * n, 1))),
            ]
        )
        mass = exact(system.mass)
        for j in range(system.dampers):
            if riding >> j & 1 and system.lasting[j]:
                gap = int(system.bed[j])
                stiffness, damping, height = self.wall(j)
                force[gap, gap] -= stiffness
                force[gap, n + gap] -= damping
                force[gap, -1] += stiffness * height
            elif riding >> j & 1:
                bed = Decimal(float(system.damper_mass[j]))
                mass[self.row(j), self.row(j)] += bed
                force[self.row(j), -1] -= bed * self.gravity
        acceleration = _solve(mass, force)
        matrix = exact(np.zeros((ns + 3, ns + 3)))
        for i in range(n):
            matrix[i, n + i] = Decimal(1)
        matrix[n : 2 * n] = acceleration
        matrix[2 * n : ns] = rate
        matrix[ns, ns + 1], matrix[ns + 1, ns] = -self.omega, self.omega
        return [[(k, value) for k, value in enumerate(row) if value] for row in matrix]


def _solve(mass: NDArray[np.object_], right: NDArray[np.object_]) -> NDArray[np.object_]:
    """Gaussian elimination for a positive definite matrix of decimals."""
    mass, right = mass.copy(), right.copy()
    count = len(mass)
    for i in range(count):
        for r in range(i + 1, count):
            if mass[r, i]:
                factor = mass[r, i] / mass[i, i]
                mass[r, i:] -= factor * mass[i, i:]
                right[r] -= factor * right[i]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            if mass[i, k]:
                right[i] = right[i] - mass[i, k] * right[k]
        right[i] = right[i] / mass[i, i]
    return right
