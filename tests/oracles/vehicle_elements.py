"""Vehicles that cross a finite-element beam on a rough surface, by Newmark's method in small steps.

With w the nodal values of the beam, u the heights of the vehicle from static equilibrium and
y = S w + r the surface under its wheels at the positions x(t),

    M_b w'' + C_b w' + K_b w = -S^T F,    F = P + k (y - N u) + c (y' - N u'),
    M u'' + C u' + K u = N^T (F - P),     y' = S w' + x' (S_x w + r'),

in average-acceleration steps, in which the forces F of the wheels follow from one linear system.
Moments at nodes are those at the end of an element without a wheel on it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from tests.oracles.crossing import GRAVITY
from tests.oracles.finite_elements import Beam, Model, assemble
from tests.oracles.modal_equations import Span


@dataclass(frozen=True)
class Vehicle:
    """Matrices of a vehicle, its wheels' distances behind the first, and their static loads (N)."""

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    wheel_map: np.ndarray  # (wheel, dof)
    contact_stiffness: np.ndarray
    contact_damping: np.ndarray
    offsets: np.ndarray
    static_loads: np.ndarray


@dataclass(frozen=True)
class Crossing:
    """Histories at the times (s): SI units, deflection positive upwards, moment where it sags."""

    times: np.ndarray
    deflection: np.ndarray  # (time, sensor)
    acceleration: np.ndarray
    moment: np.ndarray
    body_acceleration: np.ndarray  # (time, dof)
    contact_force: np.ndarray  # (time, wheel), positive where it presses


def forces(offsets: Sequence[float], weights: Sequence[float]) -> Vehicle:
    """Axles that press with their weights (N) alone."""
    count, none = len(offsets), np.zeros((0, 0))
    zeros = np.zeros(count)
    places, loads = np.asarray(offsets, float), np.asarray(weights, float)
    return Vehicle(none, none, none, np.zeros((count, 0)), zeros, zeros, places, loads)


def quarter_car(body_mass, axle_mass, spring, damper, tyre, tyre_damper) -> Vehicle:
    """Body and axle, one over the other."""
    pair = np.array([[1.0, -1.0], [-1.0, 1.0]])
    return Vehicle(
        np.diag([body_mass, axle_mass]), damper * pair, spring * pair, np.array([[0.0, 1.0]]),
        np.array([tyre]), np.array([tyre_damper]), np.zeros(1),
        np.array([(body_mass + axle_mass) * GRAVITY]),
    )  # fmt: skip


def half_car(body_mass, inertia, places, axle_masses, spring, damper, tyre) -> Vehicle:
    """Body that pitches on two axles at places (m) forward of its centre of mass; numbers alike."""
    places = np.asarray(places, float)
    reach = np.column_stack([np.ones(2), places, -np.eye(2)])  # extensions of the springs
    share = np.linalg.solve(np.array([np.ones(2), places]), [body_mass, 0.0])
    return Vehicle(
        np.diag([body_mass, inertia, *axle_masses]), damper * reach.T @ reach,
        spring * reach.T @ reach, np.column_stack([np.zeros((2, 2)), np.eye(2)]),
        np.full(2, tyre), np.zeros(2), places[0] - places,
        (share + np.asarray(axle_masses)) * GRAVITY,
    )  # fmt: skip


def cross(
    beam: Beam,
    vehicle: Vehicle,
    speed: float,
    start: float,
    sensors: Sequence[float],
    duration: float,
    profile: Callable | None = None,
    *,
    step: float = 5e-4,
    every: int = 1,
) -> Crossing:
    """Crossing from rest at t = 0, the first wheel at `start` (m); sensors are at nodes.

    `profile(x)` is height (m) and slope at positions; without one the surface is level.
    """
    model = assemble(beam, sensors)
    at = model.free
    M, K = (matrix[np.ix_(at, at)] for matrix in (model.mass, model.stiffness))
    frequencies, shapes = model.modes()
    shapes = shapes[at]
    ratio = float(beam.damping_ratio)  # type: ignore[arg-type]
    C = M @ (shapes * (2 * ratio * frequencies)) @ shapes.T @ M
    v = vehicle
    b, g = step**2 / 4, step / 2  # of the acceleration at the end of a step
    G = np.linalg.inv(M + g * C + b * K)
    H = np.linalg.inv(v.mass + g * v.damping + b * v.stiffness)
    k, c, N = v.contact_stiffness, v.contact_damping, v.wheel_map
    own = (b * k + g * c)[:, None] * (N @ H @ N.T)

    w, w1, w2 = (np.zeros(len(at)) for _ in range(3))
    height = _surface(profile, start - v.offsets)[0]
    level = np.linalg.solve(v.stiffness + N.T @ (k[:, None] * N), N.T @ (k * height))
    u, u1, u2 = level, np.zeros(N.shape[1]), np.zeros(N.shape[1])
    rows = np.array([model.shape(x)[at] for x in sensors])
    samples = []
    count = round(duration / step)
    for i in range(count + 1):
        x = start + speed * step * i - v.offsets
        on = (x >= 0) & (x <= beam.length)
        S, slope = (_rows(model, x, on, d)[:, at] for d in (0, 1))
        r, r1 = _surface(profile, x)
        first = i == 0  # at rest: only the accelerations follow
        h = 0.0 if first else step
        w_, w1_ = w + h * w1 + h**2 / 4 * w2, w1 + h / 2 * w2
        u_, u1_ = u + h * u1 + h**2 / 4 * u2, u1 + h / 2 * u2
        w2_, u2_ = -G @ (C @ w1_ + K @ w_), -H @ (v.damping @ u1_ + v.stiffness @ u_)
        w_f, w1_f, u_f, u1_f = w_ + b * w2_, w1_ + g * w2_, u_ + b * u2_, u1_ + g * u2_
        rate = S @ w1_f + speed * (slope @ w_f + r1) - N @ u1_f
        q = k * (S @ w_f + r - N @ u_f) + c * rate
        reach = G @ S.T
        flexible = (b * k + g * c)[:, None] * (S @ reach) + b * speed * c[:, None] * (slope @ reach)
        q = np.linalg.solve(np.eye(len(k)) + own + flexible, q - flexible @ v.static_loads)
        F = v.static_loads + q
        w2, u2 = w2_ - reach @ F, u2_ + H @ N.T @ q
        w, w1, u, u1 = w_ + b * w2, w1_ + g * w2, u_ + b * u2, u1_ + g * u2
        if i % every == 0:
            moments = [_moment(model, at, w, place, x[on]) for place in sensors]
            samples.append((rows @ w, rows @ w2, moments, u2, F))
    times = step * every * np.arange(len(samples))
    return Crossing(times, *(np.array(part) for part in zip(*samples, strict=True)))


def _surface(profile, x):
    zero = np.zeros(len(x))
    return (zero, zero) if profile is None else profile(x)


def _rows(model: Model, x, on, derivative):
    rows = np.zeros((len(x), 2 * len(model.nodes)))
    for i in np.flatnonzero(on):
        rows[i] = model.shape(x[i], derivative)
    return rows


def _moment(model: Model, at, w, place, wheels) -> float:
    """Moment at a node, in an element beside it without a wheel."""
    node = int(np.argmin(np.abs(model.nodes - place)))
    loaded = np.any((wheels > model.nodes[node - 1]) & (wheels < model.nodes[node]))
    element = node if loaded else node - 1
    nodal = np.zeros(2 * len(model.nodes))
    nodal[at] = w
    return float(model.beam.flexural_rigidity * (model.shape(place, 2, element) @ nodal))  # type: ignore[operator]


# A quarter car on a profile across a simply supported span, by scipy; see `modal_equations`.
#
# With the deflection under the wheel and the profile, y = w + r, the coupled equations are
#
#     q'' + 2 Z W q' + W^2 q = -F phi(x),    F = (m_b + m_a) g + k_t (y - a) + c_t (y' - a'),
#     m_a a'' = k_t (y - a) + c_t (y' - a') - f,    m_b b'' = f = k_s (a - b) + c_s (a' - b'),
#
# with y' = w_t + x' (w_x + r') and the heights a, b of axle and body from static equilibrium.


@dataclass(frozen=True)
class Car:
    """Masses (kg), springs (N/m) and dampers (N s/m) of a quarter car."""

    body_mass: float
    axle_mass: float
    suspension_stiffness: float
    suspension_damping: float
    tyre_stiffness: float
    tyre_damping: float


def quarter_cross(span: Span, car: Car, motion, profile, events, times):
    """States (time, ...) at times (s): modal coordinates and rates, heights, their rates; forces.

    `motion(t)` is position, speed of the wheel; `profile(x)` height and slope. The solver starts
    anew at each of the `events` (s), where a number jumps. At rest in static equilibrium at first.
    """
    modes = span.modes
    x, _ = motion(times[0])
    height = profile(x)[0]

    def surface(t, z):
        x, speed = motion(t)
        r, slope = profile(x)
        on_beam = 0.0 <= x <= span.length
        shape = span.shapes(x) if on_beam else np.zeros(modes)
        gradient = span.shapes(x, 1) if on_beam else np.zeros(modes)
        q, rate = z[:modes], z[modes : 2 * modes]
        return shape, shape @ q + r, shape @ rate + speed * (gradient @ q + slope)

    def tyre(t, z):
        shape, y, y_rate = surface(t, z)
        a, a_rate = z[2 * modes + 1], z[2 * modes + 3]
        return shape, car.tyre_stiffness * (y - a) + car.tyre_damping * (y_rate - a_rate)

    def rates(t, z):
        shape, pressed = tyre(t, z)
        q, rate = z[:modes], z[modes : 2 * modes]
        b, a, b_rate, a_rate = z[2 * modes :]
        lift = car.suspension_stiffness * (a - b) + car.suspension_damping * (a_rate - b_rate)
        force = (car.body_mass + car.axle_mass) * GRAVITY + pressed
        acceleration = -force * shape - span.damping @ rate - span.frequencies**2 * q
        heights = lift / car.body_mass, (pressed - lift) / car.axle_mass
        return np.concatenate([rate, acceleration, [b_rate, a_rate], heights])

    state = np.concatenate([np.zeros(2 * modes), [height, height, 0.0, 0.0]])
    ends = np.unique(np.clip([times[0], *events, times[-1]], times[0], times[-1]))
    states = np.zeros((len(times), state.size))
    for start, end in zip(ends[:-1], ends[1:], strict=True):
        # Just inside, so that the wheel is on the same piece of the profile all along.
        inside = (times >= start) & (times <= end)
        wanted = np.unique(np.append(times[inside], end))
        middle = (start + end) / 2
        solution = solve_ivp(
            lambda t, z, middle=middle: rates(t + 1e-13 * (middle - t), z),
            (start, end),
            state,
            method="DOP853",
            t_eval=wanted,
            rtol=1e-12,
            atol=1e-16,
        )
        assert solution.success, solution.message
        states[inside] = solution.y[:, np.isin(wanted, times[inside])].T
        state = solution.y[:, -1]
    weight = (car.body_mass + car.axle_mass) * GRAVITY
    forces = np.array([weight + tyre(t, z)[1] for t, z in zip(times, states, strict=True)])
    return states, forces
