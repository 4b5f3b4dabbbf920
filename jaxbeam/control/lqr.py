"""Linear-quadratic regulators.

    J = x(end)' F x(end) + integral of x'Qx + u'Ru,     u = -K x        (thesis, eqs 3.3 and 3.7)

The weights are those of the states of the design plant in the chosen coordinates.
"""

import dataclasses
import math
from typing import ClassVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, crossing_times
from jaxbeam.case.fields import (
    INCREASING,
    NOT_NEGATIVE,
    ON_BEAM,
    POSITIVE,
    choice,
    concrete,
    count,
    is_concrete,
    number,
    part,
)
from jaxbeam.case.loads.base import VehicleModel
from jaxbeam.control.crossing_gains import (
    GainSchedule,
    PositionGainLaw,
    ScheduledGainLaw,
    crossing_events,
    designs_of,
    finite_horizon_gains,
    frozen_gains,
    with_single_mass,
)
from jaxbeam.control.estimation.sampled_plant import sample_timing
from jaxbeam.control.load_identification import LoadIdentification, given_load, identification_error
from jaxbeam.control.sampled_lqr import IntegralLaw, sampled_gain, warn_slow_sampling
from jaxbeam.control.state_controller import AbstractStateController, GainLaw, deflection_rows
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.finite_horizon import GainTable, boundary_layer
from jaxbeam.numerics.riccati import lqr
from jaxbeam.runtime.arrays import Array, Number, set_at, to_numpy, xp
from jaxbeam.runtime.compiling import compiled
from jaxbeam.runtime.printer import counted

MAX_PHASE_PER_INTERVAL = 3.0  # rad, phase advance of the fastest mode in an interval of a table

# Settings that act only with some words of an option.
_NEEDED = {
    "input_rate_weight": ("sampling", ("exact",)),
    "integral_weight": ("sampling", ("exact",)),
    "reference": ("sampling", ("exact",)),
    "sampling": ("horizon", ("infinite",)),
    "entries": ("horizon", ("crossing", "frozen")),
    "after": ("horizon", ("crossing", "frozen")),
    "points": ("horizon", ("crossing", "frozen")),
    "terminal_weight": ("horizon", ("crossing",)),
    "augmented": ("horizon", ("crossing",)),
    "schedule": ("horizon", ("crossing",)),
    "masses": ("schedule", ("load", "positions")),
    "speeds": ("schedule", ("load", "positions")),
    "between": ("schedule", ("load",)),
    "load_identification": ("schedule", ("load",)),
}


class LQR(AbstractStateController):
    """Linear-quadratic regulator.

    `state_weight` is the diagonal of Q, `command_weight` that of R. Deflections at `positions` are
    weighted too, eq. (3.2) of the thesis. `feedback` is the fraction of each state that is fed back
    (1 or 0; all if left out); the gain is designed for all of them.

    **Horizon.** "infinite": a constant gain for the plant without loads, eq. (5.7) of the thesis.
    "crossing": the optimum over the crossing, from the Riccati equation backward in time, eqs (3.3)
    to (3.9); `terminal_weight` is the diagonal of F, Q if left out. "frozen": the regulator of the
    plant frozen at each time, eqs (3.10) and (3.11); vehicles need damping, for it to exist while
    they are off the beam. States of vehicles, about static equilibrium, are fed back too, with no
    weight of their own.

    **Sampling**, of an infinite horizon with a `period`. "emulated": the gain of continuous time.
    "exact": designed for commands that are held for a period and begin a `delay` after the sample:
    it minimises the same integral, so that weights mean the same at every period, the cost includes
    the motion between samples, and the gain tends to the emulated one as the period shrinks.
    `input_rate_weight` adds the changes of the command, as rates over a period. With it or a delay
    the last command, as limited by the actuators, is fed back too.

    **Integral action**, of exact sampling. With the readings y of the first sensors, deflections,
    as many as `reference` has entries,

        e(k+1) = e(k) + h (y(k) - reference),     u = -K (x, last command, e),

    where h is the period; the cost has `integral_weight` times h e^2 at each sample. At rest y is
    the reference, whatever constant load acts, while the commands are within their limits; beyond
    them e stands still.

    **Gains over a crossing** are tabulated over the fraction of its time, from the first entry to
    the last exit; this is one of distance too while a single load keeps its speed. Where the design
    model has another speed, the table is stretched. After the crossing the command is "none", or
    the last gain is on "hold", or it decays ("fade", with the time constant `fade_time`), or the
    "time-invariant" regulator takes over. A table has `points` intervals, or some more, between
    consecutive entries and exits. With `entries` "measured" it starts with the first entry and ends
    with the last exit of the loads of the case; with "predicted" it runs between entry and exit of
    the loads of the `design` model. With 7 modes the largest error of the gains, relative to the
    largest gain nearby, was 3e-4 where the phase of the fastest mode advanced by 3 rad in an
    interval of the table, 3e-5 with 2 rad, 2e-6 with 1, and 1e-7 with 0.5; while P oscillates,
    before an event, the table has finer intervals. With a lag of an actuator it was 1e-6 if an
    interval lasted nine of its time constants, 1e-8 with four.

    **Augmented** by "loads", eq. (5.8) of the thesis, the weights of the loads are constant states:
    the command responds to loads on the beam and, as their entry times are given or predicted, to
    later ones. With a profile or forces that vary in time, which are given too, a further constant
    state is 1.

    **Schedule.** "load", section 5.3 of the thesis: a design for each of the `masses` and `speeds`
    (magnitudes; that of the load in the design if left out), at constant speed. Between them
    commands are "interpolated" linearly, or those of the "nearest" design are used; outside, the
    mass or speed is clamped to the grid. The tables are stretched to the speed of the load, also
    outside the grid. Mass, speed and entry time are those of the load in the design, or identified
    by `load_identification`: then the command is zero until the speed is identified, and the
    lightest mass is assumed until the mass is. A vehicle of another mass is similar to that of the
    design: all its masses, springs and dampers are in proportion. "positions": each load of the
    case reads such tables at its measured position and present speed, which may change, rather than
    at a time. Of several loads on the beam the gains of the state are averaged with their masses as
    weights; if augmented, the commands for their weights, in proportion to the masses, are added.
    With none on the beam, `after` holds for those that have left. An estimator that follows the
    loads, `kalman-extended`, gives their masses, positions and speeds.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.LQR(state_weight=[1e6, 1.0], command_weight=[1e-2], period=0.005),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.914 mm
    >>> exact = jb.LQR([1e7, 10.0], [1e-3], sampling="exact", period=0.005)
    >>> peak = jb.simulate(dataclasses.replace(case, controller=exact)).peak_deflection[0]
    >>> print(f"{1e3 * peak:.3f} mm")
    0.537 mm
    """

    kind: ClassVar[str] = "lqr"

    state_weight: Float[Number, " state"] = number(
        "1/unit of the state^2", "weight of each state", NOT_NEGATIVE
    )
    command_weight: Float[Number, " actuator"] = number(
        "1/unit of a command^2", "weight of each command", POSITIVE
    )
    positions: Float[Number, " position"] | None = number(
        "m", "positions of weighted deflections", ON_BEAM, default=None
    )
    position_weight: Float[Number, " position"] | None = number(
        "1/m^2", "weight of the deflection at each position", NOT_NEGATIVE, default=None
    )
    feedback: Float[Number, " state"] | None = number(
        "1", "fraction of each state that is fed back", default=None
    )
    horizon: str = choice(
        "time over which the cost is taken",
        "infinite",
        "crossing",
        "frozen",
        default="infinite",
        kw_only=True,
    )
    sampling: str = choice(
        "design for samples", "emulated", "exact", default="emulated", kw_only=True
    )
    input_rate_weight: Float[Number, " actuator"] | None = number(
        "s^2/unit of a command^2",
        "weight of the rate of change of each command",
        NOT_NEGATIVE,
        default=None,
        kw_only=True,
    )
    integral_weight: Float[Number, " output"] | None = number(
        "1/(m^2 s^2)",
        "weight of the integral of each error",
        POSITIVE,
        default=None,
        kw_only=True,
    )
    reference: Float[Number, " output"] | None = number(
        "m", "reference of each of the first sensors", default=None, kw_only=True
    )
    entries: str = choice(
        "times of entry and exit", "measured", "predicted", default="measured", kw_only=True
    )
    after: str = choice(
        "gain after the last exit",
        "none",
        "hold",
        "fade",
        "time-invariant",
        default="none",
        kw_only=True,
    )
    fade_time: Float[Number, ""] | None = number(
        "s", "time constant with which the last gain decays", POSITIVE, default=None, kw_only=True
    )
    points: int = count("intervals of the table from event to event", default=1600, kw_only=True)
    terminal_weight: Float[Number, " state"] | None = number(
        "s/unit of the state^2",
        "weight of each state at the end",
        NOT_NEGATIVE,
        default=None,
        kw_only=True,
    )
    augmented: str = choice(
        "constants among the states", "none", "loads", default="none", kw_only=True
    )
    schedule: str = choice(
        "what reads the table of the gains",
        "time",
        "load",
        "positions",
        default="time",
        kw_only=True,
    )
    masses: Float[Number, " mass"] | None = number(
        "kg", "masses of the designs", INCREASING, default=None, kw_only=True
    )
    speeds: Float[Number, " speed"] | None = number(
        "m/s", "speeds of the designs", INCREASING, default=None, kw_only=True
    )
    between: str = choice(
        "commands between designs",
        "interpolated",
        "nearest",
        default="interpolated",
        kw_only=True,
    )
    load_identification: LoadIdentification | None = part(
        "how mass and speed are identified", LoadIdentification, kw_only=True
    )

    @property
    def varies(self) -> bool:
        """Whether the gain varies while loads cross."""
        return self.horizon != "infinite"

    @property
    def design_depends_on_loads(self) -> bool:
        return self.varies or super().design_depends_on_loads

    @property
    def feeds_back_command(self) -> bool:
        """Whether the last command is fed back too."""
        held = self.sampling == "exact"
        return held and (self.delay is not None or self.input_rate_weight is not None)

    @property
    def feedback_fractions(self) -> Float[Array, " state"]:
        """Fraction of each state that is fed back."""
        return xp.ones_like(self.state_weight) if self.feedback is None else self.feedback

    def weights(self, plant: Plant) -> tuple[Float[Array, "state state"], Float[Array, "..."]]:
        """Q (state, state) and R (command, command) for the states of a plant."""
        Q = xp.diag(self.state_weight)
        if self.positions is not None:
            rows = deflection_rows(plant, self.positions)
            Q = Q + rows.T @ (self.position_weight[:, None] * rows)
        return Q, xp.diag(self.command_weight)

    def time_invariant_gain(self, plant: Plant) -> Float[Array, "actuator column"]:
        """Gain for a plant without its loads, of an infinite horizon.

        Its columns are those of the states, eq. (5.7) of the thesis; with exact sampling those of
        `sampled_gain`.
        """
        Q, R = self.weights(plant)
        if self.sampling == "exact":
            period, input_delay = sample_timing(self).period, sample_timing(self).input_delay
            further = self.input_rate_weight, self.integral_weight
            return sampled_gain(plant, Q, R, period, input_delay, *further)
        system = plant.unloaded
        return lqr(system.A, system.B, Q, R)[0]

    def crossing_gains(self, plant: Plant) -> tuple[GainTable, Float[Array, "..."]]:
        """Optimal gains over the crossing for a plant, and P at the breakpoints of their table."""
        Q, R = self.weights(plant)
        F = Q if self.terminal_weight is None else xp.diag(self.terminal_weight)
        return finite_horizon_gains(plant, self.points, Q, R, F, self.augmented == "loads")

    def gain_table(self, plant: Plant) -> GainTable:
        """Gains over the crossing for a plant: of its states, and of the weights fed forward."""
        return to_numpy(_gain_table(self, plant))

    def gain_schedule(self, plant: Plant, design_plant: Plant) -> GainSchedule:
        """Schedule designed for one plant, for the times of entry and exit of the other."""
        table, fractions = self.gain_table(design_plant), self.feedback_fractions
        vehicle_states, augmented = design_plant.vehicle_states, self.augmented == "loads"
        load_weights = design_plant.augmented_start[vehicle_states:] if augmented else xp.zeros(0)
        last_gain = table(xp.ones(()))
        if self.after == "time-invariant":
            last_gain = self.time_invariant_gain(design_plant)
        states = fractions.shape[0]
        further = vehicle_states + load_weights.shape[0]
        final_gain = xp.zeros((last_gain.shape[0], states + further))
        if self.after != "none":
            final_gain = set_at(final_gain, np.s_[:, :states], last_gain[:, :states])
        fractions = xp.concatenate([fractions, xp.ones(further)])
        events = crossing_events(design_plant if self.entries == "predicted" else plant)
        return GainSchedule(
            GainTable(table.breakpoints, table.coefficients * fractions),
            final_gain * fractions,
            load_weights,
            events[0],
            events[-1],
            self.fade_time,
            augmented,
            vehicle_states,
        )

    def design_state_law(self, plant, design_plant):
        if self.schedule == "load":
            return self._load_schedule(plant, design_plant)
        if self.schedule == "positions":
            return self._position_schedule(plant, design_plant)
        if self.varies:
            return self.gain_schedule(plant, design_plant)
        gain = self.time_invariant_gain(design_plant)
        if self.reference is None:
            further = xp.ones(gain.shape[1] - self.feedback_fractions.shape[0])
            fractions = xp.concatenate([self.feedback_fractions, further])
            return GainLaw(gain * fractions, self.feeds_back_command)
        limits = [actuator.command_limits() for actuator in plant.case.driven]
        unlimited = np.array([-np.inf, np.inf])
        limits = xp.stack([unlimited if one is None else one for one in limits])
        settings = self.feedback_fractions, self.reference, self.period
        return IntegralLaw(gain, *settings, limits, self.feeds_back_command)

    def _load_schedule(self, plant: Plant, design_plant: Plant) -> ScheduledGainLaw:
        load = design_plant.case.loads[0]
        speeds = xp.abs(load.speed)[None] if self.speeds is None else self.speeds
        source = given_load(load, design_plant.case.run.gravity)
        if self.load_identification is not None:
            source = self.load_identification.identifier(plant, design_plant)

        return ScheduledGainLaw(
            to_numpy(_designs(self, plant, design_plant, speeds)),
            self.masses,
            speeds,
            plant.case.beam.length,
            xp.abs(load.speed),
            source,
            self.between == "nearest",
            design_plant.weights.shape[0],
        )

    def _position_schedule(self, plant: Plant, design_plant: Plant) -> PositionGainLaw:
        alone = with_single_mass(design_plant, plant.loads.trajectories[0].direction())
        speeds = self.speeds
        if speeds is None:
            speeds = xp.abs(design_plant.case.loads[0].speed)[None]

        designs = to_numpy(_designs(self, alone, alone, speeds))
        gravity = plant.case.run.gravity
        masses = xp.stack([xp.asarray(load.total_mass(gravity)) for load in plant.case.loads])
        return PositionGainLaw(designs, self.masses, speeds, masses, masses * gravity, plant.loads)

    def events(self, case: Case) -> Float[np.ndarray, " event"]:
        """Times (s) of entry and exit between which the table runs, ascending."""
        if self.entries == "predicted":
            case = eqx.tree_at(lambda c: c.loads, case, self.design_loads(case))
        return np.sort(np.ravel(crossing_times(case)))

    def breakpoints(self, case):
        """Times (s) of the design loads, and of jumps and boundary layers of a continuous gain.

        In continuous time the gain jumps at predicted entries and exits, and optimal gains have a
        boundary layer before each.
        """
        times = super().breakpoints(case)
        if self.period is not None or not self.varies:
            return times
        found, events = [] if times is None else [times], self.events(case)
        if self.entries == "predicted":
            found.append(events)
        if self.horizon == "crossing":
            intervals = np.diff(events[events < concrete(case.run.duration)])
            layers = intervals[:, None] * boundary_layer(self.points)
            found.append(np.ravel(events[1 : intervals.size + 1, None] - layers))
        return np.concatenate(found) if found else None

    def warn(self, system, case):
        warn_slow_sampling(system, float(concrete(self.period)), float(concrete(case.run.duration)))

    def validate(self, case):
        return (
            self._size_error(case)
            or self._option_error()
            or (self._sampling_error(case) if self.sampling == "exact" else None)
            or (self._crossing_error(case) if self.varies else None)
            or super().validate(case)
        )

    def _size_error(self, case: Case) -> str | None:
        """Error message of a list of the wrong length, or None."""
        states, commands = self.state_count(case), len(case.driven)
        sizes = dict.fromkeys(("state_weight", "feedback", "terminal_weight"), states)
        sizes |= dict.fromkeys(("command_weight", "input_rate_weight"), commands)
        for name, size in sizes.items():
            value = getattr(self, name)
            if value is not None and value.shape[0] != size:
                return f"{name} must have {counted(size, 'entry', 'entries')}, not {value.shape[0]}"
        for name, other in (("positions", "position_weight"), ("reference", "integral_weight")):
            pair = getattr(self, name), getattr(self, other)
            if (pair[0] is None) != (pair[1] is None):
                return f"{name} and {other} belong together; give both or neither"
            if pair[0] is not None and pair[0].shape != pair[1].shape:
                return f"{other} must have an entry for each of {pair[0].shape[0]} {name}"
        return None

    def _option_error(self) -> str | None:
        """Error message of a setting that is missing, or that others make useless, or None."""
        defaults = {field.name: field.default for field in dataclasses.fields(self)}
        for name, (option, words) in _NEEDED.items():
            value, word = getattr(self, name), getattr(self, option)
            is_default = value is None if defaults[name] is None else value == defaults[name]
            if not is_default and word not in words:
                return (
                    f"{name} has no effect with {option} = {word!r}: leave it out, or take"
                    f" {option} = {words[0]!r}"
                )
        if self.schedule != "time" and self.masses is None:
            return f"masses must be given with schedule = {self.schedule!r}"
        if (self.after == "fade") != (self.fade_time is not None):
            return "fade_time belongs to after = 'fade'; give both or neither"
        if self.schedule != "time" and self.entries == "predicted":
            return "entries must be 'measured': a schedule follows the loads, given or identified"
        for name in ("masses", "speeds"):
            values = getattr(self, name)
            if values is not None and (
                values.size == 0 or (is_concrete(values) and bool(np.any(concrete(values) <= 0)))
            ):
                return f"{name} must list at least one, and positive ones"
        return None

    def _sampling_error(self, case: Case) -> str | None:
        """Error of exact sampling and integral action."""
        if self.period is None:
            return (
                "period must be given: sampling = 'exact' is designed for commands held that long"
            )
        timed = self.delay is not None and is_concrete(self.delay) and is_concrete(self.period)
        if timed and concrete(self.delay) >= concrete(self.period):
            return "delay must be less than the period: the design allows for one pending command"
        if self.reference is None:
            return None
        outputs = self.reference.shape[0]
        if outputs > len(case.driven):
            return (
                "reference must have at most"
                f" {counted(len(case.driven), 'entry', 'entries')}, one for each actuator:"
                " so many deflections can be commanded"
            )
        sensors = case.sensors[:outputs]
        if len(sensors) < outputs or any(sensor.quantity != "deflection" for sensor in sensors):
            return (
                f"reference needs a sensor of deflection for each of {outputs} entries, before all"
                " other sensors"
            )
        return None

    def _crossing_error(self, case: Case) -> str | None:
        """Error of a design for loads that cross."""
        if not case.loads:
            return "horizon needs loads to be designed for; add one, or take horizon = 'infinite'"
        if self.horizon == "frozen":
            return self._undamped_error(case)
        scheduled = {"load": self._load_error, "positions": self._positions_error}
        error = scheduled[self.schedule](case) if self.schedule in scheduled else None
        if error is None and self.speeds is not None:
            error = self._interval_error(case, self.speeds[0])
        return error or self._interval_error(case)

    def _undamped_error(self, case: Case) -> str | None:
        for i, load in enumerate(self.design_loads(case)):
            numbers = jax.tree.leaves((load, case.run.gravity))
            if all(map(is_concrete, numbers)) and not _decays(load.vehicle(case.run.gravity)):
                return (
                    f"horizon needs vehicles with damping: loads.{i} has a motion without, for"
                    " which no stationary regulator exists off the beam; take horizon = 'crossing'"
                )
        return None

    def _load_error(self, case: Case) -> str | None:
        gravity = case.run.gravity
        if len(case.loads) != 1 or any(
            load.speed is None or load.total_mass(gravity) is None for load in case.loads
        ):
            return (
                "schedule needs a single load, with a mass and a speed; or take schedule = 'time'"
            )
        return identification_error(self, case)

    def _positions_error(self, case: Case) -> str | None:
        gravity = case.run.gravity
        if case.profile is not None:
            return "schedule is for beams without a profile; take schedule = 'load' or 'time'"
        for i, load in enumerate(case.loads):
            vehicle = load.vehicle(gravity)
            if load.total_mass(gravity) is None:
                return f"schedule needs loads with a mass; loads.{i} has none"
            if vehicle.names or vehicle.offsets.shape[0] != 1:
                return f"schedule needs loads of one wheel; loads.{i} has more: take 'time'"
        if case.loads[0].speed is None and self.speeds is None:
            return "speeds must be given where the first load has a table of positions"
        paths = [load.trajectory(case.beam.length) for load in case.loads]
        directions = [path.direction() for path in paths]
        if all(map(is_concrete, directions)) and len({float(concrete(x)) for x in directions}) > 1:
            return "schedule needs loads that all travel in one direction; take 'time'"
        return None

    def _interval_error(self, case: Case, slowest_speed=None) -> str | None:
        """Error if an interval is too long for the fastest mode, by the frequency for pinned ends.

        Loads cross at the speeds of the design, or at the `slowest_speed` (m/s) if that is given.
        """
        beam = case.beam
        loads = self.design_loads(case)
        speeds = [load.speed for load in loads] if slowest_speed is None else [slowest_speed]
        numbers = (beam.length, beam.bending_stiffness, beam.linear_density, *speeds)
        if not all(value is not None and is_concrete(value) for value in numbers):
            return None
        length, rigidity, density, *speeds = (float(concrete(value)) for value in numbers)
        modes = self.mode_count(case)
        fastest_frequency = (modes * math.pi / length) ** 2 * (rigidity / density) ** 0.5
        crossing_time = length / max(min(abs(speed) for speed in speeds), 1e-300)
        min_points = math.ceil(fastest_frequency * crossing_time / MAX_PHASE_PER_INTERVAL)
        if self.points >= min_points:
            return None
        return (
            f"points must be at least {min_points} for {modes} modes and a crossing of"
            f" {crossing_time:.3g} s: in an interval the phase of the fastest mode may advance by"
            f" at most {MAX_PHASE_PER_INTERVAL:g} rad"
        )


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


@compiled
def _gain_table(law: LQR, plant: Plant) -> GainTable:
    """Gains over the crossing, always compiled: in NumPy its loop takes longer than compilation."""
    if law.horizon == "frozen":
        return frozen_gains(plant, law.points, *law.weights(plant))
    return law.crossing_gains(plant)[0]


@compiled
def _designs(law: LQR, plant: Plant, design_plant: Plant, speeds) -> GainSchedule:
    """Schedules (mass, speed) of a design plant, for the times of entry and exit of the other."""

    def schedule(design):
        return law.gain_schedule(plant, design)

    return designs_of(schedule, design_plant, law.masses, speeds)
