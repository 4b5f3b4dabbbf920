"""Penalised objective of a run set as a function of search variables, with its gradient."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.compiling import compiled
from tuning.control.objective import Objective, WeightsAndLimits
from tuning.control.run_set import RunSet
from tuning.parameters.free import FreeParameter

# Up to so many parameters gradients are computed forward, which takes less time to compile.
MAX_FORWARD_PARAMETERS = 4


@dataclasses.dataclass(frozen=True)
class PenalisedObjective:
    """Objective of a run set, with a penalty, as a function of the search variables.

    It is static data of compiled programs: what it holds is compiled into them.
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
