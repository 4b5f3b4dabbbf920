"""Trajectories of loads: position, speed and acceleration along the beam over time."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

NEVER = 1e30  # s, beyond any run; finite, also in single precision, so that derivatives exist


class AbstractTrajectory(eqx.Module):
    """Trajectory x(t) of a load, on the beam from one entry to at most one exit."""

    length: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def kinematics(self, t) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
        """Position (m), speed (m/s) and acceleration (m/s^2) at times t (s), of any shape."""

    @abc.abstractmethod
    def entry_exit_times(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Times of entry and exit (s); the exit is `NEVER` if the load stays on the beam."""

    @abc.abstractmethod
    def passage_times(self, positions: Float[Array, " position"]) -> Float[Array, " time"]:
        """Times (s) of passing the positions (m), and of a discontinuous speed or acceleration.

        `NEVER` stands for what does not happen.
        """


class AbstractPiecewiseTrajectory(AbstractTrajectory):
    """Trajectory of cubic polynomials in time."""

    @abc.abstractmethod
    def cubics(self) -> tuple[Float[Array, " piece"], Float[Array, "piece 4"]]:
        """Breakpoints (s) and coefficients (m/s^power, ascending) of the cubic after each.

        A cubic is in the time since its breakpoint. They hold while the load is on the beam.
        """


class BrakingTrajectory(AbstractPiecewiseTrajectory):
    """Constant deceleration from the speed at entry: x = v t - a t^2 / 2 until it stops.

    A load of negative speed enters at the right end and travels left. A negative deceleration
    accelerates the load.
    """

    speed: Float[Array, ""]
    entry_time: Float[Array, ""]
    deceleration: Float[Array, ""]
    length: Float[Array, ""]

    def _stopping_time(self):
        """Time from entry to standstill (s)."""
        braking = self.deceleration > 0
        deceleration = jnp.where(braking, self.deceleration, 1.0)
        return jnp.where(braking, jnp.abs(self.speed) / deceleration, NEVER)

    def _time_to_cover(self, distance):
        """Time from entry (s) to cover a distance (m): the smaller root of the parabola."""
        speed = jnp.abs(self.speed)
        squared_speed = speed**2 - 2 * self.deceleration * distance
        final_speed = jnp.where(
            squared_speed > 0, jnp.sqrt(jnp.where(squared_speed > 0, squared_speed, 1.0)), 0.0
        )
        reached = (squared_speed >= 0) & (speed + final_speed > 0)
        return jnp.where(
            reached, 2 * distance / jnp.where(reached, speed + final_speed, 1.0), NEVER
        )

    def kinematics(self, t):
        elapsed = t - self.entry_time
        stop = self._stopping_time()
        moving = elapsed < stop
        moving_time = jnp.minimum(elapsed, stop)
        direction = jnp.sign(self.speed)
        distance = jnp.abs(self.speed) * moving_time - self.deceleration * moving_time**2 / 2
        speed = jnp.where(moving, jnp.abs(self.speed) - self.deceleration * moving_time, 0.0)
        start = jnp.where(self.speed < 0, self.length, 0.0)
        braking = jnp.where(moving, -self.deceleration, 0.0)
        return start + direction * distance, direction * speed, direction * braking

    def cubics(self):
        start = jnp.where(self.speed < 0, self.length, 0.0)
        half_acceleration = -jnp.sign(self.speed) * self.deceleration / 2
        stop = self._stopping_time()
        stop_position = start + jnp.where(stop < NEVER, self.speed * stop / 2, 0.0)
        zero = jnp.zeros(())
        moving = jnp.stack([start, self.speed, half_acceleration, zero])
        standing = jnp.stack([stop_position, zero, zero, zero])
        times = jnp.stack([self.entry_time, self.entry_time + stop])
        return times, jnp.stack([moving, standing])

    def entry_exit_times(self):
        crossing_time = self._time_to_cover(self.length)
        return self.entry_time, jnp.where(
            crossing_time < NEVER, self.entry_time + crossing_time, NEVER
        )

    def passage_times(self, positions):
        distance = jnp.where(self.speed < 0, self.length - positions, positions)
        times = jnp.append(self._time_to_cover(distance), self._stopping_time())
        return jnp.where(times < NEVER, self.entry_time + times, NEVER)


class TabulatedTrajectory(AbstractPiecewiseTrajectory):
    """Not-a-knot cubic spline through positions at times.

    The load is on the beam from the first time, or from the time at which it passes an end; where
    the table ends on the beam it stays. Passage times are exact for monotonic positions; where the
    load turns round they are those of the first passage only.
    """

    times: Float[Array, " point"]
    positions: Float[Array, " point"]
    length: Float[Array, ""]

    def _second_derivatives(self):
        """Second derivatives (m/s^2) of the spline at its breakpoints."""
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

    def cubics(self):
        breakpoints, x, second_derivatives = self.times, self.positions, self._second_derivatives()
        intervals = jnp.diff(breakpoints)
        speed = (
            jnp.diff(x) / intervals
            - intervals * (2 * second_derivatives[:-1] + second_derivatives[1:]) / 6
        )
        jerk = jnp.diff(second_derivatives) / intervals
        inner = jnp.stack([x[:-1], speed, second_derivatives[:-1] / 2, jerk / 6], axis=1)
        end = jnp.zeros(4).at[0].set(x[-1])
        return breakpoints, jnp.concatenate([inner, end[None]])

    def kinematics(self, t):
        breakpoints, cubics = self.cubics()
        inside = (t >= breakpoints[0]) & (t <= breakpoints[-1])
        clipped = jnp.clip(t, breakpoints[0], breakpoints[-1])
        i = jnp.clip(
            jnp.searchsorted(breakpoints, clipped, side="right") - 1, 0, breakpoints.shape[0] - 2
        )
        elapsed, (start, speed, half_acceleration, sixth_jerk) = (
            clipped - breakpoints[i],
            jnp.moveaxis(cubics[i], -1, 0),
        )
        position = start + elapsed * (speed + elapsed * (half_acceleration + elapsed * sixth_jerk))
        velocity = speed + elapsed * (2 * half_acceleration + elapsed * 3 * sixth_jerk)
        acceleration = 2 * half_acceleration + elapsed * 6 * sixth_jerk
        return position, jnp.where(inside, velocity, 0.0), jnp.where(inside, acceleration, 0.0)

    def _passage_time(self, target):
        """First time (s) of passing a position (m), by bisection.

        A Newton step of value zero gives it its derivative.
        """
        passed = jnp.sign(self.positions - target) * jnp.sign(self.positions[0] - target) <= 0
        last = jnp.argmax(passed)
        low, high = self.times[jnp.maximum(last - 1, 0)], self.times[last]
        start_side = jnp.sign(self.positions[0] - target)

        def halve(_, bracket):
            low, high = bracket
            middle = (low + high) / 2
            before = jnp.sign(self.kinematics(middle)[0] - target) == start_side
            return jnp.where(before, middle, low), jnp.where(before, high, middle)

        low, high = jax.lax.fori_loop(0, 60, halve, jax.lax.stop_gradient((low, high)))
        time = (low + high) / 2
        position, speed, _ = self.kinematics(time)
        moving = jnp.abs(speed) > 0
        step = jnp.where(moving, (position - target) / jnp.where(moving, speed, 1.0), 0.0)
        return jnp.where(jnp.any(passed), time - (step - jax.lax.stop_gradient(step)), NEVER)

    def entry_exit_times(self):
        first, last = self.positions[0], self.positions[-1]
        entry_end = jnp.where(first < last, 0.0, self.length)
        outside = (first < 0) | (first > self.length)
        entry = jnp.where(outside, self._passage_time(entry_end), self.times[0])
        exits = (last < 0) | (last > self.length)
        exit_time = jnp.where(exits, self._passage_time(self.length - entry_end), NEVER)
        return entry, jnp.where(last == self.length - entry_end, self.times[-1], exit_time)

    def passage_times(self, positions):
        times = jax.vmap(self._passage_time)(positions)
        return jnp.append(times, self.times[-1])
