"""Optimisers: Adam, L-BFGS, BFGS, each with one evaluation of value and gradient per step.

All share the one program that simulates, and their evaluations are counted alike.
"""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
import optimistix
from jaxtyping import Bool, Float

from jaxbeam.runtime.arrays import Array

METHODS = ("adam", "lbfgs", "bfgs")
ADAM_STEP = 0.1  # first step of Adam, in search variables, which are of order one
MAX_FIRST_STEP = 0.5  # longest first step of a line search, root mean square of the variables
BACKTRACKING_FACTOR = 0.5  # on a step that led to an unstable loop or decreased too little
SUFFICIENT_DECREASE = 1e-4  # share of the decrease predicted by the slope (Armijo condition)
SHARPNESS_STAGES = 5  # stages of sharper maxima, for methods whose curvatures jump with sharpness

Point = Float[Array, " parameter"]
Value = Float[Array, ""]
Flag = Bool[Array, ""]


class AbstractOptimiser(eqx.Module):
    """Interface: initial state and one step of a search from a single start."""

    @property
    @abc.abstractmethod
    def sharpness_stages(self) -> int | None:
        """Number of stages in which maxima get sharper; None if they do at every step."""

    @abc.abstractmethod
    def init(self, point: Point) -> Any:
        """State before the first step."""

    @abc.abstractmethod
    def step(
        self, previous, point: Point, value: Value, gradient: Point, objective_changed: Flag
    ) -> tuple[Point, Any]:
        """The next point to evaluate, and the state after the step.

        `value` is infinite, and the gradient zero, where the loop diverges. `objective_changed` is
        true if the objective has become sharper, so that earlier values do not compare.
        """


class AdamState(NamedTuple):
    """State of `Adam`: its moments, the last point with a finite value, and the scale of steps."""

    moments: Any
    last_finite: Point
    step_scale: Value


class Adam(AbstractOptimiser):
    """Adam (Kingma and Ba, 2015; optax) with steps that get shorter along a cosine.

    A step to a point where the loop diverges is taken back, and later ones are shorter.
    """

    steps: int

    @property
    def sharpness_stages(self):
        return None

    @property
    def transformation(self) -> optax.GradientTransformation:
        """The update rule of optax."""
        return optax.adam(optax.cosine_decay_schedule(ADAM_STEP, self.steps, alpha=0.05))

    def init(self, point):
        return AdamState(self.transformation.init(point), point, jnp.ones(()))

    def step(self, previous, point, value, gradient, objective_changed):
        finite = jnp.isfinite(value)
        scale = jnp.where(finite, previous.step_scale, BACKTRACKING_FACTOR * previous.step_scale)
        base = jnp.where(finite, point, previous.last_finite)
        change, moments = self.transformation.update(gradient, previous.moments)
        next_point = base + jnp.where(finite, scale, 0.0) * change
        return next_point, AdamState(moments, base, scale)


class LineSearchState(NamedTuple):
    """State of `LBFGS`: curvature pairs, and the line of the current line search."""

    curvature: Any
    origin: Point
    value: Value
    direction: Point
    directional_slope: Value
    step_length: Value


class LBFGS(AbstractOptimiser):
    """L-BFGS (Nocedal, 1980; optax) with a backtracking line search.

    Curvature pairs are dropped where the curvature is negative or the objective has changed.
    """

    transformation = optax.scale_by_lbfgs(memory_size=10)

    @property
    def sharpness_stages(self):
        return SHARPNESS_STAGES

    def init(self, point):
        zero = jnp.zeros(())
        return LineSearchState(
            self.transformation.init(point), point, zero + jnp.inf, 0 * point, zero, zero + 1.0
        )

    def step(self, previous, point, value, gradient, objective_changed):
        goal = (
            previous.value + SUFFICIENT_DECREASE * previous.step_length * previous.directional_slope
        )
        accepted = jnp.isfinite(value) & (objective_changed | (value <= goal))
        last = previous.curvature
        negative_curvature = jnp.vdot(point - last.params, gradient - last.updates) <= 0
        empty = self.transformation.init(point)
        usable = jax.tree.map(
            lambda new, old: jnp.where(objective_changed | negative_curvature, new, old),
            empty,
            last,
        )
        uphill, learnt = self.transformation.update(gradient, usable, point)
        size = jnp.linalg.norm(uphill) / (MAX_FIRST_STEP * jnp.sqrt(point.size))
        direction = -uphill / jnp.maximum(size, 1.0)
        next_line = LineSearchState(
            learnt, point, value, direction, jnp.vdot(direction, gradient), jnp.ones(())
        )
        halved = previous._replace(step_length=BACKTRACKING_FACTOR * previous.step_length)
        found = jax.tree.map(lambda a, b: jnp.where(accepted, a, b), next_line, halved)
        return found.origin + found.step_length * found.direction, found


class OptimistixState(NamedTuple):
    """State of `Optimistix`: the point of its solver, and the arrays of the solver's state."""

    point: Point
    state: Any


class Optimistix(AbstractOptimiser):
    """A minimiser of optimistix that evaluates one point per step, such as BFGS.

    It is given the tangent plane at that point in place of the objective.
    """

    solver: optimistix.AbstractMinimiser

    @property
    def sharpness_stages(self):
        return SHARPNESS_STAGES

    def init(self, point):
        value = jax.ShapeDtypeStruct((), point.dtype)
        state = self.solver.init(_zero_function, point, None, {}, value, None, frozenset())
        return OptimistixState(point, eqx.filter(state, eqx.is_array))

    def step(self, previous, point, value, gradient, objective_changed):
        finite = jnp.isfinite(value)
        empty = self.init(point)
        restarts = objective_changed & finite
        previous = jax.tree.map(lambda new, old: jnp.where(restarts, new, old), empty, previous)
        value = jnp.where(finite, value, jnp.finfo(point.dtype).max / 4)

        def plane(asked, _):
            return value + jnp.vdot(gradient, asked - jax.lax.stop_gradient(asked)), None

        template = self.solver.init(_zero_function, point, None, {}, value, None, frozenset())
        state = eqx.combine(previous.state, eqx.filter(template, eqx.is_array, inverse=True))
        next_point, state, _ = self.solver.step(plane, previous.point, None, {}, state, frozenset())
        return state.y_eval, OptimistixState(next_point, eqx.filter(state, eqx.is_array))


def _zero_function(point, _):
    return jnp.zeros(()), None


def optimiser(name: str, steps: int) -> AbstractOptimiser:
    """Optimiser by name, for a number of steps. Raises ValueError for an unknown name."""
    if name not in METHODS:
        raise ValueError(f"a method is one of {', '.join(METHODS)}, not {name!r}")
    if name == "adam":
        return Adam(steps)
    return LBFGS() if name == "lbfgs" else Optimistix(optimistix.BFGS(rtol=1e-8, atol=1e-8))
