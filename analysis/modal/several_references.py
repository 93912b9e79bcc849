"""Modes from responses to several inputs, for repeated and close modes that a single input cannot separate.

All elements of the matrix share their poles. The residue of a pole is the outer product of a shape and its
participation in the inputs. The residue of a repeated pole is a sum of such products; their number is the rank of the
residue matrix [1]_.

References
----------
.. [1] D. J. Ewins, Modal Testing, 2nd ed., Research Studies Press 2000, section 4.6.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from analysis.modal.modes import Modes
from rig.arrays import ComplexArray

# Smallest significant further singular value of a residue, in standard uncertainties.
_DETECTION_SIGMAS = 5.0
# Smallest ratio of a significant singular value to the largest; smaller values are errors of the model.
_MIN_RATIO = 0.02


def separate(modes: Modes, outputs: tuple[str, ...], inputs: tuple[str, ...], places: tuple[str, ...]) -> Modes:
    """Separate the modes of each pole by the singular values of its residues.

    `modes`: identified from all elements of a matrix, in the order of the outputs; `places`: positions of the
    outputs. Returns modes with the residues of the input that excites all modes best.
    """
    n_outputs, n_inputs = len(outputs), len(inputs)
    poles: list[int] = []
    vectors: list[tuple[ComplexArray, ComplexArray]] = []  # shape and participation of each mode
    for k in range(modes.frequency.size):
        residue = modes.residue[:, k].reshape(n_outputs, n_inputs)
        noise = float(np.linalg.norm(modes.shape_error[:, k])) * float(abs(residue).max())
        left, singular, right = np.linalg.svd(residue, full_matrices=False)
        for r in range(singular.size):
            if r == 0 or singular[r] > max(_DETECTION_SIGMAS * noise, _MIN_RATIO * singular[0]):
                poles.append(k)
                vectors.append((left[:, r] * singular[r], right[r]))
    shapes, participation = (np.stack(columns, axis=1) for columns in zip(*vectors, strict=True))
    reference = int(np.argmax(np.min(abs(participation), axis=1)))
    rows = np.arange(n_outputs) * n_inputs + reference
    error = np.sqrt(np.mean(np.square(modes.shape_error[:, poles].reshape(n_outputs, n_inputs, -1)), axis=1))
    largest = np.argmax(abs(shapes), axis=0)
    error[largest, np.arange(len(vectors))] = 0.0
    repeated = [f"{modes.frequency[k]:.5g} Hz" for k in dict.fromkeys(poles) if poles.count(k) > 1]
    notes = (f"Repeated modes, with one pole each: {', '.join(repeated)}.",) if repeated else ()
    return replace(
        modes,
        **{name: getattr(modes, name)[poles] for name in ("frequency", "frequency_error", "damping", "damping_error")},
        shape_error=error,
        residue=shapes * participation[reference],
        responses=outputs,
        places=places,
        lower=modes.lower[rows],
        upper=modes.upper[rows],
        input=inputs[reference],
        warnings=(*modes.warnings, *notes),
    )
