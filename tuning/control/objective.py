"""What a controller is tuned for: figures of merit of runs, each smooth, and true."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.simulation.simulate import Histories

MERITS = ("peak", "shortfall", "rms", "after_exit", "effort", "contact")
AGGREGATIONS = ("mean", "worst", "cvar")
LIMIT_PENALTY_SLOPE = (
    10.0  # of the objective, for each unit by which a limited figure exceeds its limit
)
Sharpness = Float[Array, ""] | float | None  # of smooth maxima; None for true ones


class WeightsAndLimits(NamedTuple):
    """Weights and limits of all figures of merit, as arrays in the order of `MERITS`."""

    weights: Float[Array, " merit"]
    limits: Float[Array, " merit"]


@dataclasses.dataclass(frozen=True)
class Objective:
    """A weighted sum of figures of merit, and how runs are taken together.

    Every figure is relative to the same run without control: the largest deflection (`peak`), the
    share of its attainable reduction that is missed (`shortfall`: 0 at the bound, 1 without
    control, so that runs with little to gain count as much as others), its root mean square
    (`rms`), the largest `after_exit` of the last load (relative to the peak); the root mean square
    of the commands, relative to the largest within their limits (`effort`); and the largest change
    of a contact force, relative to the weight (`contact`: how rough the ride is). Runs count by
    their "mean", their "worst", or ("cvar") the mean of the worst `tail_share` of them. Figures with
    `limits` must not exceed those, runs taken together likewise.
    """

    weights: dict[str, float] = dataclasses.field(default_factory=lambda: {"peak": 1.0})
    aggregation: str = "worst"
    tail_share: float = 0.25
    limits: dict[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        unknown = (set(self.weights) | set(self.limits)) - set(MERITS)
        if unknown:
            raise ValueError(
                f"there is no merit {min(unknown)!r} to tune for; it may be {', '.join(MERITS)}"
            )
        if not self.weights or any(not 0 < value < float("inf") for value in self.weights.values()):
            raise ValueError("an objective needs merits with positive, finite weights")
        if any(not 0 < value < float("inf") for value in self.limits.values()):
            raise ValueError("limits of merits must be positive and finite")
        if self.aggregation not in AGGREGATIONS:
            raise ValueError(f"over may be {', '.join(AGGREGATIONS)}, not {self.aggregation!r}")
        if not 0 < self.tail_share <= 1:
            raise ValueError(f"share must be above 0 and at most 1; it is {self.tail_share:g}")

    @property
    def target(self) -> WeightsAndLimits:
        """Weights, zero for what does not count, and limits, infinite for what has none."""
        weights = [self.weights.get(name, 0.0) for name in MERITS]
        return WeightsAndLimits(
            jnp.array(weights), jnp.array([self.limits.get(name, jnp.inf) for name in MERITS])
        )

    def penalised(
        self,
        merits: dict[str, Float[Array, " run"]],
        target: WeightsAndLimits,
        sharpness: Sharpness = None,
    ) -> Float[Array, ""]:
        """One number for all runs by the weights of a target, with a price on excess of limits.

        The price is so steep that the least lies at a limit, not beyond it.
        """
        rows = jnp.stack([merits[name] for name in MERITS])
        excess = jnp.stack([self.aggregate(row, sharpness) for row in rows]) - target.limits
        penalty = LIMIT_PENALTY_SLOPE * jnp.sum(jnp.maximum(excess, 0.0))
        return self.aggregate(target.weights @ rows, sharpness) + penalty

    def weighted_merits(self, merits: dict[str, Float[Array, "..."]]) -> Float[Array, "..."]:
        """The weighted sum for runs whose merits are known."""
        return sum((w * merits[name] for name, w in self.weights.items()), jnp.zeros(()))

    def aggregate(
        self, values: Float[Array, " run"], sharpness: Sharpness = None
    ) -> Float[Array, ""]:
        """One number for the values of all runs; smooth if a sharpness is given."""
        if self.aggregation == "mean":
            return jnp.mean(values)
        if self.aggregation == "worst":
            return smooth_max(values, sharpness)
        count = max(1, round(self.tail_share * values.shape[0]))
        return jnp.mean(jnp.sort(values)[-count:])


def smooth_max(values: Float[Array, "..."], sharpness: Sharpness) -> Float[Array, ""]:
    """The largest of some values, or a smooth bound from above that is log(count)/sharpness off."""
    if sharpness is None:
        return jnp.max(values)
    return jax.nn.logsumexp(sharpness * values) / sharpness


def run_merits(
    found: Histories,
    uncontrolled: dict[str, Float[Array, ""]],
    after_exit: Float[Array, " time"],
    command_ranges: Float[Array, " actuator"],
    weights: Float[Array, " load"],
    sharpness: Sharpness = None,
) -> dict[str, Float[Array, ""]]:
    """Figures of merit of one run (see `Objective`); `uncontrolled_peaks` holds those without control, in m,
    and the least peak possible (NaN where it is not known).

    `after_exit` is 1 at samples after the last exit and 0 before; `command_ranges` are the largest commands
    within limits, `weights` those of the loads (N). With a `sharpness` maxima are smooth.
    """
    size = jnp.abs(found.deflection)
    change = jnp.abs(found.contact_force - weights) * (found.contact_force != 0)
    nonzero_weights = jnp.where(weights > 0, weights, 1.0)
    peak, least = (
        smooth_max(size / uncontrolled["peak"], sharpness),
        uncontrolled["least"] / uncontrolled["peak"],
    )
    return {
        "peak": peak,
        "shortfall": (peak - least) / (1 - least),
        "rms": jnp.sqrt(jnp.mean(found.deflection**2)) / uncontrolled["rms"],
        "after_exit": smooth_max(size * after_exit[:, None] / uncontrolled["peak"], sharpness),
        "effort": jnp.sqrt(jnp.mean((found.command / command_ranges) ** 2) + 1e-30),
        "contact": smooth_max(change / nonzero_weights, sharpness),
    }
