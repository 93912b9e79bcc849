"""The drive of a scene's test without a controller."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array
from rig.errors import SceneError
from rig.scene.excitation import Impulse, Sine, SteppedSine, SweptSine
from rig.scene.scene import Scene
from rig.scene.shaker import ForceShaker, TableShaker
from rig.system.assembly import spring_force_row
from rig.system.hybrid_system import HybridSystem


@dataclass(frozen=True)
class ToneDrive:
    """Complex drive amplitude of each input, frequency [Hz] and [rad/s], and the state to start from."""

    amplitudes: NDArray[np.complex128]
    frequency: float
    omega: float
    state: Array


def tone_drive(scene: Scene, system: HybridSystem, frequency: float | None = None) -> ToneDrive | None:
    """Tone of a sine or stepped sine test, or at a given frequency; None if the test is no tone.

    `frequency`: Hz; None: the test's own, the first one of a stepped sine. Raises `SceneError` if a frequency is
    given but no level or no shaker.
    """
    test = scene.test
    if frequency is None:
        if isinstance(test, Sine):
            frequency = test.frequency
        elif isinstance(test, SteppedSine):
            frequency = test.order[0]
        else:
            return None
    elif not (np.isfinite(frequency) and frequency > 0.0):
        raise SceneError(f"frequency: got {frequency!r}; expected a positive number of hertz")
    omega = 2.0 * np.pi * frequency
    amplitude = -1j * level_of(scene) * drive_per_level(scene, system, omega)
    amplitudes = np.zeros(len(system.inputs), dtype=complex)
    amplitudes[system.inputs.index(scene.at_driven("shaker"))] = amplitude
    state = system.initial.copy()
    if isinstance(scene.driven_shaker, TableShaker):
        # The table's motion is the prescribed tone from the start, not its servo's response.
        position = amplitude / _servo_inverse(scene.driven_shaker, omega)
        table = system.points.index(scene.at_driven("table"))
        state[table] = position.real
        state[system.coordinates + table] = (1j * omega * position).real
    return ToneDrive(amplitudes, frequency, omega, state)


def level_of(scene: Scene) -> float:
    """Level of the test: force [N], or drive in its own unit.

    Raises `SceneError` if the scene has no shaker, or a test without a level.
    """
    if scene.driven_shaker is None and scene.shakers:
        raise SceneError(
            f"scene {scene.name!r} has {len(scene.shakers)} shakers; expected a test with shaker: and "
            "the number of the one that it drives"
        )
    if scene.driven_shaker is None:
        raise SceneError(f"scene {scene.name!r} has no shaker; expected shaker: {{kind: ...}}")
    test = scene.test
    force, drive = getattr(test, "force", None), getattr(test, "drive", None)
    level = force if force is not None else drive
    if level is None:
        raise SceneError(f"scene {scene.name!r} has no test with a level; expected force or drive under test")
    return float(level[0] if isinstance(level, tuple) else level)


def drive_per_level(scene: Scene, system: HybridSystem, omega: float | Array) -> Any:
    """Complex drive amplitude for one unit of level at omega (rad/s), all dampers riding."""
    shaker = scene.driven_shaker
    drives = getattr(scene.test, "drive", None) is not None
    if isinstance(shaker, ForceShaker):
        return 1.0
    if drives:
        return _servo_inverse(shaker, omega) if isinstance(shaker, TableShaker) else 1.0
    return 1.0 / force_per_drive(scene, system, omega)


def _servo_inverse(shaker: TableShaker, omega: float | Array) -> Any:
    """Drive for one unit of table displacement: the critically damped servo, inverted."""
    ratio = omega / (2.0 * np.pi * shaker.bandwidth)
    return (1.0 + 1j * ratio) ** 2


def force_per_drive(scene: Scene, system: HybridSystem, omega: float | Array) -> Any:
    """Spring force for one unit of drive, in the linear structure with all dampers riding."""
    return spring_force_row(scene, system) @ riding_response(system, scene.at_driven("shaker"), omega)


def accelerations_per_level(scene: Scene, system: HybridSystem, omega: float | Array) -> Array:
    """Amplitude of each body's acceleration per unit of level, all dampers riding; shape (bodies,) + omega.shape."""
    response = riding_response(system, scene.at_driven("shaker"), omega) * drive_per_level(
        scene, system, omega
    )
    return omega**2 * np.abs(response[: scene.structure.bodies])


def with_ideal_force(scene: Scene) -> Scene:
    """Replace coil spring, table and channels by the test's force as a pure tone on the body.

    This needs no controller of the spring force. Scenes whose tests give a drive, or whose shaker is a force already,
    do not change.
    """
    shaker = scene.driven_shaker
    if shaker is None or isinstance(shaker, ForceShaker) or getattr(scene.test, "force", None) is None:
        return scene
    force = ForceShaker(body=shaker.bodies[0])
    shakers = [force if number == scene.driven else each for number, each in enumerate(scene.shakers, 1)]
    return scene.replace(shaker=shakers if len(shakers) > 1 else force, channels=None)


def riding_equations(system: HybridSystem, name: str) -> tuple[Array, Array, Array]:
    """Matrices of the rig with all dampers riding, under the drive of a name: E dx/dt = G x + b u.

    Returns `inertia`, shape (states, states), E: identity but for the mass matrix in the rows of the velocities;
    `matrix`, shape (states, states), G; `inflow`, shape (states,), b.
    """
    n, ns = system.coordinates, system.states
    inertia, matrix, inflow = np.eye(ns), np.zeros((ns, ns)), np.zeros(ns)
    mass = system.mass.copy()
    riding = system.damper_coordinate[~system.lasting]
    np.add.at(mass, (riding, riding), system.damper_mass[~system.lasting])
    inertia[n : 2 * n, n : 2 * n] = mass
    matrix[:n, n : 2 * n] = np.eye(n)
    force, _ = system.contact_forces(system.at_rest)
    matrix[n : 2 * n] = system.force_state + force
    matrix[2 * n :] = system.rate_state
    column = system.inputs.index(name)
    inflow[n : 2 * n] = system.force_drive[:, column]
    inflow[2 * n :] = system.rate_drive[:, column]
    return inertia, matrix, inflow


def riding_response(system: HybridSystem, name: str, omega: float | Array) -> NDArray[np.complex128]:
    """States for one unit of the drive of that name, all dampers riding; shape (states,) + that of omega in rad/s."""
    n, ns = system.coordinates, system.states
    inertia, matrix, column = riding_equations(system, name)
    mass = inertia[n : 2 * n, n : 2 * n]
    matrix[n : 2 * n] = np.linalg.solve(mass, matrix[n : 2 * n])
    inflow = column[:, None].astype(complex)
    inflow[n : 2 * n, 0] = np.linalg.solve(mass, column[n : 2 * n])
    at = np.asarray(omega)[..., None, None]
    try:
        solved = np.linalg.solve(1j * at * np.eye(ns) - matrix, inflow).astype(np.complex128, copy=False)
    except np.linalg.LinAlgError:
        raise SceneError(
            f"the undamped rig has no steady state at {np.ravel(omega)[0] / (2 * np.pi):.6g} Hz, its "
            "resonance. Add structure.damping, choose another frequency, or give drive in place of "
            "force."
        ) from None
    return np.moveaxis(solved[..., 0], -1, 0)


def sampled_drive(scene: Scene, system: HybridSystem, samples: int, rate: float) -> Array:
    """Drive (inputs, samples) of a test that is not a tone.

    Raises `SceneError` for tests whose signal only the bench generates.
    """
    drive = np.zeros((len(system.inputs), samples))
    test = scene.test
    time = np.arange(samples) / rate
    if isinstance(test, Impulse):
        drive[system.inputs.index("hammer")] = _hits(test, time)
    elif isinstance(test, SweptSine):
        drive[system.inputs.index(scene.at_driven("shaker"))] = _sweep(scene, system, test, time)
    elif test is not None and test.kind != "free":
        raise SceneError(
            f"a {test.kind} test is generated during the recording (daq.record). To simulate open loop, "
            "give frequency for a tone at its level, or drive, an array of shape (inputs, samples)."
        )
    return drive


def _hits(test: Impulse, time: Array) -> Array:
    force = np.zeros_like(time)
    for hit in range(test.repeats):
        inside = time - hit * test.interval
        pulse = test.peak * np.sin(np.pi * inside / test.width)
        force += np.where((inside >= 0.0) & (inside <= test.width), pulse, 0.0)
    return force


def _sweep(scene: Scene, system: HybridSystem, test: SweptSine, time: Array) -> Array:
    first, last = test.from_, test.to
    share = np.minimum(time / test.duration, 1.0)
    if test.spacing == "log":
        ratio = np.log(last / first)
        phase = 2.0 * np.pi * first * test.duration * np.expm1(share * ratio) / ratio
        frequency = first * np.exp(share * ratio)
    else:
        phase = 2.0 * np.pi * test.duration * (first * share + 0.5 * (last - first) * share**2)
        frequency = first + (last - first) * share
    grid = np.linspace(min(first, last), max(first, last), 400)
    gains = np.array([drive_per_level(scene, system, 2.0 * np.pi * f) for f in grid])
    size = np.interp(frequency, grid, np.abs(gains))
    angle = np.interp(frequency, grid, np.unwrap(np.angle(gains)))
    swept = level_of(scene) * size * np.sin(phase + angle)
    return np.where(time <= test.duration, swept, 0.0)
