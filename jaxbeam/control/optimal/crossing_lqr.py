"""Regulators with a gain that varies while loads cross: finite-horizon, and frozen in time.

J = x(end)' F x(end) + integral of x'Qx + u'Ru,     u = -K(t) x     (thesis, eqs 3.3 to 3.11)
"""

import abc
import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, crossing_times
from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, choice, concrete, count, is_concrete, number
from jaxbeam.case.loads.vehicle_model import VehicleModel
from jaxbeam.control.optimal.crossing_plant import crossing_plant
from jaxbeam.control.optimal.gain_schedules import GainSchedule, crossing_events
from jaxbeam.control.optimal.lqr import AbstractRegulator
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.finite_horizon import boundary_layer, finite_horizon, finite_horizon_coupled
from jaxbeam.numerics.gain_table import (
    GainTable,
    breakpoints_between,
    frozen_time_gains,
    uniform_fractions,
)
from jaxbeam.runtime.arrays import Array, set_at, xp

MAX_PHASE_PER_INTERVAL = 3.0  # rad, phase advance of the fastest mode in an interval of a table


class AbstractCrossingRegulator(AbstractRegulator):
    """Settings of a regulator whose gain varies while loads cross.

    The gain is tabulated over the share of the crossing, which lasts from the first entry to the
    last exit: share of time, hence of the distance only while a single load keeps its speed. Where
    the design model has another speed, the table is stretched. After the crossing the command is
    "none", or the last gain is on "hold", or it decays ("fade", with the time constant
    `fade_time`), or the "time-invariant" regulator takes over. A table has `points` intervals, or
    some more, between consecutive entries and exits.

    With `entries` "measured" the table starts with the first entry and ends with the last exit of
    the loads of the case; with "predicted" it runs between entry and exit of the
    loads of the `design` model.
    """

    entries: str = choice("times of entry and exit", "measured", "predicted", default="measured")
    after: str = choice(
        "gain after the last exit", "none", "hold", "fade", "time-invariant", default="none"
    )
    fade_time: Float[Array, ""] | None = number(
        "s", "time constant with which the last gain decays", POSITIVE, default=None
    )
    points: int = count("intervals of the table from event to event", default=1600)

    @property
    def design_depends_on_loads(self) -> bool:
        return True

    @property
    def runs_compiled(self) -> bool:
        return True

    @property
    def load_feedforward(self) -> bool:
        """Whether the weights of the loads are fed forward."""
        return False

    @abc.abstractmethod
    def gain_table(self, plant: Plant) -> GainTable:
        """Gains over the crossing for a plant: of its states, and of the weights fed forward."""

    def validate(self, case):
        if not case.loads:
            return "kind needs loads to be designed for; add one, or take kind 'lqr'"
        if (self.after == "fade") != (self.fade_time is not None):
            return "fade_time belongs to after = 'fade'; give both or neither"
        return super().validate(case)

    def design_state_law(self, plant, design_plant):
        return self.gain_schedule(plant, design_plant)

    def gain_schedule(self, plant: Plant, design_plant: Plant) -> GainSchedule:
        """Schedule designed for one plant, for the times of entry and exit of the other."""
        table, shares = self.gain_table(design_plant), self.feedback_shares
        vehicle_states = design_plant.vehicle_states
        load_weights = xp.zeros(0)
        if self.load_feedforward:
            load_weights = design_plant.augmented_start[design_plant.vehicle_states :]
        last_gain = table(xp.ones(()))
        if self.after == "time-invariant":
            last_gain = self.time_invariant_gain(design_plant)
        states = shares.shape[0]
        further = vehicle_states + load_weights.shape[0]
        final_gain = xp.zeros((last_gain.shape[0], states + further))
        if self.after != "none":
            final_gain = set_at(final_gain, np.s_[:, :states], last_gain[:, :states])
        shares = xp.concatenate([shares, xp.ones(further)])
        events = crossing_events(design_plant if self.entries == "predicted" else plant)
        return GainSchedule(
            GainTable(table.breakpoints, table.coefficients * shares),
            final_gain * shares,
            load_weights,
            events[0],
            events[-1],
            self.fade_time,
            self.load_feedforward,
            vehicle_states,
        )

    def events(self, case: Case) -> Float[np.ndarray, " event"]:
        """Times (s) of entry and exit between which the table runs, ascending."""
        if self.entries == "predicted":
            case = eqx.tree_at(lambda c: c.loads, case, self.design_loads(case))
        return np.sort(np.ravel(crossing_times(case)))

    def breakpoints(self, case):
        """Also the predicted entries and exits, at which the gain jumps, in continuous time."""
        times = super().breakpoints(case)
        if self.period is not None or self.entries == "measured":
            return times
        return np.append([] if times is None else times, self.events(case))


class AbstractFiniteHorizonRegulator(AbstractCrossingRegulator):
    """Regulator over the crossing, from the Riccati equation integrated backward in time.

    `terminal_weight` is the diagonal of F, eq. (3.3) of the thesis; Q if left out. With 7 modes the
    largest error of the gains, relative to the largest gain nearby, was 3e-4 where the phase of the
    fastest mode advanced by 3 rad in an interval of the table, 3e-5 with 2 rad, 2e-6 with 1, and
    1e-7 with 0.5; while P oscillates, before an event, the table has finer intervals. With a lag of
    an actuator it was 1e-6 if an interval lasted nine of its time constants, 1e-8 with four.
    """

    terminal_weight: Float[Array, " state"] | None = number(
        "s/unit of the state^2", "weight of each state at the end", NOT_NEGATIVE, default=None
    )

    def sizes(self, case):
        return super().sizes(case) | {"terminal_weight": self.state_count(case)}

    def validate(self, case):
        return super().validate(case) or interval_error(self, case)

    def gain_table(self, plant):
        return finite_horizon_gains(self, plant)[0]

    def breakpoints(self, case):
        """Also the start of the boundary layer of the gains before each event."""
        if self.period is not None:
            return None
        events, times = self.events(case), super().breakpoints(case)
        crossing_intervals = np.diff(events[events < concrete(case.run.duration)])
        layer_starts = events[1 : crossing_intervals.size + 1, None] - crossing_intervals[
            :, None
        ] * boundary_layer(self.points)
        return np.append([] if times is None else times, layer_starts)


class StepLQR(AbstractCrossingRegulator):
    """Regulator of the plant frozen at each time, eqs (3.10) and (3.11) of the thesis.

    States of vehicles, about static equilibrium, are fed back too, with no weight of their own;
    the vehicles need damping, for a stationary regulator to exist while they are off the beam.

    >>> import jaxbeam as jb
    >>> regulator = jb.StepLQR(state_weight=[1e7, 10.0], command_weight=[1e-3], points=40)
    >>> print(regulator.points, regulator.open_loop)
    40 False
    """

    kind: ClassVar[str] = "lqr-step"

    def gain_table(self, plant):
        def system_at(t):
            return plant.A(t), plant.B(t)

        Q, R = self.weights(plant)
        return frozen_time_gains(
            system_at,
            breakpoints_between(crossing_events(plant), uniform_fractions(self.points)),
            xp.pad(Q, (0, plant.vehicle_states)),
            R,
        )

    def validate(self, case):
        for i, load in enumerate(self.design_loads(case)):
            numbers = jax.tree.leaves((load, case.run.gravity))
            if all(map(is_concrete, numbers)) and not _decays(load.vehicle(case.run.gravity)):
                return (
                    f"kind needs vehicles with damping: loads.{i} has a motion without, for which"
                    " no stationary regulator exists off the beam; take kind 'lqr-finite'"
                )
        return super().validate(case)


def _decays(vehicle: VehicleModel) -> bool:
    """Whether all motions of a vehicle on rigid ground decay."""
    count = len(vehicle.names)
    if not count:
        return True
    parts = (vehicle.mass, vehicle.full_stiffness, vehicle.full_damping)
    mass, stiffness, damping = (np.asarray(concrete(part)) for part in parts)
    rates = -np.linalg.solve(mass, np.hstack([stiffness, damping]))
    poles = np.linalg.eigvals(np.vstack([np.eye(count, 2 * count, k=count), rates]))
    return bool(np.all(poles.real < -1e-9 * np.abs(poles)))


class FiniteLQR(AbstractFiniteHorizonRegulator):
    """Optimal regulator over the crossing, eqs (3.3) to (3.9) of the thesis.

    States of vehicles, about static equilibrium, are fed back too, with no weight of their own.

    >>> import jaxbeam as jb
    >>> regulator = jb.FiniteLQR(state_weight=[1e7, 10.0], command_weight=[1e-3], points=40)
    >>> print(regulator.points, regulator.open_loop)
    40 False
    """

    kind: ClassVar[str] = "lqr-finite"


class AugmentedLQR(AbstractFiniteHorizonRegulator):
    """Optimal regulator over the crossing with known weights of the loads, eq. (5.8) of the thesis.

    The weights of all loads are constant states of the plant: the command responds to loads on the
    beam, and, as their entry times are known or predicted, to later ones. With a profile or forces
    that vary in time, which are known too, a further constant state is 1.

    >>> import jaxbeam as jb
    >>> regulator = jb.AugmentedLQR(state_weight=[1e7, 10.0], command_weight=[1e-3], points=40)
    >>> print(regulator.points, regulator.open_loop)
    40 False
    """

    kind: ClassVar[str] = "lqr-augmented"

    @property
    def load_feedforward(self) -> bool:
        return True


def finite_horizon_gains(
    regulator: AbstractFiniteHorizonRegulator, plant: Plant
) -> tuple[GainTable, Float[Array, "breakpoint state state"]]:
    """Table of optimal gains for a plant, and P at its breakpoints.

    Their states are those of beam and vehicles and, if the weights are fed forward, constants; see
    `Plant.augmented`.
    """
    Q, R = regulator.weights(plant)
    F = Q if regulator.terminal_weight is None else xp.diag(regulator.terminal_weight)
    with_weights = regulator.load_feedforward
    further = plant.augmented_start.shape[0] if with_weights else plant.vehicle_states
    Q, F = (xp.pad(weight, (0, further)) for weight in (Q, F))
    problem = crossing_events(plant), regulator.points, Q, R, F
    if plant.modal_model.state_count == 2 * plant.coordinate_scale.shape[0]:
        return finite_horizon_coupled(*crossing_plant(plant, with_weights), *problem)

    # The coupled method assumes gains that are polynomials within an interval, which those of an
    # actuator with a lag much shorter than the interval are not.
    def system_at(t):
        system = plant.augmented(t) if with_weights else plant.at(t)
        return system.A, system.B[:, : plant.commands]

    return finite_horizon(system_at, *problem)


def interval_error(
    regulator: AbstractCrossingRegulator, case: Any, slowest_speed=None
) -> str | None:
    """Error if an interval is too long for the fastest mode, by the frequency for pinned ends.

    Loads cross at the speeds of the design, or at the `slowest_speed` (m/s) if that is given.
    """
    beam = case.beam
    loads = regulator.design_loads(case)
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
        f"points must be at least {min_points} for {modes} modes and a crossing of"
        f" {crossing_time:.3g} s: in an interval the phase of the fastest mode may advance by at"
        f" most {MAX_PHASE_PER_INTERVAL:g} rad"
    )
