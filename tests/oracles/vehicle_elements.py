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

from tests.oracles.finite_elements import Beam, Model, assemble
from tests.oracles.loads import GRAVITY


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
