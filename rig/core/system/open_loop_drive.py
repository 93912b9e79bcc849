"""The drive of a scene's test without a controller (open loop), and the validation of a sampled drive.

The *level* of a test is its force, or its drive in the unit of the shaker's input. The drive per level is computed for
the linear structure with all dampers *at rest*: the particles are at rest in their cavities, and act as an added mass.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RunError, SceneError
from rig.core.scene.excitation.kind import Chirp, Pulses
from rig.core.scene.scene import Scene
from rig.core.scene.shaker import ForceShaker
from rig.core.system.assembly import assemble, force_row
from rig.core.system.hybrid_system import HybridSystem, hold_coordinates

# Minimum number of frequencies between which the drive per level of a sweep is interpolated.
_MIN_GAIN_FREQUENCIES = 400
# The interpolated drive has a relative error of at most this value.
_MAX_GAIN_ERROR = 1e-3
# Halvings of an interval of this interpolation: its ends are then a millionth apart.
_MAX_HALVINGS = 20
# Maximum number of elements in the matrices of several frequencies that are solved in one call (16 MB).
_MAX_ELEMENTS = 1_000_000


@dataclass(frozen=True)
class ToneDrive:
    """A pure tone u(t) = Re(U e^{i omega t}) of the inputs, and the state at its start."""

    amplitudes: ComplexArray  # U of each input, in the unit of the input
    frequency: float  # Hz
    omega: float  # rad/s
    state: Array  # initial state, SI units, shape (states,)


def tone_drive(scene: Scene, system: HybridSystem, frequency: float | None = None) -> ToneDrive | None:
    """Return the tone of a test at a frequency [Hz].

    The default is the test's `tone`; without one, the result is None.
    Raises `SceneError` if the frequency is not positive, or the scene has no level or no shaker.
    """
    test = scene.test
    if frequency is None:
        frequency = None if test is None else test.tone
        if frequency is None:
            return None
    elif not (np.isfinite(frequency) and frequency > 0.0):
        raise SceneError(f"frequency: got {frequency!r}; expected a positive number of hertz")
    omega = 2.0 * np.pi * frequency
    # The factor -i makes the tone a sine.
    amplitude = -1j * level_of(scene) * drive_per_level(scene, system, omega)
    amplitudes = np.zeros(len(system.inputs), dtype=complex)
    amplitudes[system.inputs.index(scene.at_driven("shaker"))] = amplitude
    state = system.initial.copy()
    if scene.driven_shaker is not None and scene.driven_shaker.prescribed:
        # The table moves with the tone from the start, without a transient of its servo.
        position = complex(amplitude / scene.driven_shaker.required_drive(np.asarray(1j * omega))[0])
        table = system.points.index(scene.at_driven("table"))
        state[table] = position.real
        state[system.coordinates + table] = (1j * omega * position).real
    return ToneDrive(amplitudes, frequency, omega, state)


def level_of(scene: Scene) -> float:
    """Return the level of the test: force [N] or drive; raise `SceneError` without a shaker or level."""
    if scene.driven_shaker is None and scene.shakers:
        raise SceneError(
            f"scene {scene.name!r} has {len(scene.shakers)} shakers. Set test.shaker to the number of the driven "
            "shaker."
        )
    if scene.driven_shaker is None:
        raise SceneError(f"scene {scene.name!r} has no shaker. Add shaker: {{kind: ...}}.")
    test = scene.test
    if test is None or not test.uses_shaker or not test.levels:
        raise SceneError(f"scene {scene.name!r} has no test with a level. Add force or drive under test.")
    if test.held_motion is not None:
        raise SceneError(
            f"test: the drive of a {test.kind} test depends on measured values. Use daq.record, or give test: {{kind: "
            "sine} with force or drive."
        )
    return float(test.levels[0])


def drive_per_level(scene: Scene, system: HybridSystem, omega: float | Array) -> Any:
    """Return the complex drive amplitude per unit of level at omega [rad/s], in the shape of omega, or 1."""
    shaker = scene.driven_shaker
    assert shaker is not None
    held_motion = None if scene.test is None else scene.test.held_motion
    if held_motion is not None:
        location, order = held_motion
        response = riding_response(system, scene.at_driven("shaker"), omega)[system.points.index(location)]
        return 1.0 / ((1j * omega) ** order * response)
    if shaker.drive_is_force or scene.level_key == "drive":
        return 1.0
    return 1.0 / force_per_drive(scene, system, omega)


def force_per_drive(scene: Scene, system: HybridSystem, omega: float | Array) -> Any:
    """Return the complex amplitude of the coil spring's force per unit of drive at omega [rad/s], in N."""
    return force_row(scene, system) @ riding_response(system, scene.at_driven("shaker"), omega)


def accelerations_per_drive(scene: Scene, places: Sequence[str], omega: Array) -> Array:
    """Return accelerations at places per drive [m/s²] with resting dampers; (places,) + omega.shape; `omega`: rad/s."""
    system = assemble(scene)
    rows = [system.points.index(place) for place in places]
    return np.asarray(omega**2 * np.abs(riding_response(system, scene.at_driven("shaker"), omega)[rows]))


def accelerations_per_level(scene: Scene, system: HybridSystem, omega: float | Array) -> Array:
    """Return accelerations of bodies per level [m/s²] with resting dampers; (bodies,) + omega.shape; `omega`: rad/s."""
    return omega**2 * np.abs(_response_per_level(scene, system, omega)[: scene.structure.bodies])


def _response_per_level(scene: Scene, system: HybridSystem, omega: float | Array) -> ComplexArray:
    """Return the complex amplitudes of the states per unit of level with resting dampers; (states,) + omega.shape."""
    gain = drive_per_level(scene, system, omega)
    return np.asarray(riding_response(system, scene.at_driven("shaker"), omega) * gain)


def damper_accelerations(scene: Scene, system: HybridSystem, omega: Array) -> Array:
    """Return the accelerations of all dampers at rest [m/s²] per level; (dampers, frequencies)."""
    return _damper_accelerations(system, _response_per_level(scene, system, omega), omega)


def _damper_accelerations(system: HybridSystem, response: ComplexArray, omega: Array) -> Array:
    """Return the accelerations of dampers in a response [m/s²]: a bed on a compliant wall moves more than its body."""
    displacements, gap = response[system.damper_coordinate], system.gap_coordinate[: system.dampers]
    displacements[gap >= 0] += response[gap[gap >= 0]]
    return np.asarray(omega**2 * np.abs(displacements))


def loadings_per_level(scene: Scene, system: HybridSystem, omega: Array) -> Array:
    """Return the loadings of all dampers and joints per level, (elements, frequencies).

    An element with a loading of 1 ends the linear motion, see `separation_levels`. Without such a limit, it is 0.
    """
    return _loadings(system, _response_per_level(scene, system, omega), omega)


def _loadings(system: HybridSystem, response: ComplexArray, omega: Array) -> Array:
    """Return the loadings of all elements in a response, as `loadings_per_level`."""
    loadings = np.zeros((len(system.elements), response.shape[1]))
    # Without gravity, and at a wall, any motion exceeds the limit; an element at rest has no loading.
    with np.errstate(divide="ignore", invalid="ignore"):
        loadings[: system.dampers] = (
            _damper_accelerations(system, response, omega) / system.separation_acceleration[:, None]
        )
        for row in _between_walls(system):
            loadings[row] = np.abs(system.elements[row].along_gap(response.T)) / system.elements[row].distance
    return np.nan_to_num(loadings, nan=0.0, posinf=np.inf)


def linear_limits(scene: Scene, frequency: Array) -> Array:
    """Return the amplitudes of the bodies at which linear motion ends [m], shape (bodies, frequencies).

    `frequency`: Hz. See `separation_levels`.
    """
    system, omega = assemble(scene), 2.0 * np.pi * frequency
    response = riding_response(system, scene.at_driven("shaker"), omega)
    return np.asarray(_separation_drive(system, response, omega) * abs(response[: scene.structure.bodies]))


def separation_levels(scene: Scene, frequency: Array) -> Array:
    """Compute the level at which the linear motion with resting dampers ends.

    At this level a bed reaches 1 g, a mass on a spring its wall, friction its limit, or the first joint closes or
    slips. `frequency`, shape (frequencies,): Hz. Returns shape (frequencies,), N, or the unit of the drive.
    """
    system, omega = assemble(scene), 2.0 * np.pi * frequency
    return _separation_drive(system, _response_per_level(scene, system, omega), omega)


def _separation_drive(system: HybridSystem, response: ComplexArray, omega: Array) -> Array:
    """Return the factor by which a response is multiplied where linear motion ends, shape (frequencies,)."""
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / _loadings(system, response, omega).max(axis=0))


def gaps_per_level(scene: Scene, system: HybridSystem, omega: Array) -> Array:
    """Return the amplitude of the gap of each element that rests between walls, in m per unit of level.

    For a joint with friction, the slip displacement replaces the wall. `omega`: rad/s, shape (frequencies,). Shape of
    the result: (elements, frequencies).
    """
    response = _response_per_level(scene, system, omega)
    gaps = [np.abs(system.elements[row].along_gap(response.T)) for row in _between_walls(system)]
    return np.array(gaps).reshape(-1, omega.size)


def _between_walls(system: HybridSystem) -> list[int]:
    """Return the numbers of the elements that rest between walls."""
    return [
        row
        for row, element in enumerate(system.elements)
        if element.distance < np.inf and not element.law.starts_at_rest
    ]


def with_ideal_force(scene: Scene) -> Scene:
    """Replace the driven shaker with an ideal force on its body, and omit the channels.

    The spring force is then exact without a controller. The scene is returned unchanged if the test has no force, or
    the shaker is an ideal force.
    """
    shaker = scene.driven_shaker
    if shaker is None or shaker.drive_is_force or scene.level_key != "force":
        return scene
    force = ForceShaker(body=shaker.bodies[0])
    shakers = [force if number == scene.driven else other for number, other in enumerate(scene.shakers, 1)]
    return scene.replace(shaker=shakers if len(shakers) > 1 else force, channels=None)


def riding_equations(system: HybridSystem, name: str) -> tuple[Array, Array, Array]:
    """Return E, G and b of the equations E dx/dt = G x + b u with all dampers at rest; `name`: name of the input u.

    E and G have the shape (states, states), b the shape (states,). E is the identity, except for the mass matrix in the
    rows of the velocities.
    """
    n, ns = system.coordinates, system.states
    descriptor_matrix, state_matrix, input_vector = np.eye(ns), np.zeros((ns, ns)), np.zeros(ns)
    mass = system.mass.copy()
    np.add.at(mass, (system.damper_coordinate, system.damper_coordinate), system.detached_mass)
    state_matrix[:n, n : 2 * n] = np.eye(n)
    force, _ = system.contact_forces(system.start)
    state_matrix[n : 2 * n] = system.force_state + force
    # The gap of a mass that sticks remains at rest.
    fixed = system.gaps_at_rest(system.start)
    hold_coordinates(mass, fixed)
    state_matrix[[n + gap for gap in fixed]] = 0.0
    descriptor_matrix[n : 2 * n, n : 2 * n] = mass
    state_matrix[2 * n :] = system.rate_state
    column = system.inputs.index(name)
    input_vector[n : 2 * n] = system.force_drive[:, column]
    input_vector[2 * n :] = system.rate_drive[:, column]
    return descriptor_matrix, state_matrix, input_vector


def riding_response(system: HybridSystem, name: str, omega: float | Array) -> ComplexArray:
    """Return the complex amplitudes of the states per unit of drive, dampers at rest; shape (states,) + omega.shape.

    `name`: name of the driven input; `omega`: rad/s. Raises `SceneError` at the resonance of an undamped system.
    """
    n, ns = system.coordinates, system.states
    descriptor_matrix, state_matrix, input_vector = riding_equations(system, name)
    mass = descriptor_matrix[n : 2 * n, n : 2 * n]
    state_matrix[n : 2 * n] = np.linalg.solve(mass, state_matrix[n : 2 * n])
    right_side = input_vector[:, None].astype(complex)
    right_side[n : 2 * n, 0] = np.linalg.solve(mass, input_vector[n : 2 * n])
    try:
        states = solve_harmonic(np.eye(ns), state_matrix, right_side, np.ravel(omega))[..., 0]
    except np.linalg.LinAlgError:
        raise SceneError(
            f"the undamped rig has no steady state at {np.ravel(omega)[0] / (2 * np.pi):.6g} Hz, its "
            "resonance. Add structure.damping, choose another frequency, or give drive instead of force."
        ) from None
    return states.T.reshape((ns, *np.shape(omega)))


def solve_harmonic(
    descriptor_matrix: Array, state_matrix: Array, right_side: ComplexArray, omega: Array
) -> ComplexArray:
    """Solve (j omega E - G) x = b at each frequency [rad/s], in blocks of limited memory.

    E, G: shape (states, states); b: shape (states, columns), or (frequencies, states, columns) as the result.
    """
    right_sides = np.broadcast_to(right_side, (omega.size, *right_side.shape[-2:]))
    solution = np.empty(right_sides.shape, dtype=np.complex128)
    step = max(1, _MAX_ELEMENTS // state_matrix.size)
    for first in range(0, omega.size, step):
        block = slice(first, first + step)
        matrices = 1j * omega[block, None, None] * descriptor_matrix - state_matrix
        solution[block] = np.linalg.solve(matrices, right_sides[block])
    return solution


def sampled_drive(scene: Scene, system: HybridSystem, samples: int, rate: float) -> Array:
    """Return the drive (inputs, samples) at a `rate` [Hz]; `SceneError` if a recording alone can generate it."""
    drive = np.zeros((len(system.inputs), samples))
    test = scene.test
    if test is None:
        return drive
    wave = test.wave(samples, rate)
    if isinstance(wave, Pulses):
        name = "hammer" if wave.input == "hammer" else scene.at_driven("shaker")
        assert not scene.controlled_terms, f"{test.kind}: the level is not a drive; set level_keys = ('drive',)"
        drive[system.inputs.index(name)] = wave.values
    elif isinstance(wave, Chirp):
        is_sweeping = np.arange(samples) / rate <= test.shortest
        values = np.where(is_sweeping, _chirp_drive(scene, system, wave), 0.0)
        drive[system.inputs.index(scene.at_driven("shaker"))] = values
    elif wave is None:
        raise SceneError(
            f"test: the signal of a {test.kind} test is generated during a recording. Record it with daq record, "
            "or give `frequency` (of a tone at the test's level) or `drive` (an array of shape (inputs, samples))."
        )
    return drive


def _chirp_drive(scene: Scene, system: HybridSystem, chirp: Chirp) -> Array:
    """Return the drive of a sweep, with the amplitude that gives the test's level at each frequency."""
    assert scene.test is not None and scene.test.band is not None
    gain = np.interp(chirp.frequency, *_tabulate_gain(scene, system, *scene.test.band))
    return np.asarray(level_of(scene) * np.imag(gain * np.exp(1j * chirp.phase)))


def _tabulate_gain(scene: Scene, system: HybridSystem, low: float, high: float) -> tuple[Array, ComplexArray]:
    """Return frequencies [Hz], closely spaced at resonances and antiresonances, and the drive per level at each."""

    def gain_at(frequency: Array) -> ComplexArray:
        gain = drive_per_level(scene, system, 2.0 * np.pi * frequency)
        return np.broadcast_to(np.asarray(gain, dtype=np.complex128), frequency.shape)

    frequency = np.linspace(low, high, _MIN_GAIN_FREQUENCIES)
    gain = gain_at(frequency)
    for _ in range(_MAX_HALVINGS):
        middle = 0.5 * (frequency[1:] + frequency[:-1])
        exact = gain_at(middle)
        is_inaccurate = np.abs(0.5 * (gain[1:] + gain[:-1]) - exact) > _MAX_GAIN_ERROR * np.abs(exact)
        if not is_inaccurate.any():
            break
        next_indices = np.flatnonzero(is_inaccurate) + 1
        frequency = np.insert(frequency, next_indices, middle[is_inaccurate])
        gain = np.insert(gain, next_indices, exact[is_inaccurate])
    return frequency, gain


def validate_drive(drive: ArrayLike, inputs: Sequence[str], first: int = 0) -> Array:
    """Return a drive as an array of shape (inputs, samples).

    `inputs`: names of the drive inputs; `first`: index of the first sample, for error messages. Raises `RunError`
    if the drive has a different shape or is not finite.
    """
    try:
        block: Array = np.asarray(drive, dtype=np.float64)
    except (TypeError, ValueError):
        raise RunError(
            "drive: the values are not real numbers, or the rows differ in length. Give an array of real numbers of "
            f"shape ({len(inputs)}, samples)."
        ) from None
    if block.ndim != 2 or block.shape[0] != len(inputs):
        raise RunError(
            f"drive: got an array of shape {block.shape}; expected shape ({len(inputs)}, samples), one row for each "
            f"input: {', '.join(inputs) or '(none)'}"
        )
    if not np.isfinite(block).all():
        row, column = np.argwhere(~np.isfinite(block))[0]
        raise RunError(
            f"drive: got {block[row, column]} at sample {first + column} of input {inputs[row]}; expected finite "
            "numbers"
        )
    return block
