"""Axles in the responses of a bridge: their number, positions and speeds.

Forces at each count of axles cross the vibrating bridge, from starts of `search_geometry` and of
the count before, one of whose axles is taken for two. The mean square r_n of what remains is due to
dynamic wheel forces on an unknown road, rather than to noise: the readings count for no more
numbers m than these forces have degrees of freedom (see `dynamic_forces`). With a force and a
distance for each axle,

    BIC_n = m ln r_n + 2 n ln m.

One more axle needs strong evidence: of the counts whose criterion is within 6 of the lowest (Kass
and Raftery 1995, DOI 10.1080/01621459.1995.10476572) the smallest is taken.

Speed, entry time and distances of the axles are found with static influence lines, and their forces
by Moses' method; from there all are fitted together to the vibrating bridge. The road is unknown:
the intervals of both allow for dynamic wheel forces as large as the residuals say
(`dynamic_forces`).
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.case.loads.axles import Axles
from jaxbeam.files.report import text_table
from tuning.fit.identify import identify
from tuning.fit.result import Fit
from tuning.logs.log import Log
from tuning.logs.pairing import sensor_readings
from tuning.weighing.dynamic_forces import (
    DynamicErrors,
    UnitForce,
    degrees_of_freedom,
    dynamic_errors,
    dynamic_readings,
    white_noise,
)
from tuning.weighing.influence_lines import InfluenceLines, check_static, model_influence_lines
from tuning.weighing.moses import AxleGeometry, MosesFit, find_geometry, moses, search_geometry

EVIDENCE = 6.0  # difference of BIC that is strong
MOST_AXLES = 8
RISES = 2  # counts beyond the best that are tried
HALF_GAP = 0.7  # m, of the two axles for which one is taken


@dataclasses.dataclass(frozen=True)
class AxleCount:
    """Number of axles chosen, and BIC by number."""

    chosen: int
    bic: dict[int, float]

    def __str__(self) -> str:
        criteria = ", ".join(f"{n}: {value:.1f}" for n, value in self.bic.items())
        return (
            f"BIC by number of axles, of which the smallest within {EVIDENCE:g} of the lowest is"
            f" taken: {criteria}; the option `axles` sets another"
        )


def count_axles(
    case: Case,
    times: Float[np.ndarray, " time"],
    readings: Float[np.ndarray, "time sensor"],
    speeds: tuple[float, float],
    both_ways: bool = False,
) -> AxleCount:
    """Number of axles, at most 8, of a vehicle that crossed a beam in readings (SI units).

    `speeds` (m/s) are the lowest and highest possible ones. Axles less than about 1.5 m apart look
    like one.
    """
    unit_force = UnitForce(case, float(times[-1] - times[0]), vibrating=True)

    def unit_readings(geometry: AxleGeometry, times):
        entries = geometry.entry_time + geometry.offsets / abs(geometry.speed)
        return np.stack([unit_force.readings(geometry.speed, times - at) for at in entries], axis=1)

    search = unit_readings, unit_force.length, times, readings, speeds
    misfits, freedom, starts = {}, 1.0, []
    while len(misfits) < MOST_AXLES:
        axles = len(misfits) + 1
        geometry, misfits[axles], forces = search_geometry(*search, axles, both_ways, starts)
        waves = dynamic_readings(unit_readings(geometry, times), forces, times)
        freedom = max(freedom, degrees_of_freedom(waves))
        bic = {n: freedom * np.log(r) + 2 * n * np.log(freedom) for n, r in misfits.items()}
        lowest = min(bic.values())
        if axles - max(n for n, value in bic.items() if value == lowest) >= RISES:
            break
        starts = _with_one_taken_for_two(geometry)
    chosen = min(n for n, value in bic.items() if value <= lowest + EVIDENCE)
    return AxleCount(chosen, {n: float(value) for n, value in bic.items()})


def _with_one_taken_for_two(geometry: AxleGeometry) -> list[AxleGeometry]:
    """Geometries with two axles in the place of one of those of a geometry."""
    found = []
    for i, at in enumerate(geometry.offsets):
        pair = [at - HALF_GAP, at + HALF_GAP]
        offsets = np.sort([*np.delete(geometry.offsets, i), *pair])
        entry = geometry.entry_time + offsets[0] / abs(geometry.speed)
        gaps = np.maximum(np.diff(offsets), HALF_GAP)
        offsets = np.append(0.0, np.cumsum(gaps))
        found.append(AxleGeometry(geometry.speed, entry, offsets, geometry.length))
    return found


GAP_RANGE = (0.5, 1.6)  # of the distance to the next axle, within which it is fitted
SPEED_RANGE = (0.8, 1.25)  # of the speed


@dataclasses.dataclass(frozen=True, eq=False)
class AxleWeighing:
    """Axle loads found in a log: by Moses' method, and by the fit with the vibration of the bridge.

    The load of the fit has `forces` (N), `offsets` (m, behind the first axle), speed and entry
    time. `dynamic` has the errors of the parameters of the fit on an unknown road, which are larger
    than the fit's own. `count` says how the number of axles was chosen; None if it was given.

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
    >>> found = tuning.weigh_axles(case, log, (1.0, 3.0), axles=1)
    >>> print(found.fit.addresses)
    ['loads.0.forces.0', 'loads.0.speed', 'loads.0.entry_time', 'sensors.0.offset']
    """

    moses: MosesFit
    fit: Fit
    dynamic: DynamicErrors
    count: AxleCount | None = None

    @property
    def intervals(self) -> Float[np.ndarray, "parameter 2"]:
        """95 % intervals of the parameters of the fit on an unknown road."""
        values, half = self.fit.values, self.dynamic.half_widths
        return np.stack([values - half, values + half], axis=1)

    def _number(self, address: str) -> dict:
        """Value, standard error and interval of a parameter of the fit."""
        i = self.fit.addresses.index(address)
        return {
            "value": float(self.fit.values[i]),
            "standard_error": float(self.dynamic.errors[i]),
            "interval_95": self.intervals[i].tolist(),
        }

    @property
    def load(self) -> Axles:
        """The fitted axles."""
        load = self.fit.cases[0].loads[0]
        assert isinstance(load, Axles)
        return load

    def to_dict(self) -> dict:
        """Axle loads with intervals by both methods, spacings and speed (SI units), for JSON."""
        geometry = self.moses.geometry
        count = len(self.moses.forces)
        rows = zip(self.moses.forces, self.moses.errors, self.moses.intervals, strict=True)
        gross, gross_error = self.moses.gross_weight
        by_moses = [
            {"value": float(force), "standard_error": float(error), "interval_95": pair.tolist()}
            for force, error, pair in rows
        ]
        return {
            "axles": [self._number(f"loads.0.forces.{i}") for i in range(count)],
            "offsets": [self._number(f"loads.0.offsets.{i}") for i in range(1, count)],
            "speed": self._number("loads.0.speed"),
            "entry_time": self._number("loads.0.entry_time"),
            "moses": {
                "axles": by_moses,
                "gross_weight": {"value": gross, "standard_error": gross_error},
                "offsets": geometry.offsets[1:].tolist(),
                "speed": geometry.speed,
            },
            "dynamic_share": self.dynamic.share,
            "bic": {} if self.count is None else {str(n): b for n, b in self.count.bic.items()},
            "verdict": self.fit.verdict,
        }

    def __str__(self) -> str:
        count, geometry = len(self.moses.forces), self.moses.geometry
        rows = []
        for i in range(count):
            low, high = self.moses.intervals[i] / 1e3
            own_low, own_high = self._number(f"loads.0.forces.{i}")["interval_95"]
            rows.append(
                (
                    str(i + 1),
                    f"{float(concrete(self.load.offsets)[i]):.4g}",
                    f"{float(concrete(self.load.forces)[i]) / 1e3:.4g}",
                    f"{own_low / 1e3:.4g} to {own_high / 1e3:.4g}",
                    f"{self.moses.forces[i] / 1e3:.4g}",
                    f"{low:.4g} to {high:.4g}",
                )
            )
        gross, gross_error = self.moses.gross_weight
        header = ("axle", "at (m)", "fitted (kN)", "95 % interval", "Moses (kN)", "95 % interval")
        lines = [
            f"{count} axle{'s' * (count > 1)} found",
            *([] if self.count is None else [str(self.count)]),
            *text_table(header, rows, ">>><><"),
            f"gross weight by Moses' method {gross / 1e3:.5g} kN, standard error"
            f" {gross_error / 1e3:.3g} kN, at {geometry.speed:.4g} m/s",
            f"the intervals above allow for dynamic wheel forces of {self.dynamic.share:.2g} of the"
            " static ones (standard deviation), those below do not",
        ]
        return "\n".join([*lines, "", str(self.fit)])


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
    both directions; `axles` is their number, by default that of `count_axles`. Moses' method has
    the influence lines of the case, or the `influence_lines` given (see
    `calibrate_influence_lines`). The fit has moving forces, the vibration of the beam, and offsets
    of the sensors; loads and profile of case and log are not used.

    Raises ValueError if speeds are not 0 < low < high, there is no axle, or a sensor measures
    velocity or acceleration, and as `identify` does.

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
    >>> found = tuning.weigh_axles(case, log, (1.0, 3.0), axles=1)
    >>> print(f"{found.load.forces[0]:.1f} N at {found.load.speed:.1f} m/s")
    4.0 N at 2.0 m/s
    """
    low, high = speeds
    if not 0 < low < high:
        raise ValueError(f"speeds must be 0 < low < high in m/s; they are {low:g} and {high:g}")
    if axles is not None and axles < 1:
        raise ValueError(f"the number of axles must be 1 or more, not {axles}")
    check_static(case)
    case = dataclasses.replace(case, loads=(), vehicle_sensors=(), profile=None)
    lines = model_influence_lines(case) if influence_lines is None else influence_lines
    readings, valid = sensor_readings(case, log)
    count = None
    if axles is None:
        count = count_axles(case, log.times, readings, (low, high), both_ways)
        axles = count.chosen
    geometry = find_geometry(lines, log.times, readings, (low, high), axles, both_ways)
    static = moses(lines, geometry, log.times, readings, valid, found=True)
    fit = identify(case, *axle_problem(case, log, static))
    problem = fit.least_squares
    jacobian = problem.linearised(fit.values)[1][0]
    errors = errors_of_fit(lines, fit.addresses, fit.values, jacobian, fit.noise[0], log.times,
                           readings, readings - fit.fitted[0], valid)  # fmt: skip
    return AxleWeighing(static, fit, errors, count)


def errors_of_fit(
    lines: InfluenceLines,
    addresses: list[str],
    values: Float[np.ndarray, " parameter"],
    jacobian: Float[np.ndarray, "time sensor parameter"],
    noise: Float[np.ndarray, " sensor"],
    times: Float[np.ndarray, " time"],
    readings: Float[np.ndarray, "time sensor"],
    residuals: Float[np.ndarray, "time sensor"],
    valid: np.ndarray,
) -> DynamicErrors:
    """Errors of the parameters of `axle_problem` on an unknown road.

    `noise` is the standard deviation of the residuals, by which the fit has weighted the sensors.
    """
    found = dict(zip(addresses, values, strict=True))
    axles = sum(address.startswith("loads.0.forces") for address in addresses)
    forces = np.array([found[f"loads.0.forces.{i}"] for i in range(axles)])
    offsets = np.array([0.0, *(found[f"loads.0.offsets.{i}"] for i in range(1, axles))])
    length = float(lines.positions[-1])
    at = AxleGeometry(found["loads.0.speed"], found["loads.0.entry_time"], offsets, length)
    waves = dynamic_readings(lines.at(at.positions(times)), forces, times)
    rows = np.moveaxis(jacobian, 2, 1)
    return dynamic_errors(rows, waves, residuals, white_noise(readings, valid), valid / noise)


def axle_problem(
    case: Case, log: Log, static: MosesFit
) -> tuple[Log, dict[str, tuple[float, float] | None]]:
    """The log with the axles of Moses' method as its load, and the free parameters of the fit."""
    geometry = static.geometry
    least = 1e-2 * max(float(np.max(static.forces)), 1e-12)
    load = Axles(
        offsets=geometry.offsets,
        forces=np.maximum(static.forces, least),
        speed=geometry.speed,
        entry_time=geometry.entry_time,
    )
    gaps = np.diff(geometry.offsets)
    free: dict[str, tuple[float, float] | None] = {}
    for i in range(len(static.forces)):
        free[f"loads.0.forces.{i}"] = None
    for i in range(1, len(static.forces)):
        # Neighbours keep their order: each stays on its side of the middle between them.
        behind = gaps[i] / 2 if i < len(gaps) else GAP_RANGE[1] * gaps[i - 1]
        at = geometry.offsets[i]
        free[f"loads.0.offsets.{i}"] = (at - GAP_RANGE[0] * gaps[i - 1], at + 0.98 * behind)
    free["loads.0.speed"] = tuple(sorted(share * geometry.speed for share in SPEED_RANGE))
    crossing = geometry.length / abs(geometry.speed)
    free["loads.0.entry_time"] = (geometry.entry_time - crossing, geometry.entry_time + crossing)
    free |= {f"sensors.{i}.offset": None for i in range(len(case.sensors))}
    return dataclasses.replace(log, loads=(load,)), free
