"""Number of axles of a vehicle or train in a log, by Schwarz's criterion (BIC).

Forces at each count of axles cross the vibrating bridge, from starts of `search_geometry` and of
the count before, one of whose axles is taken for two. The mean square r_n of what remains is due to
dynamic wheel forces on an unknown road, rather than to noise: the readings count for no more
numbers m than these forces have degrees of freedom (see `dynamic_forces`). With a force and a
distance for each axle,

    BIC_n = m ln r_n + 2 n ln m.

One more axle needs strong evidence: of the counts whose criterion is within 6 of the lowest (Kass
and Raftery 1995, DOI 10.1080/01621459.1995.10476572) the smallest is taken.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from tuning.weighing.dynamic_forces import degrees_of_freedom, dynamic_readings
from tuning.weighing.moses import AxleGeometry, search_geometry
from tuning.weighing.unit_force import UnitForce

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
