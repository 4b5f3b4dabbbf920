"""Which load is coming: its speed from two gates or from how the beam sinks at first, as its mass.

In a simulation the gates are passed when the load's path says so; the law is told those two times.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.case import Case
from jaxbeam.case.controller import Measurement
from jaxbeam.case.fields import POSITIVE, is_known, known, number
from jaxbeam.control.load_position import Follower
from jaxbeam.control.load_update import Listener
from jaxbeam.estimation.constant_gain import offsets
from jaxbeam.estimation.observability import deflections
from jaxbeam.model.modes import lay_out
from jaxbeam.model.state_space import LoadedBeam, state_space
from jaxbeam.runtime.compiling import compiled

PLACES = 201  # at which influence lines are kept


class Recognition(eqx.Module):
    """How a load is recognised: how much of the crossing is listened to, and what tells the speed.

    That are two `gates`, which may be before the beam (a negative position if the load enters at
    the left); the speed is taken to be constant from there on. Without gates it is the deflections
    (see `following`), of two sensors or more, where they exceed a `threshold`. While the load is on
    the first part of the beam, `until`, its weight is the one whose static deflections fit the
    readings of the sensors of deflection best, those that the commands cause subtracted. The beam
    must be held.
    """

    gates: Float[Array, "2"] | None = number(
        "m", "where the gates are, in the order they are passed", default=None
    )
    until: Float[Array, ""] = number(
        "1", "share of the way after which the mass is told", POSITIVE, default=0.3
    )
    threshold: Float[Array, ""] | None = number(
        "m", "deflection that tells of a load, without gates", POSITIVE, default=None
    )

    def fault(self, case: Any) -> str | None:
        """What is wrong with it in a case, as "key must ...", or None."""
        if not any(sensor.quantity == "deflection" for sensor in case.sensors):
            return "until has no use without a sensor of deflection; add one"
        if (self.gates is None) == (self.threshold is None):
            return "gates or threshold must be given, and not both"
        if self.gates is None:
            seeing = sum(sensor.quantity == "deflection" for sensor in case.sensors)
            if seeing < 2:
                return "threshold needs two sensors of deflection or more; add one, or give gates"
            return None
        numbers = (self.gates, self.until, case.beam.length, case.loads[0].speed)
        if not all(is_known(value) for value in numbers):
            return None
        gates, until, length, speed = (known(value) for value in numbers)
        way = np.sign(speed) * (gates - (length if speed < 0 else 0.0)) / length
        if way[1] <= way[0]:
            return "gates must be two places, that which the load passes first before the other"
        if not way[1] < until <= 1:
            return (
                f"until must be beyond the second gate, at {way[1]:.3g} of the way, and at most 1"
            )
        return None

    def init(self, model: LoadedBeam, designed: LoadedBeam) -> Listener:
        """The recogniser of the first load of a model; deflections are those of the design."""
        plant, modes = designed.unloaded, designed.scale.shape[0]
        length = model.case.beam.length
        answer = jnp.linalg.solve(plant.A.T, plant.C[deflections(plant)].T).T
        shapes = designed.rig.shapes(length * np.linspace(0, 1, PLACES), (0,))[0]
        seen = deflections(plant)
        common = {
            "length": length,
            "gravity": designed.case.run.gravity,
            "line": answer[:, modes : 2 * modes] @ (designed.scale[:, None] * shapes.T),
            "lift": -answer @ plant.B,
            "offset": offsets(designed)[seen],
            "seen": tuple(int(i) for i in seen),
        }
        if self.gates is None:
            settings = {"until": self.until, "threshold": self.threshold}
            return Follower(fit=jnp.zeros(8), **settings, **common)
        times = model.traffic.motions[0].arrivals(self.gates)[:2]
        return Recogniser(settings=self, times=times, fit=jnp.zeros(2), **common)


class Recogniser(Listener):
    """What is known of a load by now; `times` (s) are when it passes the gates."""

    settings: Recognition
    times: Float[Array, "2"]

    @property
    def speed(self) -> Float[Array, ""]:
        """The speed (m/s), negative to the left; it is known from the second gate on."""
        return jnp.diff(self.settings.gates)[0] / jnp.diff(self.times)[0]

    @property
    def entry(self) -> Float[Array, ""]:
        """When the load enters the beam (s), if it keeps its speed."""
        start = jnp.where(self.speed < 0, self.length, 0.0)
        return self.times[1] + (start - self.settings.gates[1]) / self.speed

    @property
    def mass(self) -> Float[Array, ""]:
        """The mass (kg) that fits what was heard; zero where nothing was."""
        return self.mass_of(*self.fit)

    def share(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """The share of the way that is behind the load at a time (s)."""
        return (t - self.entry) * jnp.abs(self.speed) / self.length

    def told(self, t: Float[Array, ""]) -> tuple[Array, Array]:
        """Whether speed and mass are known at a time (s)."""
        passed = t >= self.times[1]
        return passed, passed & (self.share(t) >= self.settings.until)

    def news(self, deflections, t):
        share = self.share(t)
        passed, done = self.told(t)
        way = jnp.where(self.speed < 0, 1 - share, share)
        places = np.linspace(0, 1, PLACES)
        line = jax.vmap(lambda each: jnp.interp(way, places, each))(self.line)
        listening = passed & ~done & (share > 0)
        return jnp.where(listening, jnp.stack([line @ deflections, line @ line]), 0.0)


class Recognised(NamedTuple):
    """What was made of a load: mass (kg) and speed (m/s), and their errors over the truth."""

    mass: float
    speed: float
    mass_error: float
    speed_error: float


def recognised(record: Any, settings: Recognition) -> Recognised:
    """What the readings and commands of a record say of its first load, and how wrong that is.

    As the law hears them, if the record has a sample at every tick and commands change at ticks
    only. The true speed is that at entry. Raises ValueError for settings that do not suit the case.
    """
    case = record.case
    fault = settings.fault(case)
    if fault is not None:
        raise ValueError(f"recognition.{fault}")
    mass, speed = _replayed(settings, case, lay_out(case), record)
    truth = float(case.loads[0].mass), float(case.loads[0].speed)
    found = float(mass), float(speed)
    errors = [value / true - 1 for value, true in zip(found, truth, strict=True)]
    return Recognised(*found, *errors)


@compiled
def _replayed(settings: Recognition, case: Case, layout, record):
    model = state_space(case, layout=layout)
    start = settings.init(model, model)
    still = jnp.zeros(model.rig.states)

    def tick(fit, at):
        readings, command, t = at
        heard = eqx.tree_at(lambda r: r.fit, start, fit)
        return heard.hear(Measurement(readings, still, command), t).fit, None

    # A sample holds the command from its tick on; the law heard the one before.
    before = jnp.concatenate([jnp.zeros_like(record.command[:1]), record.command[:-1]])
    fit, _ = jax.lax.scan(tick, start.fit, (record.measured, before, record.times))
    last = eqx.tree_at(lambda r: r.fit, start, fit)
    return last.mass, last.speed
