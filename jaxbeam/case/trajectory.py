"""Trajectories of loads: position, speed and acceleration along the beam over time."""

import abc

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.runtime.arrays import Array, fori_loop, set_at, stop_gradient, take, vmap, xp
from jaxbeam.runtime.module import Module

NEVER = 1e30  # s, beyond any run; finite, also in single precision, so that derivatives exist


class AbstractTrajectory(Module):
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
        deceleration = xp.where(braking, self.deceleration, 1.0)
        return xp.where(braking, xp.abs(self.speed) / deceleration, NEVER)

    def _time_to_cover(self, distance):
        """Time from entry (s) to cover a distance (m): the smaller root of the parabola."""
        speed = xp.abs(self.speed)
        squared_speed = speed**2 - 2 * self.deceleration * distance
        final_speed = xp.where(
            squared_speed > 0, xp.sqrt(xp.where(squared_speed > 0, squared_speed, 1.0)), 0.0
        )
        reached = (squared_speed >= 0) & (speed + final_speed > 0)
        return xp.where(reached, 2 * distance / xp.where(reached, speed + final_speed, 1.0), NEVER)

    def kinematics(self, t):
        elapsed = t - self.entry_time
        stop = self._stopping_time()
        moving = elapsed < stop
        moving_time = xp.minimum(elapsed, stop)
        direction = xp.sign(self.speed)
        distance = xp.abs(self.speed) * moving_time - self.deceleration * moving_time**2 / 2
        speed = xp.where(moving, xp.abs(self.speed) - self.deceleration * moving_time, 0.0)
        start = xp.where(self.speed < 0, self.length, 0.0)
        braking = xp.where(moving, -self.deceleration, 0.0)
        return start + direction * distance, direction * speed, direction * braking

    def cubics(self):
        start = xp.where(self.speed < 0, self.length, 0.0)
        half_acceleration = -xp.sign(self.speed) * self.deceleration / 2
        stop = self._stopping_time()
        stop_position = start + xp.where(stop < NEVER, self.speed * stop / 2, 0.0)
        zero = xp.zeros(())
        moving = xp.stack([start, self.speed, half_acceleration, zero])
        standing = xp.stack([stop_position, zero, zero, zero])
        times = xp.stack([self.entry_time, self.entry_time + stop])
        return times, xp.stack([moving, standing])

    def entry_exit_times(self):
        crossing_time = self._time_to_cover(self.length)
        return self.entry_time, xp.where(
            crossing_time < NEVER, self.entry_time + crossing_time, NEVER
        )

    def passage_times(self, positions):
        distance = xp.where(self.speed < 0, self.length - positions, positions)
        times = xp.append(self._time_to_cover(distance), self._stopping_time())
        return xp.where(times < NEVER, self.entry_time + times, NEVER)


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
        h, slope = xp.diff(t), xp.diff(x) / xp.diff(t)
        if n == 2:
            return xp.zeros(2)
        if n == 3:
            return xp.full(3, 2 * (slope[1] - slope[0]) / (h[0] + h[1]))
        inner = xp.arange(1, n - 1)
        rows = xp.zeros((n, n))
        rows = set_at(rows, (inner, inner - 1), h[:-1])
        rows = set_at(rows, (inner, inner), 2 * (h[:-1] + h[1:]))
        rows = set_at(rows, (inner, inner + 1), h[1:])
        rows = set_at(rows, np.s_[0, :3], xp.stack([h[1], -(h[0] + h[1]), h[0]]))
        rows = set_at(rows, np.s_[-1, -3:], xp.stack([h[-1], -(h[-2] + h[-1]), h[-2]]))
        return xp.linalg.solve(rows, set_at(xp.zeros(n), inner, 6 * xp.diff(slope)))

    def cubics(self):
        breakpoints, x, second_derivatives = self.times, self.positions, self._second_derivatives()
        intervals = xp.diff(breakpoints)
        speed = (
            xp.diff(x) / intervals
            - intervals * (2 * second_derivatives[:-1] + second_derivatives[1:]) / 6
        )
        jerk = xp.diff(second_derivatives) / intervals
        inner = xp.stack([x[:-1], speed, second_derivatives[:-1] / 2, jerk / 6], axis=1)
        end = set_at(xp.zeros(4), 0, x[-1])
        return breakpoints, xp.concatenate([inner, end[None]])

    def kinematics(self, t):
        breakpoints, cubics = self.cubics()
        inside = (t >= breakpoints[0]) & (t <= breakpoints[-1])
        clipped = xp.clip(t, breakpoints[0], breakpoints[-1])
        i = xp.clip(
            xp.searchsorted(breakpoints, clipped, side="right") - 1, 0, breakpoints.shape[0] - 2
        )
        elapsed, (start, speed, half_acceleration, sixth_jerk) = (
            clipped - take(breakpoints, i),
            xp.moveaxis(take(cubics, i), -1, 0),
        )
        position = start + elapsed * (speed + elapsed * (half_acceleration + elapsed * sixth_jerk))
        velocity = speed + elapsed * (2 * half_acceleration + elapsed * 3 * sixth_jerk)
        acceleration = 2 * half_acceleration + elapsed * 6 * sixth_jerk
        return position, xp.where(inside, velocity, 0.0), xp.where(inside, acceleration, 0.0)

    def _passage_time(self, target):
        """First time (s) of passing a position (m), by bisection.

        A Newton step of value zero gives it its derivative.
        """
        passed = xp.sign(self.positions - target) * xp.sign(self.positions[0] - target) <= 0
        last = xp.argmax(passed)
        low, high = take(self.times, xp.maximum(last - 1, 0)), take(self.times, last)
        start_side = xp.sign(self.positions[0] - target)

        def halve(_, bracket):
            low, high = bracket
            middle = (low + high) / 2
            before = xp.sign(self.kinematics(middle)[0] - target) == start_side
            return xp.where(before, middle, low), xp.where(before, high, middle)

        low, high = fori_loop(0, 60, halve, stop_gradient((low, high)))
        time = (low + high) / 2
        position, speed, _ = self.kinematics(time)
        moving = xp.abs(speed) > 0
        step = xp.where(moving, (position - target) / xp.where(moving, speed, 1.0), 0.0)
        return xp.where(xp.any(passed), time - (step - stop_gradient(step)), NEVER)

    def entry_exit_times(self):
        first, last = self.positions[0], self.positions[-1]
        entry_end = xp.where(first < last, 0.0, self.length)
        outside = (first < 0) | (first > self.length)
        entry = xp.where(outside, self._passage_time(entry_end), self.times[0])
        exits = (last < 0) | (last > self.length)
        exit_time = xp.where(exits, self._passage_time(self.length - entry_end), NEVER)
        return entry, xp.where(last == self.length - entry_end, self.times[-1], exit_time)

    def passage_times(self, positions):
        times = vmap(self._passage_time)(positions)
        return xp.append(times, self.times[-1])
