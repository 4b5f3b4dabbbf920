"""Control laws under the faults of real loops: lost, stuck, late and coarse signals, a softer beam.

A new fault is an entry of `FAULTS`.
"""

import dataclasses
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxbeam.analysis.bound.bound import DEFAULT_PERIOD, Bound, bound
from jaxbeam.case.case import Case
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import concrete
from jaxbeam.model.state_space import state_space
from jaxbeam.simulation.record import Record
from jaxbeam.simulation.simulate import ContactLossWarning, simulate

SEEDS = 5  # runs of a random fault, of which the worst counts
BITS = 12  # of converters
STUCK_WIDTH = 1e-12  # of a stuck sensor's range, in terms of its largest reading


class FaultedPeak(NamedTuple):
    """Worst run of a law under a fault.

    `peak` is the largest deflection at the sensors (m), NaN of a run that diverges, `uncontrolled`
    that of the same beam without control, `share` the fraction of the attainable reduction (see
    `Bound.share`), negative where the law is worse than none. `at` names the run if a fault has
    several: "sensor 1", "seed 3".
    """

    peak: float
    uncontrolled: float
    share: float
    at: str

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
) -> tuple[dict[str, dict[str, FaultedPeak | None]], Bound]:
    """Worst peaks of controllers under each fault, by name and fault, and the case's bound.

    Laws are designed for the case without the fault. The attainable reduction of a run is that by
    the bound of its own beam, with commands held over `period` (s), by default the shortest period
    of the controllers or 0.01 s. Random faults are run with five seeds from that of the case. None
    stands for faults of samples of a law in continuous time.

    Raises ValueError as `compare`.

    >>> import jaxbeam as jb
    >>> from jaxbeam.analysis.loop_faults import compare_under_faults
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
    free = dataclasses.replace(case, controller=None)
    periods = [float(concrete(c.period)) for c in controllers.values() if c.period is not None]
    period = min(periods, default=DEFAULT_PERIOD) if period is None else period
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)
        uncontrolled = simulate(free)
        bounds: dict[bytes, Bound] = {}

        def least_peak(one: Case) -> Bound:
            """Bound of the beam of a case, found once."""
            key = np.asarray(concrete(one.beam.flexural_rigidity)).tobytes()
            if key not in bounds:
                bounds[key] = bound(dataclasses.replace(free, beam=one.beam), period=period)
            return bounds[key]

        table = {}
        for name, law in controllers.items():
            case_with_law = _with_fixed_design(dataclasses.replace(case, controller=law))
            table[name] = {}
            for fault in faults:
                if fault.sampled and law.period is None:
                    table[name][fault.name] = None
                    continue
                variants = fault.variants(case_with_law, uncontrolled)
                runs = [_peak(name, one, at, least_peak(one)) for at, one in variants.items()]
                table[name][fault.name] = min(
                    runs, key=lambda run: np.nan_to_num(run.share, nan=-np.inf)
                )
    return table, least_peak(free)


def _with_fixed_design(case: Case) -> Case:
    """The case with its law designed for it now, so that later faults do not change the design."""
    if case.controller.nominal_plant is not None:
        return case
    law = dataclasses.replace(case.controller, nominal_plant=state_space(case))
    return dataclasses.replace(case, controller=law)


def _peak(name: str, case: Case, at: str, least_peak: Bound) -> FaultedPeak:
    try:
        record = simulate(case)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    peak = float(np.max(record.peak_deflection))
    return FaultedPeak(peak, least_peak.uncontrolled, least_peak.share(record), at)
