"""Weighing in motion: how many loads crossed, how heavy and how fast, from deflections alone.

Starts come from the exact static influence lines (see `pursuit`); then all loads are fitted
together with the full dynamics. Loads are added as long as residuals are no white noise and
Schwarz's criterion falls (see `criticism`).
"""

import dataclasses

from jaxbeam.case.case import Case
from jaxbeam.case.fields import known
from jaxbeam.case.loads import AbstractLoad, MovingMass
from tuning.fit.identify import Fit, identify
from tuning.fit.matching_pursuit import MatchingPursuit
from tuning.fit.model_validation import (
    WHITENESS_SIGNIFICANCE,
    ModelCriteria,
    channel_residuals,
    compare_fits,
)
from tuning.logs.log import Log

_LOAD_PARAMETERS = ("mass", "speed", "entry_time")
_MAX_MISFIT_RATIO = (
    0.7  # what another load must make of the static misfit to be looked for at first
)
_MAX_RESIDUAL_SHARE = (
    0.65  # of the readings' deviation: one load must leave less to be there at all
)


@dataclasses.dataclass(frozen=True, eq=False)
class Weighing:
    """Loads found in a log: the fit of the best count, and all counts tried, best first.

    `load_counts` is empty where the first count tried left nothing but white noise.
    """

    fit: Fit
    load_counts: list[ModelCriteria]

    @property
    def loads(self) -> tuple[AbstractLoad, ...]:
        """The loads, in the order in which they were found."""
        return self.fit.cases[0].loads

    def to_dict(self) -> dict:
        """Loads with standard errors and intervals (SI units), counts tried, and the verdict."""
        told = self.fit.to_dict()
        loads = [
            {part: told["numbers"][f"loads.{i}.{part}"] for part in _LOAD_PARAMETERS}
            for i in range(len(self.loads))
        ]
        counts = {rival.name: rival.bic for rival in self.load_counts}
        return {"loads": loads, "bic": counts, "verdict": self.fit.verdict}

    def __str__(self) -> str:
        lines = [f"{_count_text(len(self.loads))} found"]
        lines += [f"BIC with {rival.name}: {rival.bic:.1f}" for rival in self.load_counts]
        return "\n".join([*lines, str(self.fit)])


def weigh(
    case: Case, log: Log, speeds: tuple[float, float], max_count: int = 3, both_ways: bool = True
) -> Weighing:
    """Find the masses, speeds and entry times of the loads that crossed a known beam in a log.

    `speeds` (m/s) are the lowest and highest that come into question, in both directions or only
    from the left; at `max_count` so many loads are looked for. Offsets of the sensors are fitted along.
    Loads of the case or the log are not used.

    Raises ValueError if a sensor does not measure deflection, speeds are not 0 < low < high, or no
    load shows in the log, and as `identify` does.
    """
    low, high = speeds
    if not 0 < low < high:
        raise ValueError(f"speeds must be 0 < low < high in m/s; they are {low:g} and {high:g}")
    others = [i for i, sensor in enumerate(case.sensors) if sensor.quantity != "deflection"]
    if others or not case.sensors:
        what = f"sensors.{others[0]} does not measure" if others else "no sensor measures"
        raise ValueError(f"weighing needs deflections; {what} them")
    pursuit = MatchingPursuit(case, log, (low, high), both_ways)
    first = pursuit.find(1)
    if first.residual_rms > _MAX_RESIDUAL_SHARE * pursuit.readings_rms:
        raise ValueError(f"{log.source}: no load shows in it at these speeds")
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
            min(channel.p_value for channel in channel_residuals(fit)) > WHITENESS_SIGNIFICANCE
            or count >= max_count
        ):
            break
        if len(fits) > 1 and compare_fits(fits)[0].name != _count_text(count):
            break
        found = pursuit.find(count + 1)
    criteria = compare_fits(fits) if len(fits) > 1 else []
    return Weighing(fits[criteria[0].name] if criteria else fit, criteria)


def _fit_loads(case: Case, log: Log, loads: list[MovingMass]) -> Fit:
    """Fit all loads together, and the offsets of the sensors."""
    length, end = float(known(case.beam.length)), float(log.times[-1])
    free: dict[str, tuple[float, float] | None] = {}
    for i, load in enumerate(loads):
        speed = float(known(load.speed))
        low, high = sorted([0.3 * speed, 3 * speed])
        free[f"loads.{i}.mass"] = None
        free[f"loads.{i}.speed"] = low, high
        free[f"loads.{i}.entry_time"] = (-length / abs(speed), end)
    free |= {f"sensors.{i}.offset": None for i in range(len(case.sensors))}
    return identify(case, dataclasses.replace(log, loads=tuple(loads)), free)


def _count_text(count: int) -> str:
    return f"{count} load{'s' if count > 1 else ''}"
