"""Compiled functions, alone and within others; options that XLA does not know."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxbeam.runtime import compiling
from jaxbeam.runtime.arrays import fori_loop, xp
from jaxbeam.runtime.compiling import compiled, compiled_if_traced

POINTS = np.array([0.1, 0.7, 2.0])


@compiled
def wave(x, power: int = 1):
    return jnp.sin(x) ** power


@pytest.mark.parametrize(
    ("transformed", "expected"),
    [
        (lambda x: wave(x, 3), lambda x: np.sin(x) ** 3),
        (jax.vmap(wave), np.sin),
        (jax.vmap(jax.grad(wave)), np.cos),
        (jax.jacfwd(wave), lambda x: np.diag(np.cos(x))),
        (jax.jit(lambda x: wave(x) + wave(0.5)), lambda x: np.sin(x) + np.sin(0.5)),
        (jax.jit(lambda x: x * jax.grad(wave)(0.5)), lambda x: x * np.cos(0.5)),
    ],
)
def test_compiled_functions_can_be_transformed(transformed, expected):
    """JAX refuses compiler options within another function: there they are left out."""
    assert_allclose(transformed(POINTS), expected(POINTS), rtol=1e-14)


@compiled
def halves(x, words: str):
    return {"half": x[: x.shape[0] // 2], "words": words, "count": x.shape[0], "none": None}


def test_template_has_the_structure_and_shapes_of_the_result():
    expected, result = halves.template(POINTS[:2], "as given"), halves(POINTS[:2], "as given")
    assert jax.tree.structure(expected) == jax.tree.structure(result)
    assert_allclose(result["half"], POINTS[:1])
    assert (
        (expected["words"], expected["count"])
        == (result["words"], result["count"])
        == ("as given", 2)
    )
    assert expected["half"].shape == (1,) and expected["half"].dtype == result["half"].dtype


def test_precompiled_functions_are_not_traced_again():
    traced = []

    @compiled
    def counted(x):
        traced.append(x.shape)
        return 2 * x

    for _ in range(3):
        counted.precompile(POINTS)()
        assert_allclose(counted(POINTS), 2 * POINTS)
    counted.precompile(POINTS[:2])()
    assert traced == [(3,), (2,)]
    compiling.clear_caches()
    counted.precompile(POINTS)()
    assert traced == [(3,), (2,), (3,)]


def test_unknown_options_are_left_out(monkeypatch):
    known = {"xla_backend_optimization_level": 1}
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(compiling, "XLA_OPTIONS", {"xla_no_such_setting": True, **known})
    compiling._supported_options.cache_clear()
    try:
        assert compiling.xla_options() == known
        assert_allclose(compiled(jnp.cos)(0.5), np.cos(0.5), rtol=1e-14)
    finally:
        compiling._supported_options.cache_clear()


@compiled_if_traced
def decay(x):
    return fori_loop(0, 20, lambda _, y: y * xp.cos(x), xp.ones(()))


def test_derivatives_are_computed_in_numpy_until_that_has_cost_a_compilation(monkeypatch):
    programs, program_of = [], compiling._program_of

    def noted(*args):
        programs.append(program_of(*args))
        return programs[-1]

    monkeypatch.setattr(compiling, "_program_of", noted)
    expected = -20 * np.cos(0.4) ** 19 * np.sin(0.4)
    assert_allclose(jax.grad(decay)(0.4), expected, rtol=1e-12)
    program = programs[-1]
    assert program.jitted._cache_size() == 0
    for _ in range(int(program.price / program.cost)):
        assert_allclose(jax.grad(decay)(0.4), expected, rtol=1e-12)
    assert programs[-1] is program
    assert program.jitted._cache_size() == 1


@pytest.mark.parametrize(
    ("transformed", "x"),
    [
        (jax.grad(jax.grad(decay)), 0.4),
        (jax.vmap(decay), np.array([0.4, 0.7])),
        (jax.vmap(jax.grad(decay)), np.array([0.4, 0.7])),
        (jax.hessian(lambda x: decay(x[0]) * decay(x[1])), np.array([0.4, 0.7])),
    ],
)
def test_transformations_in_numpy_are_those_of_xla(transformed, x):
    assert_allclose(transformed(x), jax.jit(transformed)(x), rtol=1e-12)
