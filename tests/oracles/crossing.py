"""The finite-element beam under travelling loads, adaptively integrated.

A run keeps the first `modes` modes of the supported beam, or all of them, which then is the full
finite-element system. A travelling mass m at x(t) stays on the beam (the contact may pull) and
presses on it with

    m (g + w_tt + 2 x' w_xt + x'^2 w_xx + x'' w_x)      at x = x(t),

a travelling force with m g. The integration (DOP853) restarts whenever a load enters, leaves,
stops or passes a node, where w_xx of the elements jumps. The modal velocities are continuous
there: a mass that enters over a moving end takes up the motion of the end without an impact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from tests.oracles.finite_elements import Beam, Model, assemble, hermite

# Trajectory of a load along a beam at constant deceleration, shared by the oracles.

GRAVITY = 9.81  # m/s^2


@dataclass(frozen=True)
class Load:
    """A load that enters at the left end, or at the right end if its speed is negative."""

    mass: float  # kg
    speed: float  # m/s at entry
    entry_time: float = 0.0  # s
    deceleration: float = 0.0  # m/s^2, against the travel; a load that stops stays
    kind: str = "mass"  # or "force", which is the weight of `mass` alone

    def time_at(self, distance: float) -> float:
        """Time (s) at which the load has travelled `distance` (m); infinite if it never does."""
        v, a = abs(self.speed), self.deceleration
        root = v**2 - 2.0 * a * distance
        return self.entry_time + 2.0 * distance / (v + root**0.5) if root >= 0.0 else np.inf

    @property
    def stop_time(self) -> float:
        a = self.deceleration
        return self.entry_time + abs(self.speed) / a if a > 0.0 else np.inf

    def motion(self, t: float, length: float, stopped: bool) -> tuple[float, float, float]:
        """Position, velocity and acceleration along the beam at time t.

        The caller says whether it has `stopped`: at the stop itself the acceleration jumps.
        """
        s = min(t, self.stop_time) - self.entry_time if stopped else t - self.entry_time
        v, a = abs(self.speed), self.deceleration
        x, dx, ddx = v * s - 0.5 * a * s**2, v - a * s, -a
        if stopped:
            dx, ddx = 0.0, 0.0
        return (x, dx, ddx) if self.speed > 0.0 else (length - x, -dx, -ddx)


@dataclass(frozen=True)
class Response:
    times: np.ndarray  # (time,) s
    deflection: np.ndarray  # (time, sensor) m
    velocity: np.ndarray  # (time, sensor) m/s
    acceleration: np.ndarray  # (time, sensor) m/s^2
    contact_force: np.ndarray  # (time, load) N, positive where the load presses; 0 off the beam
    modal: np.ndarray = field(repr=False)  # (time, mode) modal coordinates, sqrt(kg) m
    modal_rate: np.ndarray = field(repr=False)  # (time, mode) and their rates


def respond(
    beam: Beam,
    loads: Sequence[Load],
    sensors: Sequence[float],
    times: np.ndarray,
    *,
    modes: int | None = None,
    initial: tuple[np.ndarray, np.ndarray] | None = None,
    force: Callable[[float], np.ndarray] | None = None,
    breaks: Sequence[float] = (),
    rtol: float = 1e-11,
    atol: float = 1e-14,
) -> Response:
    """The beam's motion at the increasing `times`, from t = 0 and rest (or `initial` modal
    coordinates and rates). `force` gives further nodal forces, over the degrees of freedom of
    `assemble(beam)`, as a function of time, which may jump at the `breaks`. Raises RuntimeError
    if the integration fails."""
    model = assemble(beam)
    omega, shapes = model.modes(modes)
    n = len(omega)
    stiffness, damping, inertia = _modal_matrices(model, omega, shapes)
    mobility = np.linalg.inv(inertia)
    scale = np.append(np.maximum(omega, 1.0), np.ones(n))  # for well-scaled exponentials
    upper, lower = [np.zeros((n, n)), np.eye(n)], [-mobility @ stiffness, -mobility @ damping]
    state_matrix = scale[:, None] * np.block([upper, lower]) / scale
    propagators: dict[float, np.ndarray] = {}

    def accelerations(t: float, y: np.ndarray, active: list[_Contact]) -> tuple:
        """Modal accelerations and the contact forces of the active loads."""
        q, u = y[:n], y[n:]
        modal_force = -damping @ u - stiffness @ q
        if force is not None:
            modal_force = modal_force + shapes.T @ force(t)
        rows = np.empty((len(active), n))
        convective = np.empty(len(active))  # contact acceleration but for the modal accelerations
        for i, contact in enumerate(active):
            x, dx, ddx = contact.load.motion(t, beam.length, contact.stopped)
            s = x - contact.left
            nodal = shapes[2 * contact.element : 2 * contact.element + 4]
            rows[i] = hermite(s, contact.h) @ nodal
            slope, curvature = (hermite(s, contact.h, d) @ nodal for d in (1, 2))
            convective[i] = 2 * dx * slope @ u + dx**2 * curvature @ q + ddx * slope @ q
        pressing = np.array([c.load.mass * GRAVITY for c in active])
        is_mass = np.array([c.load.kind == "mass" for c in active], dtype=bool)
        modal_force = modal_force - pressing[~is_mass] @ rows[~is_mass]
        modal_responses = mobility @ rows[is_mass].T
        masses = np.array([c.load.mass for c in active])[is_mass]
        compliance = np.diag(1.0 / masses) + rows[is_mass] @ modal_responses
        unconstrained_acceleration = GRAVITY + convective[is_mass] + modal_responses.T @ modal_force
        pressing[is_mass] = np.linalg.solve(compliance, unconstrained_acceleration)
        modal_force = modal_force - pressing[is_mass] @ rows[is_mass]
        return mobility @ modal_force, pressing

    y = np.zeros(2 * n) if initial is None else np.concatenate(initial)
    states = np.zeros((len(times), 2 * n))
    modal_accelerations = np.zeros((len(times), n))
    contact_force = np.zeros((len(times), len(loads)))
    limits = _break_points(model, loads, breaks, times[-1])
    for k, (start, end) in enumerate(zip(limits[:-1], limits[1:], strict=True)):
        last = k == len(limits) - 2
        sample_indices = np.flatnonzero(
            (times >= start) & ((times <= end) if last else (times < end))
        )
        marks = np.append(times[sample_indices], end)
        active = _contacts(model, loads, 0.5 * (start + end))
        if active or force is not None:
            solution = solve_ivp(
                lambda t, y, a=active: np.append(y[n:], accelerations(t, y, a)[0]),
                (start, end), y, method="DOP853", t_eval=np.unique(marks), rtol=rtol, atol=atol,
            )  # fmt: skip
            if not solution.success:
                raise RuntimeError(solution.message)
            path = solution.y.T[np.searchsorted(solution.t, marks)]
        else:  # free vibration, exactly
            path, t = np.empty((len(marks), 2 * n)), start
            for i, mark in enumerate(marks):
                key = round(mark - t, 14)  # the same for samples that differ by rounding
                if key not in propagators:
                    propagators[key] = expm(state_matrix * (mark - t)) * scale / scale[:, None]
                path[i] = propagators[key] @ (path[i - 1] if i else y)
                t = mark
        for i, state in zip(sample_indices, path, strict=False):
            states[i] = state
            modal_accelerations[i], pressing = accelerations(times[i], state, active)
            contact_force[i, [c.index for c in active]] = pressing
        y = path[-1]

    rows = np.array([model.shape(x) for x in sensors]).reshape(len(sensors), -1) @ shapes
    q, u = states[:, :n], states[:, n:]
    return Response(
        times, q @ rows.T, u @ rows.T, modal_accelerations @ rows.T, contact_force, q, u
    )


@dataclass(frozen=True)
class _Contact:
    """A load on one element."""

    load: Load
    index: int
    element: int
    left: float
    h: float
    stopped: bool


def _contacts(model: Model, loads: Sequence[Load], t: float) -> list[_Contact]:
    """The loads on the beam at time t."""
    length, contacts = model.beam.length, []
    for index, load in enumerate(loads):
        if load.entry_time < t < load.time_at(length):
            stopped = t > load.stop_time
            x = load.motion(t, length, stopped)[0]
            element = int(np.clip(np.searchsorted(model.nodes, x) - 1, 0, len(model.nodes) - 2))
            left, right = model.nodes[element : element + 2]
            contacts.append(_Contact(load, index, element, left, right - left, stopped))
    return contacts


def _break_points(
    model: Model, loads: Sequence[Load], breaks: Sequence[float], end: float
) -> np.ndarray:
    """Where the equations change: entries, exits, stops and passed nodes, from 0 to the end."""
    points = [0.0, end, *breaks]
    for load in loads:
        distances = model.nodes if load.speed > 0.0 else model.beam.length - model.nodes
        points += [load.stop_time, *(load.time_at(d) for d in distances)]
    times = np.unique(np.clip([p for p in points if p <= end], 0.0, None))
    return times[np.append(True, np.diff(times) > 1e-13 * end)]


def _modal_matrices(
    model: Model, omega: np.ndarray, shapes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stiffness, damping and inertia over the modes, with support dampers and suspensions."""
    beam = model.beam
    ratios = np.zeros(len(omega))
    if isinstance(beam.damping_ratio, (int, float)):
        ratios[:] = beam.damping_ratio
    else:
        own = np.asarray(beam.damping_ratio)[: len(omega)]
        ratios[: len(own)] = own
    stiffness, inertia = np.diag(omega**2), np.eye(len(omega))
    damping = np.diag(2 * ratios * omega + beam.rayleigh[0] + beam.rayleigh[1] * omega**2)
    damping = damping + shapes.T @ model.damping @ shapes
    for s in beam.suspensions:
        row = model.shape(s.position) @ shapes
        stiffness = stiffness + s.stiffness * np.outer(row, row)
        damping = damping + s.damping * np.outer(row, row)
        inertia = inertia + s.mass * np.outer(row, row)
    return stiffness, damping, inertia
