"""Integration with unilateral contact: wheels lift where they would have to pull, fly, and land.

Between these events the set of wheels that press is fixed; steps are those of
`integrator.lifting_steps`. An event is the zero of a contact force (or of the compression
of a spring of contact), or of the gap between a wheel in flight and the surface. A step that has
one inside is cut there, by the state at its end. Landing, and where the velocity of the surface
jumps under a rigid wheel, impulses follow from the law of `jaxbeam.case.contact`. A surface that
rises at once, as at the end of a beam on springs, lifts a rigid wheel without an impulse.

Records of such runs have samples, peaks in continuous time, and the error.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.case.case import Case
from jaxbeam.case.contact import UnilateralContact
from jaxbeam.case.fields import concrete
from jaxbeam.case.sensors import Sensor
from jaxbeam.case.trajectory import NEVER
from jaxbeam.model.contact import ContactState, initial_vehicle_states, split_states
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.output_rows import sensor_history
from jaxbeam.model.sensor_signals import VehicleMotion, relative_to_beam
from jaxbeam.model.static_correction import Motion
from jaxbeam.simulation.integration_plan import IntegrationPlan
from jaxbeam.simulation.integrator.lifting_steps import (
    INSIDE,
    NODE_COUNT,
    NODES,
    POINTS,
    ContactLaw,
    Instants,
    Piece,
    Steps,
    advance,
    contact_law,
    instants,
    prepare,
)
from jaxbeam.simulation.integrator.peaks import (
    FORCE_FRACTIONS,
    FORCE_WEIGHTS,
    RunningPeaks,
    contact_minimum,
    initial_peaks,
    peaks_of_steps,
)
from jaxbeam.simulation.integrator.step_size import UNSAMPLED, rounding_deflection, trial_positions
from jaxbeam.simulation.integrator.time_grid import TimeGrid
from jaxbeam.simulation.section_forces import motion_of
from jaxbeam.simulation.views import Flights

ROUNDING = 1e-9  # of forces, gaps and velocities
LEAST = 1e-300
RATES = 1e2  # of the rounding of gaps times frequencies
EXACT = 1e-2  # of ROUNDING: value at an event
JUMP = 10.0  # of ROUNDING: a smaller one is none
SAME_TIME = 1e-12  # of the duration of a run
MAX_EVENTS = 500  # of one wheel within a share of the run: impacts that end take some hundred
EVENT_SHARE = 1e-2  # of the duration of a run
MAX_TRIALS = 40  # cuts of a step until it ends at an event
CHUNK_ENTRIES = 2**22  # of the largest array of the steps that are prepared together
_OF_POINTS = np.linalg.inv(POINTS[:, None] ** np.arange(POINTS.size))
SLOPE_AT_END = np.arange(POINTS.size) @ _OF_POINTS  # derivative at 1, of values at the points
OF_POINTS = FORCE_FRACTIONS[:, None] ** np.arange(POINTS.size) @ _OF_POINTS


class UnilateralRun(NamedTuple):
    """Integrated run: its pieces in order, the first piece of each step, and the flights.

    Steps are cut into pieces at events of contact. `last` is the state of beam and vehicles at the
    end, with the wheels in contact there.
    """

    pieces: list[Piece]
    first_piece: Int[np.ndarray, " step"]
    flights: Flights
    last: Piece
    law: ContactLaw


def run_unilateral(
    case: Case,
    model: ModalModel,
    loads: LoadSet,
    grid: TimeGrid,
    events: Float[np.ndarray, " time"],
) -> UnilateralRun:
    """Run of a case over the steps of a grid, cut at events of contact.

    `events` are the times (s) of load events, at which velocities may jump.

    Raises RuntimeError if a wheel leaves and lands too often in too short a time.
    """
    return _LiftingRun(case, model, loads).over(grid, events)


def law_of(case: Case, loads: LoadSet) -> ContactLaw:
    """Contact law of a case with unilateral contact."""
    assert isinstance(case.contact, UnilateralContact)
    return contact_law(loads, case.contact.spring())


class _LiftingRun:
    """State of a run while it is integrated: beam, vehicles, wheels in contact and in flight.

    And the pieces integrated so far.
    """

    def __init__(self, case: Case, model: ModalModel, loads: LoadSet):
        self.model, self.loads, self.law = model, loads, law_of(case, loads)
        self.count, self.duration = loads.wheel_count, float(concrete(case.run.duration))
        self.state, self.e = np.zeros(model.state_count), np.zeros(self.law.A.shape[0])
        start = initial_vehicle_states(loads)
        if start is not None:
            self.e[: start.shape[0]] = np.asarray(start)[:, 0]
        self.pressing = self.law.contact.copy()
        motion = loads.surface_motion(*loads.kinematics(np.zeros(())))
        if motion is not None:
            self.follow(np.asarray(motion[0]), np.asarray(motion[1]), self.law.contact)
        self.pieces: list[Piece] = []
        self.flying: dict[int, dict] = {}
        self.landed: list[dict] = []
        self.events: list[list[float]] = [[] for _ in range(self.count)]  # times (s), by wheel
        self.force_scale, self.gap_scale, self.rate_scale = self.scales(case)

    def scales(self, case: Case) -> tuple[float, float, float]:
        """Rounding errors of forces (N), gaps (m) and velocities (m/s)."""
        length = float(concrete(case.beam.length))
        weight = np.abs(np.asarray(self.loads.weight)[:, 0])
        stiffness = np.asarray(self.model.modes.stiffness)
        soft = np.where(stiffness > 0, stiffness, np.inf)
        shapes = np.asarray(self.model.shapes(length * np.linspace(0.0, 1.0, 33), (0,))[0])
        height = np.sum(weight) * np.max(np.sum(shapes**2 / soft, axis=1))
        times = np.linspace(0.0, self.duration, 257)
        position, speed, _ = map(np.asarray, self.loads.kinematics(times))
        if self.loads.profile is not None:
            height += np.ptp(np.asarray(self.loads.profile.heights(position)[0]))
        frequency = np.pi * np.max(np.abs(speed)) / length + np.sqrt(np.min(stiffness))
        gap = max(ROUNDING * float(height), LEAST)
        force = max(ROUNDING * float(np.max(weight)), LEAST)
        return force, gap, max(RATES * gap * float(frequency), LEAST)

    def over(self, grid: TimeGrid, events) -> UnilateralRun:
        """Integrate over the steps of a grid and return the run."""
        index = np.arange(int(grid.step_count))
        panel, start, kind = map(np.asarray, grid.locate_steps(index))
        length, on_beam = np.asarray(grid.lengths)[kind], np.asarray(grid.loads_on_beam)[panel]
        tolerance = SAME_TIME * self.duration
        nearest = np.min(np.abs(start[:, None] - np.asarray(events)), axis=1, initial=np.inf)
        moving = np.flatnonzero(length > tolerance)
        entries = (NODE_COUNT * self.count) * max(
            POINTS.size * self.model.state_count, NODE_COUNT * self.count
        )
        size, first_piece, former = max(1, CHUNK_ENTRIES // entries), np.zeros(index.size, int), -1
        for begin in range(0, moving.size, size):
            chunk = moving[begin : begin + size]
            steps = self.prepare(start[chunk], length[chunk], on_beam[chunk])
            for i, step in enumerate(chunk.tolist()):
                if nearest[step] <= tolerance:
                    self.jump(steps, i)
                first_piece[former + 1 : step + 1], former = len(self.pieces), step
                self.cross(steps, i)
        first_piece[former + 1 :] = len(self.pieces)
        last = self.pieces[-1]
        end = last._replace(
            start=last.start + last.length,
            pressing=self.pressing,
            states=self.state[None],
            heights=self.e[None],
        )
        return UnilateralRun(self.pieces, first_piece, self.flights(), end, self.law)

    def prepare(self, start, length, on_beam) -> Steps:
        """Step matrices for given starts and lengths (s), with the wheels `on_beam`."""
        return prepare(self.model, self.loads, self.law, start, length, on_beam)

    def follow(self, height, rate, wheels) -> None:
        """Set the heights and velocities of the `wheels` to those of the surface."""
        for index, value in ((self.law.height_index, height), (self.law.rate_index, rate)):
            own = wheels & (index >= 0)
            self.e[index[own]] = value[own]

    def cross(self, steps: Steps, i: int) -> None:
        """Integrate one step, cut at every event of contact inside."""
        end, on_beam = float(steps.start[i] + steps.length[i]), steps.at.on_beam[i, 0]
        while True:
            piece = advance(self.law, steps, i, self.pressing, self.state, self.e)
            event = self.first_event(piece, steps, i)
            if event is None:
                self.keep(piece, steps, i)
                return
            wheel, cut = event
            if cut is None:
                self.switch(wheel, steps, i, 0)
                continue
            part, until = cut
            self.keep(part, until, 0)
            self.switch(wheel, until, 0, -1)
            now = part.start + part.length
            if end - now <= SAME_TIME * self.duration:
                return
            steps, i = self.prepare(np.array([now]), np.array([end - now]), on_beam[None]), 0

    def keep(self, piece: Piece, steps: Steps, i: int) -> None:
        """Append a piece and take over its final state; wheels in contact are on the surface."""
        self.pieces.append(piece)
        self.state, self.e = piece.states[-1].copy(), piece.heights[-1].copy()
        for wheel, flight in self.flying.items():
            if piece.on_beam[wheel]:
                flight["gap"] = max(flight["gap"], float(np.max(OF_POINTS @ piece.gap[wheel])))
        height, rate = self.surface(steps, i, -1)
        self.follow(height, rate, self.pressing & ~self.law.sprung)

    def surface(self, steps: Steps, i: int, point: int) -> Float[np.ndarray, "2 wheel"]:
        """Heights (m) and velocities (m/s) of the surface under the wheels at an end of a step."""
        return steps.at.rows[i, point, :2] @ self.state + steps.at.profile[i, point, :2]

    def first_event(self, piece: Piece, steps: Steps, i: int):
        """First wheel that lifts or lands in a step, and the piece until then with its steps.

        The piece is None for an event at the start; None in all without an event.
        """
        by_force = piece.pressing & ~self.law.sprung
        sign = np.where(piece.pressing, -1.0, 1.0)[:, None] / self.gap_scale
        values = sign * piece.gap @ OF_POINTS.T
        values[by_force] = piece.force[by_force] @ FORCE_WEIGHTS.T / self.force_scale
        below = (values < -1.0) & (self.law.contact & ~self.law.held)[:, None]
        for fraction in np.flatnonzero(below.any(axis=0)):
            found = []
            for wheel in np.flatnonzero(below[:, fraction]).tolist():
                # At the start the states give the value, more exactly than extrapolation.
                if fraction <= 1 and self.event_function(piece, steps, i, 0, wheel) < -1.0:
                    return wheel, None
                if fraction:
                    ends = FORCE_FRACTIONS[fraction - 1], FORCE_FRACTIONS[fraction]
                    cut = self.cut(piece, wheel, ends, values[wheel, fraction - 1 : fraction + 1])
                    found += [] if cut is None else [(wheel, cut)]
            if found:
                wheel, cut = min(found, key=lambda one: one[1][0].length)
                return wheel, cut if cut[0].length > SAME_TIME * self.duration else None
        return None

    def event_function(self, piece: Piece, steps: Steps, i: int, point: int, wheel: int) -> float:
        """Scaled contact force or gap of a wheel at an end of a piece: positive until its event."""
        gap = float(piece.gap[wheel, point]) / self.gap_scale
        if not piece.pressing[wheel]:
            return gap
        if self.law.sprung[wheel]:
            return -gap
        at = Instants(*(part[i, point] for part in steps.at))
        parts = piece.pressing, piece.states[point], piece.heights[point]
        return float(at.forces(self.law, *parts)[wheel]) / self.force_scale

    def cut(self, piece: Piece, wheel: int, ends, near):
        """The piece until a wheel's event between two fractions of it, with its steps.

        `near` are estimates of the event function at these `ends`; None if there is no event. A
        zero from which the function rises, as that at the start of a flight, is none.
        """

        def until(fraction):
            length = np.array([fraction * piece.length])
            steps = self.prepare(np.array([piece.start]), length, piece.on_beam[None])
            part = advance(self.law, steps, 0, piece.pressing, self.state, self.e)
            return (part, steps), self.event_function(part, steps, 0, -1, wheel)

        low, high = ends
        best, value = until(high)
        if value > -EXACT:
            return None
        slope = (near[1] - near[0]) / (high - low)
        fraction = low + (high - low) * np.clip(near[0] / (near[0] - near[1]), 0.0, 1.0)
        for _ in range(MAX_TRIALS):
            if not low < fraction < high:
                fraction = (low + high) / 2
            trial, value = until(fraction)
            rises = value > self.event_function(*trial, 0, 0, wheel)
            if abs(value) <= EXACT and not rises:
                return trial
            if value > 0 or (rises and value > -EXACT):
                low = fraction
            else:
                high, best = fraction, trial
            if (high - low) * piece.length <= SAME_TIME * self.duration:
                break
            fraction = fraction - value / slope if abs(value) > EXACT else low
        return best

    def switch(self, wheel: int, steps: Steps, i: int, point: int) -> None:
        """Change a wheel from contact to flight, or back, at an end of a step.

        Raises RuntimeError if events follow each other too fast.
        """
        time, position = self.place(wheel, steps, i, point)
        events, share = self.events[wheel], EVENT_SHARE * self.duration
        events.append(time)
        if len(events) > MAX_EVENTS and time - events[-1 - MAX_EVENTS] < share:
            raise RuntimeError(
                f"wheel {wheel} leaves and lands more than {MAX_EVENTS} times within {share:.3g} s,"
                f" until {time:.6g} s, at {position:.6g} m: keep fewer modes (beam.modes), or give"
                " the contact a spring (contact.hertz_stiffness)"
            )
        if self.pressing[wheel]:
            self.lift(wheel, steps, i, point)
            return
        law, (height, rate) = self.law, self.surface(steps, i, point)
        self.pressing[wheel], flight = True, self.flying.pop(wheel)  # an impact may lift it anew
        landing = {"landing_time": time, "landing_position": position}
        if law.rigid[wheel]:
            self.e[law.height_index[wheel]] = height[wheel]
            landing["approach_speed"] = rate[wheel] - self.e[law.rate_index[wheel]]
            landing["impulse"] = self.impact(steps, i, point)[wheel]
        else:
            self.follow(height, rate, (np.arange(self.count) == wheel) & law.tyre)
            last = self.pieces[-1]
            landing["approach_speed"] = -float(SLOPE_AT_END @ last.gap[wheel]) / last.length
            landing["impulse"] = 0.0
        self.landed.append(flight | landing)

    def lift(self, wheel: int, steps: Steps, i: int, point: int) -> None:
        """Change a wheel from contact to flight at an end of a step."""
        time, position = self.place(wheel, steps, i, point)
        self.pressing[wheel] = False
        names = [field.name for field in dataclasses.fields(Flights)]
        lift = {"wheel": wheel, "lift_time": time, "lift_position": position, "gap": 0.0}
        self.flying[wheel] = dict.fromkeys(names, np.nan) | lift

    def place(self, wheel: int, steps: Steps, i: int, point: int) -> tuple[float, float]:
        """Time (s) of an end of a step, and position (m) of a wheel."""
        time = float(steps.start[i] + (steps.length[i] if point else 0.0))
        return time, float(np.asarray(self.loads.kinematics(np.asarray(time))[0])[wheel])

    def jump(self, steps: Steps, i: int) -> None:
        """Contact after a jump of the surface, in height or velocity, at the start of a step."""
        law, (height, rate) = self.law, self.surface(steps, i, 0)
        rigid = np.flatnonzero(law.rigid & ~law.held)
        gap = self.e[law.height_index[rigid]] - height[rigid]
        for wheel in rigid[(gap > JUMP * self.gap_scale) & self.pressing[rigid]].tolist():
            self.lift(wheel, steps, i, 0)
        for wheel in rigid[gap < -JUMP * self.gap_scale].tolist():
            self.e[law.height_index[wheel]] = height[wheel]
            if not self.pressing[wheel]:
                self.switch(wheel, steps, i, 0)
        rigid = rigid[self.pressing[rigid]]
        if np.any(np.abs(self.e[law.rate_index[rigid]] - rate[rigid]) > self.rate_scale):
            self.impact(steps, i, 0)

    def impact(self, steps: Steps, i: int, point: int) -> Float[np.ndarray, " wheel"]:
        """Impulses (N s) of an inelastic impact of the rigid wheels that touch the surface.

        They change the velocities of wheels and beam. Wheels that rise without an impulse lift, but
        for those that would rise by less than the rounding of gaps: these are held on the surface.
        Holding may pull, by as much as the weight would give in the flight that is left out.
        """
        law, at = self.law, Instants(*(part[i, point] for part in steps.at))
        index, impulses = np.flatnonzero(law.rigid & self.pressing), np.zeros(self.count)
        shape, rates, held = at.shape[index], law.rate_index[index], law.held[index]
        mobility = np.diag(1 / law.mass[index]) + shape @ shape.T
        inertia = np.diag(np.linalg.inv(mobility))  # of one wheel while the others press
        while True:
            relative = self.e[rates] - self.surface(steps, i, point)[1, index]
            found = impulses_of(mobility, relative, held)
            self.e[rates] += found / law.mass[index]
            self.state[self.model.rate_index] -= shape.T @ found
            impulses[index] += found
            after = relative + mobility @ found
            rising = (after > self.rate_scale) & ~held
            force = at.forces(law, self.pressing, self.state, self.e)[index]
            low = rising & (inertia * after**2 / 2 < force * self.gap_scale)
            if not low.any():
                break
            held = held | low
        for wheel in index[rising].tolist():
            self.lift(wheel, steps, i, point)
        return impulses

    def flights(self) -> Flights:
        """Flights that are in part over the beam, in the order in which they begin."""
        windows, found = np.asarray(self.loads.entry_exit_times()), []
        for flight in [*self.landed, *self.flying.values()]:
            entry, leave = windows[flight["wheel"]]
            end = np.fmin(flight["landing_time"], self.duration)
            over = min(end, leave) - max(flight["lift_time"], entry)
            if over > SAME_TIME * self.duration and flight["gap"] > self.gap_scale:
                found.append(flight)
        found.sort(key=lambda flight: (flight["lift_time"], flight["wheel"]))
        names = [field.name for field in dataclasses.fields(Flights)]
        columns = {name: np.array([flight[name] for flight in found], float) for name in names}
        return Flights(**columns | {"wheel": columns["wheel"].astype(int)})


def impulses_of(
    mobility: Float[np.ndarray, "wheel wheel"],
    relative: Float[np.ndarray, " wheel"],
    held: Bool[np.ndarray, " wheel"],
) -> Float[np.ndarray, " wheel"]:
    """Impulses p (N s) of an impact: relative + mobility p >= 0, p >= 0, one of both zero.

    `relative` are the velocities (m/s) of wheels away from the surface, `mobility` is in 1/kg. For
    `held` wheels relative + mobility p = 0.
    """
    from scipy.optimize import nnls  # late: it takes long to import

    free, fixed = np.flatnonzero(~held), np.flatnonzero(held)
    coupling, found = mobility[np.ix_(free, fixed)], np.zeros(relative.size)
    of_fixed = np.linalg.solve(
        mobility[np.ix_(fixed, fixed)], np.column_stack([coupling.T, relative[fixed]])
    )
    if free.size:
        reduced = mobility[np.ix_(free, free)] - coupling @ of_fixed[:, :-1]
        factor = np.linalg.cholesky(reduced)
        right = relative[free] - coupling @ of_fixed[:, -1]
        found[free] = nnls(factor.T, -np.linalg.solve(factor, right))[0]
    found[fixed] = -of_fixed[:, -1] - of_fixed[:, :-1] @ found[free]
    return found


LARGEST_STEP_NORM = 2.0  # of the matrix of heights and vehicles, times a step
MAX_HALVINGS = 8  # of steps until runs agree
NO_LANDING = (
    "no time step makes runs with unilateral contact agree to {:g}, as landings follow each other"
    " too fast: keep fewer modes (beam.modes), give the contact a spring (contact.hertz_stiffness),"
    " or a larger tolerance"
)


def with_short_steps(case: Case, plan: IntegrationPlan, times) -> IntegrationPlan:
    """The plan with steps short enough for wheels in flight and contact springs too."""
    steps = np.max(np.diff(times)) * law_of(case, load_set(case)).norm() / LARGEST_STEP_NORM
    return dataclasses.replace(plan, substeps=max(plan.substeps, int(np.ceil(steps))))


def change_of_runs(case: Case, model: ModalModel, coarse: Motion, fine: Motion) -> np.ndarray:
    """Error of a run, its change as steps are halved: of the deflection, then of each sensor."""
    shapes = np.asarray(model.modes.shapes(trial_positions(case)))
    least, both = rounding_deflection(case, model, load_set(case)), (coarse, fine)
    pairs = [
        [np.asarray(motion.coordinates) @ shapes.T for motion in both],
        *(
            [np.asarray(sensor_history(case, model.modes, motion, one)) for motion in both]
            for one in case.sensors
        ),
    ]
    errors = []
    for i, (former, present) in enumerate(pairs):
        largest = max(float(np.max(np.abs(present))), 0.0 if i else least)
        change = UNSAMPLED * float(np.max(np.abs(present - former)))
        errors.append(change / largest if largest else 0.0)
    return np.array(errors)


def _accelerations(model: ModalModel, at: Instants, states, force) -> np.ndarray:
    """Second derivatives (time, mode) of coordinates under contact forces (time, wheel) in N."""
    blocks, side, _ = model.state_matrix.shape
    rates = (model.state_matrix @ states.reshape(-1, blocks, side, 1)).reshape(states.shape)
    return rates[:, model.rate_index] - np.einsum("twm,tw->tm", at.shape, force)


def motion_at_samples(
    case: Case,
    model: ModalModel,
    loads: LoadSet,
    run: UnilateralRun,
    times: Float[np.ndarray, " time"],
    sample_steps: Int[np.ndarray, " time"],
) -> tuple[Motion, VehicleMotion]:
    """Motion of beam and vehicles at samples (s), which are at the starts of some steps."""
    pieces, law = [*run.pieces, run.last], run.law
    own = [pieces[i] for i in np.append(run.first_piece, len(run.pieces))[sample_steps]]
    pressing, states, heights = (
        np.stack(part)
        for part in zip(*((p.pressing, p.states[0], p.heights[0]) for p in own), strict=True)
    )
    on_beam = np.asarray(loads.on_beam(times)).T
    at = instants(model, loads, times, on_beam)
    force = at.forces(law, pressing, states, heights)
    return _motion(case, model, loads, law, at, times, on_beam, states, heights, force)


def _motion(
    case: Case, model: ModalModel, loads: LoadSet, law, at, times, on_beam, states, heights, force
) -> tuple[Motion, VehicleMotion]:
    """Motion of beam and vehicles at times (s), under contact forces (time, wheel) in N."""
    excess = np.where(law.contact, force, 0.0) - at.weight
    vehicles = loads.vehicle_states
    rates = (heights @ law.A.T + excess @ law.B.T)[:, :vehicles, None]
    of_groups = zip(loads.wheels.vehicles, split_states(0, loads, rates)[1], strict=True)
    contact = ContactState(
        -np.where(on_beam | loads.on_ground, force, 0.0)[..., None],
        _accelerations(model, at, states, force)[..., None],
        tuple(rate[..., group.A.shape[0] // 2 :, :] for group, rate in of_groups),
    )
    states = np.concatenate([states, heights[:, :vehicles]], axis=1)
    return motion_of(case, model, loads, times, states[..., None], contact)


def peaks_of_run(
    case: Case, model: ModalModel, loads: LoadSet, run: UnilateralRun, sensors: Sequence[Sensor]
) -> RunningPeaks:
    """Peaks of what sensors measure, upwards, then downwards, and the contact forces of a run.

    The last of the sensors are at the absorbers, twice, in whose place peaks are those of strokes
    (m) and then of forces (N).
    """
    pieces: dict[str, Any] = {
        name: np.stack([getattr(piece, name) for piece in run.pieces])
        for name in ("start", "length", "on_beam", "pressing", "force", "states", "heights")
    }
    start, length, on_beam = (pieces[name] for name in ("start", "length", "on_beam"))
    count, wheels = on_beam.shape
    times = (start[:, None] + length[:, None] * INSIDE).reshape(-1)
    states, heights = (pieces[name].reshape(times.size, -1) for name in ("states", "heights"))
    here, pressing = (
        np.repeat(pieces[name], POINTS.size, axis=0) for name in ("on_beam", "pressing")
    )
    at = instants(model, loads, times, here)
    force = at.forces(run.law, pressing, states, heights).reshape(count, POINTS.size, wheels)
    force[:, NODES] = np.swapaxes(pieces["force"], 1, 2)
    force = np.where(on_beam[:, None], force, 0.0)
    force = force.reshape(times.size, wheels)
    parts = [
        states[:, model.coordinate_index],
        states[:, model.rate_index],
        _accelerations(model, at, states, force),
    ]
    if model.mode_map is not None:
        parts = [part @ np.asarray(model.mode_map).T for part in parts]
    coordinates, rates, accelerations = parts
    position = np.where(here, np.asarray(loads.kinematics(times)[0]).T, np.nan)
    commands = np.zeros((times.size, len(case.actuators)))
    motion = Motion(coordinates, rates, accelerations, position, force, commands)
    peaks = initial_peaks(2 * len(sensors), wheels, 1, lambda value: value)
    if sensors:
        values = [np.asarray(sensor_history(case, model.modes, motion, one)) for one in sensors]
        if absorbers := len(case.absorbers):
            at_points = at, times, here, states, heights, force
            _, vehicles = _motion(case, model, loads, run.law, *at_points)
            stroke = relative_to_beam(case, model.modes, vehicles.body_displacement, coordinates)
            values[-2 * absorbers :] = [*np.asarray(stroke).T, *force[:, -absorbers:].T]
        samples = np.stack([*values, *(-value for value in values)], axis=1)
        samples = samples.reshape(count, POINTS.size, -1, 1)
        peaks = peaks_of_steps(peaks, samples, start, length)
    downwards, is_load = -pieces["force"].reshape(count, -1, 1), on_beam[..., None] * np.eye(wheels)
    start_of_contact = peaks.lowest_contact_force, peaks.contact_lost_time
    lowest = contact_minimum(*start_of_contact, downwards, is_load > 0, start, length)[0][:, 0]
    lowest = np.where(run.law.contact & ~loads.fixed, np.maximum(lowest, 0.0), lowest)
    lost = np.full(wheels, NEVER)
    np.minimum.at(lost, run.flights.wheel, run.flights.lift_time)
    return peaks.with_contact(lowest[:, None], lost[:, None])
