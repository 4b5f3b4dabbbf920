"""One case to one record."""

import dataclasses
import warnings
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbeam.case.case import Case
from jaxbeam.case.fields import is_known, known
from jaxbeam.integrator.events import sampled
from jaxbeam.integrator.input_policy import AbstractDriver
from jaxbeam.integrator.integrate import trace
from jaxbeam.integrator.propagators import NODES, at_ends
from jaxbeam.integrator.running_peaks import Found
from jaxbeam.integrator.step_matrices import Rigging, make_rigging
from jaxbeam.integrator.time_grid import scheduled_grid
from jaxbeam.model.contact import Traffic, at_instant, traffic
from jaxbeam.model.measurement import measure
from jaxbeam.model.modal_model import Rig, rig
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.closed_loop import make_loop
from jaxbeam.simulation.integration_plan import TOLERANCE, Plan, make_plan, sample_times
from jaxbeam.simulation.record import Record


class ContactLossWarning(UserWarning):
    """A load would have to pull on the beam to stay on it, and in the model it does."""


def simulate(
    case: Case,
    times: Float[Array, " time"] | None = None,
    plan: Plan | None = None,
    tolerance: float = TOLERANCE,
) -> Record:
    """Simulate a case: the beam at rest at t = 0, then crossed by the loads.

    q'' + D q' + K q = sum of shapes(x_a) r_a, with r_a the contact forces (see `dynamics`),
    integrated to `tolerance` (relative to the largest deflection) by exponential collocation.
    Samples are at the run's own rate or at the given ascending `times` (s); they do not depend on
    the time step. Differentiable in every number of the case, forward and in reverse. Inside
    `jit` or `vmap`, give the `plan` made outside by `jaxbeam.simulation.integration_plan.make_plan`.

    Raises ValueError for a faulty case or times, RuntimeError if no time step meets the
    tolerance; warns (ContactLossWarning) if a load would have to pull on the beam.
    """
    if times is not None:
        _check_times(times)
    if plan is None:
        plan = make_plan(case, times, tolerance)
    times = sample_times(case) if times is None else jnp.asarray(times, float)
    # Plans that differ in their error alone share what is compiled.
    record = _record(case, dataclasses.replace(plan, error=0.0), times, jnp.asarray(plan.error))
    if is_known(record.contact_lost_time):
        lost = np.isfinite(known(record.contact_lost_time))
        if lost.any() and np.isnan(known(record.diverged_time)):
            warnings.warn(record.verdict, ContactLossWarning, stacklevel=2)
    return record


def _check_times(times) -> None:
    if not is_known(times):
        return
    times = known(times)
    if times.ndim != 1 or times.size < 2:
        raise ValueError(
            f"times must be a list of at least two numbers, not of shape {times.shape}"
        )
    if not np.all(np.isfinite(times)) or not np.all(np.diff(times) > 0):
        raise ValueError("times must be finite and ascend, in s from the start of the run")


@compiled
def _record(case: Case, plan: Plan, times, error) -> Record:
    best, outputs, found, count = _trace(case, plan, times, case.sensor_places)
    coordinates, rates, accelerations, position, force, commands, shown, failures = outputs
    if commands is None:
        commands = jnp.zeros((times.shape[0], len(case.actuators)))
    if failures is None:
        failures = jnp.zeros(times.shape)
    found_peaks = Found(*(part[0] for part in best.found()))
    loads, lost = traffic(case), found_peaks.contact_lost_time
    lost_position = jnp.array(
        [path.travel(time)[0] for path, time in zip(loads.motions, lost, strict=True)]
    ).reshape(-1)
    return Record(
        case=case,
        modes=found,
        times=times,
        coordinates=coordinates,
        rates=rates,
        accelerations=accelerations,
        load_position=position,
        contact_force=force,
        command=commands,
        failures=failures,
        shown=shown,
        **found_peaks._asdict(),
        contact_lost_position=lost_position,
        error_estimate=error,
        steps=count,
    )


def readings(case: Case, times: Float[Array, " time"], plan: Plan) -> Float[Array, "time sensor"]:
    """What the sensors read at ascending times (s), and nothing else: `Record.measured`.

    Without noise, which is not known of a log, neither in the readings nor in what a controller
    sees of them. Lean in compiling and differentiating, for fits; see `simulate`, which checks and
    warns.
    """
    _, outputs, found, _ = _trace(case, plan, times, None, noisy=False)
    coordinates, rates, accelerations, *_, shown, _ = outputs
    if shown is not None:
        return shown
    return measure(case, found, coordinates, rates, accelerations, times)


class Histories(NamedTuple):
    """Deflection (m) at some places, commands, and contact forces (N) of a run, at sample times."""

    deflection: Float[Array, "time place"]
    command: Float[Array, "time actuator"]
    contact_force: Float[Array, "time load"]


def histories(
    case: Case, times: Float[Array, " time"], plan: Plan, places: Float[Array, " place"]
) -> Histories:
    """Histories at ascending times (s) and places (m), and nothing else; as `readings`, lean."""
    _, outputs, found, _ = _trace(case, plan, times, None)
    coordinates, _, _, _, force, commands, *_ = outputs
    if commands is None:
        commands = jnp.zeros((times.shape[0], len(case.actuators)))
    return Histories(coordinates @ found.shapes(places).T, commands, force)


class Prepared(NamedTuple):
    """All that an integration needs: a rig on its grid, its loads, and what drives it, if any.

    `edges` are the steps with which the samples begin, `count` is how many steps there are.
    """

    rigging: Rigging
    loads: Traffic
    driver: AbstractDriver | None
    edges: Int[Array, " time"]
    count: int


def prepare(case: Case, plan: Plan, times, watched, noisy: bool = True) -> Prepared:
    """A case made ready to be integrated as planned, watching deflections at some places (m)."""
    loads, layout = traffic(case), plan.form.layout
    if case.controller is None:
        assembled, driver = rig(case, layout, plan.form.coupled), None
        # From rest at the start to the first sample in steps like those between samples.
        spacing = (times[-1] - times[0]) / (times.shape[0] - 1)
        lead = times[0] - spacing * jnp.arange(plan.lead, 0, -1)
        schedule = sampled(jnp.concatenate([lead, times]), plan.even, plan.lead)
    else:
        schedule = plan.schedule
        driver = make_loop(case, layout, loads, schedule)
        if not noisy:
            driver = dataclasses.replace(driver, noise=None)
        assembled = driver.rig
    grid = scheduled_grid(case, assembled, schedule, plan.substeps)
    rigging = make_rigging(assembled, grid, watched, driver)
    edges = plan.substeps * grid.place[schedule.samples]
    return Prepared(rigging, loads, driver, edges, grid.counts.shape[0] * plan.substeps)


def _trace(case: Case, plan: Plan, times, watched, noisy=True):
    """Extremes, outputs at the sample times, modes, and the number of steps."""
    rigging, loads, driver, edges, count = prepare(case, plan, times, watched, noisy)
    assembled = rigging.rig
    best, states, commands, shown, _ = trace(
        rigging, loads, slots=plan.form.slots, steps=count, driver=driver
    )
    states = states[edges]
    shown, failures = (None, None) if shown is None else (part[edges, ..., 0] for part in shown)
    if driver is not None:
        # A law at every instant is asked itself: its polynomials are less exact at their ends.
        commands = (
            driver.at_instants(states[..., 0], times)
            if driver.inner
            else _begin(case, commands, edges)
        )
    *motion, commands = _outputs(assembled, loads, times, states, commands)
    if commands is not None:
        commands = commands[:, : len(case.actuators)]
    return best, (*motion, commands, shown, failures), assembled.modes, count


def _begin(case: Case, commands, edges):
    """Commands (time, actuator) with which the steps at some edges begin, as they took effect."""
    histories = commands[..., 0].reshape(commands.shape[0], NODES, -1)
    begun = jnp.tensordot(histories, at_ends()[:, 0], axes=[1, 0])[edges]
    limits = [actuator.command_limits() for actuator in case.actuators]
    low = jnp.array([-jnp.inf if pair is None else pair[0] for pair in limits])
    high = jnp.array([jnp.inf if pair is None else pair[1] for pair in limits])
    return jnp.clip(begun, low, high)


def _outputs(rig: Rig, loads: Traffic, times, states, commands):
    """Modal coordinates, rates and accelerations, loads' places and contact forces, commands."""

    def instant(time, state, command):
        column = None if command is None else command[:, None]
        force, pushed = at_instant(rig, loads, time, state, column)
        return force[:, 0], pushed[:, 0]

    force, pushed = jax.vmap(instant)(times, states, commands)
    size = 2 * pushed.shape[1]
    modal = (states[:, 0:size:2, 0], states[:, 1:size:2, 0], pushed)
    if rig.mixing is not None:
        modal = tuple(part @ rig.mixing.T for part in modal)
    position = loads.travel(times)[0].T
    return *modal, jnp.where(loads.on_beam(times).T, position, jnp.nan), -force, commands
