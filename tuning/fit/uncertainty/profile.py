"""Profiles of the misfit over a parameter, and their figures."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from jaxbeam.case.fields import refuses_traced
from jaxbeam.plot.style import COLOURS, FAINT, INK, use_style
from tuning.fit.result import Fit
from tuning.fit.uncertainty.covariance import t_quantile
from tuning.fit.uncertainty.posterior import Posterior

LINEAR_AGREEMENT = 0.25  # relative difference of half widths below which intervals agree
MAX_STEPS_PER_SIDE = 12  # steps to each side, each at most twice as long as the one before


@dataclasses.dataclass(frozen=True, eq=False)
class Profile:
    """Profile of a parameter: `values` (SI), and `deviance`, -2 ln L above its minimum, there.

    `interval` is where the deviance stays below `critical_deviance` (95 % confidence); infinite on
    a side on which it does not reach it. `linear_interval` is that of the linearised fit.
    """

    address: str
    unit: str
    values: Float[np.ndarray, " point"]
    deviance: Float[np.ndarray, " point"]
    critical_deviance: float
    interval: tuple[float, float]
    linear_interval: tuple[float, float]

    @property
    def verdict(self) -> str:
        """The interval, and how it compares with the linear one, in a sentence."""
        low, high = self.interval
        unit = "" if self.unit in ("", "1") else f" {self.unit}"
        if np.isinf(low) and np.isinf(high):
            return f"{self.address} is not identifiable from the data: every value fits as well"
        if np.isinf(high):
            return f"the data only say that {self.address} is above {low:.5g}{unit}"
        if np.isinf(low):
            return f"the data only say that {self.address} is below {high:.5g}{unit}"
        statement = f"{self.address} is between {low:.5g} and {high:.5g}{unit}"
        ends = np.abs(np.array(self.interval) - self.linear_interval)
        if not np.all(np.isfinite(self.linear_interval)):
            return f"{statement}, though not identifiable by the linearised fit"
        if np.all(ends < LINEAR_AGREEMENT * (high - low) / 2):
            return f"{statement}, as the linearised fit says"
        return f"{statement}; the linearised interval is misleading, use this one"


@refuses_traced("a profile")
def profile(fit: Fit, address: str, points: int = 4) -> Profile:
    """Profile likelihood of a parameter, on both sides of its fitted value.

    The noise is that of the fit, widened for autocorrelation. About `points` steps lie on either
    side within the interval; steps lengthen where the deviance hardly rises. Nothing is compiled
    anew.

    Raises ValueError if the parameter is not free.

    The `address` is one of those that were free in the fit.

    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     sensors=[jb.Sensor(0.3, noise=1e-5)],
    ...     loads=[jb.MovingForce(force=4.0, speed=2.0)],
    ...     run=jb.Run(0.4, sample_rate=50.0),
    ... )
    >>> logs = []
    >>> for speed in (2.0, 2.5):
    ...     record = jb.simulate(jb.replace(case, {"loads.0.speed": speed}))
    ...     columns = ("w",), ("deflection",), ("m",), f"{speed} m/s", (0,)
    ...     logs.append(
    ...         tuning.Log(record.times, record.measured, *columns, loads=record.case.loads)
    ...     )
    >>> start = jb.replace(case, {"beam.flexural_rigidity": 10.0})
    >>> fit = tuning.identify(start, logs, "beam.flexural_rigidity")
    >>> found = tuning.fit.profile(fit, "beam.flexural_rigidity", points=1)
    >>> print(f"{found.interval[0]:.1f} to {found.interval[1]:.1f} {found.unit}")
    12.0 to 12.1 N m^2
    """
    if address not in fit.addresses:
        raise ValueError(f"{address} is not free in this fit; free are {', '.join(fit.addresses)}")
    index = fit.addresses.index(address)
    critical_deviance = t_quantile(fit.degrees_of_freedom) ** 2
    noise = fit.widened_noise
    # With weights widened channel by channel the minimum is not quite that of the fit.
    centre = _refit(fit, fit.unbounded, noise)
    least = fit.least_squares.values_at(centre)
    parameter, value = fit.parameters[index], float(least[index])
    best = fit.least_squares.cost(least, noise, fit.dataset.measured)
    error = fit.errors[index]
    size = parameter.typical_size_at(value)
    step = min(error, size / 2) * np.sqrt(critical_deviance) / points
    values, deviance = [value], [0.0]
    for side in (-1.0, 1.0):
        moved_value, stride, rise, point = value, side * step, 0.0, centre
        for _ in range(MAX_STEPS_PER_SIDE):
            if not parameter.low < moved_value + stride < parameter.high:
                break
            moved_value += stride
            point, before = np.array(point), rise
            point[index] = parameter.to_unbounded(moved_value)
            point = _refit(fit, point, noise, index)
            cost = fit.least_squares.cost(
                fit.least_squares.values_at(point), noise, fit.dataset.measured
            )
            rise = 2 * (cost - best)
            values.append(moved_value)
            deviance.append(rise)
            if rise > 1.3 * critical_deviance or not np.isfinite(rise):
                break
            if rise - before < critical_deviance / points**2:
                stride *= 2
    order = np.argsort(values)
    values, deviance = np.array(values)[order], np.array(deviance)[order]
    interval = tuple(
        _interval_end(values, deviance, value, critical_deviance, side) for side in (-1, 1)
    )
    linear = tuple(map(float, fit.intervals[index]))
    return Profile(address, parameter.unit, values, deviance, critical_deviance, interval, linear)


def _refit(fit: Fit, point, noise, held: int | None = None) -> Float[np.ndarray, " parameter"]:
    """Search variables with one parameter held and the others fitted, from a point on."""
    free = np.arange(point.size) != (-1 if held is None else held)
    if not free.any():
        return point
    search = fit.least_squares
    scale = search.step_scale(point, noise)
    found, _ = search.minimise(point, scale, search.weights(noise), fit.dataset.measured, free)
    return found


def _interval_end(values, deviance, best: float, critical_deviance: float, side: int) -> float:
    """Value at which the root of the deviance, nearly a straight line, reaches the critical one."""
    on_side = side * (values - best) >= 0
    side_values = values[on_side][::side]
    roots = np.maximum.accumulate(np.sqrt(np.maximum(deviance[on_side][::side], 0.0)))
    finite = np.isfinite(roots)
    if not np.any(roots[finite] > np.sqrt(critical_deviance)):
        return side * np.inf
    return float(np.interp(np.sqrt(critical_deviance), roots[finite], side_values[finite]))


PANELS_PER_ROW = 3


@use_style
def plot_profiles(profiles: Sequence[Profile]) -> Figure:
    """Figure of the deviance of each parameter, with its critical value and the interval."""
    figure, panels = _panels(len(profiles))
    for axes, found in zip(panels, profiles, strict=False):
        axes.plot(found.values, found.deviance, "o-", color=INK, markersize=3, linewidth=1)
        axes.axhline(found.critical_deviance, color=COLOURS[1], linewidth=1)
        for end in found.interval:
            if np.isfinite(end):
                axes.axvline(end, color=COLOURS[1], linewidth=0.8, linestyle=":")
        if np.all(np.isfinite(found.linear_interval)):
            axes.axvspan(*found.linear_interval, color=FAINT, alpha=0.6, linewidth=0)
        axes.set(
            title=found.address,
            ylabel="rise of $-2\\,\\ln L$",
            ylim=(0, 2 * found.critical_deviance),
        )
        axes.set_xlabel("" if found.unit == "1" else found.unit)
    return figure


@use_style
def plot_posterior(posterior: Posterior) -> Figure:
    """Figure of histograms of the draws of each parameter, a line for each chain, and intervals."""
    figure, panels = _panels(len(posterior.addresses))
    for i, axes in enumerate(panels):
        draws = posterior.draws[..., i]
        bin_edges = np.linspace(draws.min(), draws.max(), 31)
        for j, chain in enumerate(draws):
            axes.hist(
                chain, bin_edges, histtype="step", density=True, color=COLOURS[j % len(COLOURS)]
            )
        axes.axvspan(*posterior.intervals[i], color=FAINT, alpha=0.6, linewidth=0)
        axes.set(title=posterior.addresses[i], yticks=[])
    return figure


def _panels(count: int):
    """A figure with so many panels, and its axes."""
    rows = -(-count // PANELS_PER_ROW)
    figure = Figure(figsize=(3.2 * min(count, PANELS_PER_ROW), 2.4 * rows))
    grid = figure.subplots(rows, min(count, PANELS_PER_ROW), squeeze=False).ravel()
    for axes in grid[count:]:
        axes.axis("off")
    return figure, grid[:count]
