"""Steps per second of the environments of `jaxbeam.benchmark`, beside a plain one in NumPy.

    python -m experiments.benchmarks.environments [--problem NAME] [--batch COUNT ...]

The environment in NumPy is what one would write for this problem alone: the same maps of each
period, prepared before, a product a step, the limits of the command, the running peak; no noise,
filters, delays or rounding. Runs are those of one load from beginning to end, with random actions.
"""

import jax
import jax.numpy as jnp
import numpy as np

import jaxbeam as jb
from experiments.benchmarks.common import parser, print_row, print_table, time_call
from jaxbeam.benchmark.environment import EnvironmentState

PROBLEM, BATCHES = "patch", (1, 64, 1024)
SEED = 1


class PlainEnvironment:
    """Environment in NumPy of one actuator and one interval a period."""

    def __init__(self, environment: jb.benchmark.Environment, state: EnvironmentState):
        maps = jax.tree.map(np.asarray, state.maps)
        if maps.states.linear.shape[1] != 1:
            raise ValueError(f"{environment.problem.name} has events within its periods")
        self.transitions, self.offsets = maps.states.linear[:, 0], maps.states.offset[:, 0]
        self.rows, self.row_offsets = maps.deflections.linear[:, 0], maps.deflections.offset[:, 0]
        (self.limits,) = [one.command_limits() for one in environment.problem.case.driven]
        self.sensors = np.asarray(environment.prepared.loop.output_rows)
        self.start, self.uncontrolled = np.asarray(state.plant), float(state.uncontrolled)

    def reset(self):
        """Readings at the start of a run."""
        self.state, self.peak, self.k = self.start, 0.0, 0
        return self.sensors @ self.state[: self.sensors.shape[1]]

    def step(self, action):
        """Readings, reward, and whether the run has ended."""
        column = np.append(self.state, min(max(action[0], self.limits[0]), self.limits[1]))
        deflections = self.rows[self.k] @ column + self.row_offsets[self.k]
        self.state = self.transitions[self.k] @ column + self.offsets[self.k]
        peak = max(self.peak, np.abs(deflections).max())
        reward, self.peak = (self.peak - peak) / self.uncontrolled, peak
        self.k += 1
        readings = self.sensors @ self.state[: self.sensors.shape[1]]
        return readings, reward, self.k == len(self.offsets)


def main() -> None:
    """Print the table."""
    options = parser(__doc__)
    options.add_argument("--problem", default=PROBLEM, help="name of a problem")
    options.add_argument("--batch", type=int, nargs="+", default=list(BATCHES), help="runs at once")
    arguments = options.parse_args()
    environment = jb.benchmark.Environment(jb.benchmark.load(arguments.problem))
    state, _ = jax.jit(environment.reset)(SEED)
    plain, steps = PlainEnvironment(environment, state), environment.steps
    actions = np.random.default_rng(0).uniform(-1.0, 5.0, (steps, 1))

    def run_plain():
        plain.reset()
        return sum(plain.step(action)[1] for action in actions)

    def run_one(actions):
        def period(state, action):
            state, _, reward, _ = environment.step(state, action)
            return state, reward

        return jax.lax.scan(period, state, actions)[1].sum()

    step = jax.jit(environment.step)

    def step_by_step():
        now = state
        for action in actions:
            now, _, reward, _ = step(now, action)
        return reward

    print_table(("environment", "runs at once", "steps per second"))

    def row(name: str, count: int, timing):
        print_row((name, str(count), f"{count * steps / timing.run:,.0f}"))

    row("plain NumPy", 1, time_call(run_plain))
    row("jitted, step by step", 1, time_call(step_by_step, repeat=3))
    for count in arguments.batch:
        batch = jnp.asarray(np.broadcast_to(actions, (count, *actions.shape)))
        row("jitted, vmap and scan", count, time_call(jax.jit(jax.vmap(run_one)), batch, repeat=3))
    difference = abs(float(run_plain()) - float(run_one(jnp.asarray(actions))))
    print(f"\nreturns of the two differ by {difference:.1e} (rounding of the command included)")


if __name__ == "__main__":
    main()
