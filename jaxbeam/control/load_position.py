"""Which load is coming, from deflections alone: at each tick where it is, then how fast that goes.

The deflections at two places or more have another ratio for each place of a load that rests on the
beam, whatever it weighs. So each tick tells where the load is; a straight line through these places
over time is its way, large deflections counting most.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.control.load_update import Listener

# A way is believed that scatters places by so much of the way listened to, after so many ticks with
# deflections as large as the largest: at first the beam lags; its load seems to stay, or to jump.
TRAVELLED, TICKS = 0.1, 8
# Of the square of the largest deflection under a weight: that of rounding is less.
ROUNDING = 1e-20


class Follower(Listener):
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
        return self._way()[0]

    @property
    def entry(self) -> Float[Array, ""]:
        """When the load entered the beam (s), if it keeps its speed; zero until that is known."""
        return self._way()[1]

    @property
    def mass(self) -> Float[Array, ""]:
        """The mass (kg) that fits what was heard; zero where nothing was."""
        return self.mass_of(*self.fit[5:7])

    def told(self, t: Float[Array, ""]) -> tuple[Array, Array]:
        """Whether speed and mass are known at a time (s); they are at once."""
        speed, entry, known = self._way()
        passed = known & ((t - entry) * jnp.abs(speed) >= self.until * self.length)
        return passed, passed

    def news(self, deflections, t):
        size = jnp.sum(self.line**2, axis=0)
        felt = deflections @ self.line
        # The place at which a weight explains most of the readings, to a share of the spacing.
        # At a pin it bends nothing, but for rounding, which may look like any place.
        bends = size > ROUNDING * jnp.max(size)
        explained = jnp.where(bends, felt**2 / jnp.where(bends, size, 1.0), 0.0)
        best = jnp.clip(jnp.argmax(explained), 1, size.shape[0] - 2)
        before, here, after = (explained[best + k] for k in (-1, 0, 1))
        bend = before - 2 * here + after
        shift = jnp.where(bend < 0, (before - after) / (2 * jnp.where(bend < 0, bend, -1.0)), 0.0)
        place = (best + jnp.clip(shift, -0.5, 0.5)) * self.length / (size.shape[0] - 1)
        weight = jnp.sum(deflections**2) ** 2
        way = weight * jnp.stack([jnp.ones(()), t, t**2, place, t * place])
        largest = jnp.maximum(weight - self.fit[7], 0.0)
        news = jnp.concatenate([way, jnp.stack([felt[best], size[best], largest])])
        listening = ~self.told(t)[0] & (jnp.max(jnp.abs(deflections)) > self.threshold)
        return jnp.where(listening, news, 0.0)

    def _way(self):
        """Speed (m/s) and time of entry (s), and whether they are known."""
        total, t, square, x, product = self.fit[:5]
        spread = total * square - t**2
        known = spread > 1e-9 * total * square
        speed = (total * product - t * x) / jnp.where(known, spread, 1.0)
        least = TRAVELLED * self.until * self.length
        known = known & (speed**2 * spread > (least * total) ** 2) & (total > TICKS * self.fit[7])
        speed = jnp.where(known, speed, self.length)
        start = jnp.where(speed < 0, self.length, 0.0)
        total = jnp.where(known, total, 1.0)
        return speed, jnp.where(known, t / total + (start - x / total) / speed, 0.0), known
