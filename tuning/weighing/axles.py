"""Axle loads and spacings of a vehicle or train from readings of a bridge.

Influence lines and first modes, of the model or calibrated by known vehicles, serve all steps: the
search of speed, entry time and distances (`search`), Moses' method, and the fit, in which dynamic
wheel forces on an unknown road and errors of calibrated lines are noise (`axle_fit`).

The number of axles is that of least Schwarz's criterion (BIC). The least mean square r_n that n
axles with constant forces leave is due to dynamic wheel forces on an unknown road, rather than to
noise: readings count for no more numbers m than these forces have degrees of freedom, and
BIC_n = m ln r_n + 2 n ln m. One more axle needs strong evidence: of the numbers whose criterion is
within 6 of the lowest (Kass and Raftery 1995, DOI 10.1080/01621459.1995.10476572) the smallest is
taken.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.loads.axles import Axles
from jaxbeam.runtime.printer import text_table
from tuning.logs.log import Log
from tuning.logs.pairing import sensor_readings
from tuning.weighing.axle_fit import SHARES, AxleFit, fit_axles
from tuning.weighing.dynamic_forces import degrees_of_freedom, dynamic_readings
from tuning.weighing.influence_lines import InfluenceLines, check_static, model_influence_lines
from tuning.weighing.moses import MosesFit, moses
from tuning.weighing.search import AxleSearch

EVIDENCE = 6.0  # difference of BIC that is strong
MOST_AXLES = 8
RISES = 2  # numbers beyond the best that are tried
GROUP_GAP = 2.2  # m, of axles of one group (COST 323)


@dataclasses.dataclass(frozen=True, eq=False)
class AxleWeighing:
    """Axle loads found in a log, and those of Moses' method at the same geometry.

    `case` has the axles found as its load. `bic` are criteria by number of axles, of which the
    smallest within strong evidence of the lowest is taken; empty if the number was given.

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
    >>> found = tuning.weighing.weigh_axles(case, log, (1.0, 3.0), axles=1)
    >>> print(f"{found.fit.gross_weight[0]:.1f} N")
    4.0 N
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
        apart = np.flatnonzero(np.diff(self.fit.geometry.offsets) >= GROUP_GAP) + 1
        return [part.tolist() for part in np.split(np.arange(self.fit.forces.size), apart)]

    def to_dict(self) -> dict:
        """Axle loads with intervals by both methods, groups, spacings, speed (SI), for JSON."""
        fit, count = self.fit, self.fit.forces.size
        numbers = [
            {"value": float(value), "standard_error": float(error), "interval_95": pair.tolist()}
            for value, error, pair in zip(fit.values, fit.errors, self.intervals, strict=True)
        ]
        by_moses = [
            {"value": float(force), "standard_error": float(error), "interval_95": pair.tolist()}
            for force, error, pair in zip(
                self.moses.forces, self.moses.errors, self.moses.intervals, strict=True
            )
        ]
        return {
            "axles": numbers[:count],
            "groups": [{"axles": own, **_of_weight(fit.group_weight(own))} for own in self.groups],
            "gross_weight": _of_weight(fit.gross_weight),
            "speed": numbers[count],
            "entry_time": numbers[count + 1],
            "offsets": numbers[count + 2 :],
            "moses": {"axles": by_moses, "gross_weight": _of_weight(self.moses.gross_weight)},
            "dynamic_fraction": fit.dynamic_share,
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
        if fit.dynamic_share > 0.95 * SHARES[1]:
            lines.append(
                "no road gives so large dynamic wheel forces: number of axles, range of speeds or"
                " influence lines are wrong, and intervals too narrow; calibrate by more runs"
            )
        if self.bic:
            lines.append(
                f"BIC by number of axles, of which the smallest within {EVIDENCE:g} of the lowest"
                f" is taken: {criteria}  [--axles NUMBER]"
            )
        return "\n".join(lines)


def _of_weight(weight: tuple[float, float]) -> dict:
    return {"value": weight[0], "standard_error": weight[1]}


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
    both directions; `axles` is their number, by default that of least BIC, at most 8. All steps use
    the `influence_lines`, by default those of the case (see `calibrate_influence_lines`).
    Loads and profile of case and log are not used. An axle has at least a twenty-fifth of the gross
    weight, unless no others explain the readings.

    Raises ValueError if speeds are not 0 < low < high, there is no axle, a sensor measures velocity
    or acceleration, the influence lines are of other sensors, or nothing crosses in the log.

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
    >>> found = tuning.weighing.weigh_axles(case, log, (1.0, 3.0), axles=1)
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
    if lines.values.shape[1] != len(case.sensors):
        raise ValueError(
            f"the influence lines are of {lines.values.shape[1]} sensors, the case has "
            f"{len(case.sensors)}: calibrate with this case"
        )
    readings, valid = sensor_readings(case, log)
    search = AxleSearch(lines, log.times, readings, speeds, both_ways)
    if not search.combs[0][2]:
        raise ValueError(
            f"{log.source}: no load is found in it at {low:g} to {high:g} m/s: other speeds?"
        )

    fits, bic, before, of_number = {}, {}, None, {}
    misfits: dict[int, float] = {}
    freedom = 1.0
    for count in range(1, (axles or MOST_AXLES) + 1):
        found = search.axles(count, before)
        if before is not None:
            found += search.with_one_more(
                before._replace(geometry=fits[count - 1].geometry, forces=fits[count - 1].forces)
            )
        own = [
            fit_axles(one.lines, one.geometry, one.forces, log.times, readings, valid)
            for one in found
        ]
        best = min(range(len(own)), key=lambda k: (not own[k].is_plausible, own[k].deviance))
        fits[count], before = own[best], found[best]
        of_number[count] = before
        plausible = [one.misfit for one in found if one.is_plausible]
        if axles is None and plausible:
            misfits[count] = min(plausible)
            still = before.lines._replace(frequency=None)  # vibration would count as one number
            waves = dynamic_readings(still, before.geometry, before.forces, log.times)
            freedom = max(freedom, degrees_of_freedom(waves))
            bic = {
                n: float(freedom * np.log(misfit) + 2 * n * np.log(freedom))
                for n, misfit in misfits.items()
            }
        if axles is None and bic and count - min(bic, key=lambda n: bic[n]) >= RISES:
            break
    lowest = min(bic.values(), default=0.0)
    bic = {} if axles else bic
    chosen = axles or min((n for n, value in bic.items() if value <= lowest + EVIDENCE), default=1)
    fit = fits[chosen]
    static = moses(of_number[chosen].lines, fit.geometry, log.times, readings, valid, found=True)
    geometry = fit.geometry
    load = Axles(
        offsets=geometry.offsets,
        forces=np.maximum(fit.forces, 1e-6 * fit.forces.sum()),
        speed=geometry.speed,
        entry_time=geometry.entry_time,
    )
    return AxleWeighing(dataclasses.replace(case, loads=(load,)), fit, static, bic)
