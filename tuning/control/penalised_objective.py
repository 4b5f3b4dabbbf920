"""Objective with penalties, and limits of stability."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbeam.analysis.linearised_loop import linearise, loop_dynamics, loop_timing
from jaxbeam.case.arguments import check_call
from jaxbeam.case.case import Case, concrete_case, crossing_times, replace, stack_cases, value_at
from jaxbeam.model.modes import mesh_layout
from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.compiling import compiled
from tuning.control.objective import Objective, WeightsAndLimits, with_fixed_design
from tuning.control.run_set import AddressValues, RunSet, run_cases
from tuning.parameters import FreeParameter

STABILITY_PENALTY_SLOPE = 1.0  # added to the objective for each 1/s of violation


@dataclasses.dataclass(frozen=True)
class StabilityConstraint:
    """Constraint on the frozen poles of all training runs: real parts up to `max_real_part` (1/s).

    Poles are computed without loads and at a number of `instants` along the crossing of the first
    load of each run; also with each parameter in `parameter_tolerance` (address: fraction) changed
    by its fraction up and down and, for a sampled controller, with an `extra_delay` (s). As poles
    cost more than runs, `crossings` (values by address, like load cases) may replace the training
    runs.

    Raises ValueError for a negative delay, less than one instant and fractions outside 0 to 1, and
    TypeError for fields of other classes.

    >>> import tuning
    >>> stable = tuning.StabilityConstraint(max_real_part=-1.0, extra_delay=0.001)
    >>> print(f"{stable.max_real_part:g} 1/s at {stable.instants} instants")
    -1 1/s at 7 instants
    """

    max_real_part: float = 0.0
    extra_delay: float = 0.0
    parameter_tolerance: dict[str, float] = dataclasses.field(default_factory=dict)
    instants: int = 7
    crossings: tuple[AddressValues, ...] = ()

    def __post_init__(self):
        check_call(type(self), (), vars(self))
        if self.extra_delay < 0 or self.instants < 1:
            raise ValueError("stable needs a delay that is not negative, and at least one instant")
        if any(not 0 < fraction < 1 for fraction in self.parameter_tolerance.values()):
            raise ValueError("parameter tolerances are fractions between 0 and 1")

    def violation_of_runs(self, case: Case, run_set: RunSet):
        """`violation_function` for a case, along the crossings or all runs of its run set."""
        if self.crossings:
            return self.violation_function(run_cases(case, self.crossings))
        return self.violation_function(run_set.cases, run_set.nominal)

    def violation_function(self, cases: list[Case], nominal: Mapping[str, Any] | None = None):
        """Function from values by address to the violation (1/s) of the constraint; 0 if it is met.

        Controllers are designed for the cases without the parameter tolerance, and for the
        `nominal` parameters, by address, where the cases differ from these. Raises ValueError as
        `linearised_loop` does, and for an extra delay without a sampling period.
        """
        timing = loop_timing(cases[0])
        if timing is None and self.extra_delay:
            raise ValueError(
                "stable.extra_delay needs a sampled controller: give the controller a period"
            )
        timings = [timing]
        if self.extra_delay:
            timings.append(timing._replace(delay=timing.delay + self.extra_delay))
        layout = mesh_layout(concrete_case(cases[0]))
        stacked = jax.tree.map(jnp.asarray, stack_cases(cases))
        instants = jnp.asarray(np.array([self._evaluation_times(case) for case in cases]))
        # One row with the nominal values, and two for each parameter with a tolerance.
        changes = np.diag(list(self.parameter_tolerance.values()))
        factors = 1 + np.concatenate([np.zeros((1, len(changes))), changes, -changes])

        def growth_rates(values, case, factor, times):
            """Growth rates (1/s) by loop timing and time, with parameters multiplied by factors."""
            case = replace(case, values)
            design_values = {a: value_at(case, a) for a in self.parameter_tolerance} | dict(
                nominal or {}
            )
            pairs = zip(self.parameter_tolerance, factor, strict=True)
            changed = replace(case, {a: f * value_at(case, a) for a, f in pairs})
            loop = loop_dynamics(with_fixed_design(changed, design_values, layout), layout)

            def at(own):
                return jax.vmap(lambda t: linearise(loop, own, t).growth_rate())(times)

            return jnp.stack([at(own) for own in timings])

        def violation(values: Mapping[str, Any]) -> Float[Array, ""]:
            # Derivatives of poles cost more than poles, and only the worst pole needs them.
            fixed = jax.lax.stop_gradient(dict(values))
            rows = jnp.asarray(factors)
            found = jax.lax.map(
                lambda run: jax.lax.map(
                    lambda factor: growth_rates(fixed, run[0], factor, run[1]), rows
                ),
                (stacked, instants),
            )
            run, row, own, instant = jnp.unravel_index(jnp.argmax(found), found.shape)
            case = jax.tree.map(lambda leaf: leaf[run], stacked)
            worst = growth_rates(values, case, rows[row], instants[run, instant][None])[own, 0]
            return jnp.maximum(worst - self.max_real_part, 0.0)

        return violation

    def _evaluation_times(self, case: Case) -> Float[np.ndarray, " time"]:
        """A time (s) before the first load, and others evenly along its crossing."""
        entry, leave = crossing_times(case)[0]
        leave = min(leave, float(case.run.duration))
        fractions = (np.arange(self.instants) + 0.5) / self.instants
        return np.append(entry - 1.0, entry + (leave - entry) * fractions)


# Up to so many parameters gradients are computed forward, which takes less time to compile.
MAX_FORWARD_PARAMETERS = 4


@dataclasses.dataclass(frozen=True)
class PenalisedObjective:
    """Objective of a run set, with a penalty, as a function of the search variables.

    It is static data of compiled programs: its fields are compiled into them.
    """

    parameters: tuple[FreeParameter, ...]
    aggregation: str
    tail_share: float
    penalty: Callable | None

    def evaluate(self, point, run_set: RunSet, target: WeightsAndLimits, *sharpnesses):
        """Values at a point, one for each sharpness of smooth maxima (None for true ones)."""
        pairs = zip(self.parameters, point, strict=True)
        values = {parameter.address: parameter.from_unbounded(y) for parameter, y in pairs}
        found = run_set.histories(values)
        penalty = 0.0 if self.penalty is None else self.penalty(values)
        own = Objective(aggregation=self.aggregation, tail_share=self.tail_share)
        return tuple(
            own.penalised(run_set.metrics_of(found, sharpness), target, sharpness) + penalty
            for sharpness in sharpnesses
        )


@compiled
def values_and_gradients(
    objective: PenalisedObjective,
    in_batches: bool,
    run_set: RunSet,
    points,
    sharpness,
    run_indices,
    target: WeightsAndLimits,
):
    """Smooth and true values at points (start, parameter), and gradients of the smooth ones.

    `in_batches` says whether only the runs of `run_indices` are simulated.
    """
    run_set = run_set.subset(run_indices) if in_batches else run_set

    def evaluate(point):
        return objective.evaluate(point, run_set, target, sharpness, None)

    def forward(point):
        def along(direction):
            return jax.jvp(evaluate, (point,), (direction,), has_aux=True)

        value, gradient, true = jax.vmap(along, out_axes=(None, 0, None))(jnp.eye(point.size))
        return (value, true), gradient

    few = points.shape[1] <= MAX_FORWARD_PARAMETERS
    function = forward if few else jax.value_and_grad(evaluate, has_aux=True)
    if points.shape[0] == 1:  # takes a third less to trace than a batch of one
        return jax.tree.map(lambda part: part[None], function(points[0]))
    return jax.vmap(function)(points)


@compiled
def true_values(
    objective: PenalisedObjective, run_set: RunSet, points, target: WeightsAndLimits
) -> Float[Array, " start"]:
    """True values of all runs at points (start, parameter)."""
    return jax.vmap(lambda point: objective.evaluate(point, run_set, target, None)[0])(points)
