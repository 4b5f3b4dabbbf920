"""Quadratic programs in C: solutions and verdicts of random problems, as those of jaxbeam."""

import shutil
import subprocess

import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxbeam.c_code.source import array_text, helpers_of
from jaxbeam.numerics.qp import MAX_STEPS, MAX_SWEEPS, solve_qp

COMPILER = shutil.which("cc") or shutil.which("gcc")
ROWS, VARIABLES = 12, 4
MAIN = """
#include <math.h>
#include <stdio.h>
typedef double real;
{helpers}
static const real G[] = {{{G}}};
static const real h[] = {{{h}}};
static real z[{variables}], work[1000];
int main(void)
{{
    int k, i;
    for (k = 0; k < {problems}; k++) {{
        const real *matrix = G + k * {size}, *limits = h + k * {rows};
        printf("%d", {method}(z, matrix, limits, {rows}, {variables}, {steps}, work));
        for (i = 0; i < {variables}; i++) printf(" %.17g", z[i]);
        printf("\\n");
    }}
    return 0;
}}
"""


@pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")
@pytest.mark.parametrize(
    ("method", "steps", "problems"), [("interior", MAX_STEPS, 40), ("hildreth", MAX_SWEEPS, 12)]
)
def test_random_problems(method, steps, problems, tmp_path):
    """In the least-distance form; several limits are active, or no point obeys all of them."""
    random = np.random.default_rng(1)
    G = random.normal(size=(problems, ROWS, VARIABLES))
    G /= np.linalg.norm(G, axis=-1, keepdims=True)
    inside = 2 * random.normal(size=(problems, VARIABLES, 1))
    h = (G @ inside)[..., 0] + random.uniform(0, 1, (problems, ROWS))
    h[::4] -= 3.0  # some of these have no solution
    h /= np.max(-h, axis=1, keepdims=True)
    name = "hildreth" if method == "hildreth" else "interior_point"
    text = MAIN.format(
        helpers="\n".join(helpers_of(f"{name}(")),
        G=array_text(G.ravel()),
        h=array_text(h.ravel()),
        method=name,
        steps=steps,
        rows=ROWS,
        variables=VARIABLES,
        size=ROWS * VARIABLES,
        problems=problems,
    )
    (tmp_path / "qp.c").write_text(text)
    assert COMPILER is not None
    build = [COMPILER, "-std=c99", "-Wall", "-Wextra", "-Werror", "-O1", "-o", "qp", "qp.c", "-lm"]
    subprocess.run(build, cwd=tmp_path, check=True)
    run = subprocess.run([tmp_path / "qp"], capture_output=True, text=True, check=True)
    found = np.array([line.split() for line in run.stdout.splitlines()], float)
    H, f = np.eye(VARIABLES), np.zeros(VARIABLES)
    expected = [solve_qp(H, f, *limits, method) for limits in zip(G, h, strict=True)]
    solved = np.array([bool(solution.solved) for solution in expected])
    assert 0 < np.sum(~solved) < problems / 2
    assert (found[:, 0] == solved).all()
    x = np.array([solution.x for solution in expected])[solved]
    assert_allclose(found[solved, 1:], x, atol=1e-11)
