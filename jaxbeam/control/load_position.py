"""Which load is coming, from deflections alone: at each tick where it is, then how fast that goes.

The deflections at two places or more have another ratio for each place of a load that rests on the
beam, whatever it weighs. So each tick tells where the load is; a straight line through these places
over time is its way, large deflections counting most.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.control.load_update import AbstractLoadIdentifier

# A way is believed that scatters places by so much of the way listened to, after so many ticks with
# deflections as large as the largest: at first the beam lags; its load seems to stay, or to jump.
MIN_TRAVEL_SPREAD, MIN_EFFECTIVE_SAMPLES = 0.1, 8
# Of the square of the largest deflection under a weight: that of rounding is less.
INFLUENCE_ROUNDING = 1e-20


class DeflectionIdentifier(AbstractLoadIdentifier):
    """What is known of a load by now; it is told when it is beyond a share of the way, `until`.

    Deflections of no more than `threshold` (m) are not listened to. The sums are those of the
    weights, with 1, t, t^2, x and t x, for the way; those for the mass of the load; and the largest
    of the weights.
    """

    until: Float[Array, ""]
    threshold: Float[Array, ""]

    @property
    def speed(self) -> Float[Array, ""]:
        """The speed (m/s), negative to the left; one length per second until it is known."""
        return self._speed_and_entry_time()[0]

    @property
    def entry_time(self) -> Float[Array, ""]:
        """When the load entered the beam (s), if it keeps its speed; zero until that is known."""
        return self._speed_and_entry_time()[1]

    @property
    def mass(self) -> Float[Array, ""]:
        """The mass (kg) that fits what was heard; zero where nothing was."""
        return self.fitted_mass(*self.sums[5:7])

    def identified(self, t: Float[Array, ""]) -> tuple[Array, Array]:
        """Whether speed and mass are known at a time (s); they are at once."""
        speed, entry, known = self._speed_and_entry_time()
        travelled = known & ((t - entry) * jnp.abs(speed) >= self.until * self.length)
        return travelled, travelled

    def innovation(self, deflections, t):
        squared_influence = jnp.sum(self.influence_lines**2, axis=0)
        projection = deflections @ self.influence_lines
        # The place at which a weight explains most of the readings, to a share of the spacing.
        # At a pin it bends nothing, but for rounding, which may look like any place.
        observable = squared_influence > INFLUENCE_ROUNDING * jnp.max(squared_influence)
        explained_square = jnp.where(
            observable, projection**2 / jnp.where(observable, squared_influence, 1.0), 0.0
        )
        best = jnp.clip(jnp.argmax(explained_square), 1, squared_influence.shape[0] - 2)
        before, here, after = (explained_square[best + k] for k in (-1, 0, 1))
        second_difference = before - 2 * here + after
        vertex_offset = jnp.where(
            second_difference < 0,
            (before - after) / (2 * jnp.where(second_difference < 0, second_difference, -1.0)),
            0.0,
        )
        position = (
            (best + jnp.clip(vertex_offset, -0.5, 0.5))
            * self.length
            / (squared_influence.shape[0] - 1)
        )
        weight = jnp.sum(deflections**2) ** 2
        line_sums = weight * jnp.stack([jnp.ones(()), t, t**2, position, t * position])
        peak_increment = jnp.maximum(weight - self.sums[7], 0.0)
        increments = jnp.concatenate(
            [line_sums, jnp.stack([projection[best], squared_influence[best], peak_increment])]
        )
        active = ~self.identified(t)[0] & (jnp.max(jnp.abs(deflections)) > self.threshold)
        return jnp.where(active, increments, 0.0)

    def _speed_and_entry_time(self):
        """Speed (m/s) and time of entry (s), and whether they are known."""
        total, t, square, x, product = self.sums[:5]
        time_variance = total * square - t**2
        known = time_variance > 1e-9 * total * square
        speed = (total * product - t * x) / jnp.where(known, time_variance, 1.0)
        min_travel = MIN_TRAVEL_SPREAD * self.until * self.length
        known = (
            known
            & (speed**2 * time_variance > (min_travel * total) ** 2)
            & (total > MIN_EFFECTIVE_SAMPLES * self.sums[7])
        )
        speed = jnp.where(known, speed, self.length)
        start = jnp.where(speed < 0, self.length, 0.0)
        total = jnp.where(known, total, 1.0)
        return speed, jnp.where(known, t / total + (start - x / total) / speed, 0.0), known
