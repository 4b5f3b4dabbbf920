"""Lower bound on the peak deflection: the least peak over all commands within the limits.

For given loads and a given profile the deflection is affine in the held commands u_k
(`input_influence`), and its least peak p is the optimum of a linear program,

    minimise p   subject to   |w_0(x, t) + sum_k g_k(x, t) u_k| <= p,
                              u_min <= u_k <= u_max,   |u_k - u_(k-1)| <= rate * period,

at all positions x and times t. No controller that holds its commands over the same period has a
smaller peak, whatever it measures, estimates or predicts.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxbeam.analysis.bound.input_influence import (
    TOLERANCE,
    InputInfluence,
    input_influence,
)
from jaxbeam.analysis.bound.linear_program import least_peak
from jaxbeam.case.case import Case
from jaxbeam.case.controller import commanded
from jaxbeam.case.declared_checks import check_on_beam
from jaxbeam.case.fields import refuses_traced
from jaxbeam.case.validation import check_case
from jaxbeam.control.feedforward import Prescribed
from jaxbeam.integrator.discrete_model import discrete_model
from jaxbeam.integrator.integrate import integrate_peaks
from jaxbeam.integrator.peaks import RunningPeaks
from jaxbeam.integrator.static_shapes import StaticShapes, static_shapes
from jaxbeam.integrator.step_size import choose_step_size
from jaxbeam.integrator.time_grid import grid_by_step_length
from jaxbeam.model.channels import accepts_commands
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import modal_model
from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.compiling import compiled_if_traced
from jaxbeam.runtime.module import Module
from jaxbeam.simulation.commands import acting_ranges
from jaxbeam.simulation.record import Record

DEFAULT_PERIOD = 0.01  # s, over which commands are held without a sampled controller


class ActiveConstraints(NamedTuple):
    """Active constraints of the linear program: positions (m), times (s) and their multipliers.

    The `weights`, multipliers with the sign of the deflection, have absolute values of sum 1. They
    are a certificate of the bound: for any commands within the limits the weighted sum of the
    deflections is at least the bound, and the largest absolute deflection at least that sum.
    """

    positions: Float[np.ndarray, " constraint"]
    times: Float[np.ndarray, " constraint"]
    weights: Float[np.ndarray, " constraint"]


class Bound(Module):
    """Least achievable peak deflection of a case, and commands that attain it.

    `peak` (m) is the largest absolute deflection at the `positions` (m) and at times at most
    `spacing` (s) apart; that between these times may be slightly larger. `uncontrolled` (m) is the
    peak without commands. `commands` start at `times` (s) and are held over `period` (s); they
    attain the peak to 1e-5, with small and smooth commands among those that do; those of springs,
    not among the `driven` actuators, are without effect.
    """

    peak: float
    uncontrolled: float
    positions: Float[np.ndarray, " position"]
    times: Float[np.ndarray, " hold"]
    commands: Float[np.ndarray, "hold actuator"]
    period: float
    spacing: float
    active_constraints: ActiveConstraints
    driven: tuple[int, ...]

    @property
    def reduction(self) -> float:
        """Attainable reduction as a fraction of the uncontrolled peak, 0 to 1."""
        return 1 - self.peak / self.uncontrolled

    @property
    def verdict(self) -> str:
        """Peaks without control and with the best commands, in one sentence."""
        return (
            f"no control: peak {self.uncontrolled:.6g} m; no controller that holds its commands"
            f" for {self.period:g} s gets below {self.peak:.6g} m, {self.reduction:.1%} less"
        )

    def share(self, record: Record) -> float:
        """Fraction of the attainable reduction that a run achieves: 0 without control, 1 at best.

        Negative for a peak above the uncontrolled one, NaN for a run that diverges. The peak of the
        run is that at the positions of the bound, over its samples if these are not the sensors.
        """
        sensors = np.array([float(sensor.position) for sensor in record.case.sensors])
        if np.array_equal(sensors, self.positions):
            peak = np.max(np.asarray(record.peak_deflection))
        else:
            peak = np.max(np.abs(np.asarray(record.at(self.positions))))
        attainable = self.uncontrolled - self.peak
        return float((self.uncontrolled - peak) / attainable) if attainable > 0 else np.nan

    def controller(self) -> Prescribed:
        """Open-loop controller with the commands of those actuators that take any."""
        end = self.times[-1] + self.period
        commands = self.commands[:, np.array(self.driven, int)]
        values = np.concatenate([commands, commands[-1:]]).T
        offsets = np.zeros(len(self.driven))
        table = {"times": np.append(self.times, end), "values": values}
        return Prescribed(offsets=offsets, period=self.period, **table)


@refuses_traced("a bound")
def bound(
    case: Case,
    positions: ArrayLike | None = None,
    period: float | None = None,
    spacing: float | None = None,
) -> Bound:
    """Least peak deflection over all commands within the limits, and commands that attain it.

    The peak is that at the sensors, or at given `positions` (m from the left end), many for the
    whole beam. Commands are held over `period` (s), by default that of the case's controller, or
    0.01 s, within the limits and rates of the actuators, if any; resolution, delay, and the
    controller of the case have no influence. The deflection is evaluated every `spacing` (s), by
    default at the run's sample rate, and at changes of the commands.

    Raises ValueError for an invalid case, one without loads, without positions or without actuators
    that take commands, for a period or spacing that is not positive, for limits that the rates
    cannot reach from zero, and under `jit` or differentiation (there are no derivatives);
    RuntimeError if the linear program fails.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(
    ...         length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, damping_ratio=0.03
    ...     ),
    ...     actuators=[jb.PointForce(0.3, limits=[-1.0, 1.0])],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.5, speed=2.0)],
    ... )
    >>> best = jb.bound(case, period=0.02)
    >>> print(f"{best.reduction:.0%} of the peak, at most")
    24% of the peak, at most
    """
    least = _bound_without_baseline(case, positions, period, spacing)
    return dataclasses.replace(least, uncontrolled=_uncontrolled_peak(case, least.positions))


@refuses_traced("a bound")
def least_achievable_peak(case: Case, positions: ArrayLike | None, period: float) -> float:
    """Peak (m) of `bound`, without the run for the uncontrolled peak. Raises as `bound`."""
    return _bound_without_baseline(case, positions, period, None).peak


def _bound_without_baseline(case: Case, positions, period, spacing) -> Bound:
    """Bound of a case, with NaN for the uncontrolled peak."""
    influence, positions, period, spacing = checked_influence(case, positions, period, spacing)
    peak, commands, weights = least_peak(influence, *held_command_limits(case, period))
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
        driven=commanded(case.actuators),
    )


def checked_influence(
    case: Case, positions: ArrayLike | None, period: float | None, spacing: float | None
) -> tuple[InputInfluence, Float[np.ndarray, " position"], float, float]:
    """Influence of held commands, positions (m), period and spacing (s), with the defaults filled.

    Raises ValueError as `bound`.
    """
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
        raise ValueError("a bound needs actuators, and the case has none; add one")
    if not any(map(accepts_commands, case.actuators)):
        raise ValueError(
            f"actuators: none of the {len(case.actuators)} takes commands; add one that does"
        )
    if not (np.isfinite([period, spacing]).all() and min(period, spacing) > 0):
        raise ValueError(f"period and spacing must be positive; they are {period:g}, {spacing:g} s")
    if period > float(case.run.duration):
        raise ValueError(f"period {period:g} s is longer than the run, {case.run.duration:g} s")
    if not case.loads:
        raise ValueError("a bound needs loads, and the case has none; add one")
    influence = input_influence(case, positions, period, spacing)
    if not np.any(influence.unforced @ influence.deflection_rows.T):
        raise ValueError("no load deflects the beam at these positions during the run")
    if not np.any(influence.response):
        raise ValueError(
            "no actuator deflects the beam at these positions; move one off supports and nodes"
        )
    return influence, positions, period, spacing


def _checked_positions(case: Case, positions) -> Float[np.ndarray, " position"]:
    if positions is None:
        positions = case.sensor_positions
    positions = np.asarray(positions, float).ravel()
    if positions.size == 0:
        raise ValueError("a bound needs positions: add a sensor, or give positions (m)")
    for i, position in enumerate(positions):
        check_on_beam(f"positions.{i}", position, case.beam.length)
    return positions


def _uncontrolled_peak(case: Case, positions) -> float:
    """Largest absolute deflection (m) at the positions (m) without commands, in continuous time."""
    uncontrolled_case = dataclasses.replace(case, controller=None)
    shapes = static_shapes(uncontrolled_case)
    step, *_ = choose_step_size(uncontrolled_case, shapes, TOLERANCE)
    running_peaks = run_peaks(uncontrolled_case, shapes, np.asarray(step), positions)
    return float(np.max(running_peaks.refined_peak()[0]))


def held_command_limits(case: Case, period: float) -> tuple[Float[np.ndarray, " actuator"], ...]:
    """Lowest and highest command that acts, and its largest change from hold to hold."""
    low, high, rate = (np.asarray(part) for part in acting_ranges(case))
    return low, high, rate * period


@compiled_if_traced
def run_peaks(
    case: Case,
    shapes: StaticShapes,
    max_step: Float[Array, ""],
    positions: Float[Array, " sensor"],
) -> RunningPeaks:
    """Running peaks of an uncontrolled run at positions (m), in steps of at most `max_step` (s)."""
    model = modal_model(case, shapes.layout, shapes.coupled)
    grid = grid_by_step_length(case, model, max_step)
    discrete = discrete_model(model, grid, positions)
    return integrate_peaks(discrete, load_set(case, shapes.layout), max_loads=shapes.max_loads)[0]
