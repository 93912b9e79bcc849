"""Energy dissipated by the dampers per period of a steady tone: supplied work minus dissipation of the structure."""

from dataclasses import dataclass

import numpy as np

from analysis.core.responses.errors.aliasing import aliased_ratios
from analysis.core.responses.errors.systematic import ChannelContributions, tolerance
from analysis.core.responses.measurands import motion_of, reference_of, response_channels
from analysis.core.responses.stepped_sine import Sweep
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError
from rig.core.base.renamed import renamed
from rig.core.results.uncertainty import expand
from rig.core.system.structural_model import structural_model


@dataclass(frozen=True)
class EnergyBalance:
    """Energy balance of one period of a steady tone."""

    frequency: Array  # Hz; shape (n,)
    supplied: Array
    """Work of the force on the structure [J]; shape (n,)."""
    structure: Array
    """Energy dissipated by the structural damping of the scene [J]; shape (n,)."""
    expanded: Array
    """Expanded uncertainty of `dampers` [J]; shape (n,)."""

    bound = renamed("bound", "expanded")

    @property
    def dampers(self) -> Array:
        """Energy dissipated by the dampers: difference of `supplied` and `structure` [J]."""
        return self.supplied - self.structure


def energy_per_period(rec: Recording, sweep: Sweep) -> EnergyBalance:
    """Estimate the energy that force, structure and dampers exchange per period from the channels.

    The supplied work follows from the force and the motion of the driven body, including harmonics. The energy
    dissipated in the structure follows from the motion of all bodies and the damping matrix of the scene. Both are
    quadratic forms of the complex amplitudes a of the channels. An error da of the amplitudes therefore changes the
    difference of both energies by ``2 Re(g^H da)`` to first order, with the gradient g.

    `rec`: recording of a stepped-sine test with a channel on every body; `sweep`: result of
    `analysis.core.responses.stepped_sine.sweeps`.
    """
    if rec.scene.reference == "table":
        raise RecordingError(
            "the structure is mounted on a shaker table, and no channel measures the force between them. Compare the "
            "peaks with those of a test without dampers (`analysis compare`)."
        )
    names = sweep.lines.channels
    damping = structural_model(rec.scene).damping
    bodies = {rec.channels[name].at: name for name in response_channels(rec)}
    count = len(damping)
    missing = [body for body in range(1, count + 1) if f"body {body}" not in bodies]
    if missing:
        raise RecordingError(
            f"no channel on {rec.scene.structure.listed(missing)}, but the energy balance needs the motion of all "
            f"{count} bodies. Mount a motion sensor there."
        )
    # `driven_bodies` of the structural model would reject several coil springs; only the driven shaker matters.
    shaker = rec.scene.driven_shaker
    driven = [0] if shaker is None else [body - 1 for body in shaker.bodies]
    supplied, structure, gradients, force_shares = [], [], [], []
    compliance = np.empty(len(sweep.tones), dtype=complex)
    for index, tone in enumerate(sweep.tones):
        orders = np.arange(1, tone.amplitude.shape[1] + 1)
        frequency = orders * tone.frequency
        force_row = reference_of(rec, "force").row(rec, names, frequency)
        motion_rows = np.array(
            [motion_of(rec, bodies[f"body {body}"]).row(rec, names, frequency) for body in range(1, count + 1)]
        )
        force = np.sum(force_row * tone.amplitude, axis=0)
        motion = np.sum(motion_rows * tone.amplitude, axis=1)
        # The work of a force that acts on several bodies follows from the sum of their motions.
        driven_motion, driven_row = motion[driven].sum(axis=0), motion_rows[driven].sum(axis=0)
        dissipation_factor = 2 * np.pi**2 * tone.frequency * orders**2
        damping_force = damping @ motion
        supplied.append(np.pi * np.sum(orders * np.imag(force * driven_motion.conj())))
        structure.append(np.sum(dissipation_factor * np.sum(motion.conj() * damping_force, axis=0).real))
        # Gradients of supplied and dissipated energy with respect to the channels' amplitudes, (channels, harmonics).
        supplied_gradient = np.pi / 2j * orders * (driven_row.conj() * force - force_row.conj() * driven_motion)
        structure_gradient = dissipation_factor * np.einsum("bck,bk->ck", motion_rows.conj(), damping_force)
        gradients.append(supplied_gradient - structure_gradient)
        compliance[index] = driven_motion[0] / force[0]
        force_shares.append((force_row * tone.amplitude)[:, 0] / force[0])
    return EnergyBalance(
        sweep.lines.frequency,
        np.array(supplied),
        np.array(structure),
        _expanded(rec, sweep, gradients, compliance, np.transpose(force_shares)),
    )


def _expanded(
    rec: Recording, sweep: Sweep, gradients: list[ComplexArray], compliance: ComplexArray, force_shares: ComplexArray
) -> Array:
    """Return the expanded uncertainty of the energy from the scatter and all limits of error.

    `gradients`: gradient g for each tone, shape (channels, harmonics); `compliance`, shape (n,): compliance of the
    driven body; `force_shares`, shape (channels, n): contribution of each channel to the force, relative to the force.
    """
    lines = sweep.lines
    scatter, gain_sensitivity, phase_sensitivity, fundamental_sensitivity = [], [], [], []
    for gradient, tone in zip(gradients, sweep.tones, strict=True):
        # The scatter of the harmonics is assumed equal to that of the fundamental.
        scatter.append(2.0 * np.sum(np.square(np.abs(tone.scatter() @ gradient.conj()))))
        product = 2.0 * gradient * tone.amplitude.conj()
        gain_sensitivity.append(product.real.sum(axis=1))
        phase_sensitivity.append(abs(product).sum(axis=1))
        fundamental_sensitivity.append(2.0 * abs(gradient[:, 0]))
    tolerances = np.array([tolerance(rec, name) for name in lines.channels])
    limits = list(abs(np.transpose(gain_sensitivity)) * (tolerances / np.maximum(1.0 - tolerances, 1e-300))[:, None])
    _, aliased = aliased_ratios(
        rec,
        ChannelContributions(lines.channels, lines.frequency, "displacement", compliance, force_shares, force_shares),
    )
    for sensitivity, error_ratio in (
        (phase_sensitivity, aliased),
        (fundamental_sensitivity, lines.residual_transient),
        (fundamental_sensitivity, lines.resolution),
    ):
        if error_ratio is not None:
            limits.append(np.sum(np.transpose(sensitivity) * error_ratio, axis=0))
    return expand(np.sqrt(np.nan_to_num(scatter)), limits, np.maximum(lines.scatter.degrees_of_freedom, 1.0))
