"""Natural modes of known numbers are solved for once, and are those of the traced ones."""

import jax
import numpy as np
from numpy.testing import assert_allclose

from jaxbeam.numerics import matrices as module


def matrices(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness and mass of five unknowns, positive definite."""
    rng = np.random.default_rng(seed)
    parts = rng.normal(size=(2, 5, 5))
    return tuple(part @ part.T + np.eye(5) for part in parts)  # type: ignore[return-value]


def test_known_numbers_are_solved_once(monkeypatch):
    solved, solution = [], module._solution

    def counted(*pair):
        solved.append(pair)
        return solution(*pair)

    monkeypatch.setattr(module, "_solution", counted)
    first, again, other = (module.eigen(*matrices(seed)) for seed in (1, 1, 2))
    assert len(solved) == 2
    assert first[0] is again[0]
    assert not np.allclose(first[0], other[0])


def test_known_and_traced_solutions_agree():
    pair = matrices(3)
    for known, traced in zip(module.eigen(*pair), jax.jit(module.eigen)(*pair), strict=True):
        assert_allclose(np.abs(known), np.abs(traced), atol=1e-12)
