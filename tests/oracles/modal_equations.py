"""The modal equations of a simply supported span under travelling loads, from analytic sine modes.

Independent of the finite-element solver: no contact forces, but the full mass matrix. With
mass-normalised modes phi_n = sqrt(2 / (m L)) sin(n pi x / L) and every load's own mass M (zero
for a force), weight P, position x(t) and column phi = phi(x(t)),

    (I + sum M phi phi^T) q'' + (2 Z W + sum 2 M x' phi phi_x^T) q'
        + (W^2 + sum M (x'^2 phi phi_xx^T + x'' phi phi_x^T)) q = -sum P phi.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from tests.oracles.crossing import GRAVITY, Load


@dataclass(frozen=True)
class Span:
    """A uniform beam on two pins."""

    length: float  # m
    flexural_rigidity: float  # N m^2
    mass_per_length: float  # kg/m
    modes: int
    damping_ratio: float = 0.0

    @functools.cached_property
    def wavenumbers(self) -> np.ndarray:
        return np.arange(1, self.modes + 1) * np.pi / self.length

    @functools.cached_property
    def frequencies(self) -> np.ndarray:
        """Natural angular frequencies in rad/s."""
        return self.wavenumbers**2 * np.sqrt(self.flexural_rigidity / self.mass_per_length)

    @functools.cached_property
    def damping(self) -> np.ndarray:
        """Damping matrix in 1/s."""
        return np.diag(2 * self.damping_ratio * self.frequencies)

    def shapes(self, x: float | np.ndarray, derivative: int = 0) -> np.ndarray:
        """Modes or their x-derivatives: (..., mode), in 1 / (sqrt(kg) m^derivative)."""
        k = self.wavenumbers
        phase = np.multiply.outer(x, k) + 0.5 * np.pi * derivative
        return np.sqrt(2.0 / (self.mass_per_length * self.length)) * k**derivative * np.sin(phase)


@dataclass(frozen=True, eq=False)
class KnownModes:
    """A beam of known modes: `rows` map positions and orders of derivatives to their shapes."""

    length: float  # m
    stiffness: np.ndarray  # squares of the natural angular frequencies, 1/s^2
    damping_ratio: float
    rows: Callable  # (positions, orders) -> (order, *position, mode), in 1 / (sqrt(kg) m^order)

    @property
    def modes(self) -> int:
        return len(self.stiffness)

    @functools.cached_property
    def frequencies(self) -> np.ndarray:
        """Natural angular frequencies in rad/s."""
        return np.sqrt(np.maximum(self.stiffness, 0.0))

    def shapes(self, x: float | np.ndarray, derivative: int = 0) -> np.ndarray:
        """Modes or their x-derivatives: (..., mode), in 1 / (sqrt(kg) m^derivative)."""
        return np.asarray(self.rows(np.asarray(x), (derivative,))[0])


@functools.lru_cache(16)  # solvers ask many times for the same position
def under(span, x: float) -> tuple[np.ndarray, ...]:
    """Modes, slopes and curvatures of a span at a position; read-only arrays."""
    return tuple(span.shapes(x, derivative) for derivative in range(3))


@dataclass(frozen=True)
class ModalResponse:
    times: np.ndarray  # (time,) s
    deflection: np.ndarray  # (time, sensor) m
    contact_force: np.ndarray  # (time, load) N, positive where the load presses; 0 off the beam
    modal: np.ndarray  # (time, mode) sqrt(kg) m
    modal_rate: np.ndarray  # (time, mode)


def respond(
    span: Span,
    loads: Sequence[Load],
    sensors: Sequence[float],
    times: np.ndarray,
    *,
    initial: tuple[np.ndarray, np.ndarray] | None = None,
) -> ModalResponse:
    """The motion at the increasing `times`, from t = 0 and rest (or `initial` coordinates, rates).

    Raises RuntimeError if the integration fails.
    """
    n, events = span.modes, [0.0, times[-1]]
    for load in loads:
        events += [load.entry_time, load.stop_time, load.time_at(span.length)]
    events = np.unique(np.clip(events, 0.0, times[-1]))

    state = np.zeros(2 * n) if initial is None else np.concatenate(initial)
    states, contact_force = np.zeros((len(times), 2 * n)), np.zeros((len(times), len(loads)))
    for start, end in zip(events[:-1], events[1:], strict=True):
        system = _System(span, loads, 0.5 * (start + end))
        sample_indices = np.flatnonzero((times >= start) & (times <= end))
        marks = np.append(times[sample_indices[times[sample_indices] < end]], end)
        if any(system.on):
            solution = solve_ivp(
                system.rate, (start, end), state, method="DOP853", t_eval=marks,
                rtol=1e-12, atol=1e-15,
            )  # fmt: skip
            if not solution.success:
                raise RuntimeError(solution.message)
            path = solution.y.T
        else:
            path = free_vibration(span, state, marks - start)
        for i, k in enumerate(sample_indices):
            states[k] = path[i]
            contact_force[k] = system.contact_forces(times[k], states[k])
        state = path[-1]
    deflection = states[:, :n] @ span.shapes(np.asarray(sensors)).T
    return ModalResponse(times, deflection, contact_force, states[:, :n], states[:, n:])


def free_vibration(span, state: np.ndarray, times: np.ndarray) -> np.ndarray:
    """States (time, 2 mode) of the damped modes without loads, times (s) after a state."""
    q, u = np.split(state, 2)
    decay = span.damping_ratio * span.frequencies
    damped = span.frequencies * np.sqrt(1.0 - span.damping_ratio**2)
    cosine = np.cos(np.multiply.outer(times, damped))
    sine = np.multiply.outer(times, np.ones(len(q))) * np.sinc(
        np.multiply.outer(times, damped) / np.pi
    )  # sin(damped t) / damped, also at zero frequency
    fall = np.exp(-np.multiply.outer(times, decay))
    start = u + decay * q
    displacement = fall * (q * cosine + start * sine)
    rate = fall * (start * cosine - q * damped**2 * sine) - decay * displacement
    return np.concatenate([displacement, rate], axis=1)


class _System:
    """The equations while the same loads are on the beam, around a time in between."""

    def __init__(self, span: Span, loads: Sequence[Load], middle: float):
        self.span, self.loads = span, loads
        self.stiffness = span.frequencies**2
        self.damping = 2.0 * span.damping_ratio * span.frequencies
        self.on = [load.entry_time < middle < load.time_at(span.length) for load in loads]
        self.stopped = [middle > load.stop_time for load in loads]

    def _shapes_under(self, i: int, t: float) -> tuple:
        x, dx, ddx = self.loads[i].motion(t, self.span.length, self.stopped[i])
        return *under(self.span, float(x)), dx, ddx

    def rate(self, t: float, state: np.ndarray) -> np.ndarray:
        q, u = state[: self.span.modes], state[self.span.modes :]
        mass, force = np.eye(len(q)), -self.damping * u - self.stiffness * q
        for i, load in enumerate(self.loads):
            if not self.on[i]:
                continue
            phi, slope, curvature, dx, ddx = self._shapes_under(i, t)
            force = force - load.mass * GRAVITY * phi
            if load.kind == "mass":
                mass += load.mass * phi[:, None] * phi
                convective = 2 * dx * slope @ u + dx**2 * curvature @ q + ddx * slope @ q
                force = force - load.mass * convective * phi
        return np.concatenate([u, np.linalg.solve(mass, force)])

    def contact_forces(self, t: float, state: np.ndarray) -> np.ndarray:
        """Weight times (1 + acceleration along the path / gravity), of the loads on the beam."""
        q, u = np.split(state, 2)
        accelerations = self.rate(t, state)[len(q) :]
        forces = np.zeros(len(self.loads))
        for i, load in enumerate(self.loads):
            if self.on[i]:
                forces[i] = load.mass * GRAVITY
                if load.kind == "mass":
                    phi, slope, curvature, dx, ddx = self._shapes_under(i, t)
                    convective = 2 * dx * slope @ u + dx**2 * curvature @ q + ddx * slope @ q
                    forces[i] += load.mass * (phi @ accelerations + convective)
        return forces
