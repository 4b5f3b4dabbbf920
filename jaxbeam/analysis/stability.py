"""Is a closed loop stable while loads cross? Frozen poles, growth, streams, margins.

With the loads frozen the loop has poles, one set for each place of the loads. They say what a
slow crossing does; no set of frozen poles decides what a loop that changes with time does. That
is decided by its transition matrix: by how much a deviation can grow over the crossing, and, for
equal loads that follow each other for ever, by the multipliers of one period (Floquet).
"""

import dataclasses
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.flatten_util import ravel_pytree
from jaxtyping import Complex, Float

from jaxbeam.analysis.frozen_loop import Clock, OpenLoop, open_loop, through
from jaxbeam.analysis.linearised_loop import linear, prepared
from jaxbeam.case.case import Case, known_case
from jaxbeam.case.fields import known
from jaxbeam.case.loads import motion
from jaxbeam.case.trajectory import NEVER
from jaxbeam.model.modes import lay_out
from jaxbeam.runtime.compiling import compiled

TURN = 0.15  # rad by which the fastest mode may turn in a step along a transition


class FrozenPoles(NamedTuple):
    """Poles of the closed loop with its loads frozen, at times along a run.

    Column by column the poles (1/s) of one branch are followed from time to time. `largest` is
    the largest real part at each time; above zero, the loop would be unstable if the loads
    stopped in mid-motion there.
    """

    times: Float[np.ndarray, " time"]
    poles: Complex[np.ndarray, "time state"]

    @property
    def largest(self) -> Float[np.ndarray, " time"]:
        """Largest real part of all poles at each time, in 1/s."""
        return self.poles.real.max(axis=1)


class Growth(NamedTuple):
    """How much deviations can grow from the start of a run to each of some times (s).

    `factor` is the largest ratio of the root of mechanical energy then to that at the start,
    over all deviations of the beam; a run of a stable beam without control stays near one or
    below. Filters, actuators and laws start undisturbed.
    """

    times: Float[np.ndarray, " time"]
    factor: Float[np.ndarray, " time"]


class Stream(NamedTuple):
    """What one period of an endless stream of equal loads multiplies deviations by.

    Stable if all `multipliers` lie within the unit circle. `period` is in s.
    """

    multipliers: Complex[np.ndarray, " state"]
    period: float

    @property
    def largest(self) -> float:
        """Largest absolute value of the multipliers."""
        return float(np.max(np.abs(self.multipliers)))

    @property
    def stable(self) -> bool:
        """Whether every deviation dies out."""
        return self.largest < 1


def frozen_poles(case: Case, times: Float[np.ndarray, " time"] | None = None) -> FrozenPoles:
    """Poles of the closed loop at ascending times (s), the loads frozen there (Figs 5.17, 5.18).

    The times are 101 over the crossing if left out. Raises ValueError as `linear_loop`.
    """
    clock = prepared(case)
    if times is None:
        times = np.linspace(*_crossing(case), 101)[:-1] if case.loads else np.zeros(1)
    times = np.asarray(times, float)
    loop = open_loop(case, lay_out(known_case(case)))
    loops = _frozen_loops(loop, clock, jnp.asarray(times))
    each = [jax.tree.map(lambda part, i=i: part[i], loops).poles() for i in range(times.size)]
    return FrozenPoles(times, _followed(np.stack(each)))


@compiled
def _frozen_loops(loop, clock, times):
    return jax.lax.map(lambda t: linear(loop, clock, t), times)


def growth(case: Case, points: int = 100) -> Growth:
    """The growth of deviations over a crossing, in energy, at some times from start to end.

    The loop is linear about rest, where a cubic law has no gain. Raises ValueError as
    `linear_loop`, and for a case without loads.
    """
    clock = prepared(case)
    start, end = _crossing(case)
    loop = open_loop(case, lay_out(known_case(case)))
    if clock is None:
        times = np.linspace(start, end, points + 1)
    else:
        ticks = np.arange(math.ceil(start / clock.period), math.floor(end / clock.period) + 1)
        times = ticks * clock.period
    steps = _substeps(loop, clock, times)
    whole, energy = _transitions(loop, clock, jnp.asarray(times), steps)
    whole, energy = np.asarray(whole), np.asarray(energy)
    size = energy.shape[0]
    root = np.linalg.cholesky(energy).T
    part = root @ whole[:, :size, :size] @ np.linalg.inv(root)
    return Growth(times, np.linalg.norm(part, ord=2, axis=(1, 2)))


def stream(case: Case, spacing: float) -> Stream:
    """Floquet multipliers of the loop while equal loads follow each other, `spacing` (s) apart.

    The case has one load, which travels over the whole beam; it is repeated for ever. A law must
    not depend on time. Raises ValueError for other cases, for a spacing that is not a whole
    number of sampling periods, and as `linear_loop`.
    """
    clock = prepared(case)
    if len(case.loads) != 1:
        raise ValueError(f"a stream repeats the one load of a case; this has {len(case.loads)}")
    start, end = _crossing(case)
    if motion(case.loads[0], case.beam.length).window()[1] >= NEVER:
        raise ValueError("the load of a stream must leave the beam; loads.0 stays on it")
    if not spacing > 0:
        raise ValueError(f"spacing must be positive, in s; it is {spacing:g}")
    if clock is not None and abs(spacing / clock.period - round(spacing / clock.period)) > 1e-6:
        raise ValueError(
            f"spacing must be a whole number of the controller's periods, {clock.period:g} s, for"
            f" the loop to repeat itself; it is {spacing:g} s"
        )
    count = max(1, math.ceil((end - start) / spacing))
    load = case.loads[0]
    if load.times is None:
        loads = [
            eqx.tree_at(lambda x: x.entry_time, load, load.entry_time - i * spacing)
            for i in range(count)
        ]
    else:
        loads = [
            eqx.tree_at(lambda x: x.times, load, load.times - i * spacing) for i in range(count)
        ]
    many = dataclasses.replace(case, loads=tuple(loads))
    loop = open_loop(many, lay_out(known_case(case)))
    cuts = 1 if clock is None else round(spacing / clock.period)
    times = start + np.linspace(0.0, spacing, max(cuts, 20 if clock is None else 1) + 1)
    steps = _substeps(loop, clock, times)
    whole, _ = _transitions(loop, clock, jnp.asarray(times), steps)
    return Stream(np.linalg.eigvals(np.asarray(whole[-1])), float(spacing))


def _crossing(case: Case) -> tuple[float, float]:
    """From the first entry to the last exit, in s; loads that stay end with the run."""
    if not case.loads:
        raise ValueError("there is no crossing: the case has no loads")
    windows = [motion(load, case.beam.length).window() for load in case.loads]
    entries, exits = known(jnp.array(windows)).T
    last = min(float(exits.max()), float(known(case.run.duration)))
    if exits.max() < NEVER:
        last = float(exits.max())
    return float(entries.min()), last


def _substeps(loop, clock, times) -> int:
    """Substeps between any two of the times in which the fastest mode turns a little only."""
    fastest = float(jnp.max(loop.model.rig.modes.angular_frequencies))
    longest = float(np.max(np.diff(times))) if clock is None else clock.period
    return max(1, math.ceil(fastest * longest / TURN))


@compiled
def _transitions(loop: OpenLoop, clock: Clock | None, times, substeps: int):
    """Transition matrices from the first time to each, and the energy's matrix of q and q'."""
    model, modes = loop.model, loop.model.scale.shape[0]
    stiffness = model.rig.stiffness() / jnp.outer(model.scale, model.scale)
    mass = jnp.diag(1 / model.scale**2)
    none = jnp.zeros((modes, modes))
    energy = jnp.block([[stiffness, none], [none, mass]])
    if clock is None:

        def matrix(t):
            A, push, _, command = loop.parts(t)
            return A + push @ jax.jacfwd(command)(jnp.zeros(A.shape[0]))

        def onward(whole, t):
            whole = through(matrix, t[0], t[1] - t[0], substeps, whole)
            return whole, whole

        start = jnp.eye(matrix(times[0]).shape[0])
        spans = jnp.stack([times[:-1], times[1:]], axis=1)
        whole = jax.lax.scan(onward, start, spans)[1]
    else:
        rest, rebuild = loop.at_rest(clock)
        # About rest: without the weights.
        bare = eqx.tree_at(
            lambda loop: loop.wide.traffic.weight, loop, 0 * loop.wide.traffic.weight
        )

        def tick(whole, t):
            def after(state):
                return ravel_pytree(bare.tick(clock, rebuild(state), t, None, substeps)[0])[0]

            whole = jax.jacfwd(after)(rest) @ whole
            return whole, whole

        start = jnp.eye(rest.shape[0])
        whole = jax.lax.scan(tick, start, times[:-1])[1]
    return jnp.concatenate([start[None], whole]), energy


def _followed(poles: Complex[np.ndarray, "time state"]) -> Complex[np.ndarray, "time state"]:
    """The poles in columns that each follow one branch, by the nearest continuation in time."""
    ordered = poles.copy()
    for i in range(1, len(ordered)):
        # Straight ahead where two branches cross.
        ahead = ordered[i - 1] if i == 1 else 2 * ordered[i - 1] - ordered[i - 2]
        far = np.abs(ahead[:, None] - poles[i][None])
        ordered[i] = poles[i][scipy.optimize.linear_sum_assignment(far)[1]]
    return ordered
