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
from jaxbeam.case.fields import POSITIVE, concrete, is_concrete, number
from jaxbeam.control.load_position import DeflectionIdentifier
from jaxbeam.control.load_update import AbstractLoadIdentifier
from jaxbeam.estimation.constant_gain import sensor_offsets
from jaxbeam.estimation.observability import deflection_outputs
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.state_space import Plant, state_space
from jaxbeam.runtime.compiling import compiled

INFLUENCE_POSITIONS = 201  # at which influence lines are kept


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

    def validate(self, case: Any) -> str | None:
        """What is wrong with it in a case, as "key must ...", or None."""
        if not any(sensor.quantity == "deflection" for sensor in case.sensors):
            return "until has no use without a sensor of deflection; add one"
        if (self.gates is None) == (self.threshold is None):
            return "gates or threshold must be given, and not both"
        if self.gates is None:
            deflection_sensors = sum(sensor.quantity == "deflection" for sensor in case.sensors)
            if deflection_sensors < 2:
                return "threshold needs two sensors of deflection or more; add one, or give gates"
            return None
        numbers = (self.gates, self.until, case.beam.length, case.loads[0].speed)
        if not all(is_concrete(value) for value in numbers):
            return None
        gates, until, length, speed = (concrete(value) for value in numbers)
        gate_shares = np.sign(speed) * (gates - (length if speed < 0 else 0.0)) / length
        if gate_shares[1] <= gate_shares[0]:
            return "gates must be two places, that which the load passes first before the other"
        if not gate_shares[1] < until <= 1:
            return f"until must be beyond the second gate, at {gate_shares[1]:.3g} of the way, and at most 1"
        return None

    def identifier(self, plant: Plant, design_plant: Plant) -> AbstractLoadIdentifier:
        """The recogniser of the first load of a model; deflections are those of the design."""
        system, modes = design_plant.unloaded, design_plant.coordinate_scale.shape[0]
        length = plant.case.beam.length
        static_response = jnp.linalg.solve(system.A.T, system.C[deflection_outputs(system)].T).T
        shapes = design_plant.modal_model.shapes(
            length * np.linspace(0, 1, INFLUENCE_POSITIONS), (0,)
        )[0]
        sensor_indices = deflection_outputs(system)
        common = {
            "length": length,
            "gravity": design_plant.case.run.gravity,
            "line": static_response[:, modes : 2 * modes]
            @ (design_plant.coordinate_scale[:, None] * shapes.T),
            "lift": -static_response @ system.B,
            "offset": sensor_offsets(design_plant)[sensor_indices],
            "seen": tuple(int(i) for i in sensor_indices),
        }
        if self.gates is None:
            settings = {"until": self.until, "threshold": self.threshold}
            return DeflectionIdentifier(sums=jnp.zeros(8), **settings, **common)
        times = plant.loads.trajectories[0].passage_times(self.gates)[:2]
        return GateIdentifier(settings=self, gate_times=times, sums=jnp.zeros(2), **common)


class GateIdentifier(AbstractLoadIdentifier):
    """What is known of a load by now; `gate_times` (s) are when it passes the gates."""

    settings: Recognition
    gate_times: Float[Array, "2"]

    @property
    def speed(self) -> Float[Array, ""]:
        """The speed (m/s), negative to the left; it is known from the second gate on."""
        return jnp.diff(self.settings.gates)[0] / jnp.diff(self.gate_times)[0]

    @property
    def entry_time(self) -> Float[Array, ""]:
        """When the load enters the beam (s), if it keeps its speed."""
        start = jnp.where(self.speed < 0, self.length, 0.0)
        return self.gate_times[1] + (start - self.settings.gates[1]) / self.speed

    @property
    def mass(self) -> Float[Array, ""]:
        """The mass (kg) that fits what was heard; zero where nothing was."""
        return self.fitted_mass(*self.sums)

    def crossing_share(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """The share of the way that is behind the load at a time (s)."""
        return (t - self.entry_time) * jnp.abs(self.speed) / self.length

    def identified(self, t: Float[Array, ""]) -> tuple[Array, Array]:
        """Whether speed and mass are known at a time (s)."""
        speed_identified = t >= self.gate_times[1]
        return speed_identified, speed_identified & (self.crossing_share(t) >= self.settings.until)

    def innovation(self, deflections, t):
        share = self.crossing_share(t)
        passed, done = self.identified(t)
        relative_position = jnp.where(self.speed < 0, 1 - share, share)
        positions = np.linspace(0, 1, INFLUENCE_POSITIONS)
        influence = jax.vmap(lambda each: jnp.interp(relative_position, positions, each))(
            self.influence_lines
        )
        active = passed & ~done & (share > 0)
        return jnp.where(active, jnp.stack([influence @ deflections, influence @ influence]), 0.0)


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
    error = settings.validate(case)
    if error is not None:
        raise ValueError(f"recognition.{error}")
    mass, speed = _replay(settings, case, mesh_layout(case), record)
    truth = float(case.loads[0].mass), float(case.loads[0].speed)
    found = float(mass), float(speed)
    errors = [value / true - 1 for value, true in zip(found, truth, strict=True)]
    return Recognised(*found, *errors)


@compiled
def _replay(settings: Recognition, case: Case, layout, record):
    plant = state_space(case, layout=layout)
    identifier = settings.identifier(plant, plant)
    zero_state = jnp.zeros(plant.modal_model.state_count)

    def tick(fit, at):
        readings, command, t = at
        current = eqx.tree_at(lambda r: r.fit, identifier, fit)
        return current.update(Measurement(readings, zero_state, command), t).fit, None

    # A sample holds the command from its tick on; the law heard the one before.
    previous_commands = jnp.concatenate([jnp.zeros_like(record.command[:1]), record.command[:-1]])
    fit, _ = jax.lax.scan(tick, identifier.sums, (record.measured, previous_commands, record.times))
    final = eqx.tree_at(lambda r: r.fit, identifier, fit)
    return final.mass, final.speed
