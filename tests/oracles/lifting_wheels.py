"""Wheels that press, fly and land on a simply supported beam: scipy's DOP853 from event to event.

Sine modes of unit modal mass. A wheel is rigid with a mass, which a body may load by a spring and a
damper; or massless at the lower end of the tyre, spring and damper, of a body; or a mass on a
spring of contact. Accelerations under pressing rigid wheels follow from the mass matrix with their
masses, (I + sum m s s^T) q'' = ..., not from contact forces. All wheels roll at constant speeds on
the profile, before and behind the beam on rigid ground.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

SIDE = 1e-11  # s, beside a load event
SMALL = 1e-9  # gaps and velocities that are none


@dataclass(frozen=True)
class Wheel:
    """A wheel at x = start + speed t; `mass` of a tyre is zero; `law` is (factor, power)."""

    mass: float
    weight: float  # static load
    speed: float
    start: float = 0.0
    body: float = 0.0
    spring: float = 0.0
    damper: float = 0.0
    law: tuple[float, float] | None = None

    @property
    def rigid(self) -> bool:
        return self.mass > 0 and self.law is None

    @property
    def tyre(self) -> bool:
        return self.mass == 0

    @property
    def compressed(self) -> float:
        return (self.weight / self.law[0]) ** (1 / self.law[1]) if self.law else 0.0


@dataclass
class Flight:
    wheel: int
    lift: float
    landing: float = np.nan
    approach: float = np.nan
    impulse: float = 0.0


class Crossing:
    """Beam of a length, circular frequencies and damping ratio of its modes, mass per length."""

    def __init__(
        self,
        frequencies: np.ndarray,
        damping_ratio: float,
        mass_per_length: float,
        length: float,
        wheels: Sequence[Wheel],
        profile: Callable[[float], tuple[float, float, float]],
        kinks: Sequence[float] = (),
    ):
        self.w, self.zeta, self.length = frequencies, damping_ratio, length
        self.scale = np.sqrt(2 / (mass_per_length * length))
        self.wheels, self.profile, self.kinks = wheels, profile, kinks
        self.n, self.step = len(frequencies), np.inf
        self.flights: list[Flight] = []

    def under(self, wheel: Wheel, t: float):
        """Shapes and their derivatives (order, mode), and those of the profile."""
        x = wheel.start + wheel.speed * t
        k = np.arange(1, self.n + 1) * np.pi / self.length
        on = 0 < x < self.length
        s, c = np.sin(k * x) * self.scale * on, np.cos(k * x) * self.scale * on
        return (s, k * c, -(k**2) * s), self.profile(x)

    def surface(self, wheel: Wheel, t: float, x: np.ndarray):
        """Height and velocity under a wheel, and its acceleration but for s q''."""
        (s, ds, dds), (r, dr, ddr) = self.under(wheel, t)
        q, dq, v = x[: self.n], x[self.n : 2 * self.n], wheel.speed
        rest = 2 * v * ds @ dq + v**2 * (dds @ q + ddr)
        return s @ q + r, s @ dq + v * (ds @ q + dr), rest, s

    def forces(self, t, x, pressing):
        """Accelerations of the modes, contact forces, accelerations of wheels, rates of tyres."""
        q, dq = x[: self.n], x[self.n : 2 * self.n]
        right = -(self.w**2) * q - 2 * self.zeta * self.w * dq
        matrix, count = np.eye(self.n), len(self.wheels)
        known, rigid = np.zeros(count), []
        for i, wheel in enumerate(self.wheels):
            h, dh, u, du = x[2 * self.n + 4 * i :][:4]
            y, dy, rest, s = self.surface(wheel, t, x)
            if not pressing[i]:
                continue
            if wheel.tyre:
                known[i] = wheel.weight + wheel.spring * (y - u) + wheel.damper * (dy - du)
            elif wheel.law:
                factor, power = wheel.law
                known[i] = factor * max(wheel.compressed + y - h, 0.0) ** power
            else:
                pushed = wheel.weight + wheel.spring * (y - u) + wheel.damper * (dy - du)
                right = right - s * (pushed + wheel.mass * rest)
                matrix = matrix + wheel.mass * np.outer(s, s)
                rigid.append((i, pushed, rest, s))
                continue
            right = right - s * known[i]
        ddq = np.linalg.solve(matrix, right)
        for i, pushed, rest, s in rigid:
            known[i] = pushed + self.wheels[i].mass * (s @ ddq + rest)
        return ddq, known

    def rate(self, t, x, start, stop, pressing):
        t = np.clip(t, start + SIDE, stop - SIDE)
        ddq, force = self.forces(t, x, pressing)
        parts = [x[self.n : 2 * self.n], ddq]
        for i, wheel in enumerate(self.wheels):
            h, dh, u, du = x[2 * self.n + 4 * i :][:4]
            y, dy, *_ = self.surface(wheel, t, x)
            own, rate = (y, dy) if pressing[i] and not wheel.law else (h, dh)
            ddh = 0.0
            if wheel.tyre:
                pull = force[i] - wheel.weight  # = k (h - u) + c (h' - u')
                rate = du
                if pressing[i]:
                    rate = dy
                elif wheel.damper:
                    rate = du - (wheel.weight + wheel.spring * (h - u)) / wheel.damper
            else:
                pull = wheel.spring * (own - u) + wheel.damper * (rate - du)
                ddh = (force[i] - wheel.weight - pull) / wheel.mass
                rate = dh
            parts.append([rate, ddh, du, pull / wheel.body if wheel.body else 0.0])
        return np.concatenate(parts)

    def lower_end(self, i, x, pressing):
        wheel = self.wheels[i]
        h, _, u, _ = x[2 * self.n + 4 * i :][:4]
        if wheel.tyre and not wheel.damper and not pressing[i]:
            return u - wheel.weight / wheel.spring
        return h - wheel.compressed

    def gap(self, i, t, x, pressing):
        return self.lower_end(i, x, pressing) - self.surface(self.wheels[i], t, x)[0]

    def impact(self, t, x, pressing):
        """Inelastic impact of all rigid wheels that press, by trying which of them take part."""
        own = [i for i, w in enumerate(self.wheels) if w.rigid and pressing[i]]
        shapes = np.array([self.surface(self.wheels[i], t, x)[3] for i in own]).reshape(-1, self.n)
        u = np.array(
            [x[2 * self.n + 4 * i + 1] - self.surface(self.wheels[i], t, x)[1] for i in own]
        )
        if not own or np.max(np.abs(u)) < SMALL:
            return {}
        masses = np.array([self.wheels[i].mass for i in own])
        for size in range(len(own), -1, -1):
            for part in map(list, itertools.combinations(range(len(own)), size)):
                p = np.zeros(len(own))
                mobility = np.diag(1 / masses) + shapes @ shapes.T
                p[part] = np.linalg.solve(mobility[np.ix_(part, part)], -u[part])
                after = u + mobility @ p
                if np.all(p >= -1e-12) and np.all(after >= -1e-12):
                    x[self.n : 2 * self.n] -= shapes.T @ p
                    for i, one in zip(own, p / masses, strict=True):
                        x[2 * self.n + 4 * i + 1] += one
                    for i, rate in zip(own, after, strict=True):
                        if rate > SMALL:
                            self.lift(i, t, pressing)
                    return dict(zip(own, p, strict=True))
        raise AssertionError("no impulses")

    def lift(self, i, t, pressing):
        pressing[i] = False
        self.flights.append(Flight(i, t))

    def land(self, i, t, x, pressing):
        wheel, at = self.wheels[i], 2 * self.n + 4 * i
        y, dy, *_ = self.surface(wheel, t, x)
        flight = [one for one in self.flights if one.wheel == i][-1]
        flight.landing, flight.approach = t, dy - x[at + 1]
        pressing[i] = True
        if not wheel.law:
            x[at] = y
        if wheel.rigid:
            flight.impulse = self.impact(t, x, pressing).get(i, 0.0)

    def run(self, times: np.ndarray, rtol: float = 1e-10) -> np.ndarray:
        """Coordinates and rates of the modes at times (state, time), from rest."""
        count = len(self.wheels)
        x = np.zeros(2 * self.n + 4 * count)
        for i, wheel in enumerate(self.wheels):
            height, slope, _ = self.profile(wheel.start)
            x[2 * self.n + 4 * i :][:4] = height, wheel.speed * slope, height, 0.0
        pressing, end = [True] * count, float(times[-1])
        events = {0.0, end}
        for wheel in self.wheels:
            for place in (0.0, self.length, *self.kinks):
                events.add((place - wheel.start) / wheel.speed)
        limits = sorted(t for t in events if 0 <= t <= end)
        found = np.zeros((2 * self.n, times.size))
        for start, stop in itertools.pairwise(limits):
            t = start
            self.after_jump(t + SIDE, x, pressing)
            while stop - t > 10 * SIDE:
                self.release(t + SIDE, x, pressing)
                t, x = self.leg(t, stop, x, pressing, times, found, rtol)
        found[:, -1] = x[: 2 * self.n]
        return found

    def after_jump(self, t, x, pressing):
        """Changes of the surface's height or velocity at once."""
        for i, wheel in enumerate(self.wheels):
            if wheel.rigid and pressing[i] and self.gap(i, t, x, pressing) > SMALL:
                self.lift(i, t, pressing)
        self.impact(t, x, pressing)

    def release(self, t, x, pressing):
        """Wheels that would have to pull from now on leave."""
        for _ in self.wheels:
            force = self.forces(t, x, pressing)[1]
            pulls = [
                i for i, w in enumerate(self.wheels)
                if pressing[i] and not w.law and force[i] < -1e-7 * w.weight
            ]  # fmt: skip
            if not pulls:
                return
            self.lift(pulls[0], t, pressing)

    def leg(self, start, stop, x, pressing, times, found, rtol):
        """From a time to the next event; the time and the state there."""
        count = len(self.wheels)

        def watch(i):
            def value(t, x):
                t = np.clip(t, start + SIDE, stop - SIDE)
                if not pressing[i]:
                    # A flight begins at a gap of zero, which is no landing.
                    return self.gap(i, t, x, pressing) + (1e-15 if t < start + 1e-7 else 0.0)
                if self.wheels[i].law:
                    return -self.gap(i, t, x, pressing)
                return self.forces(t, x, pressing)[1][i]

            value.terminal, value.direction = True, -1
            return value

        inside = (times >= start) & (times < stop)
        solution = solve_ivp(
            lambda t, x: self.rate(t, x, start, stop, pressing), (start, stop), x, "DOP853",
            rtol=rtol, atol=1e-13, dense_output=True, max_step=self.step,
            events=[watch(i) for i in range(count)],
        )  # fmt: skip
        t, x = float(solution.t[-1]), solution.y[:, -1].copy()
        inside &= times <= t
        if inside.any():
            found[:, inside] = solution.sol(times[inside])[: 2 * self.n]
        for i, wheel in enumerate(self.wheels):
            at = 2 * self.n + 4 * i
            if pressing[i] and not wheel.law:
                x[at : at + 2] = self.surface(wheel, np.clip(t, start + SIDE, stop - SIDE), x)[:2]
        for i in range(count):
            if solution.t_events[i].size:
                if pressing[i]:
                    self.lift(i, t, pressing)
                else:
                    self.land(i, t, x, pressing)
        return t, x


# Moreau's time steps of rigid wheels on a simply supported beam, without events.
#
# Sine modes of unit modal mass; rigid ground beside the beam. Velocities take midpoint steps, in
# which impulses of all wheels without a gap at half a step are those after which none of them
# enters the surface: u + D p >= 0, p >= 0, one of both zero for each wheel. No wheel is ever said
# to press or to fly, so impacts that follow each other ever faster need no care. The error is of
# first order. Moreau, J. J. (1988), Unilateral contact and dry friction in finite freedom
# dynamics.


def moreau_steps(frequencies, damping_ratio, masses, weights, speeds, starts, end, step, every):
    """Coordinates of the modes (time, mode) after each `every` steps, from rest at time zero.

    The beam has unit length and mass; wheel i is at starts[i] + speeds[i] t.
    """
    masses, weights, speeds = map(np.asarray, (masses, weights, speeds))
    k = np.pi * np.arange(1, len(frequencies) + 1)
    stiffness, damping = frequencies**2, 2 * damping_ratio * frequencies
    softened = 1 + step * damping / 2 + step**2 * stiffness / 4
    q, rate = np.zeros((2, k.size))
    height, fall = np.zeros((2, masses.size))
    found = [q]
    for n in range(round(end / step)):
        x = starts + speeds * (n + 0.5) * step
        on = ((x > 0) & (x < 1))[:, None] * np.sqrt(2.0)
        shape, slope = np.sin(x[:, None] * k) * on, k * np.cos(x[:, None] * k) * on
        half = q + step / 2 * rate
        near = np.flatnonzero(height + step / 2 * fall - shape @ half <= 0)
        # Velocities at the end of the step without contact, and per impulse.
        free = ((2 - softened) * rate - step * stiffness * q) / softened
        falling = fall - step * weights / masses
        u = (falling - shape @ free - speeds * (slope @ half))[near]
        mobility = np.diag(1 / masses)[np.ix_(near, near)] + shape[near] / softened @ shape[near].T
        p = np.zeros(masses.size)
        p[near] = complementary(mobility, u)
        new, fall_new = free - shape.T @ p / softened, falling + p / masses
        q, height = q + step / 2 * (rate + new), height + step / 2 * (fall + fall_new)
        rate, fall = new, fall_new
        if (n + 1) % every == 0:
            found.append(q)
    return np.array(found)


def complementary(mobility, u):
    """Solution p of u + mobility p >= 0, p >= 0, one of both zero, by trying all sets."""
    for size in range(u.size + 1):
        for part in map(list, itertools.combinations(range(u.size), size)):
            p = np.zeros(u.size)
            p[part] = np.linalg.solve(mobility[np.ix_(part, part)], -u[part])
            if np.all(p >= 0) and np.all(
                u + mobility @ p >= -1e-12 * np.max(np.abs(u), initial=0.0)
            ):
                return p
    raise AssertionError("no impulses")
