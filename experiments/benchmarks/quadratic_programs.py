"""Quadratic programs of predictive control against OSQP: those of a crossing, to one accuracy.

    python -m experiments.benchmarks.quadratic_programs

The rig of `controller_steps` under predictive control of 4 to 8 variables with limits; the programs
are those of the sampling instants of its crossing, scaled so that the largest entry of H is one.
OSQP is set up once and updated by the vectors of each sample; it starts from the last solution,
keeps its factors, and polishes. The table has its own report of the times of updates and solutions,
and the time of a call from Python. jaxbeam starts anew each time: on one core, compiled, one after
the other in a loop and 256 at once. Without OSQP the benchmark ends with a message.
"""

from experiments.benchmarks import use_one_core

if __name__ == "__main__":
    use_one_core()  # before JAX starts its threads

import contextlib
import os
import sys
import time
import warnings
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse

import jaxbeam as jb
from experiments.benchmarks.common import import_optional, parser, print_row, print_table, time_call
from experiments.benchmarks.controller_steps import PREDICTIVE, patch_case
from jaxbeam.control.sampled_lqr import SamplingWarning
from jaxbeam.model.state_space import state_space
from jaxbeam.numerics.qp import solve_qp
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.simulate import ContactLossWarning

HORIZONS = {4: 6, 6: 8, 8: 10}  # variables, and horizon (periods)
BATCH_SIZE, ROUNDS = 256, 20
ACCURACY = 1e-7  # of OSQP's residuals, before polishing
SOLUTION_TOLERANCE = 1e-6  # difference of solutions over the largest move
MAX_ITERATIONS = 100_000  # of OSQP


def crossing_programs(variables: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Programs of a crossing: minimise x'Hx/2 + f'x subject to M x <= gamma, one each sample.

    Returns H (variable, variable), f (sample, variable), M (row, variable), gamma (sample, row).
    """
    case = patch_case(jb.MPC(horizon=HORIZONS[variables], moves=variables, **PREDICTIVE))
    with warnings.catch_warnings():
        for kind in (ContactLossWarning, SamplingWarning):
            warnings.simplefilter("ignore", kind)
        record = jb.simulate(case, tolerance=1e-4)
    law = case.controller.law(state_space(case)).law
    states = jnp.concatenate([record.coordinates, record.rates], axis=1)
    previous_commands = jnp.concatenate([jnp.zeros((1, 1)), record.command[:-1]])

    @compiled
    def program(law, state, previous_states, previous_commands):
        predicted_state = (
            law.sampled_plant.A @ previous_states + law.sampled_plant.B @ previous_commands
        )
        prediction_data = jnp.concatenate(
            [state, state - predicted_state, previous_commands, jnp.ones(1)]
        )
        return law.quadratic_program(law.prediction, prediction_data, previous_commands)

    previous_states = jnp.concatenate([jnp.zeros((1, states.shape[1])), states[:-1]])
    programs = [
        program(law, *each) for each in zip(states, previous_states, previous_commands, strict=True)
    ]
    H, f, M, gamma = (np.array(part) for part in zip(*programs, strict=True))
    return H[0], f, M[0], gamma


def solve_by_jaxbeam(H, f, M, gamma) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Solutions (sample, variable), whether constraints are active (sample,), and times (s).

    The times are those of a program in a loop, and in a batch. Raises RuntimeError if a program is
    not solved.
    """

    @compiled
    def in_turn(H, f, M, gamma):
        return jax.lax.map(lambda each: solve_qp(H, each[0], M, each[1]), (f, gamma))

    @compiled
    def at_once(H, f, M, gamma):
        return jax.vmap(lambda f, gamma: solve_qp(H, f, M, gamma))(f, gamma)

    solutions = in_turn(H, f, M, gamma)
    if not solutions.solved.all():
        raise RuntimeError(f"jaxbeam left {int((~solutions.solved).sum())} programs unsolved")
    batch_indices = np.resize(np.arange(len(f)), BATCH_SIZE)
    batch = (
        time_call(at_once, H, f[batch_indices], M, gamma[batch_indices], repeat=ROUNDS).run
        / BATCH_SIZE
    )
    single = time_call(in_turn, H, f, M, gamma, repeat=ROUNDS).run / len(f)
    return np.asarray(solutions.x), np.asarray(solutions.steps) > 0, single, batch


def solve_by_osqp(package: ModuleType, H, f, M, gamma) -> tuple[np.ndarray, float, float]:
    """Solutions (sample, variable), and times (s) of a program: OSQP's report, and of a call."""
    solver = package.OSQP()
    matrices = scipy.sparse.csc_matrix(np.triu(H)), scipy.sparse.csc_matrix(M)
    free = np.full(gamma.shape[1], -np.inf)
    settings = {"eps_abs": ACCURACY, "eps_rel": ACCURACY, "max_iter": MAX_ITERATIONS}
    settings |= {"polishing": True, "warm_starting": True, "verbose": False}
    solver.setup(matrices[0], f[0], matrices[1], free, gamma[0], **settings)
    times = []
    for _ in range(ROUNDS):
        x, reported_time, start = [], 0.0, time.perf_counter()
        with _suppress_output():
            for one, top in zip(f, gamma, strict=True):
                solver.update(q=one, u=top)
                solution = solver.solve(raise_error=True)
                x.append(solution.x)
                reported_time += (
                    solution.info.update_time + solution.info.solve_time + solution.info.polish_time
                )
        times.append((reported_time / len(f), (time.perf_counter() - start) / len(f)))
    return np.array(x), *np.median(times, axis=0)


@contextlib.contextmanager
def _suppress_output():
    """Discard printed output, of C code too: no setting of OSQP turns off reports of polishing."""
    sys.stdout.flush()
    stdout = os.dup(1)
    with open(os.devnull, "w") as null_device:
        os.dup2(null_device.fileno(), 1)
        try:
            yield
        finally:
            os.dup2(stdout, 1)
            os.close(stdout)


def main() -> None:
    """Print the table. Raises RuntimeError if the solutions differ."""
    parser(__doc__).parse_args()
    package = import_optional("osqp")
    if package is None:
        print("OSQP is not installed (uv sync --extra benchmarks): nothing to compare with")
        return
    jaxbeam_columns = "limits active", "jaxbeam, one by one", "256 at once"
    print_table(
        (
            "variables",
            *jaxbeam_columns,
            "OSQP, its report",
            "OSQP, from Python",
            "largest difference",
        ),
        right_from=0,
    )
    for variables in HORIZONS:
        H, f, M, gamma = crossing_programs(variables)
        H, f = H / np.max(np.abs(H)), f / np.max(np.abs(H))
        x, constrained, single, batch = solve_by_jaxbeam(H, f, M, gamma)
        by_osqp, reported, called = solve_by_osqp(package, H, f, M, gamma)
        difference = np.max(np.abs(by_osqp - x)) / np.max(np.abs(x))
        if difference > SOLUTION_TOLERANCE:
            raise RuntimeError(f"{variables} variables: solutions differ by {difference:.0e}")
        times = [f"{1e6 * t:.1f} us" for t in (single, batch, reported, called)]
        active = f"{np.mean(constrained):.0%} of {len(f)}"
        print_row((str(variables), active, *times, f"{difference:.0e}"))


if __name__ == "__main__":
    main()
