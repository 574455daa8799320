"""What the matrices of a cost file must be like."""

import numpy as np

from contactgraph.control.learned_cost import ROUNDING
from contactgraph.data import InvalidInputError
from contactgraph.data.json_fields import JsonFields


def semidefinite(fields: JsonFields, name: str, size: int) -> np.ndarray:
    """[size, size] symmetric, without eigenvalues below zero, but for rounding.

    Raises `InvalidInputError` where the field is not so.
    """
    matrix, eigenvalues = _symmetric(fields, name, fields.numbers(name, (size, size)))
    if eigenvalues[0] < -ROUNDING * max(eigenvalues[-1], 0.0):
        raise _indefinite(fields, name, "positive semi-definite", eigenvalues[0])
    return matrix


def definite(fields: JsonFields, name: str) -> np.ndarray:
    """[any, any] symmetric, with eigenvalues above zero.

    Raises `InvalidInputError` where the field is not so.
    """
    size = fields.rows(name)
    matrix, eigenvalues = _symmetric(fields, name, fields.numbers(name, (size, size)))
    if not eigenvalues[0] > 0.0:
        raise _indefinite(fields, name, "positive definite", eigenvalues[0])
    return matrix


def _symmetric(fields: JsonFields, name: str, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The matrix, exactly symmetric, and its eigenvalues, ascending."""
    apart = np.abs(matrix - matrix.T)
    if apart.max() > ROUNDING * np.abs(matrix).max():
        row, column = np.unravel_index(np.argmax(apart), apart.shape)
        raise InvalidInputError(
            f"{fields.where}: field {name!r} must be symmetric, found {matrix[row, column]:g} in "
            f"row {row}, column {column} and {matrix[column, row]:g} the other way round"
        )
    matrix = 0.5 * (matrix + matrix.T)
    return matrix, np.linalg.eigvalsh(matrix)


def _indefinite(fields: JsonFields, name: str, wanted: str, smallest: float) -> InvalidInputError:
    return InvalidInputError(
        f"{fields.where}: field {name!r} must be {wanted}, but its smallest eigenvalue is "
        f"{smallest:.3g}"
    )
