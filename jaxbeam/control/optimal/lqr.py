"""Linear-quadratic regulators, fed by the true state: one gain, or gains over the crossing.

    J = x(end)' F x(end) + integral of x'Qx + u'Ru,     u = -K x        (thesis, eqs 3.3 and 3.7)

The weights are on the states of the design model in the chosen coordinates.
"""

import abc
import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.fields import (
    NOT_NEGATIVE,
    ON_BEAM,
    POSITIVE,
    choice,
    concrete,
    count,
    is_concrete,
    number,
)
from jaxbeam.case.loads import trajectory
from jaxbeam.control.optimal.crossing_plant import crossing_plant
from jaxbeam.control.optimal.gain_schedules import GainSchedule, crossing_events
from jaxbeam.control.optimal.sampling_loss import warn_slow_sampling
from jaxbeam.control.state_law import AbstractStateLaw
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.finite_horizon import boundary_layer, finite_horizon, finite_horizon_coupled
from jaxbeam.numerics.gain_table import (
    GainTable,
    breakpoints_between,
    frozen_time_gains,
    uniform_fractions,
)
from jaxbeam.numerics.riccati import lqr

MAX_PHASE_PER_INTERVAL = 3.0  # rad by which the fastest mode may turn within a stretch of a table


class AbstractRegulator(AbstractStateLaw):
    """What all linear-quadratic regulators share: their weights.

    `state_weight` is the diagonal of Q, `command_weight` that of R. With `places`, deflections
    there are weighted too, eq. (3.2) of the thesis. `feedback` says which share of each state is
    fed back (1 or 0; all if left out): the gain is designed for all of them.
    """

    state_weight: Float[Array, " state"] = number(
        "1/unit of the state^2", "weight of each state", NOT_NEGATIVE
    )
    command_weight: Float[Array, " actuator"] = number(
        "1/unit of a command^2", "weight of each command", POSITIVE
    )
    places: Float[Array, " place"] | None = number(
        "m", "where deflections are weighted", ON_BEAM, default=None
    )
    place_weight: Float[Array, " place"] | None = number(
        "1/m^2", "weight of the deflection at each place", NOT_NEGATIVE, default=None
    )
    feedback: Float[Array, " state"] | None = number(
        "1", "share of each state that is fed back", default=None
    )

    @abc.abstractmethod
    def gains(self, plant: Plant) -> Any:
        """The gains designed for a model, in the states of that model."""

    def validate(self, case):
        states, commands = self.state_count(case), len(case.actuators)
        sizes = {
            "state_weight": states,
            "command_weight": commands,
            "feedback": states,
            "terminal_weight": states,
        }
        for name, size in sizes.items():
            value = getattr(self, name, None)
            if value is not None and value.shape[0] != size:
                return f"{name} must have {size} entries, not {value.shape[0]}"
        if (self.places is None) != (self.place_weight is None):
            return "places and place_weight belong together; give both or neither"
        if self.places is not None and self.places.shape != self.place_weight.shape:
            return "place_weight must have an entry for each of the places"
        return super().validate(case)

    def warn(self, system, case):
        warn_slow_sampling(system, float(concrete(self.period)), float(concrete(case.run.duration)))

    def weights(self, plant: Plant) -> tuple[Array, Array]:
        """Q and R for the states of a model."""
        Q = jnp.diag(self.state_weight)
        if self.places is not None:
            shape = plant.modal_model.shapes(self.places, (0,))[0] / plant.coordinate_scale
            deflection_rows = (
                jnp.zeros((shape.shape[0], Q.shape[0])).at[:, : shape.shape[1]].set(shape)
            )
            Q = Q + deflection_rows.T @ (self.place_weight[:, None] * deflection_rows)
        return Q, jnp.diag(self.command_weight)

    @property
    def feedback_shares(self) -> Float[Array, " state"]:
        """The share of each state that is fed back."""
        return jnp.ones_like(self.state_weight) if self.feedback is None else self.feedback


class LQR(AbstractRegulator):
    """The time-invariant regulator for the rig without loads, eq. (5.7) of the thesis."""

    @property
    def design_depends_on_loads(self) -> bool:
        return self.estimator is not None

    def gains(self, plant):
        system = plant.unloaded
        return lqr(system.A, system.B, *self.weights(plant))[0]

    def prepare(self, plant, design_plant):
        return self.gains(design_plant) * self.feedback_shares

    def command(self, memory, estimate, measurement, t):
        return -memory @ estimate.state, memory


class AbstractScheduledRegulator(AbstractRegulator):
    """A regulator whose gain changes while loads cross, tabulated over the share of the crossing.

    The crossing lasts from the first entry to the last exit, and the share is that of its time: the
    share of the way only while a single load keeps its speed. Where the design believes in another
    speed, its table is stretched. From then on the command is "none", or the last gain is on
    "hold", or it fades ("fade", with the time constant `fade_time`), or the "time-invariant"
    regulator takes over. A table has `points` stretches, or some more, from each entry or exit to
    the next.

    The `entries` are "measured": the table starts with the first entry and ends with the last exit
    as they are. Or they are "predicted": it runs by the clock, from the first entry to the last
    exit as the `design` believes them to be, whatever comes.
    """

    entries: str = choice("times of entry and exit", "measured", "predicted", default="measured")
    after: str = choice(
        "gain after the last exit", "none", "hold", "fade", "time-invariant", default="none"
    )
    fade_time: Float[Array, ""] | None = number(
        "s", "time constant with which the last gain fades", POSITIVE, default=None
    )
    points: int = count("stretches of the table from event to event", default=1600)

    def validate(self, case):
        if not case.loads:
            return "kind needs loads to be designed for; add one, or take kind 'lqr'"
        if (self.after == "fade") != (self.fade_time is not None):
            return "fade_time belongs to after = 'fade'; give both or neither"
        return super().validate(case)

    @property
    def load_feedforward(self) -> bool:
        """Whether the weights of the loads are fed forward."""
        return False

    def prepare(self, plant, design_plant):
        table = self.gains(design_plant)
        load_weights = design_plant.weights if self.load_feedforward else jnp.zeros(0)
        gain_at_exit = table(jnp.ones(()))
        if self.after == "time-invariant":
            system = design_plant.unloaded
            gain_at_exit = lqr(system.A, system.B, *self.weights(design_plant))[0]
        final_gain = jnp.zeros(
            (gain_at_exit.shape[0], self.feedback_shares.shape[0] + load_weights.shape[0])
        )
        if self.after != "none":
            final_gain = final_gain.at[:, : self.feedback_shares.shape[0]].set(
                gain_at_exit[:, : self.feedback_shares.shape[0]]
            )
        shares = jnp.concatenate([self.feedback_shares, jnp.ones_like(load_weights)])
        table = GainTable(table.boundaries, table.pieces * shares)
        events = crossing_events(design_plant if self.entries == "predicted" else plant)
        return GainSchedule(
            table, final_gain * shares, load_weights, events[0], events[-1], self.fade_time
        )

    def events(self, case: Any) -> Float[np.ndarray, " event"]:
        """Times (s) of entry and exit by which the table runs, ascending."""
        loads = design_loads(self, case) if self.entries == "predicted" else case.loads
        windows = [
            concrete(trajectory(load, case.beam.length).entry_exit_times()) for load in loads
        ]
        return np.sort(np.ravel(windows))

    def breakpoints(self, case):
        """At every instant, the gain jumps at predicted entries and exits, where no load does."""
        estimator_breakpoints = super().breakpoints(case)
        if self.period is not None or self.entries == "measured":
            return estimator_breakpoints
        return np.append(
            [] if estimator_breakpoints is None else estimator_breakpoints, self.events(case)
        )

    def command(self, memory, estimate, measurement, t):
        load_weights = memory.known
        if self.load_feedforward and estimate.weights is not None:
            load_weights = estimate.weights
        return -memory.gain(t) @ jnp.concatenate([estimate.state, load_weights]), memory


class AbstractFiniteHorizonRegulator(AbstractScheduledRegulator):
    """What those regulators share that are found backward in time.

    `terminal_weight` is the diagonal of F, eq. (3.3) of the thesis; Q if left out. On a rig of 7
    modes gains were right everywhere to 3e-4 of the largest nearby where the fastest mode turned by
    3 rad in a stretch of the table, to 3e-5 with 2 rad, 2e-6 with 1, and 1e-7 with 0.5; while P
    rings, before an event, the table has finer stretches. Where an actuator lags, they were right
    to 1e-6 if a stretch lasted nine of its time constants, to 1e-8 with four.
    """

    terminal_weight: Float[Array, " state"] | None = number(
        "s/unit of the state^2", "weight of each state at the end", NOT_NEGATIVE, default=None
    )

    def validate(self, case):
        return super().validate(case) or points_error(self, case)

    def gains(self, plant):
        return finite_horizon_gains(self, plant)[0]

    def breakpoints(self, case):
        """At every instant, the fast layer of the gains before each event must be resolved, too."""
        if self.period is not None:
            return None
        events, estimator_breakpoints = self.events(case), super().breakpoints(case)
        crossing_intervals = np.diff(events[events < concrete(case.run.duration)])
        boundary_layers = events[1 : crossing_intervals.size + 1, None] - crossing_intervals[
            :, None
        ] * boundary_layer(self.points)
        return np.append(
            [] if estimator_breakpoints is None else estimator_breakpoints, boundary_layers
        )


class StepLQR(AbstractScheduledRegulator):
    """At each time the regulator of the plant frozen then, eqs (3.10) and (3.11) of the thesis."""

    def gains(self, plant):
        def system_at(t):
            return plant.A(t), plant.B(t)

        return frozen_time_gains(
            system_at,
            breakpoints_between(crossing_events(plant), uniform_fractions(self.points)),
            *self.weights(plant),
        )


class FiniteLQR(AbstractFiniteHorizonRegulator):
    """The optimal regulator over the crossing, eqs (3.3) to (3.9) of the thesis."""


class AugmentedLQR(AbstractFiniteHorizonRegulator):
    """The optimal regulator over the crossing that knows the loads, eq. (5.8) of the thesis.

    The weights of all loads are constant states of the model: the command answers those on the
    beam, and, as the times of entry are known or predicted, those still to come.
    """

    @property
    def load_feedforward(self) -> bool:
        return True


def finite_horizon_gains(
    regulator: AbstractFiniteHorizonRegulator, plant: Plant
) -> tuple[GainTable, Float[Array, "edge state state"]]:
    """Table of optimal gains for a model, and P at its edges, load states included."""
    Q, R = regulator.weights(plant)
    F = Q if regulator.terminal_weight is None else jnp.diag(regulator.terminal_weight)
    load_count = len(plant.case.loads) if regulator.load_feedforward else 0

    Q, F = (jnp.pad(weight, (0, load_count)) for weight in (Q, F))
    problem = crossing_events(plant), regulator.points, Q, R, F
    if plant.modal_model.state_count == 2 * plant.coordinate_scale.shape[0]:
        return finite_horizon_coupled(*crossing_plant(plant, load_count > 0), *problem)

    # Commands to a lag much faster than a stretch are no polynomials, as they are taken for there.
    def system_at(t):
        system = plant.augmented(t) if load_count else plant.at(t)
        return system.A, system.B[:, : len(plant.case.actuators)]

    return finite_horizon(system_at, *problem)


def design_loads(regulator: AbstractScheduledRegulator, case: Any) -> tuple:
    """The loads of a case as the design believes them to be."""
    return case.loads if regulator.design is None else regulator.design.design_loads(case)


def points_error(
    regulator: AbstractScheduledRegulator, case: Any, slowest_speed=None
) -> str | None:
    """Whether the fastest mode turns too far within a stretch, by the formula for pinned ends.

    A sentence, or None. Loads are as fast as believed, or have the `slowest_speed` speed (m/s).
    """
    beam = case.beam
    loads = design_loads(regulator, case)
    speeds = [load.speed for load in loads] if slowest_speed is None else [slowest_speed]
    numbers = (beam.length, beam.bending_stiffness, beam.linear_density, *speeds)
    if not all(value is not None and is_concrete(value) for value in numbers):
        return None
    length, rigidity, density, *speeds = (float(concrete(value)) for value in numbers)
    modes = regulator.mode_count(case)
    fastest_frequency = (modes * math.pi / length) ** 2 * (rigidity / density) ** 0.5
    crossing_time = length / max(min(abs(speed) for speed in speeds), 1e-300)
    min_points = math.ceil(fastest_frequency * crossing_time / MAX_PHASE_PER_INTERVAL)
    if regulator.points >= min_points:
        return None
    return (
        f"points must be at least {min_points} for {modes} modes and a crossing of {crossing_time:.3g} s:"
        " in each stretch the fastest mode may turn by some radians only"
    )
