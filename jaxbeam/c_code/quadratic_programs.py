"""C code of the solution of a quadratic program in its least-distance form."""

from jaxbeam.c_code.source import CSource
from jaxbeam.numerics.optimisation.qp import MAX_STEPS, MAX_SWEEPS


def write_solution(
    code: CSource,
    solver: str,
    h: str,
    G: str,
    minimiser: str,
    limits: int,
    variables: int,
    counter: tuple[str, str],
) -> None:
    """Write the point within G z <= h that is nearest to a `minimiser`, which it replaces.

    The rows of G have length one; `h` is work space, of which nothing is left. The C variable
    `solved` is whether there is such a point. A `counter`, its name and its meaning, counts the
    samples where there is none.
    """
    declared = "real scale", "int solved"
    code.variables += [each for each in declared if each not in code.variables]
    z = code.work("solution", variables, "solution of the least-distance form")
    if solver == "hildreth":
        work = code.work("qp_work", 2 * limits + variables)
        operations = MAX_SWEEPS * _sweep_operations(limits, variables)
        code.notes.append(f"Hildreth's procedure ends after {MAX_SWEEPS} sweeps at the latest.")
        steps = MAX_SWEEPS
    else:
        work = code.work("qp_work", variables * variables + 4 * variables + 10 * limits)
        operations = MAX_STEPS * _interior_operations(limits, variables)
        code.notes.append(f"The interior-point method ends after {MAX_STEPS} steps at the latest.")
        steps = MAX_STEPS
    failures = code.counter(*counter)
    method = "hildreth" if solver == "hildreth" else "interior_point"
    code.add(
        f"""
scale = least_distance({h}, {G}, {minimiser}, {limits}, {variables});
solved = scale <= 0 || {method}({z}, {G}, {h}, {limits}, {variables}, {steps}, {work});
if (!solved) {failures}++;
if (scale > 0)
    for (i = 0; i < {variables}; i++) {minimiser}[i] += scale * {z}[i];""",
        operations + limits * (2 * variables + 6) + 4 * variables + 4,
    )


def _interior_operations(R: int, V: int) -> int:
    """Operations of a step of the interior-point method for R limits and V variables, at most."""
    newton = 4 * R * V + 3 * V * V + 16 * R + 6 * V
    factor = (3 * R + 2) * V * (V + 1) // 2 + V * V * V + 3 * V * V + 4 * R
    return factor + 2 * newton + 10 * R * V + 58 * R + 12 * V + 32


def _sweep_operations(R: int, V: int) -> int:
    """Operations of a sweep of Hildreth's procedure, at most."""
    return 10 * R * V + 14 * R + 8 * V + 12
