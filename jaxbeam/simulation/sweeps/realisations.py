"""Statistics of peaks over random realisations, as seeds of profiles or crowds.

The fractile of a level p is the p-quantile of the values. Its interval is free of assumptions on
their distribution: of n independent realisations, k lie below the true fractile with the binomial
probability B(k; n, p), so that it lies between the values of two ranks with a confidence known
beforehand. Without enough of them the largest value is no bound (p = 0.95 takes 72 for a confidence
of 95 %), and the interval is open. The mean has that of Student.
"""

import math
import re
from collections.abc import Collection
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.model.statics import STATIC_QUANTITIES, static_peak

if TYPE_CHECKING:
    import xarray

CONFIDENCE = 0.95
# Numbers that change no static peak.
UNCHANGED = re.compile(r"profile\..*|loads\.(\d+|\*)\.(speed|entry_time|seed)|run\..*")
PRECISION = 0.05  # half the interval of a fractile over it, with which realisations are enough


def interval_ranks(count: int, level: float, confidence: float = CONFIDENCE) -> tuple[int, int]:
    """Ranks, from 1, of the values that bound the fractile of a level; 0 and count + 1 are open.

    The fractile is beyond each bound with a probability of at most (1 - confidence) / 2.
    """
    from scipy.stats import binom

    missed = (1 - confidence) / 2
    low = int(binom.ppf(missed, count, level))  # B(k < low) <= missed
    while low > 0 and binom.cdf(low - 1, count, level) > missed:
        low -= 1
    high = int(binom.ppf(1 - missed, count, level)) + 1
    return low, high


def least_count(level: float, confidence: float = CONFIDENCE) -> int:
    """Least number of realisations for which both sides of the interval of a fractile are closed.

    >>> from jaxbeam.simulation.sweeps.realisations import least_count
    >>> print(least_count(0.95), least_count(0.5))
    72 6
    """
    missed = (1 - confidence) / 2
    return max(math.ceil(math.log(missed) / math.log(base)) for base in (level, 1 - level))


def realisation_statistics(
    values: Float[np.ndarray, "realisation *run"],
    level: float,
    confidence: float = CONFIDENCE,
    precision: float = PRECISION,
) -> dict[str, np.ndarray]:
    """Mean, fractile, their intervals, and number of realisations still needed, of each run.

    "needed" realisations close the interval of the fractile and shrink half of it to the fraction
    `precision` of the fractile, as intervals shrink with the root of their number; of a fractile of
    0 no number does, unless the bounds are 0. Open ends are infinite. Failed runs, NaN, are left
    out.

    >>> import numpy as np
    >>> from jaxbeam.simulation.sweeps.realisations import realisation_statistics
    >>> found = realisation_statistics(np.arange(1.0, 101.0), 0.95)
    >>> print(found["mean"], round(float(found["fractile"]), 2), found["low"], found["high"])
    50.5 95.05 90.0 100.0
    """
    from scipy.stats import t

    shape = values.shape[1:]
    columns = np.sort(values.reshape(values.shape[0], -1), axis=0)  # NaN last
    names = ("mean", "mean_low", "mean_high", "fractile", "low", "high", "needed", "count")
    found = {name: np.full(columns.shape[1], np.nan) for name in names}
    for i, column in enumerate(columns.T):
        own = column[np.isfinite(column)]
        found["count"][i] = own.size
        if own.size < 2:
            continue
        mean, error = own.mean(), own.std(ddof=1) / math.sqrt(own.size)
        half = float(t.ppf((1 + confidence) / 2, own.size - 1)) * error
        fractile = float(np.quantile(own, level))
        low, high = interval_ranks(own.size, level, confidence)
        bounds = (
            own[low - 1] if low >= 1 else -np.inf,
            own[high - 1] if high <= own.size else np.inf,
        )
        least = least_count(level, confidence) if 0 < level < 1 else own.size
        half_width = (bounds[1] - bounds[0]) / 2
        if 0 < half_width < np.inf:
            ratio = half_width / (precision * abs(fractile)) if fractile else np.inf
            least = max(least, np.ceil(own.size * ratio**2))
        row = mean, mean - half, mean + half, fractile, *bounds, max(0, least - own.size)
        for name, value in zip(names, row, strict=False):
            found[name][i] = value
    return {name: column.reshape(shape) for name, column in found.items()}


def peak_names(dataset: "xarray.Dataset") -> list[str]:
    """Names of the peaks of a sweep."""
    names = map(str, dataset.data_vars)
    return [name for name in names if name.startswith("peak_") and name != "peak_time"]


def static_peaks(case: Case, addresses: Collection[str]) -> list[float]:
    """Static peaks of the sensors, to compare with those of a sweep over addresses.

    NaN where a number at an address may change the static peak, and for quantities without a static
    value. Speeds and profiles do not change static peaks.
    """
    changing = [one for one in addresses if not UNCHANGED.fullmatch(one)]
    found = []
    for sensor in case.sensors:
        peak = math.nan
        if not changing and case.loads and sensor.quantity in STATIC_QUANTITIES:
            parameters = dict(
                fibre_distance=sensor.fibre_distance, section_modulus=sensor.section_modulus
            )
            side = sensor.side or "right"
            place = sensor.position, None, 0
            try:
                given = static_peak(case, *place, quantity=sensor.quantity, side=side, **parameters)
                peak = float(given)
            except ValueError:  # a beam that can move as a rigid body has none
                peak = math.nan
        found.append(peak)
    return found


def realisations(
    dataset: "xarray.Dataset", address: str, level: float = 0.95, confidence: float = CONFIDENCE
) -> "xarray.Dataset":
    """Statistics of the peaks of a sweep over an address, along a dimension `statistic`.

    The statistics are those of `realisation_statistics`, for each quantity and sensor. Raises
    ValueError for an address that is not swept, or a level or confidence not between 0 and 1.
    """
    import xarray

    if address not in dataset.dims:
        raise ValueError(f"{address} is not swept; statistics are over one of {list(dataset.dims)}")
    if not (0 <= level <= 1 and 0 < confidence < 1):
        raise ValueError(
            f"level and confidence lie from 0 to 1, the confidence inside; they are {level:g} and"
            f" {confidence:g}"
        )
    found, of_peaks = {}, {}
    for name in peak_names(dataset):
        peaks = dataset[name].transpose(address, ...)
        of_peaks = realisation_statistics(peaks.values, level, confidence)
        found[name] = (
            ("statistic", *peaks.dims[1:]),
            np.stack(list(of_peaks.values())),
            dict(peaks.attrs),
        )
    coordinates = {name: one for name, one in dataset.coords.items() if address not in one.dims} | {
        "statistic": list(of_peaks)
    }
    attributes = {"level": level, "confidence": confidence, "over": address}
    return xarray.Dataset(found, coordinates, attributes)
