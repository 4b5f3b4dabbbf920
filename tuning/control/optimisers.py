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
RATE = 0.1  # first step of Adam in search variables, each of which is of order one
REACH = 0.5  # longest first step of a line search, for each variable in the mean
SHRINK = 0.5  # of a step that led to a loop which diverges, or not far enough down
DOWN = 1e-4  # share of the decrease that the slope promises with which a step is accepted
STAGES = 5  # of the sharpness of maxima, for methods that learn curvatures: these jump with it

Point = Float[Array, " free"]
Value = Float[Array, ""]
Yes = Bool[Array, ""]


class AbstractMethod(eqx.Module):
    """Interface: memory at the start, and one step of a single search."""

    @property
    @abc.abstractmethod
    def stages(self) -> int | None:
        """In how many stages maxima get sharper; at every step a little if None."""

    @abc.abstractmethod
    def init(self, point: Point) -> Any:
        """Memory before the first step."""

    @abc.abstractmethod
    def next(
        self, memory, point: Point, value: Value, slope: Point, fresh: Yes
    ) -> tuple[Point, Any]:
        """The next point to ask for, and the memory.

        `value` is infinite where the loop diverges (the slope is zero then). `fresh` says that
        what is minimised has changed a little, so that earlier values do not compare.
        """


class Followed(NamedTuple):
    """Memory of `Adam`: its moments, the last sound point, and the size of its steps."""

    moments: Any
    sound: Point
    scale: Value


class Adam(AbstractMethod):
    """Steps along averaged slopes (Kingma and Ba, 2015; optax), shorter towards the end."""

    steps: int

    @property
    def stages(self):
        return None

    @property
    def rule(self) -> optax.GradientTransformation:
        """The rule of optax."""
        return optax.adam(optax.cosine_decay_schedule(RATE, self.steps, alpha=0.05))

    def init(self, point):
        return Followed(self.rule.init(point), point, jnp.ones(()))

    def next(self, memory, point, value, slope, fresh):
        sound = jnp.isfinite(value)
        scale = jnp.where(sound, memory.scale, SHRINK * memory.scale)
        back = jnp.where(sound, point, memory.sound)
        change, moments = self.rule.update(slope, memory.moments)
        ahead = back + jnp.where(sound, scale, 0.0) * change
        return ahead, Followed(moments, back, scale)


class Line(NamedTuple):
    """Memory of `LBFGS`: curvatures, and the line on which it looks for a point further down."""

    curvature: Any
    anchor: Point
    value: Value
    direction: Point
    promise: Value
    length: Value


class LBFGS(AbstractMethod):
    """Quasi-Newton steps from the last few slopes (Nocedal, 1980; optax), halved until they pay.

    What is remembered is dropped where the function bends downwards, or has been sharpened.
    """

    rule = optax.scale_by_lbfgs(memory_size=10)

    @property
    def stages(self):
        return STAGES

    def init(self, point):
        zero = jnp.zeros(())
        return Line(self.rule.init(point), point, zero + jnp.inf, 0 * point, zero, zero + 1.0)

    def next(self, memory, point, value, slope, fresh):
        goal = memory.value + DOWN * memory.length * memory.promise
        accepted = jnp.isfinite(value) & (fresh | (value <= goal))
        last = memory.curvature
        bent = jnp.vdot(point - last.params, slope - last.updates) <= 0
        blank = self.rule.init(point)
        known = jax.tree.map(lambda new, old: jnp.where(fresh | bent, new, old), blank, last)
        uphill, learnt = self.rule.update(slope, known, point)
        size = jnp.linalg.norm(uphill) / (REACH * jnp.sqrt(point.size))
        direction = -uphill / jnp.maximum(size, 1.0)
        onward = Line(learnt, point, value, direction, jnp.vdot(direction, slope), jnp.ones(()))
        halved = memory._replace(length=SHRINK * memory.length)
        found = jax.tree.map(lambda a, b: jnp.where(accepted, a, b), onward, halved)
        return found.anchor + found.length * found.direction, found


class Stepped(NamedTuple):
    """Memory of `Optimistix`: where its solver stands, and the arrays of its state."""

    anchor: Point
    state: Any


class Optimistix(AbstractMethod):
    """A minimiser of optimistix that looks at one point a step, such as BFGS.

    It is given the plane through the value with the slope at the point that it asks for, which is
    all it can see of the function there.
    """

    solver: optimistix.AbstractMinimiser

    @property
    def stages(self):
        return STAGES

    def init(self, point):
        value = jax.ShapeDtypeStruct((), point.dtype)
        state = self.solver.init(_flat, point, None, {}, value, None, frozenset())
        return Stepped(point, eqx.filter(state, eqx.is_array))

    def next(self, memory, point, value, slope, fresh):
        sound = jnp.isfinite(value)
        blank = self.init(point)
        anew = fresh & sound
        memory = jax.tree.map(lambda new, old: jnp.where(anew, new, old), blank, memory)
        value = jnp.where(sound, value, jnp.finfo(point.dtype).max / 4)

        def plane(asked, _):
            return value + jnp.vdot(slope, asked - jax.lax.stop_gradient(asked)), None

        form = self.solver.init(_flat, point, None, {}, value, None, frozenset())
        state = eqx.combine(memory.state, eqx.filter(form, eqx.is_array, inverse=True))
        anchor, state, _ = self.solver.step(plane, memory.anchor, None, {}, state, frozenset())
        return state.y_eval, Stepped(anchor, eqx.filter(state, eqx.is_array))


def _flat(point, _):
    return jnp.zeros(()), None


def method_of(given: str, steps: int) -> AbstractMethod:
    """The method of a name. Raises ValueError for an unknown one."""
    if given not in METHODS:
        raise ValueError(f"a method is one of {', '.join(METHODS)}, not {given!r}")
    if given == "adam":
        return Adam(steps)
    return LBFGS() if given == "lbfgs" else Optimistix(optimistix.BFGS(rtol=1e-8, atol=1e-8))
