"""Axle loads and spacings of a vehicle or train from readings of a bridge.

Influence lines and first modes, of the model or calibrated by known vehicles, serve all steps: the
search of speed, entry time and distances (`search`), Moses' method, and the fit, in which dynamic
wheel forces on an unknown road and errors of calibrated lines are noise (`axle_fit`).

The number of axles is the most likely one (`AxleFit.criterion`).
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import refuses_traced
from jaxbeam.case.loads.axles import Axles
from jaxbeam.runtime.printer import text_table
from tuning.fit.dataset import sensor_readings
from tuning.logs.log import Log
from tuning.weighing.axle_fit import AxleFit, CrossingLog, interpolated, telling_sensors
from tuning.weighing.influence_lines import InfluenceLines, lines_for
from tuning.weighing.search import find_axles, most_likely, with_free_frequency
from tuning.weighing.vehicles import MOST_EXCESS
from tuning.weighing.weigh import MosesFit, moses


@dataclasses.dataclass(frozen=True, eq=False)
class AxleWeighing:
    """Axle loads found in a log, and those of Moses' method at the same geometry.

    `case` has the axles found as its load. `bic` are criteria by number of axles, of which the
    lowest is taken; empty if the number was given.

    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 8e9, 12e3, damping_ratio=0.02, modes=1),
    ...     sensors=[jb.Sensor(10.0, noise=2e-5)],
    ...     loads=[jb.MovingForce(force=1e5, speed=20.0)],
    ...     run=jb.Run(1.6, sample_rate=50.0),
    ... )
    >>> record = jb.simulate(case)
    >>> columns = ("w",), ("deflection",), ("m",), "log", (0,)
    >>> log = tuning.Log(record.times, record.measured, *columns)
    >>> found = tuning.weighing.weigh_axles(case, log, (10.0, 30.0), axles=1)
    >>> print(f"{found.fit.gross_weight[0] / 1e3:.0f} kN")
    100 kN
    """

    case: Case
    fit: AxleFit
    moses: MosesFit
    bic: dict[int, float]

    @property
    def load(self) -> Axles:
        """The axles found."""
        load = self.case.loads[0]
        assert isinstance(load, Axles)
        return load

    @property
    def intervals(self) -> Float[np.ndarray, "parameter 2"]:
        """95 % intervals of axle forces (N), speed (m/s), entry time (s), offsets (m)."""
        half = self.fit.half_widths
        return np.stack([self.fit.values - half, self.fit.values + half], axis=1)

    @property
    def groups(self) -> list[list[int]]:
        """Axles (from 0) of groups, each less than 2.2 m behind the one before."""
        return self.fit.groups

    def to_dict(self) -> dict:
        """Axle loads with intervals by both methods, groups, spacings, speed (SI), for JSON."""
        fit, count = self.fit, self.fit.forces.size
        numbers = _numbers(fit.values, fit.errors, self.intervals)
        by_moses = _numbers(self.moses.forces, self.moses.errors, self.moses.intervals)
        return {
            "axles": numbers[:count],
            "groups": [{"axles": own, **_of_weight(fit.group_weight(own))} for own in self.groups],
            "gross_weight": _of_weight(fit.gross_weight),
            "speed": numbers[count],
            "entry_time": numbers[count + 1],
            "offsets": numbers[count + 2 :],
            "moses": {"axles": by_moses, "gross_weight": _of_weight(self.moses.gross_weight)},
            "dynamic_fraction": fit.dynamic_share,
            "excess_variance": fit.excess,
            "bic": {str(number): value for number, value in self.bic.items()},
        }

    def __str__(self) -> str:
        fit, count = self.fit, self.fit.forces.size
        rows = [
            (
                str(i + 1),
                f"{fit.geometry.offsets[i]:.4g}",
                f"{fit.forces[i] / 1e3:.4g}",
                "{:.4g} to {:.4g}".format(*self.intervals[i] / 1e3),
                f"{self.moses.forces[i] / 1e3:.4g}",
                "{:.4g} to {:.4g}".format(*self.moses.intervals[i] / 1e3),
            )
            for i in range(count)
        ]
        header = ("axle", "at (m)", "load (kN)", "95 % interval", "Moses (kN)", "95 % interval")
        (gross, error), (by_moses, moses_error) = fit.gross_weight, self.moses.gross_weight
        criteria = ", ".join(f"{n}: {value:.1f}" for n, value in self.bic.items())
        lines = [
            f"{count} axle{'s' * (count > 1)} found, at {fit.geometry.speed:.4g} m/s",
            *text_table(header, rows, ">>><><"),
            f"gross weight {gross / 1e3:.5g} kN, standard error {error / 1e3:.3g} kN; by"
            f" Moses' method {by_moses / 1e3:.5g} kN, standard error {moses_error / 1e3:.3g} kN",
            f"intervals allow for dynamic wheel forces of {fit.dynamic_share:.2g} of the static"
            " ones (standard deviation)",
        ]
        if fit.excess > MOST_EXCESS:
            lines.append(
                f"residuals have {fit.excess:.3g} times the variance that noise and dynamic wheel"
                " forces give them: number of axles, range of speeds, signs of sensors or influence"
                " lines are wrong, and intervals too narrow; calibrate by more runs"
            )
        if self.bic:
            lines.append(
                f"criterion by number of axles, of which the lowest is taken: {criteria}"
                "  [--axles NUMBER]"
            )
        return "\n".join(lines)


def _numbers(values, errors, intervals) -> list[dict]:
    return [
        {"value": float(value), "standard_error": float(error), "interval_95": pair.tolist()}
        for value, error, pair in zip(values, errors, intervals, strict=True)
    ]


def _of_weight(weight: tuple[float, float]) -> dict:
    return {"value": weight[0], "standard_error": weight[1]}


@refuses_traced("a weighing")
def weigh_axles(
    case: Case,
    log: Log,
    speeds: tuple[float, float],
    axles: int | None = None,
    *,
    both_ways: bool = False,
    influence_lines: InfluenceLines | None = None,
) -> AxleWeighing:
    """Forces and distances of the axles of one vehicle or train that crossed a known beam in a log.

    `speeds` (m/s) are the lowest and highest possible ones, from the left or, with `both_ways`, in
    both directions; `axles` is their number, by default the most likely one, at most 9. All steps
    use the `influence_lines`, by default those of the case (see `calibrate_influence_lines`).
    Loads and profile of case and log are not used. An axle has at least a twenty-fifth of the gross
    weight, unless no others explain the readings. Distances and weights are sought as road and rail
    vehicles have them: on a rig of a laboratory use `tuning.identify`.

    Raises ValueError if speeds are not 0 < low < high, there is no axle, a sensor measures velocity
    or acceleration, the influence lines are of other sensors, no sensor has readings that vary, or
    nothing crosses in the log.

    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 8e9, 12e3, damping_ratio=0.02, modes=1),
    ...     sensors=[jb.Sensor(10.0, noise=2e-5)],
    ...     loads=[jb.MovingForce(force=1e5, speed=20.0)],
    ...     run=jb.Run(1.6, sample_rate=50.0),
    ... )
    >>> record = jb.simulate(case)
    >>> columns = ("w",), ("deflection",), ("m",), "log", (0,)
    >>> log = tuning.Log(record.times, record.measured, *columns)
    >>> found = tuning.weighing.weigh_axles(case, log, (10.0, 30.0), axles=1)
    >>> print(f"{found.load.forces[0] / 1e3:.0f} kN at {found.load.speed:.1f} m/s")
    100 kN at 20.0 m/s
    """
    low, high = speeds
    if not 0 < low < high:
        raise ValueError(f"speeds must be 0 < low < high in m/s; they are {low:g} and {high:g}")
    if axles is not None and axles < 1:
        raise ValueError(f"the number of axles must be 1 or more, not {axles}")
    case = dataclasses.replace(case, loads=(), vehicle_sensors=(), profile=None)
    lines = lines_for(case, influence_lines)
    readings, valid = sensor_readings(case, log)
    telling = telling_sensors(readings, valid)
    if not telling.any():
        raise ValueError(f"{log.source}: no sensor has valid readings that vary: take another log")
    readings = interpolated(log.times, readings, valid)[:, telling]
    valid = valid[:, telling]
    lines = with_free_frequency(lines.of_sensors(telling), log.times, readings)
    crossing = CrossingLog(log.times, readings, valid)
    fits, tried = find_axles(lines, crossing, speeds, both_ways, axles)
    if not fits:
        raise ValueError(
            f"{log.source}: no load is found in it at {low:g} to {high:g} m/s: other speeds,"
            " or sensors of the opposite sign?"
        )
    criteria = dict(sorted(tried.items())) if axles is None else {}
    fit = fits[axles] if axles else most_likely(fits)
    static = moses(
        lines, fit.geometry, crossing.times, crossing.readings, crossing.valid, found=True
    )
    geometry = fit.geometry
    load = Axles(
        offsets=geometry.offsets,
        forces=np.maximum(fit.forces, 1e-6 * fit.forces.sum()),
        speed=geometry.speed,
        entry_time=geometry.entry_time,
    )
    return AxleWeighing(dataclasses.replace(case, loads=(load,)), fit, static, criteria)
