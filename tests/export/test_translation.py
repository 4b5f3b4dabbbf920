"""Functions of JAX as C99 for one run, under strict compilers: their numbers, and their cost."""

import re
import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from numpy.testing import assert_allclose

from jaxbeam.export.c_program import BY_PRECISION, array_text
from jaxbeam.export.c_steps import (
    ProgramWriter,
    functions_of,
    named_arrays,
    operations,
    sharing_memory,
    without_unused,
)
from jaxbeam.numerics.qp import solve_qp
from jaxbeam.runtime.c_writer import CArray, UntranslatedError
from tests.export.test_c_code import SANITIZED, STRICT
from tests.runtime import test_c_translation as functions

COMPILER = shutil.which("cc") or shutil.which("gcc")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")
MAIN = """
#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
typedef double real;
{precision}
{constants}
{functions}
static void program(const real *x, real *y)
{{
{body}
}}
int main(void)
{{
    static const double given[] = {{{given}}};
    static double found[{outputs}];
    int run, i;
    for (run = 0; run < {runs}; run++) {{
        program(given + run * {inputs}, found);
        for (i = 0; i < {outputs}; i++) printf("%.17g ", found[i]);
        printf("\\n");
    }}
    return 0;
}}
"""


def found_by_c(function, inputs: np.ndarray, folder) -> np.ndarray:
    """Results (run, entry) of a function of the rows of the inputs, as its C prints them."""
    closed = without_unused(jax.make_jaxpr(function)(inputs[0]))
    writer, place = ProgramWriter({}), 0
    for value in writer.run(closed, [CArray("d", inputs[0].shape, "x", False)]):
        found = writer.converted(value, "d")
        writer.copy(CArray("d", found.shape, f"(y + {place})", False), found)
        place += found.size
    body = "\n".join(writer.lines)
    constants = (
        f"static const {'real' if values.dtype.kind == 'f' else 'int'} {name}[] ="
        f" {{{array_text(values)}}};"
        for name, values in writer.constants.items()
    )
    text = MAIN.format(
        precision=BY_PRECISION,
        constants="\n".join(constants),
        functions="\n".join(functions_of(body)),
        body=body,
        given=array_text(inputs.ravel()),
        outputs=place,
        inputs=inputs.shape[1],
        runs=len(inputs),
    )
    (folder / "program.c").write_text(text)
    assert COMPILER is not None
    allowed = ["-Wno-unused-but-set-variable", "-Wno-unused-const-variable"]
    build = [COMPILER, *STRICT, *allowed, *SANITIZED, "-o", "program", "program.c", "-lm"]
    subprocess.run(build, cwd=folder, check=True)
    run = subprocess.run([folder / "program"], capture_output=True, text=True, check=True)
    return np.array([line.split() for line in run.stdout.splitlines()], float)


@needs_compiler
@pytest.mark.parametrize(
    "name",
    [
        *("elementary", "shapes", "reductions", "systems", "general_systems"),
        *("places", "branches", "loops", "searched"),
    ],
)
def test_functions_of_arrays(name, tmp_path):
    """All rules of the translation, by the numbers of JAX itself."""
    function = getattr(functions, name)
    found = found_by_c(lambda x: jax.tree.leaves(function(x)), functions.X, tmp_path)
    expected = [
        np.concatenate([np.ravel(part).astype(float) for part in jax.tree.leaves(function(x))])
        for x in map(jnp.asarray, functions.X)
    ]
    assert_allclose(found, expected, rtol=1e-12, atol=1e-12)


ROWS, VARIABLES = 12, 4


@needs_compiler
@pytest.mark.parametrize(("method", "problems"), [("interior", 40), ("hildreth", 12)])
def test_quadratic_programs(method, problems, tmp_path):
    """Several limits are active, or no point obeys all of them: solutions and verdicts."""
    random = np.random.default_rng(1)
    G = random.normal(size=(problems, ROWS, VARIABLES))
    inside = 2 * random.normal(size=(problems, VARIABLES, 1))
    h = (G @ inside)[..., 0] + random.uniform(0, 1, (problems, ROWS))
    h[::4] -= 3.0  # some of these have no solution
    H, f = np.eye(VARIABLES), np.zeros(VARIABLES)

    def solved(x):
        M, gamma = x[: ROWS * VARIABLES].reshape(ROWS, VARIABLES), x[ROWS * VARIABLES :]
        solution = solve_qp(H, f, M, gamma, method)
        return solution.status, solution.x

    inputs = np.concatenate([G.reshape(problems, -1), h], axis=1)
    found = found_by_c(solved, inputs, tmp_path)
    known = [solve_qp(H, f, *limits, method) for limits in zip(G, h, strict=True)]
    status = np.array([int(solution.status) for solution in known])
    assert 0 < np.sum(status > 0) < problems / 2
    assert (found[:, 0] == status).all()
    x = np.array([solution.x for solution in known])
    assert_allclose(found[status == 0, 1:], x[status == 0], atol=1e-11)


@pytest.mark.parametrize("word", ["factor", "const", "gamma", "x", "v12", "commands"])
def test_names_are_none_of_c(word):
    """Neither its words nor those of the program; several of one name get numbers."""
    leaves = [((jax.tree_util.GetAttrKey(word),), np.arange(3.0) + i) for i in range(2)]
    assert list(named_arrays(leaves).values()) == [f"{word}_", f"{word}__2"]


def test_cost_at_worst():
    """By hand: products and sums of a matrix, branches by the dearer one, loops by their bound."""

    def function(x):
        y = jnp.ones((3, 4)) @ x  # 24
        y = lax.cond(y[0] > 0, lambda y: 2 * y, lambda y: y + y * y, y)  # 1, then 6
        return lax.fori_loop(0, 5, lambda _, y: y - 1.0, y)  # 15

    assert operations(without_unused(jax.make_jaxpr(function)(np.ones(4))).jaxpr) == 46


def test_a_loop_needs_a_largest_number_of_turns():
    def halved(x):
        return lax.while_loop(lambda y: y[0] > 1e-9, lambda y: y / 2, x)

    with pytest.raises(UntranslatedError, match="a loop without a largest number of turns"):
        operations(jax.make_jaxpr(halved)(np.ones(4)).jaxpr)


def test_arrays_share_memory_where_no_two_are_used_at_a_time():
    """The first is free after its last line; the third lives until the loop that reads it ends."""
    text = """
    real v1[100];
    fill(v1);
    real v2[50];
    copy(v2, v1);
    real v3[80];
    copy(v3, v2);
    real v4[4];
    for (int i = 0; i < 9; i++) {
        real v5[60];
        copy(v5, v3);
        real v6[70];
        copy(v6, v5);
    }
    int v7[200];
    real v8[90];
    copy(v8, v4);
    """
    lines, size = sharing_memory(text.strip("\n").split("\n"))
    places = {}
    for line in lines:
        if "_memory +" in line:
            kind, name, first = re.fullmatch(
                r" *(\w+) \*const (v\d) = \w+ \+ (\d+);", line
            ).groups()
            places[name] = kind, int(first)
    assert places == {
        "v1": ("real", 0),
        "v2": ("real", 100),
        "v3": ("real", 0),
        "v5": ("real", 80),
        "v6": ("real", 140),
        "v7": ("int", 0),
        "v8": ("real", 0),
    }
    assert lines[:2] == ["    real real_memory[210];", "    int int_memory[200];"]
    assert "    real v4[4];" in lines and size == 8 * (210 + 4) + 4 * 200
