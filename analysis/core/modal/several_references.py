"""Modes from responses to several inputs, for repeated and close modes that a single input cannot separate.

All entries of the matrix have the same poles. The residue of a pole is the outer product of a shape and its modal
participation factors, one for each input. The residue of a repeated pole is a sum of such products; the number of
products is the rank of the residue matrix [1]_. Identification adds a second pole next to a pole if this improves the
fit significantly. A pole is reported as repeated only if no second pole was added next to it.

References
----------
.. [1] D. J. Ewins, Modal Testing, 2nd ed., Research Studies Press 2000, section 4.6.
"""

from dataclasses import replace

import numpy as np

from analysis.core.modal.modes import Modes
from rig.core.base.arrays import ComplexArray
from rig.core.results.points import Point

# Smallest further singular value of a residue that indicates another mode [standard uncertainties].
_DETECTION_SIGMAS = 5.0
# Smallest ratio of the further singular value to the largest: smaller values may be errors of the model.
_MIN_RATIO = 0.02


def separate(modes: Modes, inputs: tuple[str, ...], outputs: tuple[Point, ...]) -> Modes:
    """Separate the modes of each pole by the singular values of its residues.

    `modes`: modes identified from all entries of a matrix, in the order of the outputs; `inputs`: names of the inputs.
    Returns modes with the residues of one input, for which the smallest participation factor is the largest.
    """
    n_outputs, n_inputs = len(outputs), len(inputs)
    # A large model error raises the smallest ratio, because it may resemble a second shape.
    min_ratio = max(_MIN_RATIO, _DETECTION_SIGMAS * modes.model_error)
    pole_of_mode: list[int] = []
    vectors: list[tuple[ComplexArray, ComplexArray]] = []  # shape and participation factors of each mode
    for k in range(modes.frequency.size):
        residue = modes.residue[:, k].reshape(n_outputs, n_inputs)
        noise = float(np.linalg.norm(modes.shape_std[:, k])) * float(abs(residue).max())
        left, singular, right = np.linalg.svd(residue, full_matrices=False)
        for r in range(singular.size):
            if r == 0 or singular[r] > max(_DETECTION_SIGMAS * noise, min_ratio * singular[0]):
                pole_of_mode.append(k)
                vectors.append((left[:, r] * singular[r], right[r]))
    shapes, participation = (np.stack(columns, axis=1) for columns in zip(*vectors, strict=True))
    reference = int(np.argmax(np.min(abs(participation), axis=1)))
    rows = np.arange(n_outputs) * n_inputs + reference
    error = np.sqrt(np.mean(np.square(modes.shape_std[:, pole_of_mode].reshape(n_outputs, n_inputs, -1)), axis=1))
    largest = np.argmax(abs(shapes), axis=0)
    error[largest, np.arange(len(vectors))] = 0.0
    repeated = [f"{modes.frequency[k]:.5g} Hz" for k in dict.fromkeys(pole_of_mode) if pole_of_mode.count(k) > 1]
    notes = (f"Repeated modes, with several shapes each: {', '.join(repeated)}.",) if repeated else ()
    return replace(
        modes,
        **{
            name: getattr(modes, name)[pole_of_mode]
            for name in ("frequency", "frequency_std", "damping", "damping_std")
        },
        shape_std=error,
        residue=shapes * participation[reference],
        responses=tuple(point.name for point in outputs),
        places=tuple(point.place for point in outputs),
        bodies=tuple(point.body for point in outputs),
        lower=modes.lower[rows],
        upper=modes.upper[rows],
        input=inputs[reference],
        warnings=(*modes.warnings, *notes),
    )
