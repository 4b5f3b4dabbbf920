"""Trajectories of loads: position, speed and acceleration along the beam over time."""

import abc

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.runtime.arrays import (
    Array,
    Module,
    fori_loop,
    is_jax,
    set_at,
    stop_gradient,
    take,
    vmap,
    xp,
)

NEVER = 1e30  # s, beyond any run; finite, also in single precision, so that derivatives exist
SAME_TIME = 1e-12  # of a time: a sample that is earlier by less is at it
SAME_FRACTION = 1e-6  # of a crossing, likewise, in single precision, too
SAME_SAMPLE = 3e-7  # of a time, likewise in single precision


def has_come(time, t):
    """Whether a time (s) has come at t (s), which may be the same but for rounding."""
    return t >= time - SAME_TIME * xp.abs(time)


class AbstractTrajectory(Module):
    """Trajectory x(t) of the first wheel of a load, from before its entry to at most one exit.

    Wheels that are `behind` the first one (m) follow at that distance.
    """

    length: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def direction(self) -> Float[Array, ""]:
        """1 for a load that enters at the left end, -1 for one that enters at the right end."""

    @abc.abstractmethod
    def kinematics(self, t) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
        """Position (m), speed (m/s) and acceleration (m/s^2) at times t (s), of any shape."""

    @abc.abstractmethod
    def entry_exit_times(
        self, behind: Float[Array, " wheel"] | float = 0.0
    ) -> tuple[Float[Array, "*wheel"], Float[Array, "*wheel"]]:
        """Times of entry and exit of wheels (s); `NEVER` for an exit of one that stays."""

    @abc.abstractmethod
    def passage_times(
        self, positions: Float[Array, " position"], behind: Float[Array, " wheel"] | float = 0.0
    ) -> Float[Array, " time"]:
        """Times (s) at which wheels pass the positions (m), and of a jump in speed or acceleration.

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
    accelerates the load. At `entry_time` (s) its first wheel is at `start` (m), by default the end
    of the beam; before, it travels with the constant speed.
    """

    speed: Float[Array, ""]
    entry_time: Float[Array, ""]
    deceleration: Float[Array, ""]
    length: Float[Array, ""]
    start: Float[Array, ""] | None = None

    def direction(self):
        return xp.sign(self.speed)

    def _start(self):
        """Position (m) at entry_time."""
        if self.start is not None:
            return self.start
        return xp.where(self.speed < 0, self.length, 0.0)

    def _stopping_time(self):
        """Time from entry_time to standstill (s)."""
        braking = self.deceleration > 0
        deceleration = xp.where(braking, self.deceleration, 1.0)
        return xp.where(braking, xp.abs(self.speed) / deceleration, NEVER)

    def _time_of_arrival(self, position, behind):
        """Time (s) at which a wheel arrives at a position (m): the smaller root of the parabola."""
        distance = self.direction() * (position - self._start()) + behind
        speed = xp.abs(self.speed)
        squared_speed = speed**2 - 2 * self.deceleration * distance
        final_speed = xp.where(
            squared_speed > 0, xp.sqrt(xp.where(squared_speed > 0, squared_speed, 1.0)), 0.0
        )
        before = distance < 0
        final_speed = xp.where(before, speed, final_speed)
        reached = ((squared_speed >= 0) | before) & (speed + final_speed > 0)
        duration = 2 * distance / xp.where(reached, speed + final_speed, 1.0)
        return xp.where(reached, self.entry_time + duration, NEVER)

    def kinematics(self, t):
        elapsed = t - self.entry_time
        stop = self._stopping_time()
        moving, braking = elapsed < stop, elapsed >= 0
        moving_time = xp.minimum(elapsed, stop)
        braking_time = xp.maximum(moving_time, 0.0)
        direction, speed = self.direction(), xp.abs(self.speed)
        distance = speed * moving_time - self.deceleration * braking_time**2 / 2
        speed = xp.where(moving, speed - self.deceleration * braking_time, 0.0)
        acceleration = xp.where(moving & braking, -self.deceleration, 0.0)
        return self._start() + direction * distance, direction * speed, direction * acceleration

    def cubics(self):
        start = self._start()
        half_acceleration = -xp.sign(self.speed) * self.deceleration / 2
        stop = self._stopping_time()
        stop_position = start + xp.where(stop < NEVER, self.speed * stop / 2, 0.0)
        zero = xp.zeros(())
        moving = xp.stack([start, self.speed, half_acceleration, zero])
        standing = xp.stack([stop_position, zero, zero, zero])
        times = xp.stack([self.entry_time, self.entry_time + stop])
        return times, xp.stack([moving, standing])

    def entry_exit_times(self, behind=0.0):
        entry_end = xp.where(self.speed < 0, self.length, 0.0)
        ends = entry_end, self.length - entry_end
        entry, leave = (self._time_of_arrival(end, behind) for end in ends)
        return entry, leave

    def passage_times(self, positions, behind=0.0):
        arrivals = self._time_of_arrival(positions, xp.expand_dims(behind, -1))
        stop = self._stopping_time()
        stop = xp.where(stop < NEVER, self.entry_time + stop, NEVER)
        jumps = xp.stack([self.entry_time, stop])
        return xp.concatenate([arrivals.reshape(-1), jumps])


class StandingTrajectory(AbstractPiecewiseTrajectory):
    """Trajectory of a stationary load, at a place on the beam from `entry_time` (s) on.

    Wheels off the beam do not act.
    """

    position: Float[Array, ""]
    entry_time: Float[Array, ""]
    length: Float[Array, ""]

    def direction(self):
        return xp.ones(())

    def kinematics(self, t):
        position = xp.broadcast_to(self.position, xp.shape(t))
        return position, xp.zeros_like(position), xp.zeros_like(position)

    def cubics(self):
        zero = xp.zeros(())
        return self.entry_time[None], xp.stack([self.position, zero, zero, zero])[None]

    def entry_exit_times(self, behind=0.0):
        place = self.position - xp.asarray(behind)
        on_beam = (place >= 0) & (place <= self.length)
        entry = xp.where(on_beam, self.entry_time, NEVER)
        return entry, xp.full(entry.shape, NEVER)

    def passage_times(self, positions, behind=0.0):
        return xp.full(xp.size(positions) * xp.size(behind), NEVER)


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

    def direction(self):
        return xp.where(self.positions[0] <= self.positions[-1], 1.0, -1.0)

    def _passage_time(self, target):
        """First time (s) of passing a position (m), by bisection.

        A Newton step of value zero gives it its derivative.
        """
        passed = xp.sign(self.positions - target) * xp.sign(self.positions[0] - target) <= 0
        if not is_jax(passed) and not passed.any():
            return xp.asarray(NEVER)
        last, start_side = xp.argmax(passed), xp.sign(self.positions[0] - target)
        piece = xp.maximum(last - 1, 0)
        start, (p, v, half_a, sixth_j) = take(self.times, piece), take(self.cubics()[1], piece)

        def halve(_, bracket):
            low, high = bracket
            s = (low + high) / 2
            # At the target, to rounding, counts as before: a load that stops there has not passed.
            before = (p + s * (v + s * (half_a + s * sixth_j)) - target) * start_side >= 0
            return xp.where(before, s, low), xp.where(before, high, s)

        end = take(self.times, last)
        low, high = fori_loop(0, 60, halve, stop_gradient((xp.zeros(()), end - start)))
        time = stop_gradient(xp.minimum(start + (low + high) / 2, end))
        s = time - start
        position = p + s * (v + s * (half_a + s * sixth_j))
        speed = v + s * (2 * half_a + s * 3 * sixth_j)
        moving = xp.abs(speed) > 0
        step = xp.where(moving, (position - target) / xp.where(moving, speed, 1.0), 0.0)
        return xp.where(xp.any(passed), time - (step - stop_gradient(step)), NEVER)

    def _entry_exit_times_of(self, behind):
        """Times of entry and exit (s) of one wheel."""
        direction = self.direction()
        first, last = (self.positions[i] - direction * behind for i in (0, -1))
        entry_end = xp.where(direction > 0, 0.0, self.length)
        exit_end = self.length - entry_end
        outside = (first < 0) | (first > self.length)
        passages = (self._passage_time(end + direction * behind) for end in (entry_end, exit_end))
        entry, leave = passages
        entry = xp.where(outside, entry, self.times[0])
        leave = xp.where((last < 0) | (last > self.length), leave, NEVER)
        return entry, xp.where(last == exit_end, self.times[-1], leave)

    def entry_exit_times(self, behind=0.0):
        if xp.ndim(behind) == 0:
            return self._entry_exit_times_of(behind)
        return vmap(self._entry_exit_times_of)(behind)

    def passage_times(self, positions, behind=0.0):
        targets = positions + self.direction() * xp.expand_dims(xp.asarray(behind), -1)
        targets = targets.reshape(-1)
        # `vmap` would trace the search to find the shape of nothing.
        times = vmap(self._passage_time)(targets) if targets.size else xp.zeros(0)
        return xp.append(times, self.times[-1])
