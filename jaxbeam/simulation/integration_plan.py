"""What must be decided before a run is compiled: shapes, orders and step lengths.

Decisions are made from known numbers, in plain Python, and handed on as static data; the compiled
code then works for any numbers for which the decisions hold.
"""

import dataclasses
import functools
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.case import Case, known_case
from jaxbeam.case.fields import known
from jaxbeam.case.loads import motion
from jaxbeam.case.validation import check
from jaxbeam.integrator.events import Schedule
from jaxbeam.integrator.integrate import at_edges, longest_step, march
from jaxbeam.integrator.running_peaks import Extremes
from jaxbeam.integrator.step_matrices import make_rigging
from jaxbeam.integrator.time_grid import even_grid, scheduled_grid
from jaxbeam.model.contact import Traffic, traffic
from jaxbeam.model.modal_model import couples, rig
from jaxbeam.model.modes import Layout, lay_out
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.closed_loop import loop_schedule, make_loop

TOLERANCE = 1e-7  # relative to the largest deflection
MOST = 10**8  # samples or time steps of a run: more would fill any memory, or take days
MOST_BETWEEN = 10**5  # time steps from one sample of a controlled run to the next
HOPELESS = 6  # halvings of a step after which a run that still overflows is given up
EVEN = 1e-6  # of the spacing: more even samples are taken for equally spaced
PROBES = (0.13, 0.29, 0.47, 0.62, 0.88)  # of the length: where errors are looked for


@dataclasses.dataclass(frozen=True)
class Form:
    """What decides array shapes: order of the supports, coupling, loads on the beam at once.

    And whether steps without a driver are those written by hand, see `native`.
    """

    layout: Layout
    coupled: bool
    slots: int
    by_hand: bool = False


def form(case: Case) -> Form:
    """The form of a case, from the numbers known now (not inside `jit`)."""
    case = known_case(case)
    layout = lay_out(case)
    _, repeated, windows = _survey(case, layout)
    return Form(layout, couples(case) or bool(repeated), most_at_once(np.asarray(windows)))


@compiled
def _survey(case: Case, layout: Layout):
    """Longest step (s), whether modes are repeated, and when loads enter and leave."""
    assembled = rig(case, layout)
    paths = [motion(load, case.beam.length) for load in case.loads]
    windows = jnp.array([path.window() for path in paths]).reshape(-1, 2)
    return longest_step(assembled, case.loads), assembled.modes.repeated, windows


def most_at_once(windows: np.ndarray) -> int:
    """How many loads are on the beam at once, at most; at least one if there are any."""
    entries, exits = windows.T
    # The count only rises when a load enters.
    on = (entries[None, :] <= entries[:, None]) & (entries[:, None] < exits[None, :])
    return max(min(1, entries.size), int(np.max(on.sum(axis=1), initial=0)))


def run_extremes(
    case: Case,
    form: Form,
    longest: Float[Array, ""],
    watched: Float[Array, " sensor"],
    lanes: Traffic | None = None,
) -> Extremes:
    """Peaks and contact forces of a run, with steps no longer than `longest` (s).

    `lanes` gives the loads of several runs that differ in nothing else; without, the case's own.
    """
    assembled = rig(case, form.layout, form.coupled)
    grid = even_grid(case, assembled, longest)
    loads = traffic(case) if lanes is None else lanes
    return march(make_rigging(assembled, grid, watched), loads, slots=form.slots)[0]


class Plan(eqx.Module):
    """How a case is to be run: its form, steps from sample to sample, and their error.

    Holds for cases that differ in numbers only, as long as these change neither the order of
    supports and loads nor the frequencies much; make a new one otherwise. `lead` samples are
    added before the first one asked for, back to the start of the run. With a controller the
    `schedule` holds its clock and the samples, which are part of the plan then.
    """

    form: Form = eqx.field(static=True)
    substeps: int = eqx.field(static=True)
    lead: int = eqx.field(static=True)
    even: bool = eqx.field(static=True)
    error: float = eqx.field(static=True)
    schedule: Schedule | None = None


def make_plan(
    case: Case, times: Float[Array, " time"] | None = None, tolerance: float = TOLERANCE
) -> Plan:
    """Choose form and time steps for a case, from the numbers known now.

    `times` (s) are those of the wanted samples, the run's own if left out; `tolerance` is the
    error allowed, relative to the largest deflection. Raises ValueError for a faulty case, and
    RuntimeError if no time step meets the tolerance.
    """
    check(case)
    case = known_case(case)
    shape = form(case)
    samples = np.asarray(sample_times(case) if times is None else known(times))
    if case.controller is not None:
        schedule = loop_schedule(case, samples)
        substeps, error = _suitable_substeps(case, shape, schedule, tolerance)
        return Plan(shape, substeps, 0, False, error, schedule)
    step, error = suitable_step(case, shape, tolerance)
    gaps = np.diff(samples)
    even = bool(np.all(np.abs(gaps - gaps.mean()) < EVEN * gaps.mean()))
    lead = max(0, int(np.ceil(samples[0] / gaps.mean() - EVEN)))
    _check_steps(samples.size * (gaps.max() / step), step)
    substeps = max(1, int(np.ceil(gaps.max() / step)))
    return Plan(shape, substeps, lead, even, error)


def sample_times(case: Case) -> Float[Array, " time"]:
    """Times (s) at which a run saves samples: from 0 to its duration at its sample rate.

    Raises ValueError if these are more than can be kept.
    """
    duration, rate = float(known(case.run.duration)), float(known(case.run.sample_rate))
    if duration * rate > MOST:
        raise ValueError(
            f"run.duration ({duration:g} s) and run.sample_rate ({rate:g} Hz) make"
            f" {duration * rate:.3g} samples, and a run may have {MOST:.0e}: lower one of them"
        )
    return jnp.arange(max(2, int(np.floor(duration * rate * (1 + 1e-12))) + 1)) / rate


@compiled
def _probe(case, form, longest, lanes):
    places = case.beam.length * jnp.array(PROBES)
    return run_extremes(case, form, longest, places, lanes).peak()[0]


def _check_steps(count: float, step: float) -> None:
    """Raises RuntimeError if a run needs too many time steps, such as these (s)."""
    if not count <= MOST:
        raise RuntimeError(
            f"the run takes {count:.1e} time steps of {step:.1e} s, and {MOST:.0e} are the most:"
            " check stiffnesses, masses and damping, shorten the run, or keep fewer modes"
            " (beam.modes)"
        )


def _longest_step(case: Case, form: Form) -> float:
    """The longest step (s) that may be tried."""
    return min(float(_survey(case, form.layout)[0]), float(known(case.run.duration)))


def suitable_step(
    case: Case, form: Form, tolerance: float, lanes: Traffic | None = None
) -> tuple[float, float]:
    """Longest step (s) whose peaks at some places are right to `tolerance`, and their error.

    Found by halving the step until halving it once more changes no peak by more than the
    tolerance, relative to the largest peak; the error is that change. Raises RuntimeError if no
    step down to a millionth of the run will do.
    """
    case = known_case(case)
    step = _longest_step(case, form)
    _check_steps(float(known(case.run.duration)) / step, step)

    def peaks(halvings):
        return np.asarray(_probe(case, form, jnp.asarray(step / 2**halvings), lanes))

    halvings, error = _halve(peaks, tolerance, 20)
    return step / 2**halvings, error


def _suitable_substeps(case: Case, form: Form, schedule: Schedule, tolerance: float):
    """How many steps to take from edge to edge of a schedule, and the error of the deflection."""
    step, gap = _longest_step(case, form), float(schedule.lengths.max())
    if gap / step > MOST_BETWEEN:
        raise RuntimeError(
            f"the {gap:g} s from one sample to the next are too long to bridge: they take"
            f" {gap / step:.1e} time steps of {step:.1e} s, and {MOST_BETWEEN:.0e} are the most;"
            " give a shorter controller.period or a higher run.sample_rate"
        )
    _check_steps(schedule.times.size * gap / step, step)
    fewest = max(1, int(np.ceil(gap / step)))

    @functools.cache
    def seen(halvings):
        return np.asarray(_probe_driven(case, form, schedule, jnp.asarray(fewest * 2**halvings)))

    # A loop that diverges does so with any step; how far it has come by then is not the question.
    # A stiff law at every instant may only seem to, with steps that are too long for it.
    sure = 6 if case.controller.period is None else 1
    if np.isnan(seen(1)).any() and np.isnan(seen(sure)).any():
        return 2 * fewest, np.nan
    halvings, error = _halve(seen, tolerance, 8)
    return fewest * 2**halvings, error


@compiled
def _probe_driven(case, form, schedule, substeps):
    """Deflections at some places and all edges of the schedule (edge and place, lane).

    Not peaks, as without a controller: where a law saturates its command has a kink, whose error
    shows everywhere but at a peak, which is flat.
    """
    places = case.beam.length * jnp.array(PROBES)
    loads = traffic(case)
    driver = make_loop(case, form.layout, loads, schedule)
    grid = scheduled_grid(case, driver.rig, schedule, substeps)
    rigging = make_rigging(driver.rig, grid, None, driver)
    states = at_edges(rigging, loads, slots=form.slots, driver=driver)
    rows = driver.rig.shapes(places, (0,))[0]
    seen = rows @ states[:, 0 : 2 * case.beam.modes : 2]
    return seen.reshape(-1, seen.shape[-1])


def _halve(seen: Callable[[int], np.ndarray], tolerance: float, most: int) -> tuple[int, float]:
    """How often to halve a step until halving it again changes little seen, and that change."""
    coarse = seen(0)
    for halvings in range(most):
        fine = seen(halvings + 1)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            error = np.max(np.abs(coarse - fine) / np.max(np.abs(fine), axis=0), initial=0.0)
        if not np.any(fine):
            error = 0.0
        if error <= tolerance:
            return halvings, float(error)
        if halvings >= HOPELESS and not np.isfinite(fine).all():
            break
        coarse = fine
    raise RuntimeError(
        f"no time step makes the response agree to {tolerance:g}; it grows without bound, or its "
        "frequencies are too far apart: check stiffnesses, masses and damping, or keep fewer modes "
        "(beam.modes); or a law at every instant switches too often: give it a period, or ask for "
        "a larger tolerance"
    )
