"""Least squares over states along a chain, where each term touches one knot or two neighbours.

The normal equations are block tridiagonal, so a banded Cholesky factorisation solves them in time
linear in the number of knots. The result is that of a Rauch-Tung-Striebel smoother (both maximise the
same posterior), but the terms can be written down one by one.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float64, Int
from numpy.typing import ArrayLike
from scipy.linalg import cho_solve_banded, cholesky_banded

Jacobian = Mapping[int, ArrayLike]
"""State -> the derivative of the residuals by it, one number or one for each residual."""


class ChainLeastSquares:
    """Sums linearised terms `(residual / sigma)^2` and solves for the step that minimises them.

    Args:
        knots: number of knots.
        states: number of states of each knot.
    """

    def __init__(self, knots: int, states: int) -> None:
        self._own = np.zeros((knots, states, states))
        self._next = np.zeros((knots - 1, states, states))
        self._gradient = np.zeros((knots, states))
        self._factor: np.ndarray | None = None

    def at(self, knots: int | slice | np.ndarray, jacobian: Jacobian, residual: ArrayLike, sigma: ArrayLike) -> None:
        """Adds one residual at each of the given knots (an index, or an array of indices without repeats)."""
        weight = 1.0 / np.square(sigma)
        for row, row_slope in jacobian.items():
            self._gradient[knots, row] += weight * np.multiply(row_slope, residual)
            for column, slope in jacobian.items():
                self._own[knots, row, column] += weight * np.multiply(row_slope, slope)

    def between(self, before: Jacobian, after: Jacobian, residual: ArrayLike, sigma: ArrayLike) -> None:
        """Adds one residual between each knot and the next; an infinite `sigma` leaves it out."""
        weight = 1.0 / np.square(sigma)
        for knots, jacobian in ((slice(None, -1), before), (slice(1, None), after)):
            for row, row_slope in jacobian.items():
                self._gradient[knots, row] += weight * np.multiply(row_slope, residual)
                for column, slope in jacobian.items():
                    self._own[knots, row, column] += weight * np.multiply(row_slope, slope)
        for row, row_slope in after.items():
            for column, slope in before.items():
                self._next[:, row, column] += weight * np.multiply(row_slope, slope)

    def step(self) -> Float64[np.ndarray, "K n"]:
        """The Gauss-Newton step from the point of linearisation.

        Raises:
            numpy.linalg.LinAlgError: the terms leave some state undetermined.
        """
        return -self._solve(self._gradient.reshape(-1, 1)).reshape(self._gradient.shape)

    def sigma(self, knots: Int[np.ndarray, "M"], state: int) -> Float64[np.ndarray, "M"]:
        """Standard deviation of one state at some knots, from the inverse of the normal matrix.

        Raises:
            numpy.linalg.LinAlgError: the terms leave some state undetermined.
        """
        rows = knots * self._gradient.shape[1] + state
        columns = np.zeros((self._gradient.size, len(rows)))
        columns[rows, np.arange(len(rows))] = 1
        return np.sqrt(self._solve(columns)[rows, np.arange(len(rows))])

    def _solve(self, columns: np.ndarray) -> np.ndarray:
        if self._factor is None:
            knots, states = self._gradient.shape
            # LAPACK's form of the lower half: row d, column j holds element (j + d, j).
            banded = np.zeros((2 * states, knots, states))
            for row in range(states):
                for column in range(states):
                    if row >= column:
                        banded[row - column, :, column] = self._own[:, row, column]
                    banded[states + row - column, :-1, column] = self._next[:, row, column]
            self._factor = cholesky_banded(banded.reshape(2 * states, -1), lower=True)
        return cho_solve_banded((self._factor, True), columns)
