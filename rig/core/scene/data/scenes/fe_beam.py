"""Mass and stiffness matrices of the scene fe-beam: a steel cantilever in finite elements, condensed to five points.

The script prints the matrices as they are in the scene file. For another structure, export its mass and stiffness
matrices from a finite-element program and condense them to the points of sensors, shakers and dampers. Save them with
numpy.save, and name the files in the scene: ``matrices: {mass: M.npy, stiffness: K.npy}``.
"""

import numpy as np

from rig.core.base.arrays import Array

LENGTH, WIDTH, THICKNESS = 0.4, 0.04, 0.005  # m
YOUNG, DENSITY = 210e9, 7850.0  # steel: Pa, kg/m^3
ELEMENTS = 20  # number of finite elements
POINTS = 5  # number of points to which the structure is condensed


def beam() -> tuple[Array, Array]:
    """Assemble mass and stiffness of the cantilever: deflection and rotation of each free node.

    Euler-Bernoulli beam elements with consistent masses (e.g. M. Geradin, D. J. Rixen, Mechanical Vibrations, 3rd ed.,
    Wiley 2015, section 5.4).
    """
    h, n_coordinates = LENGTH / ELEMENTS, 2 * (ELEMENTS + 1)
    bending_stiffness = YOUNG * WIDTH * THICKNESS**3 / 12.0  # N m^2
    mass_per_length = DENSITY * WIDTH * THICKNESS  # kg/m
    element_stiffness = (bending_stiffness / h**3) * np.array(
        [[12, 6 * h, -12, 6 * h], [6 * h, 4 * h**2, -6 * h, 2 * h**2],
         [-12, -6 * h, 12, -6 * h], [6 * h, 2 * h**2, -6 * h, 4 * h**2]]
    )  # fmt: skip
    element_mass = (mass_per_length * h / 420.0) * np.array(
        [[156, 22 * h, 54, -13 * h], [22 * h, 4 * h**2, 13 * h, -3 * h**2],
         [54, 13 * h, 156, -22 * h], [-13 * h, -3 * h**2, -22 * h, 4 * h**2]]
    )  # fmt: skip
    mass, stiffness = np.zeros((n_coordinates, n_coordinates)), np.zeros((n_coordinates, n_coordinates))
    for element in range(ELEMENTS):
        coordinates = slice(2 * element, 2 * element + 4)
        mass[coordinates, coordinates] += element_mass
        stiffness[coordinates, coordinates] += element_stiffness
    # Node 0 is clamped.
    return mass[2:, 2:], stiffness[2:, 2:]


def condensed_matrices() -> tuple[Array, Array]:
    """Condense statically to the deflections of evenly spaced points, the last at the tip (R. J. Guyan, 1965)."""
    mass, stiffness = beam()
    retained = 2 * (np.arange(1, POINTS + 1) * ELEMENTS // POINTS - 1)
    condensed = np.setdiff1d(np.arange(len(mass)), retained)
    basis = np.zeros((len(mass), POINTS))
    basis[retained, np.arange(POINTS)] = 1.0
    coupling = stiffness[np.ix_(condensed, retained)]
    basis[condensed] = -np.linalg.solve(stiffness[np.ix_(condensed, condensed)], coupling)
    mass, stiffness = basis.T @ mass @ basis, basis.T @ stiffness @ basis
    return (mass + mass.T) / 2.0, (stiffness + stiffness.T) / 2.0


if __name__ == "__main__":
    for name, matrix in zip(("mass", "stiffness"), condensed_matrices(), strict=True):
        print(f"    {name}:")
        for row in matrix:
            print(f"      - [{', '.join(f'{value:.12g}' for value in row)}]")
