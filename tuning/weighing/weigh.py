"""Weighing in motion: number, masses, speeds and entry times of loads, from readings alone.

Starts come from the readings of forces that cross (`matching_pursuit`); then all loads are fitted
together with the full dynamics. Loads are added until the residuals are white noise or Schwarz's
criterion (BIC) rises.
"""

import dataclasses

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete, refuses_traced
from jaxbeam.case.loads.base import AbstractLoad
from jaxbeam.case.loads.point import MovingMass
from tuning.fit.dataset import WHITENESS_SIGNIFICANCE
from tuning.fit.identify import identify
from tuning.fit.model_validation import ModelCriteria, compare_fits
from tuning.fit.result import Fit
from tuning.logs.log import Log
from tuning.weighing.matching_pursuit import MatchingPursuit

_LOAD_PARAMETERS = ("mass", "speed", "entry_time")
# Loads are added before the first fit as long as each reduces the residual to this ratio or less.
_MAX_MISFIT_RATIO = 0.7
# Residual over readings (RMS) above which no load is found.
_MAX_RELATIVE_RESIDUAL = 0.65


@dataclasses.dataclass(frozen=True, eq=False)
class Weighing:
    """Loads found in a log: the best fit, and criteria of all load counts tried, best first.

    `load_counts` is empty where the first count tried left white noise.
    """

    fit: Fit
    load_counts: list[ModelCriteria]

    @property
    def case(self) -> Case:
        """The case with the loads found."""
        return self.fit.case

    @property
    def loads(self) -> tuple[AbstractLoad, ...]:
        """The fitted loads, in the order in which they were found."""
        return self.fit.cases[0].loads

    def to_dict(self) -> dict:
        """Loads with standard errors and intervals (SI units), counts and verdict, for JSON."""
        parameters = self.fit.to_dict()["numbers"]
        loads = [
            {name: parameters[f"loads.{i}.{name}"] for name in _LOAD_PARAMETERS}
            for i in range(len(self.loads))
        ]
        counts = {count.name: count.bic for count in self.load_counts}
        return {"loads": loads, "bic": counts, "verdict": self.fit.verdict}

    def __str__(self) -> str:
        lines = [f"{_count_text(len(self.loads))} found"]
        lines += [f"BIC with {count.name}: {count.bic:.1f}" for count in self.load_counts]
        return "\n".join([*lines, str(self.fit)])


@refuses_traced("a weighing")
def weigh(
    case: Case, log: Log, speeds: tuple[float, float], max_count: int = 3, both_ways: bool = True
) -> Weighing:
    """Masses, speeds and entry times of the loads that crossed a known beam in a log.

    Sensors may measure any quantity of the beam: deflection, strain, acceleration, and so on.
    `speeds` (m/s) are the lowest and highest possible ones, in both directions or, without
    `both_ways`, from the left only; at most `max_count` loads are found. Offsets of the sensors are
    fitted as well. Loads of the case or the log are not used.

    Raises ValueError if there is no sensor, speeds are not 0 < low < high, or no load is found in
    the log, and as `identify` does.

    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     sensors=[jb.Sensor(0.3, noise=1e-5)],
    ...     loads=[jb.MovingForce(force=4.0, speed=2.0)],
    ...     run=jb.Run(0.4, sample_rate=50.0),
    ... )
    >>> record = jb.simulate(case)
    >>> columns = ("w",), ("deflection",), ("m",), "log", (0,)
    >>> log = tuning.Log(record.times, record.measured, *columns)
    >>> found = tuning.weigh(case, log, (1.0, 3.0), max_count=1, both_ways=False)
    >>> print(f"{found.loads[0].mass:.1f} kg at {found.loads[0].speed:.1f} m/s")
    0.4 kg at 2.0 m/s
    """
    low, high = speeds
    if not 0 < low < high:
        raise ValueError(f"speeds must be 0 < low < high in m/s; they are {low:g} and {high:g}")
    if not case.sensors:
        raise ValueError("weighing needs a sensor on the beam; the case has none")
    case = dataclasses.replace(case, vehicle_sensors=())
    pursuit = MatchingPursuit(case, log, (low, high), both_ways)
    first = pursuit.find(1)
    if first.residual_rms > _MAX_RELATIVE_RESIDUAL:
        raise ValueError(f"{log.source}: no load is found in it at these speeds")
    found = first
    while len(found.loads) < max_count and (
        more := pursuit.find(len(found.loads) + 1)
    ).residual_rms < (_MAX_MISFIT_RATIO * found.residual_rms):
        found = more
    fits: dict[str, Fit] = {}
    while True:
        count = len(found.loads)
        fit = fits[_count_text(count)] = _fit_loads(case, log, found.loads)
        if (
            min(channel.p_value for channel in fit.channel_residuals) > WHITENESS_SIGNIFICANCE
            or count >= max_count
        ):
            break
        if len(fits) > 1 and compare_fits(fits)[0].name != _count_text(count):
            break
        found = pursuit.find(count + 1)
    criteria = compare_fits(fits) if len(fits) > 1 else []
    return Weighing(fits[criteria[0].name] if criteria else fit, criteria)


def _fit_loads(case: Case, log: Log, loads: list[MovingMass]) -> Fit:
    """Fit of all loads together, and of the offsets of the sensors."""
    length, end = float(concrete(case.beam.length)), float(log.times[-1])
    free: dict[str, tuple[float, float] | None] = {}
    for i, load in enumerate(loads):
        speed = float(concrete(load.speed))
        low, high = sorted([0.3 * speed, 3 * speed])
        free[f"loads.{i}.mass"] = None
        free[f"loads.{i}.speed"] = low, high
        free[f"loads.{i}.entry_time"] = (-length / abs(speed), end)
    free |= {f"sensors.{i}.offset": None for i in range(len(case.sensors))}
    return identify(case, dataclasses.replace(log, loads=tuple(loads)), free)


def _count_text(count: int) -> str:
    return f"{count} load{'s' if count > 1 else ''}"
