"""How a load travels: position, speed and acceleration along the beam at any time."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

NEVER = 1e30  # s, never reached; finite, in single precision too: its arithmetic has derivatives


class AbstractTrajectory(eqx.Module):
    """A path x(t) over the beam, entered once and left at most once."""

    length: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def travel(self, t) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
        """Position (m), speed (m/s) and acceleration (m/s^2) at times t (s), of any shape."""

    @abc.abstractmethod
    def window(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Times of entry and exit in s; the exit is `NEVER` where the load stays on the beam."""

    @abc.abstractmethod
    def passage_times(self, positions: Float[Array, " place"]) -> Float[Array, " kink"]:
        """Times in s at which the motion is not smooth, or passes one of the places (m)."""


class AbstractPiecewiseTrajectory(AbstractTrajectory):
    """A path that is made of cubic polynomials in time."""

    @abc.abstractmethod
    def pieces(self) -> tuple[Float[Array, " piece"], Float[Array, "piece 4"]]:
        """The path as cubic polynomials in the time since each of some times (s), from then on.

        Coefficients are in m/s^power, lowest power first. They hold while the load is on the beam.
        """


class Braking(AbstractPiecewiseTrajectory):
    """Constant deceleration from the speed at entry: x = v t - a t^2 / 2 until it stops.

    A negative speed enters at the right end and travels left. A negative deceleration speeds the
    load up.
    """

    speed: Float[Array, ""]
    entry_time: Float[Array, ""]
    deceleration: Float[Array, ""]
    length: Float[Array, ""]

    def _stop(self):
        """Time from entry until it stands still."""
        braking = self.deceleration > 0
        deceleration = jnp.where(braking, self.deceleration, 1.0)
        return jnp.where(braking, jnp.abs(self.speed) / deceleration, NEVER)

    def _reach(self, distance):
        """Time from entry until `distance` is covered: the smaller root of the parabola."""
        speed = jnp.abs(self.speed)
        root = speed**2 - 2 * self.deceleration * distance
        left = jnp.where(root > 0, jnp.sqrt(jnp.where(root > 0, root, 1.0)), 0.0)
        reached = (root >= 0) & (speed + left > 0)
        return jnp.where(reached, 2 * distance / jnp.where(reached, speed + left, 1.0), NEVER)

    def travel(self, t):
        since = t - self.entry_time
        stop = self._stop()
        moving = since < stop
        run = jnp.minimum(since, stop)
        way = jnp.sign(self.speed)
        distance = jnp.abs(self.speed) * run - self.deceleration * run**2 / 2
        speed = jnp.where(moving, jnp.abs(self.speed) - self.deceleration * run, 0.0)
        start = jnp.where(self.speed < 0, self.length, 0.0)
        braking = jnp.where(moving, -self.deceleration, 0.0)
        return start + way * distance, way * speed, way * braking

    def pieces(self):
        start = jnp.where(self.speed < 0, self.length, 0.0)
        rate = -jnp.sign(self.speed) * self.deceleration / 2
        stop = self._stop()
        halt = start + jnp.where(stop < NEVER, self.speed * stop / 2, 0.0)
        nought = jnp.zeros(())
        moving = jnp.stack([start, self.speed, rate, nought])
        standing = jnp.stack([halt, nought, nought, nought])
        times = jnp.stack([self.entry_time, self.entry_time + stop])
        return times, jnp.stack([moving, standing])

    def window(self):
        reach = self._reach(self.length)
        return self.entry_time, jnp.where(reach < NEVER, self.entry_time + reach, NEVER)

    def passage_times(self, positions):
        distance = jnp.where(self.speed < 0, self.length - positions, positions)
        kinks = jnp.append(self._reach(distance), self._stop())
        return jnp.where(kinks < NEVER, self.entry_time + kinks, NEVER)


class Tabulated(AbstractPiecewiseTrajectory):
    """A path through given positions at given times: a not-a-knot cubic spline.

    The load is put on the beam at the first time (or enters when it passes an end) and, when the
    table ends on the beam, stays where it is. Positions must run one way for the times at which
    it passes supports to be step boundaries; a path that turns round is followed all the same.
    """

    times: Float[Array, " point"]
    positions: Float[Array, " point"]
    length: Float[Array, ""]

    def _curvatures(self):
        """Second derivatives of the spline at its knots."""
        t, x = self.times, self.positions
        n = t.shape[0]
        h, slope = jnp.diff(t), jnp.diff(x) / jnp.diff(t)
        if n == 2:
            return jnp.zeros(2)
        if n == 3:
            return jnp.full(3, 2 * (slope[1] - slope[0]) / (h[0] + h[1]))
        inner = jnp.arange(1, n - 1)
        rows = jnp.zeros((n, n))
        rows = rows.at[inner, inner - 1].set(h[:-1])
        rows = rows.at[inner, inner].set(2 * (h[:-1] + h[1:]))
        rows = rows.at[inner, inner + 1].set(h[1:])
        rows = rows.at[0, :3].set(jnp.stack([h[1], -(h[0] + h[1]), h[0]]))
        rows = rows.at[-1, -3:].set(jnp.stack([h[-1], -(h[-2] + h[-1]), h[-2]]))
        return jnp.linalg.solve(rows, jnp.zeros(n).at[inner].set(6 * jnp.diff(slope)))

    def pieces(self):
        knots, x, bend = self.times, self.positions, self._curvatures()
        gap = jnp.diff(knots)
        speed = jnp.diff(x) / gap - gap * (2 * bend[:-1] + bend[1:]) / 6
        jerk = jnp.diff(bend) / gap
        inner = jnp.stack([x[:-1], speed, bend[:-1] / 2, jerk / 6], axis=1)
        end = jnp.zeros(4).at[0].set(x[-1])
        return knots, jnp.concatenate([inner, end[None]])

    def travel(self, t):
        knots, cubics = self.pieces()
        on = (t >= knots[0]) & (t <= knots[-1])
        held = jnp.clip(t, knots[0], knots[-1])
        i = jnp.clip(jnp.searchsorted(knots, held, side="right") - 1, 0, knots.shape[0] - 2)
        since, (place, speed, half, sixth) = held - knots[i], jnp.moveaxis(cubics[i], -1, 0)
        position = place + since * (speed + since * (half + since * sixth))
        rate = speed + since * (2 * half + since * 3 * sixth)
        acceleration = 2 * half + since * 6 * sixth
        return position, jnp.where(on, rate, 0.0), jnp.where(on, acceleration, 0.0)

    def _pass(self, place):
        """First time at which the path passes a place: bisection, then one Newton step.

        The Newton step leaves the value as it is and gives it its derivative.
        """
        beyond = jnp.sign(self.positions - place) * jnp.sign(self.positions[0] - place) <= 0
        last = jnp.argmax(beyond)
        low, high = self.times[jnp.maximum(last - 1, 0)], self.times[last]
        side = jnp.sign(self.positions[0] - place)

        def halve(_, bracket):
            low, high = bracket
            middle = (low + high) / 2
            before = jnp.sign(self.travel(middle)[0] - place) == side
            return jnp.where(before, middle, low), jnp.where(before, high, middle)

        low, high = jax.lax.fori_loop(0, 60, halve, jax.lax.stop_gradient((low, high)))
        time = (low + high) / 2
        position, speed, _ = self.travel(time)
        moving = jnp.abs(speed) > 0
        step = jnp.where(moving, (position - place) / jnp.where(moving, speed, 1.0), 0.0)
        return jnp.where(jnp.any(beyond), time - (step - jax.lax.stop_gradient(step)), NEVER)

    def window(self):
        first, last = self.positions[0], self.positions[-1]
        near = jnp.where(first < last, 0.0, self.length)
        outside = (first < 0) | (first > self.length)
        entry = jnp.where(outside, self._pass(near), self.times[0])
        left = (last < 0) | (last > self.length)
        leaves = jnp.where(left, self._pass(self.length - near), NEVER)
        return entry, jnp.where(last == self.length - near, self.times[-1], leaves)

    def passage_times(self, positions):
        passes = jax.vmap(self._pass)(positions)
        return jnp.append(passes, self.times[-1])
