"""How the matrices of the scene fe-beam came about: a steel cantilever in finite elements, reduced to five points.

Run it to get them printed as the scene has them; take it as a pattern for structures of your own. A plate or a frame
from another program goes the same way: its mass and stiffness matrices, reduced to the points where sensors, shakers
and dampers are, saved with numpy.save and named in the scene as ``matrices: {mass: M.npy, stiffness: K.npy}``.
"""

from __future__ import annotations

import numpy as np

from rig.arrays import Array

LENGTH, WIDTH, THICKNESS = 0.4, 0.04, 0.005  # m
YOUNG, DENSITY = 210e9, 7850.0  # steel: Pa, kg/m^3
ELEMENTS, POINTS = 20, 5


def beam() -> tuple[Array, Array]:
    """Assemble mass and stiffness of the cantilever: deflection and rotation of each free node.

    Euler-Bernoulli beam elements with consistent masses (e.g. M. Geradin, D. J. Rixen, Mechanical Vibrations, 3rd ed.,
    Wiley 2015, section 5.4).
    """
    h, size = LENGTH / ELEMENTS, 2 * (ELEMENTS + 1)
    bending, line = YOUNG * WIDTH * THICKNESS**3 / 12.0, DENSITY * WIDTH * THICKNESS
    stiff = (bending / h**3) * np.array(
        [[12, 6 * h, -12, 6 * h], [6 * h, 4 * h**2, -6 * h, 2 * h**2],
         [-12, -6 * h, 12, -6 * h], [6 * h, 2 * h**2, -6 * h, 4 * h**2]]
    )  # fmt: skip
    heavy = (line * h / 420.0) * np.array(
        [[156, 22 * h, 54, -13 * h], [22 * h, 4 * h**2, 13 * h, -3 * h**2],
         [54, 13 * h, 156, -22 * h], [-13 * h, -3 * h**2, -22 * h, 4 * h**2]]
    )  # fmt: skip
    mass, stiffness = np.zeros((size, size)), np.zeros((size, size))
    for element in range(ELEMENTS):
        part = slice(2 * element, 2 * element + 4)
        mass[part, part] += heavy
        stiffness[part, part] += stiff
    # Node 0 is clamped.
    return mass[2:, 2:], stiffness[2:, 2:]


def reduced() -> tuple[Array, Array]:
    """Condense to the deflection of five evenly spaced points, the last one at the tip (R. J. Guyan, 1965)."""
    mass, stiffness = beam()
    kept = 2 * (np.arange(1, POINTS + 1) * ELEMENTS // POINTS - 1)
    others = np.setdiff1d(np.arange(len(mass)), kept)
    shape = np.zeros((len(mass), POINTS))
    shape[kept, np.arange(POINTS)] = 1.0
    shape[others] = -np.linalg.solve(stiffness[np.ix_(others, others)], stiffness[np.ix_(others, kept)])
    small = shape.T @ mass @ shape, shape.T @ stiffness @ shape
    return (small[0] + small[0].T) / 2.0, (small[1] + small[1].T) / 2.0


if __name__ == "__main__":
    for name, matrix in zip(("mass", "stiffness"), reduced(), strict=True):
        print(f"    {name}:")
        for row in matrix:
            print(f"      - [{', '.join(f'{value:.12g}' for value in row)}]")
