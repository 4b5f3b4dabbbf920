"""Objective of a tuning: peaks of the runs of a fixed design."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from jaxbeam.case.case import Case, replace
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.model.modes import Layout
from jaxbeam.model.state_space import state_space
from jaxbeam.runtime.arrays import Array
from jaxbeam.simulation.simulate import Histories


def with_fixed_design(case: Case, nominal: Mapping[str, Any], layout: Layout) -> Case:
    """Case whose control law is designed for the plant with `nominal` values at some addresses.

    Otherwise a law is designed for the plant of its case, hence for each uncertain plant anew.
    `layout` is the order of positions along the beam, the same for both.
    """
    if not nominal or case.controller is None:
        return case
    plant = state_space(replace(case, dict(nominal)), layout=layout)
    return eqx.tree_at(
        lambda c: c.controller.nominal_plant, case, plant, is_leaf=lambda leaf: leaf is None
    )


METRICS = ("peak", "shortfall", "rms", "after_exit", "effort", "contact")
# Metrics named by what sensors measure; deflections have the metric `peak`.
QUANTITY_METRICS = tuple(name for name in QUANTITIES if name != "deflection")
ALL_METRICS = (*METRICS, *QUANTITY_METRICS)
AGGREGATIONS = ("mean", "worst", "cvar")
LIMIT_PENALTY_SLOPE = 10.0  # added to the objective for each unit of a metric beyond its limit
Sharpness = Float[Array, ""] | float | None  # of smooth maxima; None for true maxima


class WeightsAndLimits(NamedTuple):
    """Weights and limits of all metrics, in the order of `ALL_METRICS`."""

    weights: Float[Array, " metric"]
    limits: Float[Array, " metric"]


@dataclasses.dataclass(frozen=True)
class Objective:
    """A weighted sum of metrics, aggregated over runs.

    Metrics, each a ratio (no unit):

    - `peak`: largest deflection over that of the same run without control;
    - `shortfall`: fraction of the attainable reduction of the peak that is missed, 0 at the least
      achievable peak and 1 without control;
    - `rms`: RMS deflection over that without control;
    - `after_exit`: largest deflection after the last exit over the peak without control;
    - `effort`: RMS command over the largest command within limits;
    - `contact`: largest change of a contact force over the weight;
    - `moment`, `shear`, `strain`, `acceleration` and any other quantity of sensors: largest
      absolute value of it at the sensors that measure it, statically corrected, over that without
      control.

    The `aggregation` over runs is their "mean", their "worst" value, or "cvar", the mean of the
    worst `tail_share` of them. Metrics with `limits`, aggregated alike, must not exceed these.

    Raises ValueError for unknown metrics, weights or limits that are not positive and finite, an
    unknown aggregation and a tail share outside 0 to 1.

    >>> import tuning
    >>> objective = tuning.Objective({"shortfall": 1.0, "effort": 0.1}, limits={"rms": 0.8})
    >>> print(objective.aggregation, "of", *objective.weights)
    worst of shortfall effort
    """

    weights: dict[str, float] = dataclasses.field(default_factory=lambda: {"peak": 1.0})
    aggregation: str = "worst"
    tail_share: float = 0.25
    limits: dict[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        unknown = (set(self.weights) | set(self.limits)) - set(ALL_METRICS)
        if unknown:
            raise ValueError(
                f"there is no metric {min(unknown)!r} to tune for; it may be"
                f" {', '.join(ALL_METRICS)}"
            )
        if not self.weights or any(not 0 < value < float("inf") for value in self.weights.values()):
            raise ValueError("an objective needs metrics with positive, finite weights")
        if any(not 0 < value < float("inf") for value in self.limits.values()):
            raise ValueError("limits of metrics must be positive and finite")
        if self.aggregation not in AGGREGATIONS:
            raise ValueError(
                f"aggregation may be {', '.join(AGGREGATIONS)}, not {self.aggregation!r}"
            )
        if not 0 < self.tail_share <= 1:
            raise ValueError(f"tail_share must be above 0 and at most 1; it is {self.tail_share:g}")

    @property
    def quantities(self) -> tuple[str, ...]:
        """Quantities of sensors among its metrics."""
        named = set(self.weights) | set(self.limits)
        return tuple(name for name in QUANTITY_METRICS if name in named)

    @property
    def target(self) -> WeightsAndLimits:
        """Weights (0 for metrics that do not count) and limits (infinite where there is none)."""
        weights = [self.weights.get(name, 0.0) for name in ALL_METRICS]
        limits = [self.limits.get(name, jnp.inf) for name in ALL_METRICS]
        return WeightsAndLimits(jnp.array(weights), jnp.array(limits))

    def penalised(
        self,
        metrics: dict[str, Float[Array, " run"]],
        target: WeightsAndLimits,
        sharpness: Sharpness = None,
    ) -> Float[Array, ""]:
        """Objective of all runs with the weights of a target, plus a penalty on limits exceeded.

        The penalty is so steep that the minimum lies at a limit, not beyond it.
        """
        none = jnp.zeros_like(metrics[METRICS[0]])  # of quantities that are not tuned for
        rows = jnp.stack([metrics.get(name, none) for name in ALL_METRICS])
        excess = jnp.stack([self.aggregate(row, sharpness) for row in rows]) - target.limits
        penalty = LIMIT_PENALTY_SLOPE * jnp.sum(jnp.maximum(excess, 0.0))
        return self.aggregate(target.weights @ rows, sharpness) + penalty

    def weighted_metrics(self, metrics: dict[str, Float[Array, "..."]]) -> Float[Array, "..."]:
        """Weighted sum of metrics."""
        return sum((w * metrics[name] for name, w in self.weights.items()), jnp.zeros(()))

    def aggregate(
        self, values: Float[Array, " run"], sharpness: Sharpness = None
    ) -> Float[Array, ""]:
        """Aggregated value of all runs; with smooth maxima if a sharpness is given."""
        if self.aggregation == "mean":
            return jnp.mean(values)
        if self.aggregation == "worst":
            return smooth_max(values, sharpness)
        count = max(1, round(self.tail_share * values.shape[0]))
        return jnp.mean(jnp.sort(values)[-count:])


def smooth_max(values: Float[Array, "..."], sharpness: Sharpness) -> Float[Array, ""]:
    """Largest of some values or, with a sharpness, an upper bound within log(count) / sharpness."""
    if sharpness is None:
        return jnp.max(values)
    return jax.nn.logsumexp(sharpness * values) / sharpness


def run_metrics(
    found: Histories,
    uncontrolled: dict[str, Float[Array, ""]],
    after_exit: Float[Array, " time"],
    command_ranges: Float[Array, " actuator"],
    weights: Float[Array, " load"],
    sharpness: Sharpness = None,
) -> dict[str, Float[Array, ""]]:
    """Metrics of one run (see `Objective`), by name.

    `uncontrolled` holds "peak" and "rms" (m) without control, the "least" achievable peak (m, NaN
    if not computed), and the largest value of each quantity in `found.measured`; `after_exit` is 1
    at samples after the last exit and 0 before; `command_ranges` are the largest commands within
    limits, `weights` those of the loads (N). With a `sharpness` maxima are smooth.
    """
    size = jnp.abs(found.deflection)
    change = jnp.abs(found.contact_force - weights) * (found.contact_force != 0)
    change = change * (weights > 0)  # absorbers have none
    nonzero_weights = jnp.where(weights > 0, weights, 1.0)
    peak = smooth_max(size / uncontrolled["peak"], sharpness)
    least = uncontrolled["least"] / uncontrolled["peak"]
    commands = found.command / command_ranges
    effort = jnp.sum(commands**2) / max(1, commands.size)
    measured = {
        name: smooth_max(jnp.abs(history) / uncontrolled[name], sharpness)
        for name, history in found.measured.items()
    }
    return measured | {
        "peak": peak,
        "shortfall": (peak - least) / (1 - least),
        "rms": jnp.sqrt(jnp.mean(found.deflection**2)) / uncontrolled["rms"],
        "after_exit": smooth_max(size * after_exit[:, None] / uncontrolled["peak"], sharpness),
        "effort": jnp.sqrt(effort + 1e-30),
        "contact": smooth_max(change / nonzero_weights, sharpness),
    }
