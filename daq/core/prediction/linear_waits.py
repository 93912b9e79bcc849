"""Waits of a stepped sine, predicted by its own procedure on the linear response, with all dampers at rest.

The procedure, its detector of the steady state and its control of the force are those of the test. Only the tone is
replaced: between changes of the drive, the transient of each mode decays freely, so the amplitudes in a window are
computed in closed form instead of from samples. Random noise is added according to the noise densities of the channels.
"""

import math
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple, Self

import numpy as np

from daq.core.excitation.controlled import controlled
from daq.core.excitation.lock_in import lock_in_of_signals
from daq.core.excitation.station import Station
from daq.core.excitation.stepped_sine import excite, expected_wait
from daq.core.excitation.tones.steady_tone import SteadyTone, Tone
from daq.core.prediction.linear import noise_density
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import SceneError
from rig.core.scene.excitation.stepped_sine import SteppedTest
from rig.core.scene.scene import Scene
from rig.core.system.assembly import force_row
from rig.core.system.hybrid_system import HybridSystem
from rig.core.system.open_loop_drive import riding_equations, riding_response

# Tones and transients in a window are represented by at most this number of points per period of the highest frequency.
_POINTS_PER_PERIOD = 16
# Largest condition number of the mode shapes (rounding errors of 0.1 %); beyond, the slowest mode decides.
_MAX_CONDITION = 1e13
# A prediction ends after this number of measuring windows, about 1 s of CPU time.
_MAX_WINDOWS = 20000
# The prediction is repeated with other noise until both runs have `_REPEATED_WINDOWS` in total; the second run has at
# least `_MIN_REPEATED_WINDOWS`. A mean of four runs would be only 9 % closer to the test, because the test itself has
# noise, and would take twice the time.
_REPEATED_WINDOWS = 2000
_MIN_REPEATED_WINDOWS = 500
# Number of windows whose noise is drawn at once, to save calls.
_DRAWN_AT_ONCE = 256
# Number of windows whose amplitudes are computed at once: about as many as between two changes of the drive.
_WINDOWS_AT_ONCE = 16
_NEXT_WINDOWS = np.arange(_WINDOWS_AT_ONCE)
# Number of windows of different frequencies that are stored for further runs and levels (1 MB).
_MAX_STORED_WINDOWS = 512
# The drive of a transition has harmonics up to this order, plus this multiple of its phase deviation in rad; higher
# harmonics are below 1e-10 (Bessel functions J_n(x) with n > 1.5 x + 15).
_MIN_HARMONICS, _HARMONICS_PER_RADIAN = 16, 1.5
# Decay rate added to all modes [1/s], so no exponent equals that of a drive; its time constant is 12 days.
_ADDED_DECAY_RATE = 1e-6


class LinearWaits(NamedTuple):
    """Waits before the tones of a test."""

    expected: Array  # s, (levels, tones)
    scatter: float  # standard deviation of a wait due to noise, relative to its expected value


def linear_waits(scene: Scene, system: HybridSystem, channels: Sequence[ChannelInfo]) -> LinearWaits:
    """Return the waits before the tones of a stepped sine, in the order of the test."""
    test = scene.test
    assert test is not None
    tones = np.array(test.dwells)
    shape = len(test.levels), tones.size
    try:
        modes = _RidingModes.of(scene, system, tones)
    except SceneError:
        modes = None
    if modes is None:
        return LinearWaits(np.full(shape, expected_wait(scene, test.steady_state.longest)), 0.0)
    runs = np.full((2, shape[0] * shape[1]), np.nan)
    waits, tone = _run(scene, system, channels, modes, 0, _MAX_WINDOWS)
    runs[:, : waits.size] = waits
    if tone.has_noise:
        limit = max(_REPEATED_WINDOWS - tone.windows, _MIN_REPEATED_WINDOWS)
        waits, _ = _run(scene, system, channels, modes, 1, limit)
        runs[1] = np.nan
        runs[1, : waits.size] = waits
    first, second = runs[:, ~np.isnan(runs[1])]
    scatter = np.sqrt(np.sum((first - second) ** 2) / max(np.sum(first**2 + second**2), 1e-300))
    predicted = ~np.isnan(runs[0])
    expected = np.nanmean(runs[:, predicted], axis=0)
    # The wait of a tone that was not predicted is interpolated from the predicted tones by frequency.
    frequency, order = np.tile(tones, shape[0]), np.argsort(np.tile(tones, shape[0])[predicted], kind="stable")
    rest = np.interp(frequency[~predicted], frequency[predicted][order], expected[order])
    return LinearWaits(np.concatenate([expected, rest]).reshape(shape), float(scatter))


def _run(
    scene: Scene, system: HybridSystem, channels: Sequence[ChannelInfo], modes: "_RidingModes", number: int, limit: int
) -> tuple[Array, "_PredictedTone"]:
    """Run the test up to a number of windows, with noise of a given seed; return the waits [s] and the tone."""
    test = scene.test
    assert isinstance(test, SteppedTest)
    rate = scene.converter.true_rate
    waits: list[float] = []

    def mark(kind: str, first: int, stop: int, **fields: Any) -> None:
        if kind == "settle":
            waits.append((stop - first) / rate)

    station = Station(scene, channels, system.inputs, rate, mark)
    tone = _PredictedTone(station, system, modes, number)
    drives = excite(station, test, tone)
    try:
        drive = next(drives)
        while tone.windows < limit:
            station.now += drive.shape[1]
            drive = drives.send(drive)
    except StopIteration:
        pass
    return np.array(waits), tone


@lru_cache(maxsize=4)
def _circle(harmonics: int) -> tuple[Array, Array, Array]:
    """Return 2 `harmonics` equally spaced points on the unit circle, and the orders of their Fourier coefficients."""
    angles = np.pi * np.arange(2 * harmonics) / harmonics
    orders = np.arange(2 * harmonics)
    orders[harmonics:] -= 2 * harmonics
    return np.cos(angles), np.sin(angles), orders.astype(float)


class _Window(NamedTuple):
    """Windows of equal length at one frequency."""

    seconds: float
    steady: ComplexArray  # amplitudes of the steady state per unit of drive, (quantities,)
    transient_gain: ComplexArray  # amplitudes of the transient of each mode, (modes, quantities)
    scatter: Array  # standard deviations of the noise of the used channels in the amplitudes, (channels, quantities)


@dataclass(frozen=True)
class _RidingModes:
    """Modes of the linear system with all dampers at rest, and the steady states of the tones of a test."""

    poles: ComplexArray  # 1/s, (modes,)
    shapes: ComplexArray  # (states, modes)
    participation: ComplexArray  # derivative of each modal coordinate per unit of drive
    rows: dict[float, int]  # row of each tone in the next arrays, by its frequency
    steady: ComplexArray  # complex amplitudes of the states per unit of drive, (tones, states)
    in_phase: ComplexArray  # modal coordinates of their real parts, (tones, modes)
    quadrature: ComplexArray  # modal coordinates of their imaginary parts, (tones, modes)
    # Windows by their frequency and number of samples.
    windows: dict[tuple[float, int], _Window] = field(default_factory=dict)

    @classmethod
    def of(cls, scene: Scene, system: HybridSystem, tones: Array) -> Self | None:
        """Return the modes; None if their shapes are nearly dependent. `tones`: frequencies of the test [Hz]."""
        name = scene.at_driven("shaker")
        descriptor, state_matrix, input_vector = riding_equations(system, name)
        eigenvalues, shapes = np.linalg.eig(np.linalg.solve(descriptor, state_matrix))
        if np.linalg.cond(shapes) > _MAX_CONDITION:
            return None
        to_modes: ComplexArray = np.linalg.inv(shapes)
        rows = {tone: row for row, tone in enumerate(dict.fromkeys(tones.tolist()))}
        steady = riding_response(system, name, 2.0 * np.pi * np.array(list(rows))).T
        participation = to_modes @ np.linalg.solve(descriptor, input_vector)
        in_phase, quadrature = steady.real @ to_modes.T, steady.imag @ to_modes.T
        poles = np.asarray(eigenvalues - _ADDED_DECAY_RATE, dtype=complex)
        return cls(poles, shapes, participation, rows, steady, in_phase, quadrature)

    def after_transition(
        self, start: ComplexArray, tone: Tone, seconds: float, frequency: float, amplitude: float
    ) -> ComplexArray:
        """Return the modal coordinates at the end of the transition `Tone.transition`, from those at its start.

        The frequency rises along half a cosine, so the phase is that of a tone of the mean frequency plus
        `deviation` sin(angle), where the angle rises from 0 to pi. The drive is therefore a sum of exponential
        functions, and the response to each of them has a closed form.
        """
        deviation = (frequency - tone.frequency) * seconds  # rad
        harmonics = _MIN_HARMONICS + math.ceil(_HARMONICS_PER_RADIAN * abs(deviation))
        cosine, sine, orders = _circle(harmonics)
        mean, half_change = (tone.amplitude + amplitude) / 2.0, (amplitude - tone.amplitude) / 2.0
        envelope = (mean - half_change * cosine) * np.exp(1j * (tone.phase - deviation * sine))
        weights = np.fft.fft(envelope) / (4j * harmonics)
        exponents = 1j * math.pi * (tone.frequency + frequency + orders / seconds)
        # The drive is the sum of these exponential functions and of their conjugates.
        weights, exponents = np.concatenate([weights, weights.conj()]), np.concatenate([exponents, exponents.conj()])
        end_and_start = np.array([weights * np.exp(exponents * seconds), weights])
        at_end, at_start = end_and_start @ (1.0 / (exponents[:, None] - self.poles))
        free = np.exp(self.poles * seconds) * (start - self.participation * at_start)
        return np.asarray(free + self.participation * at_end)


class _PredictedTone(SteadyTone):
    """A tone whose amplitudes are those of the linear response."""

    def __init__(self, station: Station, system: HybridSystem, modes: _RidingModes, number: int) -> None:
        super().__init__(station, next(iter(modes.rows)), controlled(station))
        scene, self.windows = station.scene, 0
        # Windows and transitions have the samples of the test, but their response is computed at fewer points.
        self.rate = min(station.rate, _POINTS_PER_PERIOD * max(modes.rows))
        self._modes, self._random = modes, station.generator(f"predicted noise {number}")
        # Modal coordinates of the transient (deviation from the steady state of the tone): after the last change of the
        # drive or before the computed windows, whichever is later.
        self._transient = np.zeros(modes.poles.size, dtype=complex)
        self._decay = np.zeros((0, modes.poles.size), dtype=complex)
        self._window_s = 0.0  # duration of the current windows [s]
        # Amplitudes in the windows that are computed but not yet observed, the last window first, and the number of
        # windows that have been observed since they were computed.
        self._computed: list[ComplexArray] = []
        self._n_observed = 0
        # The controlled quantity and the displacement of each motion channel are weighted sums of displacements and
        # forces at the channels that are used.
        control = [] if self._controlled is None else [self._controlled]
        used = sorted({*self._motion_rows, *(row for each in control for row in each.rows)})
        self._sums = np.zeros((len(control) + len(self._motion_rows), len(used)))
        for weights, each in zip(self._sums, control, strict=False):
            weights[[used.index(row) for row in each.rows]] = each.factors
        self._sums[range(len(control), len(self._sums)), [used.index(row) for row in self._motion_rows]] = 1.0
        infos = [station.channels[row] for row in used]
        # Row vectors that yield the displacements and forces of the channels from the states.
        rows = np.zeros((len(used), system.states))
        for states_row, info in zip(rows, infos, strict=True):
            if info.quantity == "force":
                states_row[:] = force_row(scene, system)
            else:
                states_row[system.points.index(info.at)] = 1.0
        self._gains = self._sums @ rows
        settings, tones = {channel.name: channel for channel in scene.channels or ()}, np.array(list(modes.rows))
        self._drawn = np.zeros((0, len(used)), dtype=complex)  # noise in the next windows, (windows, used channels)
        self._densities = np.empty((tones.size, len(used)))
        for row, info in zip(self._densities.T, infos, strict=True):
            gain = abs(info.response(tones)) * (2.0 * np.pi * tones) ** (info.derivative or 0)
            row[:] = noise_density(scene, settings.get(info.name), info, tones) / gain
        self.has_noise = bool(self._densities.any())

    def transition(self, samples: int, frequency: float, amplitude: float) -> Array:
        """Compute the transient after a transition between drives; return no samples, because they are not used."""
        self._let_decay()
        seconds = samples / self.station.rate
        start = self._transient + self._steady_coordinates()
        end = self._modes.after_transition(start, self, seconds, frequency, amplitude)
        self.phase = (self.phase + math.pi * (self.frequency + frequency) * seconds) % (2.0 * math.pi)
        self.frequency, self.amplitude = frequency, amplitude
        self._transient = end - self._steady_coordinates()
        return np.zeros(samples)

    def _drive(self, waves: Sequence[Array]) -> Array:
        """Return a drive of the length of the waves, without samples."""
        return waves[0][None]

    def _points(self, samples: int) -> int:
        """Return the number of points that represent a number of samples."""
        return round(samples * self.rate / self.station.rate)

    def _decay_over(self, points: int) -> ComplexArray:
        """Return the decay factors of the transient of each mode after 0, 1, ..., `points` intervals between points."""
        if self._decay.shape[0] <= points:
            self._decay = np.exp(np.outer(np.arange(points + 1) / self.rate, self._modes.poles))
        return self._decay[: points + 1]

    def _steady_coordinates(self) -> ComplexArray:
        """Return the modal coordinates of the steady state at the current phase."""
        if self.amplitude == 0.0:
            return np.zeros(self._modes.poles.size, dtype=complex)
        row = self._modes.rows[self.frequency]
        in_phase, quadrature = self._modes.in_phase[row], self._modes.quadrature[row]
        return self.amplitude * (in_phase * np.sin(self.phase) + quadrature * np.cos(self.phase))

    def observe(self, samples: int) -> Generator[Array, Array, ComplexArray]:
        """Return the amplitudes in a window, without computing its samples."""
        self.windows += 1
        if not self._computed:
            self._compute_windows(samples)
        self._n_observed += 1
        self.station.now += samples
        return self._computed.pop()
        yield

    def _compute_windows(self, samples: int) -> None:
        """Compute the amplitudes in the next windows, as long as the drive is not changed."""
        self._let_decay()
        key = self.frequency, samples
        windows = self._modes.windows
        if key not in windows:
            if len(windows) == _MAX_STORED_WINDOWS:
                windows.clear()
            windows[key] = self._window(samples)
        window = windows[key]
        exponents = (self._modes.poles - 2j * math.pi * self.frequency) * window.seconds
        # The transient before each of the next windows, relative to the phase of the tone.
        relative = np.exp(np.outer(_NEXT_WINDOWS, exponents)) * (self._transient * np.exp(-1j * self.phase))
        amplitudes = self.amplitude * window.steady + relative @ window.transient_gain
        if self.has_noise:
            amplitudes += self._noise() @ window.scatter
        self._computed, self._window_s = list(amplitudes[::-1, None]), window.seconds

    def _let_decay(self, seconds: float = 0.0) -> None:
        """Hold the tone in the observed windows and for a further time in s, and discard the other windows."""
        seconds += self._n_observed * self._window_s
        self._transient = self._transient * np.exp(self._modes.poles * seconds)
        self.phase = (self.phase + 2.0 * math.pi * self.frequency * seconds) % (2.0 * math.pi)
        self._drawn = self._drawn[self._n_observed :]
        self._computed, self._n_observed = [], 0

    def _window(self, samples: int) -> _Window:
        """Return windows of a given number of samples at the current frequency."""
        seconds, row = samples / self.station.rate, self._modes.rows[self.frequency]
        lock_in_gain, noise_gain = lock_in_of_signals(
            self.frequency, self.rate, self._decay_over(self._points(samples))[:-1]
        )
        # Standard deviation of each part for white noise up to half the sample rate; their weights have similar norms.
        deviation = noise_gain * math.sqrt(self.rate) / 2.0
        return _Window(
            seconds,
            -1j * (self._gains @ self._modes.steady[row]),
            (self._gains @ self._modes.shapes * lock_in_gain).T,
            (self._sums * self._densities[row] * deviation).T,
        )

    def _noise(self) -> ComplexArray:
        """Return complex noise for windows, (windows, used channels); variance 1 of real and of imaginary part."""
        if len(self._drawn) < _WINDOWS_AT_ONCE:
            drawn = self._random.standard_normal((_DRAWN_AT_ONCE, 2 * self._sums.shape[1])).view(complex)
            self._drawn = np.concatenate([self._drawn, drawn[::-1]])
        return self._drawn[:_WINDOWS_AT_ONCE]

    def measure(self, samples: int, settled: bool, fields: Mapping[str, Any]) -> Generator[Array, Array, None]:
        """Let the transient decay during a measurement."""
        self._let_decay(samples / self.station.rate)
        self.station.now += samples
        return
        yield
