"""Comparison of controllers on one case: metrics, faults of real loops, the least achievable peak.

A new metric takes a field of `PerformanceMetrics`, its value in `performance_metrics`, and a column
and a key in `jaxbeam.cli.commands.compare`. A new fault is an entry of `FAULTS`: signals are lost,
stuck, late and coarse, or the beam is softer. Commands oscillate where they have turning points
beyond those of the uncontrolled deflection.
"""

import dataclasses
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.analysis.bound.bound import DEFAULT_PERIOD, Bound, bound, no_bound
from jaxbeam.analysis.bound.dampers import DamperPeak, damper_peak
from jaxbeam.analysis.stability import StabilityMargin, stability_margin
from jaxbeam.case.case import Case, crossing_times
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import concrete, refuses_traced
from jaxbeam.control.feedforward import without_control
from jaxbeam.control.semi_active import SemiActive
from jaxbeam.model.state_space import state_space
from jaxbeam.runtime.arrays import Module
from jaxbeam.runtime.printer import TableViews
from jaxbeam.simulation.commands import with_exact_compensation
from jaxbeam.simulation.record import Record
from jaxbeam.simulation.simulate import ContactLossWarning, simulate

MIN_REVERSAL = 0.2  # of the range of a history; smaller reversals are no turning points
MIN_EXTRA_TURNS = 4  # turning points beyond those without control: two cycles


class CommandOscillation(NamedTuple):
    """Oscillation of a command, compared with that of the uncontrolled deflection.

    `extra` is the number of turning points beyond those of the uncontrolled deflection, `at_limits`
    the number of turning points at a limit of the actuator, `frequency` (Hz) that of the turning
    points, half their rate (by the median interval), NaN if there are fewer than two.
    """

    extra: int
    frequency: float
    at_limits: int

    @property
    def oscillates(self) -> bool:
        """Whether the loop makes the command oscillate for two cycles or more."""
        return self.extra >= MIN_EXTRA_TURNS

    @property
    def limit_cycle(self) -> bool:
        """Whether the limits bound the oscillation: four turning points or more are at a limit."""
        return self.oscillates and self.at_limits >= MIN_EXTRA_TURNS


def command_oscillations(record: Record, uncontrolled: Record) -> tuple[CommandOscillation, ...]:
    """Oscillation of each command of a run, compared with the run without control.

    Command i is compared with the uncontrolled deflection at sensor i, or at the last sensor if
    there are fewer: turning points that follow the passing loads do not count.
    """
    deflection, last = np.asarray(uncontrolled.deflection), len(uncontrolled.case.sensors) - 1
    columns = zip(np.asarray(record.command).T, np.asarray(record.saturated).T, strict=True)
    return tuple(
        count_oscillations(np.asarray(record.times), *column, deflection[:, min(i, last)])
        for i, column in enumerate(columns)
    )


def count_oscillations(
    times: Float[np.ndarray, " time"],
    command: Float[np.ndarray, " time"],
    saturated: Bool[np.ndarray, " time"],
    deflection: Float[np.ndarray, " time"],
) -> CommandOscillation:
    """Oscillation of a command, compared with an uncontrolled deflection.

    `saturated` is where the command is at a limit.
    """
    command_turns, deflection_turns = turning_points(command), turning_points(deflection)
    gaps = np.diff(times[command_turns])
    frequency = float(1 / (2 * np.median(gaps))) if gaps.size else np.nan
    return CommandOscillation(
        max(len(command_turns) - len(deflection_turns), 0),
        frequency,
        int(np.sum(saturated[command_turns])),
    )


def turning_points(history: Float[np.ndarray, " time"]) -> list[int]:
    """Indices of extremes of a history before reversals of more than MIN_REVERSAL of its range.

    Empty for a history that is constant or not finite.
    """
    if not np.all(np.isfinite(history)) or np.ptp(history) == 0:
        return []
    min_reversal, turns, extreme, direction = MIN_REVERSAL * np.ptp(history), [], 0, 0.0
    for k, value in enumerate(history):
        change = value - history[extreme]
        if direction == 0:  # no change beyond MIN_REVERSAL so far
            if abs(change) > min_reversal:
                direction, extreme = np.sign(change), k
        elif direction * change >= 0:
            extreme = k
        elif abs(change) > min_reversal:
            turns, extreme, direction = [*turns, extreme], k, -direction
    return turns


class PerformanceMetrics(NamedTuple):
    """Performance metrics of a controller on a case.

    Deflections are those at the sensors, the largest of all: `peak` (m) in continuous time, `rms`
    (m) over the samples of the run, `after_exit` (m) the largest after the last load has left, NaN
    if the run ends before. For each actuator `effort` is the integral of the squared command over
    the run (command^2 s), `saturated` the fraction of samples at a limit. `share` is the fraction
    of the attainable reduction of the peak (see `Bound.share`), NaN without a bound,
    `stability_margin` the margin along the crossing, `limit_cycles` the oscillation of each
    command.
    """

    peak: float
    rms: float
    after_exit: float
    effort: Float[np.ndarray, " actuator"]
    saturated: Float[np.ndarray, " actuator"]
    share: float
    stability_margin: StabilityMargin
    limit_cycles: tuple[CommandOscillation, ...]


class Comparison(TableViews, Module):
    """Result of `compare`: records and metrics of the controllers by name, and the bound.

    `uncontrolled` is the run without controller, `optimal` the run with the commands of the bound.
    Both of the bound are None where limits of a voltage allow none (see `jaxbeam.bound`).
    `damper_peaks` are the peaks that dampers of the semi-active controllers attain with rates known
    in advance, or sentences that say why none is found.
    """

    case: Case
    uncontrolled: Record
    optimal: Record | None
    records: dict[str, Record]
    metrics: dict[str, PerformanceMetrics]
    bound: Bound | None
    damper_peaks: dict[str, DamperPeak | str]

    @property
    def headline(self) -> str:
        """Peaks without control and under the bound, in one sentence, or why there is no bound."""
        if self.bound is not None:
            return self.bound.verdict
        times = "times at limits are those of commands, not of voltages"
        return f"{without_bound(self.uncontrolled)}; {times}"

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """Name and metrics of each controller, by head, as `PerformanceMetrics` has them.

        Efforts are (controller, actuator) in that class, columns here; margins are NaN where the
        loop has none.
        """
        metrics = self.metrics.values()
        efforts = np.array([one.effort for one in metrics]).T
        limits = np.array([one.saturated for one in metrics]).T
        return {
            "controller": np.array(list(self.metrics)),
            "peak (m)": np.array([one.peak for one in metrics]),
            "share of attainable reduction": np.array([one.share for one in metrics]),
            "RMS (m)": np.array([one.rms for one in metrics]),
            "after exit (m)": np.array([one.after_exit for one in metrics]),
            **{f"effort {i} (command^2 s)": effort for i, effort in enumerate(efforts)},
            **{f"time at limit {i}": limit for i, limit in enumerate(limits)},
            "gain margin": np.array([one.stability_margin.gain for one in metrics]),
            "delay margin (s)": np.array([one.stability_margin.delay for one in metrics]),
        }

    @property
    def remarks(self) -> list[str]:
        """Sentences on margins that are missing, loops, and the verdicts of the records."""
        obstacles = {name: one.stability_margin.obstacle for name, one in self.metrics.items()}
        remarks = []
        for obstacle in dict.fromkeys(filter(None, obstacles.values())):
            names = [name for name, found in obstacles.items() if found == obstacle]
            remarks.append(f"no margin of {', '.join(names)}: {obstacle}")
        for name, record in self.records.items():
            verdicts = filter(
                None, (self.damper_summary(name), self.loop_summary(name), record.verdict)
            )
            remarks.append(f"{name}: {'; '.join(verdicts)}")
        return remarks

    def damper_summary(self, name: str) -> str:
        """Sentence on what the dampers of a semi-active controller attain; empty for others."""
        best, peak = self.damper_peaks.get(name, ""), self.metrics[name].peak
        if isinstance(best, str):
            return best and f"no peak that its dampers attain: {best}"
        attainable = best.uncontrolled - best.peak
        if not attainable > 0 or np.isnan(peak):  # dampers of no effect, or a run that diverges
            return best.verdict
        share = (best.uncontrolled - peak) / attainable
        return f"{best.verdict}; the law achieves {share:.1%} of this"

    def loop_summary(self, name: str) -> str:
        """Sentence on saturation, instability under stationary loads and oscillation of commands.

        Empty if there is none of them.
        """
        metrics = self.metrics[name]
        parts = []
        if metrics.saturated.any():
            fractions = ", ".join(f"{fraction:.1%}" for fraction in metrics.saturated)
            parts.append(f"at the limits {fractions} of the run")
        if metrics.stability_margin.unstable is not None:
            parts.append(str(metrics.stability_margin))
        for i, oscillation in enumerate(metrics.limit_cycles):
            if oscillation.oscillates:
                how = "is in a limit cycle" if oscillation.limit_cycle else "oscillates"
                parts.append(
                    f"command {i} {how}, with {oscillation.extra} turning points more than the"
                    f" uncontrolled deflection, at {oscillation.frequency:.3g} Hz"
                )
        return "; ".join(parts)


def without_bound(uncontrolled: Record) -> str:
    """Peak of an uncontrolled run, and why its case has no bound, in a clause."""
    return (
        f"largest deflection without control {np.max(uncontrolled.peak_deflection):.4g} m; no least"
        f" achievable peak, as {no_bound(uncontrolled.case)}"
    )


@refuses_traced("a comparison")
def compare(
    case: Case, controllers: dict[str, AbstractController], period: float | None = None
) -> Comparison:
    """Simulate a case under controllers, without control, and with the commands of its bound.

    The bound is that of commands held over `period` (s), by default the shortest period of the
    controllers, or 0.01 s, starting at its multiples; it is left out where limits of a voltage
    within an inner loop allow none. Dampers of a semi-active controller have the peak of
    `analysis.bound.dampers.damper_peak`, too. A controller of the case itself is left out unless it
    is given too. Contact loss is in the verdicts of the records; there is no warning.

    Raises ValueError without controllers, for a case that is invalid with one of them (which it
    names), and as `bound`.
    """
    if not controllers:
        raise ValueError("there is nothing to compare: give at least one controller")
    uncontrolled_case = without_control(case)
    periods = [float(c.period) for c in controllers.values() if c.period is not None]
    period = min(periods, default=DEFAULT_PERIOD) if period is None else period
    least_peak = None if no_bound(case) else bound(uncontrolled_case, period=period)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)
        uncontrolled = simulate(uncontrolled_case)
        records = {name: _simulate_with(case, name, one) for name, one in controllers.items()}
        optimal = None
        if least_peak is not None:
            exact_case = with_exact_compensation(case)  # commands of the bound are those that act
            optimal = _simulate_with(exact_case, "the bound", least_peak.controller())
    metrics = {
        name: performance_metrics(record, uncontrolled, least_peak)
        for name, record in records.items()
    }
    damper_peaks = {}
    for name, one in controllers.items():
        if isinstance(one, SemiActive):
            try:
                damper_peaks[name] = damper_peak(dataclasses.replace(case, controller=one))
            except ValueError as error:
                damper_peaks[name] = str(error)
    return Comparison(
        uncontrolled_case, uncontrolled, optimal, records, metrics, least_peak, damper_peaks
    )


class MetricsOverCases(NamedTuple):
    """Performance metrics of a controller over several load cases.

    `peak` (m), `after_exit` (m, NaN if a run ends before the last exit) and `saturated` (fraction
    of a run that an actuator is at a limit) are the largest of all cases, `worst_share` and
    `mean_share` the least and the mean fraction of the attainable reduction, NaN without bounds.
    """

    peak: float
    worst_share: float
    mean_share: float
    after_exit: float
    saturated: float


def metrics_over_cases(comparisons: Sequence[Comparison]) -> dict[str, MetricsOverCases]:
    """Metrics by controller over comparisons of the same controllers on several load cases."""
    table = {}
    for name in comparisons[0].metrics:
        metrics = [comparison.metrics[name] for comparison in comparisons]
        # Not of runs in which nothing can be attained; NaN where one diverges.
        shares = [one.share for one in metrics if np.isnan(one.peak) or not np.isnan(one.share)]
        shares = shares or [np.nan]
        table[name] = MetricsOverCases(
            peak=float(np.max([one.peak for one in metrics])),
            worst_share=float(np.min(shares)),
            mean_share=float(np.mean(shares)),
            after_exit=float(np.max([one.after_exit for one in metrics])),
            saturated=float(np.max([one.saturated for one in metrics])),
        )
    return table


def worst_comparison(comparisons: Sequence[Comparison], name: str) -> int:
    """Index of the comparison in which a controller achieves the least of the attainable reduction.

    Divergence is less than any; runs in which nothing can be attained count last. Without any share
    it is that of the largest peak.
    """
    metrics = [comparison.metrics[name] for comparison in comparisons]
    if all(np.isnan(one.share) for one in metrics):
        return int(np.argmax(np.nan_to_num([one.peak for one in metrics], nan=np.inf)))
    shares = [-np.inf if np.isnan(one.peak) else one.share for one in metrics]
    return int(np.argmin(np.nan_to_num(shares, nan=np.inf, neginf=-np.inf)))


def _simulate_with(case: Case, name: str, controller: AbstractController) -> Record:
    try:
        return simulate(dataclasses.replace(case, controller=controller))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def performance_metrics(
    record: Record, uncontrolled: Record, least_peak: Bound | None
) -> PerformanceMetrics:
    """Metrics of a run, given the uncontrolled run and the bound of its case, if it has one."""
    deflection, times = np.asarray(record.deflection), np.asarray(record.times)
    after_exit = np.abs(deflection[times > crossing_times(record.case)[:, 1].max()])
    return PerformanceMetrics(
        peak=float(np.max(record.peak_deflection)),
        rms=float(np.sqrt(np.mean(deflection**2, axis=0)).max()),
        after_exit=float(after_exit.max()) if after_exit.size else np.nan,
        effort=np.asarray(record.effort),
        saturated=np.asarray(record.saturated).mean(axis=0),
        share=np.nan if least_peak is None else least_peak.share(record),
        stability_margin=stability_margin(record.case),
        limit_cycles=command_oscillations(record, uncontrolled),
    )


SEEDS = 5  # runs of a random fault, of which the worst counts
BITS = 12  # of converters
STUCK_WIDTH = 1e-12  # of a stuck sensor's range, in terms of its largest reading


class FaultedPeak(NamedTuple):
    """Worst run of a law under a fault.

    `peak` is the largest deflection at the sensors (m), NaN of a run that diverges, `uncontrolled`
    that of the same beam without control, `share` the fraction of the attainable reduction (see
    `Bound.share`), negative where the law is worse than none and NaN without a bound. `at` names
    the run if a fault has several: "sensor 1", "seed 3".
    """

    peak: float
    uncontrolled: float
    share: float
    at: str

    @property
    def reduction(self) -> float:
        """Reduction of the peak as a fraction of that without control."""
        return 1 - self.peak / self.uncontrolled

    @property
    def is_worse_than_none(self) -> bool:
        """Whether the peak is above that without control, by more than rounding."""
        return not self.peak <= self.uncontrolled * (1 + 1e-9)


class LoopFault(NamedTuple):
    """A fault of a loop: `variants` returns the cases with it, by name.

    From a case with a law and its uncontrolled run. A `sampled` fault is one of samples, which laws
    in continuous time do not have.
    """

    name: str
    variants: Callable[[Case, Record], dict[str, Case]]
    sampled: bool = False


def _with_at_least(part: Any, **least: float) -> Any:
    """A sensor or controller whose fields `least` are at least these numbers."""
    own = {name: float(concrete(getattr(part, name) or 0.0)) for name in least}
    return dataclasses.replace(part, **{name: max(own[name], least[name]) for name in least})


def _of_sensors(case: Case, **least: float) -> Case:
    sensors = tuple(_with_at_least(sensor, **least) for sensor in case.sensors)
    return dataclasses.replace(case, sensors=sensors)


def _of_seeds(case: Case) -> dict[str, Case]:
    seeds = range(case.run.seed, case.run.seed + SEEDS)
    runs = {f"seed {seed}": dataclasses.replace(case.run, seed=seed) for seed in seeds}
    return {name: dataclasses.replace(case, run=run) for name, run in runs.items()}


def _lost(fraction: float) -> Callable[[Case, Record], dict[str, Case]]:
    return lambda case, uncontrolled: _of_seeds(_of_sensors(case, dropout=fraction))


def _late(case: Case, uncontrolled: Record) -> dict[str, Case]:
    """Case with readings and commands up to a fifth of the period later, for each seed."""
    late = float(concrete(case.controller.period)) / 5
    law = _with_at_least(case.controller, jitter=late)
    return _of_seeds(dataclasses.replace(_of_sensors(case, jitter=late), controller=law))


def _stuck(case: Case, uncontrolled: Record) -> dict[str, Case]:
    """Cases in each of which one sensor is stuck at its reading before the first load."""
    found = {}
    readings = np.asarray(uncontrolled.measured)
    for i, sensor in enumerate(case.sensors):
        width = STUCK_WIDTH * float(np.abs(readings[:, i]).max()) or STUCK_WIDTH
        rest = float(readings[0, i])
        stuck = dataclasses.replace(sensor, range=(rest, rest + width))
        sensors = (*case.sensors[:i], stuck, *case.sensors[i + 1 :])
        found[f"sensor {i}"] = dataclasses.replace(case, sensors=sensors)
    return found


def _coarse(case: Case, uncontrolled: Record) -> dict[str, Case]:
    """Case with readings and commands quantised by converters over their ranges.

    The range of a sensor without one is twice its uncontrolled readings.
    """
    sensors = []
    readings = np.abs(np.asarray(uncontrolled.measured)).max(axis=0)
    for sensor, largest in zip(case.sensors, readings, strict=True):
        low, high = (
            concrete(sensor.range) if sensor.range is not None else (-2 * largest, 2 * largest)
        )
        step = max(float(high - low) / 2**BITS, float(concrete(sensor.resolution or 0.0)))
        sensors.append(dataclasses.replace(sensor, resolution=step or None))
    limits = [one.command_limits() for one in case.driven]
    spans = [float(np.ptp(concrete(one))) for one in limits if one is not None]
    law, step = case.controller, max(spans, default=0.0) / 2**BITS
    step = max(step, float(concrete(law.resolution or 0.0)))
    law = dataclasses.replace(law, resolution=step or None)
    return {"": dataclasses.replace(case, sensors=tuple(sensors), controller=law)}


def _soft(case: Case, uncontrolled: Record) -> dict[str, Case]:
    rigidity = 0.85 * np.asarray(concrete(case.beam.flexural_rigidity))
    beam = dataclasses.replace(case.beam, flexural_rigidity=rigidity)
    return {"": dataclasses.replace(case, beam=beam)}


FAULTS = (
    LoopFault("none", lambda case, uncontrolled: {"": case}),
    LoopFault("1 % lost", _lost(0.01), sampled=True),
    LoopFault("5 % lost", _lost(0.05), sampled=True),
    LoopFault("stuck", _stuck),
    LoopFault("late", _late, sampled=True),
    LoopFault(f"{BITS} bits", _coarse, sampled=True),
    LoopFault("E I -15 %", _soft),
)


def compare_under_faults(
    case: Case,
    controllers: Mapping[str, AbstractController],
    period: float | None = None,
    faults: Sequence[LoopFault] = FAULTS,
) -> tuple[dict[str, dict[str, FaultedPeak | None]], Bound | Record]:
    """Worst peaks of controllers under each fault, by name and fault, and the case's bound.

    Laws are designed for the case without the fault. The attainable reduction of a run is that by
    the bound of its own beam, with commands held over `period` (s), by default the shortest period
    of the controllers or 0.01 s. Where limits of a voltage within an inner loop allow no bound, the
    run without control takes its place. Random faults are run with five seeds from that of the
    case. None stands for faults of samples of a law in continuous time.

    Raises ValueError as `compare`.

    >>> import jaxbeam as jb
    >>> from jaxbeam.analysis.compare import compare_under_faults
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=2),
    ...     actuators=[jb.PointForce(0.3, limits=[-4.0, 4.0])],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.3, speed=1.5)],
    ...     run=jb.Run(0.6),
    ... )
    >>> law = jb.Feedback(gains=[3000.0], period=0.002)
    >>> peaks, least = compare_under_faults(case, {"feedback": law})
    >>> stuck = peaks["feedback"]["stuck"]
    >>> print(f"{stuck.peak / stuck.uncontrolled:.2f}", stuck.at)
    1.00 sensor 0
    """
    if not controllers:
        raise ValueError("there is nothing to compare: give at least one controller")
    free = without_control(case)
    periods = [float(concrete(c.period)) for c in controllers.values() if c.period is not None]
    period = min(periods, default=DEFAULT_PERIOD) if period is None else period
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)
        uncontrolled = simulate(free)
        without: dict[bytes, Bound | Record] = {}

        def without_law(one: Case) -> Bound | Record:
            """Bound of the beam of a case, or its run without control, found once."""
            key = np.asarray(concrete(one.beam.flexural_rigidity)).tobytes()
            if key not in without:
                own = dataclasses.replace(free, beam=one.beam)
                without[key] = simulate(own) if no_bound(own) else bound(own, period=period)
            return without[key]

        table = {}
        for name, law in controllers.items():
            case_with_law = _with_fixed_design(dataclasses.replace(case, controller=law))
            table[name] = {}
            for fault in faults:
                if fault.sampled and law.period is None:
                    table[name][fault.name] = None
                    continue
                variants = fault.variants(case_with_law, uncontrolled)
                runs = [_peak(name, one, at, without_law(one)) for at, one in variants.items()]
                # Of one beam: the largest peak is the least share.
                table[name][fault.name] = max(
                    runs, key=lambda run: np.nan_to_num(run.peak, nan=np.inf)
                )
    return table, without_law(free)


def _with_fixed_design(case: Case) -> Case:
    """The case with its law designed for it now, so that later faults do not change the design."""
    if case.controller.nominal_plant is not None:
        return case
    law = dataclasses.replace(case.controller, nominal_plant=state_space(case))
    return dataclasses.replace(case, controller=law)


def _peak(name: str, case: Case, at: str, without: Bound | Record) -> FaultedPeak:
    try:
        record = simulate(case)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    peak = float(np.max(record.peak_deflection))
    if isinstance(without, Bound):
        return FaultedPeak(peak, without.uncontrolled, without.share(record), at)
    return FaultedPeak(peak, float(np.max(without.peak_deflection)), np.nan, at)
