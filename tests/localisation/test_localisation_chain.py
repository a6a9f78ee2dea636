"""Least squares along a chain against the same problem written out as one dense matrix."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxmap.localisation.chain import ChainLeastSquares


def random_problem(seed: int, knots: int, states: int):
    """A chain of random terms, and the rows of the dense problem that it stands for."""
    rng = np.random.default_rng(seed)
    chain = ChainLeastSquares(knots, states)
    rows, residuals = [], []

    def dense(entries: dict[int, float], residual: float, sigma: float) -> None:
        row = np.zeros(knots * states)
        for index, slope in entries.items():
            row[index] = slope / sigma
        rows.append(row)
        residuals.append(residual / sigma)

    for state in range(states):
        slopes, residual, sigma = rng.normal(size=knots), rng.normal(size=knots), rng.uniform(0.5, 2, knots)
        chain.at(slice(None), {state: slopes, (state + 1) % states: 0.3}, residual, sigma)
        for k in range(knots):
            dense({k * states + state: slopes[k], k * states + (state + 1) % states: 0.3}, residual[k], sigma[k])
        before, after = rng.normal(size=(2, knots - 1))
        residual = rng.normal(size=knots - 1)
        chain.between({state: before}, {state: after, 0: 0.5}, residual, 0.7)
        for k in range(knots - 1):
            entries = {k * states + state: before[k], (k + 1) * states + state: after[k]}
            entries[(k + 1) * states] = 0.5
            dense(entries, residual[k], 0.7)
    some = np.array([0, knots - 1])
    chain.at(some, {0: 1.0}, np.array([1.0, -2.0]), 0.1)
    for k, residual in ((0, 1.0), (knots - 1, -2.0)):
        dense({k * states: 1.0}, residual, 0.1)
    return chain, np.array(rows), np.array(residuals)


@given(seed=st.integers(0, 10_000), knots=st.integers(2, 7), states=st.integers(2, 4))
def test_the_step_and_its_sigma_are_those_of_the_dense_problem(seed, knots, states):
    chain, rows, residuals = random_problem(seed, knots, states)
    normal = rows.T @ rows
    if np.linalg.cond(normal) > 1e8:
        return
    np.testing.assert_allclose(chain.step().ravel(), -np.linalg.solve(normal, rows.T @ residuals), rtol=1e-5, atol=1e-7)
    sigma = np.sqrt(np.diag(np.linalg.inv(normal)).reshape(knots, states))
    everywhere = np.arange(knots)
    for state in range(states):
        np.testing.assert_allclose(chain.sigma(everywhere, state), sigma[:, state], rtol=1e-5)


def test_an_infinite_sigma_leaves_a_term_out():
    chain = ChainLeastSquares(3, 1)
    chain.at(slice(None), {0: 1.0}, np.array([1.0, 2.0, 3.0]), 1.0)
    chain.between({0: -1.0}, {0: 1.0}, np.array([5.0, 7.0]), np.array([np.inf, np.inf]))
    np.testing.assert_allclose(chain.step().ravel(), [-1, -2, -3])


def test_what_no_term_holds_is_refused():
    chain = ChainLeastSquares(2, 2)
    chain.at(slice(None), {0: 1.0}, np.zeros(2), 1.0)
    with pytest.raises(np.linalg.LinAlgError):
        chain.step()
