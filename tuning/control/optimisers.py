"""Ways downhill. Each asks for the value and the slope at one point a step, and nothing else.

So all of them share the one program that simulates, and their evaluations can be counted alike.
"""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
import optimistix
from jaxtyping import Array, Bool, Float

METHODS = ("adam", "lbfgs", "bfgs")
ADAM_STEP = 0.1  # first step of Adam in search variables, each of which is of order one
MAX_FIRST_STEP = 0.5  # longest first step of a line search, for each variable in the mean
BACKTRACKING_FACTOR = 0.5  # of a step that led to a loop which diverges, or not far enough down
SUFFICIENT_DECREASE = (
    1e-4  # share of the decrease that the slope promises with which a step is accepted
)
SHARPNESS_STAGES = (
    5  # of the sharpness of maxima, for methods that learn curvatures: these jump with it
)

Point = Float[Array, " free"]
Value = Float[Array, ""]
Flag = Bool[Array, ""]


class AbstractOptimiser(eqx.Module):
    """Interface: memory at the start, and one step of a single search."""

    @property
    @abc.abstractmethod
    def sharpness_stages(self) -> int | None:
        """In how many stages maxima get sharper; at every step a little if None."""

    @abc.abstractmethod
    def init(self, point: Point) -> Any:
        """Memory before the first step."""

    @abc.abstractmethod
    def step(
        self, previous, point: Point, value: Value, gradient: Point, objective_changed: Flag
    ) -> tuple[Point, Any]:
        """The next point to ask for, and the memory.

        `value` is infinite where the loop diverges (the slope is zero then). `objective_changed` says that
        what is minimised has changed a little, so that earlier values do not compare.
        """


class AdamState(NamedTuple):
    """Memory of `Adam`: its moments, the last sound point, and the size of its steps."""

    moments: Any
    last_finite: Point
    step_scale: Value


class Adam(AbstractOptimiser):
    """Steps along averaged slopes (Kingma and Ba, 2015; optax), shorter towards the end."""

    steps: int

    @property
    def sharpness_stages(self):
        return None

    @property
    def transformation(self) -> optax.GradientTransformation:
        """The rule of optax."""
        return optax.adam(optax.cosine_decay_schedule(ADAM_STEP, self.steps, alpha=0.05))

    def init(self, point):
        return AdamState(self.transformation.init(point), point, jnp.ones(()))

    def step(self, previous, point, value, gradient, objective_changed):
        finite = jnp.isfinite(value)
        scale = jnp.where(finite, previous.scale, BACKTRACKING_FACTOR * previous.scale)
        base = jnp.where(finite, point, previous.sound)
        change, moments = self.transformation.update(gradient, previous.moments)
        next_point = base + jnp.where(finite, scale, 0.0) * change
        return next_point, AdamState(moments, base, scale)


class LineSearchState(NamedTuple):
    """Memory of `LBFGS`: curvatures, and the line on which it looks for a point further down."""

    curvature: Any
    origin: Point
    value: Value
    direction: Point
    directional_slope: Value
    step_length: Value


class LBFGS(AbstractOptimiser):
    """Quasi-Newton steps from the last few slopes (Nocedal, 1980; optax), halved until they pay.

    What is remembered is dropped where the function bends downwards, or has been sharpened.
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
        goal = previous.value + SUFFICIENT_DECREASE * previous.length * previous.directional_slope
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
        halved = previous._replace(length=BACKTRACKING_FACTOR * previous.length)
        found = jax.tree.map(lambda a, b: jnp.where(accepted, a, b), next_line, halved)
        return found.anchor + found.length * found.direction, found


class OptimistixState(NamedTuple):
    """Memory of `Optimistix`: where its solver stands, and the arrays of its state."""

    point: Point
    state: Any


class Optimistix(AbstractOptimiser):
    """A minimiser of optimistix that looks at one point a step, such as BFGS.

    It is given the plane through the value with the slope at the point that it asks for, which is
    all it can see of the function there.
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
        anchor, state, _ = self.solver.step(plane, previous.anchor, None, {}, state, frozenset())
        return state.y_eval, OptimistixState(anchor, eqx.filter(state, eqx.is_array))


def _zero_function(point, _):
    return jnp.zeros(()), None


def optimiser(name: str, steps: int) -> AbstractOptimiser:
    """The method of a name. Raises ValueError for an unknown one."""
    if name not in METHODS:
        raise ValueError(f"a method is one of {', '.join(METHODS)}, not {name!r}")
    if name == "adam":
        return Adam(steps)
    return LBFGS() if name == "lbfgs" else Optimistix(optimistix.BFGS(rtol=1e-8, atol=1e-8))
