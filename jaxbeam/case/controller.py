"""What a controller is: something that turns measurements into commands, at its own pace.

The controllers themselves are in `control`.
"""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, number


class Measurement(eqx.Module):
    """What a controller may look at: the readings of the sensors, each in its own SI unit.

    `state` is the true state of the plant in the order of `state_space`, for laws that assume full
    knowledge; no sensor gives it. `command` is what the actuators have been given until now,
    limits and resolution applied.
    """

    readings: Float[Array, " sensor"]
    state: Float[Array, " state"]
    command: Float[Array, " actuator"]


class ControllerFilter(NamedTuple):
    """A filter of the readings y of one sensor: x' = A x + B y, output C x + D y."""

    sensor: int
    A: Float[Array, "state state"]
    B: Float[Array, " state"]
    C: Float[Array, " state"]
    D: Float[Array, ""]


class AbstractController(eqx.Module):
    """Interface of all controllers.

    With a sampling `period` (s) a controller acts at 0, period, 2 period, ...; its command begins
    `delay` (s) later and is held until the next one. Without a period it acts at every instant,
    the limit of ever faster sampling; its memory then stays as it was at the start, so it must be
    `stateless`, but for filters and states of its own, which join those of the plant. Commands are
    rounded to `resolution` and kept within the actuators' limits by the loop. To add a controller,
    write a file with a subclass and name it in `jaxbeam.control.KINDS`.
    """

    period: Float[Array, ""] | None = number(
        "s", "sampling period; at every instant if left out", POSITIVE, default=None, kw_only=True
    )
    delay: Float[Array, ""] | None = number(
        "s", "from measurement to command", NOT_NEGATIVE, default=None, kw_only=True
    )
    resolution: Float[Array, ""] | None = number(
        "unit of a command", "step between commands", POSITIVE, default=None, kw_only=True
    )

    @property
    def stateless(self) -> bool:
        """Whether `step` leaves the memory as it is, so that it may act at every instant."""
        return False

    @property
    def open_loop(self) -> bool:
        """Whether the command depends on time alone."""
        return False

    @property
    def design_depends_on_loads(self) -> bool:
        """Whether what `init` prepares depends on masses and weights of the loads."""
        return True

    @abc.abstractmethod
    def init(self, plant: Any) -> Any:
        """Memory at the start of a run, of any structure; gains may be designed here.

        `plant` is the `statespace.LoadedBeam` of the case.
        """

    @abc.abstractmethod
    def step(
        self, memory: Any, measurement: Measurement, t: Float[Array, ""]
    ) -> tuple[Float[Array, " actuator"], Any]:
        """Commands, in the units of the actuators, at time t (s), and the memory after it."""

    def own_filters(self) -> tuple[ControllerFilter, ...]:
        """Its filters where it acts at every instant; their outputs follow the readings."""
        return ()

    def own_states(self, memory: Any) -> int:
        """How many states of its own it has where it acts at every instant; they start at zero."""
        return 0

    def flow(
        self,
        memory: Any,
        states: Float[Array, " own"],
        measurement: Measurement,
        t: Float[Array, ""],
        saturate: Callable[[Array], Array],
    ) -> tuple[Float[Array, " actuator"], Float[Array, " own"]]:
        """Commands at every instant, and the rates of the states of its own.

        `saturate` takes the commands that are wanted to those that the actuators are given.
        """
        return saturate(self.step(memory, measurement, t)[0]), states

    def validate(self, case: Any) -> str | None:
        """What is wrong with it in a case, as "key must ...", before anything compiles; or None."""
        return None

    def failures(self, memory: Any) -> Float[Array, ""]:
        """How many steps until now found no solution and fell back, for what solves at each."""
        return jnp.zeros(())

    def breakpoints(self, case: Any) -> Float[Array, " knot"] | None:
        """Times (s) at which the command bends or jumps by itself in a run; steps end there."""
        return None
