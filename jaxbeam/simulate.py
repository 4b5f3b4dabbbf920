"""One case to one record."""

import dataclasses
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case import Case
from jaxbeam.dynamics import Traffic, contact_rows, traffic
from jaxbeam.fields import is_known, known
from jaxbeam.grid import sampled_grid
from jaxbeam.integrate import trace
from jaxbeam.plan import TOLERANCE, Plan, make_plan, sample_times
from jaxbeam.record import Record, measure, never_as_nan
from jaxbeam.rig import Rig, rig


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
    `jit` or `vmap`, give the `plan` made outside by `jaxbeam.plan.make_plan`.

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
        if lost.any():
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


@eqx.filter_jit
def _record(case: Case, plan: Plan, times, error) -> Record:
    watched = jnp.array([sensor.position for sensor in case.sensors]).reshape(-1)
    best, (coordinates, rates, accelerations, position, force), found, count = _trace(
        case, plan, times, watched
    )
    peaks, peak_times = best.peak()
    loads = traffic(case)
    lost = never_as_nan(best.lost[:, 0])
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
        peak_deflection=peaks[:, 0],
        peak_time=peak_times[:, 0],
        lowest_contact_force=best.lowest[:, 0],
        contact_lost_time=lost,
        contact_lost_position=lost_position,
        error_estimate=error,
        steps=count,
    )


def readings(case: Case, times: Float[Array, " time"], plan: Plan) -> Float[Array, "time sensor"]:
    """What the sensors read at ascending times (s), and nothing else: `Record.measured`.

    Lean in compiling and differentiating, for fits; see `simulate`, which checks and warns.
    """
    _, (coordinates, rates, accelerations, _, _), found, _ = _trace(case, plan, times, None)
    return measure(case, found, coordinates, rates, accelerations)


def _trace(case: Case, plan: Plan, times, watched):
    """Extremes, outputs at the sample times, modes, and the number of steps."""
    assembled = rig(case, plan.form.layout, plan.form.coupled)
    loads = traffic(case)
    # From rest at the start to the first sample in steps like those between samples.
    spacing = (times[-1] - times[0]) / (times.shape[0] - 1)
    lead = times[0] - spacing * jnp.arange(plan.lead, 0, -1)
    grid, where = sampled_grid(
        case, assembled, jnp.concatenate([lead, times]), plan.substeps, plan.even
    )
    count = grid.counts.shape[0] * plan.substeps
    best, states = trace(assembled, loads, grid, watched, slots=plan.form.slots, steps=count)
    samples = states[:: plan.substeps][where[plan.lead :]][:, :, 0]
    return best, _outputs(assembled, loads, grid.windows, times, samples), assembled.modes, count


def _outputs(rig: Rig, loads: Traffic, windows, times, states):
    """Modal coordinates, rates and accelerations, and the loads' places and contact forces."""
    position, speed, acceleration = (part.T for part in loads.travel(times))
    after = times[:, None]
    active = (windows[:, 0] <= after) & (after < windows[:, 1])
    shape, rows = contact_rows(rig, position, speed, acceleration, active)
    blocks, side, _ = rig.state_matrix.shape
    split = states.reshape(-1, blocks, side)
    mass = jnp.where(active, loads.inertia[:, 0], 0.0)
    weight = jnp.where(active, loads.weight[:, 0], 0.0)
    # The contact law at one instant: (1 + m S S') r = -W - m (contact row) . z.
    drive = weight + mass * jnp.einsum("tlbi,tbi->tl", rows, split)
    shape = jax.lax.collapse(shape, 2)
    matrix = jnp.eye(len(loads.motions)) + mass[:, :, None] * (shape @ shape.mT)
    force = -jnp.linalg.solve(matrix, drive[..., None])[..., 0]
    size = 2 * shape.shape[-1]
    drift = jnp.einsum("bij,tbj->tbi", rig.state_matrix, split).reshape(states.shape)
    pushed = drift[:, 1:size:2] + jnp.einsum("tl,tlm->tm", force, shape)
    modal = (states[:, 0:size:2], states[:, 1:size:2], pushed)
    if rig.mixing is not None:
        modal = tuple(part @ rig.mixing.T for part in modal)
    return *modal, jnp.where(active, position, jnp.nan), -force
