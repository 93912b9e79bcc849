"""True energy that impacts of dampers dissipate per period, from the recorded truth."""

import numpy as np

from analysis.core.responses.stepped_sine import Sweep
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array
from rig.core.system.structural_model import structural_model


def impact_energy_per_period(rec: Recording, sweep: Sweep) -> Array:
    """Compute the true energy lost in impacts per period of each tone [J] from the recorded truth.

    An instantaneous impact dissipates (1 - e²) times half the reduced mass of damper and body times the closing speed
    squared. For finite-duration contact the loss is the work of the walls (floor and ceiling) in steady state. Over
    whole periods the inertia and weight of a damper do no net work. The work of the walls is therefore the integral of
    -m a v, with the mass m of the damper, the acceleration a of its body, and the velocity v at which the gap opens,
    minus the loss in the dashpot of a mass on a spring.

    The result is NaN for beds of grains, whose impacts are not recorded. The result is also NaN if an instantaneous
    impact acts on other dampers, in the same body or through off-diagonal masses.
    """
    from rig.core.system.assembly import assemble

    if any(damper.grains is not None for damper in rec.scene.dampers) or assemble(rec.scene).impacts_interact:
        return np.full(len(sweep.lines.frequency), np.nan)
    model = structural_model(rec.scene)
    restitution = np.array([damper.restitution for damper in rec.scene.dampers])
    # The masses of locked dampers belong to their bodies.
    damper_mass, body_mass = model.damper_mass, np.diag(model.with_damper_masses().mass)[model.damper_body]
    loss_per_squared_speed = 0.5 * damper_mass * body_mass / (damper_mass + body_mass) * (1.0 - restitution**2)
    events = rec.events
    events = events[np.isin(events["kind"], ("floor", "ceiling"))]
    loss = loss_per_squared_speed[events["damper"] - 1] * events["speed"] ** 2
    has_finite_contact = [damper.impacts and damper.contact is not None for damper in rec.scene.dampers]
    losses = []
    for frequency, (first, stop) in zip(sweep.lines.frequency, sweep.windows, strict=True):
        is_inside = (events["time"] >= first / rec.rate) & (events["time"] < stop / rec.rate)
        losses.append(loss[is_inside].sum() / ((stop - first) / rec.rate * frequency))
        for j in np.flatnonzero(has_finite_contact):
            mass = float(damper_mass[j])
            losses[-1] += _work_of_walls(rec, int(j), mass, float(frequency), int(first), int(stop))
    return np.array(losses)


def _work_of_walls(rec: Recording, j: int, mass: float, frequency: float, first: int, stop: int) -> float:
    """Return the mean of the integral of -m a v over a period, minus the loss in a dashpot [J].

    See `impact_energy_per_period`.

    `j`: index of the damper, from 0; `mass`: kg; `first`, `stop`: samples of the true motion. The integral is computed
    from the spectra of displacement and gap, whose aliasing is negligible. NaN without a whole period.
    """
    periods = int((stop - first) / rec.rate * frequency)
    samples = round(periods / frequency * rec.rate)
    if not periods:
        return np.nan
    body = rec.truth_points.index(f"body {rec.scene.dampers[j].body}")
    displacement, gap = (
        np.fft.rfft(rec.truth(quantity, first, first + samples)[row]) / samples
        for quantity, row in (("displacement", body), ("gap", j))
    )
    angular = 2.0 * np.pi * np.fft.rfftfreq(samples, 1.0 / rec.rate)
    force = -mass * angular**2 * displacement + rec.scene.dampers[j].dashpot * 1j * angular * gap
    return float(-2.0 * np.sum((force * (1j * angular * gap).conj()).real) / frequency)
