"""The limit nobody can beat: the least peak deflection that commands within limits leave.

For known loads the deflection is linear in the commands (`input_influence`), so the least peak over all
histories of commands is a linear program,

    minimise p   subject to   |free(x, t) + sum_k response_k(x, t) u_k| <= p,
                              u_min <= u_k <= u_max,   |u_k - u_(k-1)| <= rate x period,

at every place x and instant t. No controller that holds its commands over the same period gets
below p, however it measures, estimates or predicts.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxbeam.analysis.bound.input_influence import TOLERANCE, input_influence
from jaxbeam.analysis.bound.linear_program import least_peak
from jaxbeam.case.case import Case
from jaxbeam.case.declared_checks import check_on_beam
from jaxbeam.case.validation import check_case
from jaxbeam.control.prescribed import Prescribed
from jaxbeam.model.channels import accepts_commands
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.integration_plan import choose_step_size, run_peaks, static_shapes
from jaxbeam.simulation.record import Record

DEFAULT_PERIOD = 0.01  # s: over which commands are held, where no controller says

_run_peaks = compiled(run_peaks)


class ActiveConstraints(NamedTuple):
    """Where and when the peak cannot be lowered: places (m), instants (s), and weights.

    The weights, multipliers of the linear program, have the sign of the deflection, and their sizes
    add to 1. They prove the bound: whatever the commands, the sum of weights times deflections is
    no less than it, and the largest of these deflections no less than their sum.
    """

    positions: Float[np.ndarray, " binding"]
    times: Float[np.ndarray, " binding"]
    weights: Float[np.ndarray, " binding"]


class Bound(eqx.Module):
    """The least achievable peak deflection of a case, and commands that attain it.

    `peak` (m) is the largest absolute deflection at the `positions` (m), at instants at most `spacing`
    (s) apart; that in between may be a little larger. `uncontrolled` (m) is the peak without
    commands. `commands` start at `times` (s) and are held over `period` (s); of the many that
    attain the peak (to 1e-5) they are calm ones.
    """

    peak: float
    uncontrolled: float
    positions: Float[np.ndarray, " place"]
    times: Float[np.ndarray, " hold"]
    commands: Float[np.ndarray, "hold actuator"]
    period: float
    spacing: float
    active_constraints: ActiveConstraints

    @property
    def reduction(self) -> float:
        """Attainable share of the uncontrolled peak that control can take away, 0 to 1."""
        return 1 - self.peak / self.uncontrolled

    def share(self, record: Record) -> float:
        """Share of the attainable reduction that a run achieves: 0 without control, 1 at best.

        It is negative for a run that control makes worse, NaN for one that diverges. Its peak is
        that at the places of the bound; where these are not the sensors of the run, among samples.
        """
        sensors = np.array([float(sensor.position) for sensor in record.case.sensors])
        if np.array_equal(sensors, self.positions):
            peak = np.max(np.asarray(record.peak_deflection))
        else:
            peak = np.max(np.abs(np.asarray(record.at(self.positions))))
        attainable = self.uncontrolled - self.peak
        return float((self.uncontrolled - peak) / attainable) if attainable > 0 else np.nan

    def controller(self) -> Prescribed:
        """The controller that gives the commands, whatever the beam does."""
        end = self.times[-1] + self.period
        values = np.concatenate([self.commands, self.commands[-1:]]).T
        nothing = np.zeros(self.commands.shape[1])
        table = {"times": np.append(self.times, end), "values": values}
        return Prescribed(offsets=nothing, period=self.period, **table)


def bound(
    case: Case,
    positions: ArrayLike | None = None,
    period: float | None = None,
    spacing: float | None = None,
) -> Bound:
    """The least peak deflection of a case that any controller can achieve, and how.

    The peak is that at the sensors, or at given `positions` (m from the left end); take many for the
    whole beam. Commands are held over `period` (s): by default that of the case's controller, or
    0.01 s. They stay within the limits and rates of the actuators, and are free where there are
    none; resolution, delay, and the controller of the case play no part. The deflection is looked
    at every `spacing` (s), by default at the run's sample rate, and wherever commands change.

    Raises ValueError for a faulty case, one without actuators that take commands, loads or places,
    for times that are not positive, for limits that rates cannot reach from zero, and under
    differentiation (it has no derivatives); RuntimeError if the linear program fails.
    """
    found = _bound_without_baseline(case, positions, period, spacing)
    return dataclasses.replace(found, uncontrolled=_uncontrolled_peak(case, found.positions))


def least_achievable_peak(case: Case, positions: ArrayLike | None, period: float) -> float:
    """The peak of `bound` alone (m), sooner; raises what that raises."""
    return _bound_without_baseline(case, positions, period, None).peak


def _bound_without_baseline(case: Case, positions, period, spacing) -> Bound:
    """The bound of a case, but for the peak without commands."""
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(case)):
        raise ValueError("a bound cannot be differentiated or compiled; call it on plain numbers")
    check_case(case)
    own_period = None if case.controller is None else case.controller.period
    period = (
        float(DEFAULT_PERIOD if own_period is None else own_period)
        if period is None
        else float(period)
    )
    spacing = 1 / float(case.run.sample_rate) if spacing is None else float(spacing)
    positions = _checked_positions(case, positions)
    if not case.actuators:
        raise ValueError("without actuators there is nothing to command; add one for a bound")
    if not any(map(accepts_commands, case.actuators)):
        raise ValueError(
            f"actuators: none of the {len(case.actuators)} takes commands; add one that does"
        )
    if not (np.isfinite([period, spacing]).all() and min(period, spacing) > 0):
        raise ValueError(f"period and spacing must be positive; they are {period:g}, {spacing:g} s")
    if period > float(case.run.duration):
        raise ValueError(f"period {period:g} s is longer than the run, {case.run.duration:g} s")
    if not case.loads:
        raise ValueError("without loads nothing deflects the beam; add one for a bound")
    influence = input_influence(case, positions, period, spacing)
    if not np.any(influence.unforced @ influence.deflection_rows.T):
        raise ValueError("no load deflects the beam at these places during the run")
    if not np.any(influence.response):
        raise ValueError("no command moves the beam; move an actuator off the supports and nodes")
    peak, commands, weights = least_peak(influence, *_command_limits(case, period))
    when, where = np.nonzero(weights)
    return Bound(
        peak=float(peak),
        uncontrolled=np.nan,
        positions=positions,
        times=influence.hold_times,
        commands=commands,
        period=period,
        spacing=spacing,
        active_constraints=ActiveConstraints(
            positions[where], influence.times[when], weights[when, where]
        ),
    )


def _checked_positions(case: Case, positions) -> Float[np.ndarray, " place"]:
    if positions is None:
        positions = case.sensor_positions
    positions = np.asarray(positions, float).ravel()
    if positions.size == 0:
        raise ValueError("nowhere to look at the deflection: add a sensor, or give places (m)")
    for i, place in enumerate(positions):
        check_on_beam(f"places.{i}", place, case.beam.length)
    return positions


def _uncontrolled_peak(case: Case, positions) -> float:
    """The largest deflection (m) at some places without commands, at all times."""
    uncontrolled_case = eqx.tree_at(
        lambda c: c.controller, case, None, is_leaf=lambda leaf: leaf is None
    )
    shapes = static_shapes(uncontrolled_case)
    step, _ = choose_step_size(uncontrolled_case, shapes, TOLERANCE)
    running_peaks = _run_peaks(uncontrolled_case, shapes, jnp.asarray(step), jnp.asarray(positions))
    return float(jnp.max(running_peaks.refined_peak()[0]))


def _command_limits(case: Case, period: float):
    """Smallest and largest command to each actuator, and its largest change between holds."""
    limits = [actuator.command_limits() for actuator in case.actuators]
    rates = [actuator.command_rate_limit() for actuator in case.actuators]
    pairs = [(-np.inf, np.inf) if pair is None else np.asarray(pair) for pair in limits]
    low, high = np.array(pairs).T
    return low, high, np.array([np.inf if r is None else float(r) * period for r in rates])
