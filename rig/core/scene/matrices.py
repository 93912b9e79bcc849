"""Mass, stiffness and damping matrices of a general linear structure: inline or from .npy files."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import FiniteFloat, GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationInfo
from pydantic_core import CoreSchema, core_schema

from rig.core.settings.problems import Problem
from rig.core.settings.quantity_field import format_value, validation_error
from rig.core.settings.settings import Settings

# Maximum number of bodies of a structure: a matrix then has 32 MB.
MAX_BODIES = 2000
# Largest asymmetry of matrices from other programs (rounding error), relative to the largest entry.
MAX_ASYMMETRY = 1e-9
FOLDER = "folder"  # key of the validation context: folder of the scene file and its .npy files


class _Matrix:
    """A square matrix of finite numbers in SI: a list of rows, an array, or a .npy file in the folder of the scene."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.with_info_plain_validator_function(self._read)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        row = {"type": "array", "items": {"type": "number"}, "minItems": 1}
        path = {"type": "string", "pattern": r"\.npy$"}
        return {"description": "matrix in SI", "anyOf": [path, {"type": "array", "items": row, "minItems": 1}]}

    def _read(self, value: Any, info: ValidationInfo) -> tuple[tuple[float, ...], ...]:
        array = _from_file(value, (info.context or {}).get(FOLDER)) if isinstance(value, str | Path) else value
        try:
            numbers = np.asarray(array)
            if numbers.dtype.kind not in "iufU":
                raise ValueError("not real numbers")
            matrix = numbers.astype(np.float64)
        except (TypeError, ValueError, OverflowError):
            raise validation_error(
                "got rows of unequal length, or values that are not numbers; expected a square matrix of numbers"
            ) from None
        if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or matrix.size == 0:
            raise validation_error(f"got a matrix of shape {matrix.shape}; expected a square matrix")
        if matrix.shape[0] > MAX_BODIES:
            raise validation_error(f"got {matrix.shape[0]} rows; expected at most {MAX_BODIES}, one for each body")
        if not np.isfinite(matrix).all():
            row, column = np.argwhere(~np.isfinite(matrix))[0] + 1
            raise validation_error(
                f"got {matrix[row - 1, column - 1]} in row {row}, column {column}; expected finite numbers"
            )
        return tuple(map(tuple, matrix.tolist()))


Matrix = Annotated[tuple[tuple[float, ...], ...], _Matrix()]


class Matrices(Settings):
    """A structure given by its matrices, in SI; instead of the damping matrix, `Structure.damping` can be given."""

    mass: Matrix
    """Symmetric and positive definite, (bodies, bodies) [kg]."""
    stiffness: Matrix
    """Symmetric, (bodies, bodies) [N/m]."""
    damping: Matrix | None = None
    """Damping matrix, (bodies, bodies) [N s/m]; it must not add energy to any free motion."""
    influence: tuple[FiniteFloat, ...] | None = None
    """Displacement of each body per static displacement of a base: 1 in the direction of the base, 0 for a rotation.
    None: 1 for all bodies."""

    def check_consistency(self) -> Iterable[Problem]:
        """Check sizes, symmetry, positive kinetic energy, nonnegative elastic energy, and that no motion grows."""
        problems = list(self._check_shapes())
        yield from problems
        if not problems:
            yield from self._check_definiteness()

    def _check_shapes(self) -> Iterable[Problem]:
        mass, stiffness = np.array(self.mass), np.array(self.stiffness)
        for key, matrix in (("stiffness", stiffness), ("damping", self.damping)):
            if matrix is not None and len(matrix) != len(mass):
                yield Problem((key,), f"got {len(matrix)} rows; expected {len(mass)}, as in the mass matrix")
        if self.influence is not None and len(self.influence) != len(mass):
            yield Problem(("influence",), f"got {len(self.influence)} values; expected {len(mass)}, one for each body")
        for key, matrix in (("mass", mass), ("stiffness", stiffness)):
            indices = asymmetry(matrix)
            if indices is not None:
                row, column = indices
                values = ", ".join(
                    f"entry ({i + 1}, {j + 1}) is {matrix[i, j]:g}" for i, j in ((row, column), (column, row))
                )
                yield Problem((key,), f"the matrix is not symmetric: {values}; expected a symmetric matrix")
        if not is_positive_definite(mass):
            yield Problem(("mass",), "not positive definite; expected a mass matrix whose eigenvalues are all positive")

    def _check_definiteness(self) -> Iterable[Problem]:
        mass, stiffness = np.array(self.mass), np.array(self.stiffness)
        squared_frequency = lowest_squared_frequency(mass, stiffness)
        if squared_frequency < 0.0:
            yield Problem(
                ("stiffness",),
                f"not positive semidefinite (squared natural frequency {squared_frequency:.3g} rad²/s²), so the "
                "structure is statically unstable; expected a stiffness matrix without negative eigenvalues",
            )
        elif self.damping is not None:
            growth, frequency = fastest_growth(mass, stiffness, np.array(self.damping))
            if growth > 0.0:
                yield Problem(
                    ("damping",),
                    f"negative damping: at {frequency:.3g} Hz the free motion grows by {growth:.3g} 1/s; expected "
                    "damping that dissipates energy",
                )


def asymmetry(matrix: NDArray[np.float64]) -> tuple[int, int] | None:
    """Return the indices of the most asymmetric pair of entries of a matrix (n, n); None if it is symmetric."""
    difference = np.abs(matrix - matrix.T)
    row, column = np.unravel_index(int(np.argmax(difference)), matrix.shape)
    if difference[row, column] <= MAX_ASYMMETRY * np.abs(matrix).max():
        return None
    return int(row), int(column)


def is_positive_definite(matrix: NDArray[np.float64]) -> bool:
    """Return whether a symmetric matrix (n, n) is positive definite by more than rounding errors."""
    diagonal = np.diag(matrix)
    if (diagonal <= 0.0).any():
        return False
    # The scaled matrix has a unit diagonal, so the result does not depend on the units of the coordinates.
    scale = 1.0 / np.sqrt(diagonal)
    scaled = (matrix + matrix.T) / 2.0 * scale[:, None] * scale
    return bool(np.linalg.eigvalsh(scaled)[0] > len(matrix) * np.finfo(float).eps)


def lowest_squared_frequency(mass: NDArray[np.float64], stiffness: NDArray[np.float64]) -> float:
    """Return the lowest squared natural frequency of symmetric matrices (n, n), 1/s^2; 0 within rounding error."""
    # With M = L L^T, the squared frequencies are the eigenvalues of L^-1 K L^-T.
    factor = np.linalg.cholesky((mass + mass.T) / 2.0)
    half_reduced = np.linalg.solve(factor, (stiffness + stiffness.T) / 2.0)
    squared = np.linalg.eigvalsh(np.linalg.solve(factor, half_reduced.T))
    rounding = 10 * len(squared) * np.finfo(float).eps * np.abs(squared).max()
    return 0.0 if abs(squared[0]) <= rounding else float(squared[0])


def fastest_growth(
    mass: NDArray[np.float64], stiffness: NDArray[np.float64], damping: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the largest growth rate of a free motion [1/s] and its frequency [Hz]; both are 0 if no mode grows."""
    # Damping whose symmetric part has no negative eigenvalues never supplies energy, so no motion grows.
    damping_eigenvalues = np.linalg.eigvalsh((damping + damping.T) / 2.0)
    rounding = 10 * len(damping) * np.finfo(float).eps * np.abs(damping_eigenvalues).max()
    if damping_eigenvalues[0] >= -rounding:
        return 0.0, 0.0
    n = len(mass)
    state_matrix = np.zeros((2 * n, 2 * n))
    state_matrix[:n, n:] = np.eye(n)
    state_matrix[n:] = -np.linalg.solve(mass, np.hstack([stiffness, damping]))
    poles = np.linalg.eigvals(state_matrix)
    fastest = poles[np.argmax(poles.real)]
    if fastest.real <= 1e-9 * np.abs(poles).max():
        return 0.0, 0.0
    return float(fastest.real), float(abs(fastest.imag) / (2.0 * np.pi))


def _from_file(name: str | Path, folder: Path | None) -> NDArray[Any]:
    if Path(name).suffix != ".npy":
        raise validation_error(f"got {format_value(str(name))}; expected rows of numbers or the name of a .npy file")
    if folder is None:
        raise validation_error(
            f"got {format_value(str(name))}, but a .npy file is read from the folder of the scene file, and this scene "
            "was not read from a file. Give rows of numbers."
        )
    path = folder / name
    if path.exists() and not path.is_file():
        raise validation_error(f"{path} is a folder or a device; expected a .npy file next to the scene file")
    try:
        # The file is mapped, so the size in its header is checked before the data are read.
        mapped: NDArray[Any] = np.load(path, mmap_mode="r", allow_pickle=False)
    except FileNotFoundError:
        raise validation_error(f"{path}: the file does not exist; expected it next to the scene file") from None
    except Exception as error:
        # A damaged file can cause an exception of almost any type in the reader.
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise validation_error(
            f"{path} cannot be read as .npy ({reason}). Save the matrix again, with numpy.save."
        ) from None
    if not isinstance(mapped, np.ndarray):
        raise validation_error(f"{path} is an archive of arrays (.npz). Save the matrix alone, with numpy.save.")
    if mapped.ndim != 2 or max(mapped.shape) > MAX_BODIES:
        raise validation_error(
            f"{path} has shape {mapped.shape}; expected a square matrix of at most {MAX_BODIES} rows"
        )
    return np.array(mapped)
