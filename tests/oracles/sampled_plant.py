"""A span with actuators and at most one load as a linear plant, in continuous time and sampled.

Its matrices are probed from the modal equations, its transitions integrated by scipy. The last
state is the weight of the load, if there is one. Also Gaussian conditioning by brute force: all
states and readings stacked into one vector.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from tests.oracles.closed_loop import Actuator, Sensor, _Plant
from tests.oracles.loads import GRAVITY, Load
from tests.oracles.modal_equations import Span


@dataclass(frozen=True)
class Step:
    """x_k = transition x_(k-1) + before u_(k-1) + after u_k + w, cov(w) = noise.

    The command u_k acts until sample k.
    """

    transition: np.ndarray
    before: np.ndarray
    after: np.ndarray
    noise: np.ndarray


class SampledPlant:
    """States (q, q', z of lagging actuators, weight of the load)."""

    def __init__(
        self,
        span: Span,
        loads: Sequence[Load],
        actuators: Sequence[Actuator],
        sensors: Sequence[Sensor],
    ):
        self.plant, self.loads = _Plant(span, loads, actuators, sensors), loads
        self.inner = self.plant.size
        self.size, self.inputs = self.inner + len(loads), len(actuators)

    def matrices(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """A, B, C and D at a time."""
        length = self.plant.span.length
        active = [x for x in self.loads if x.entry_time <= t < x.time_at(length)]

        def outcome(y, command):
            moving = self.plant.rate(t, y, command, active)
            n = self.plant.span.modes
            seen = [
                self.plant.rows[i] @ moving[n : 2 * n]
                if sensor.quantity == "acceleration"
                else self.plant.signal(i, y)
                for i, sensor in enumerate(self.plant.sensors)
            ]
            return np.append(moving, seen)

        rest = outcome(np.zeros(self.inner), np.zeros(self.inputs))
        states = [outcome(e, np.zeros(self.inputs)) - rest for e in np.eye(self.inner)]
        weights = [rest / (load.mass * GRAVITY) for load in self.loads]
        inputs = [outcome(np.zeros(self.inner), e) - rest for e in np.eye(self.inputs)]
        whole, pushed = np.array([*states, *weights]).T, np.array(inputs).T
        still = np.zeros((len(self.loads), self.size + self.inputs))
        top = np.vstack([np.hstack([whole, pushed])[: self.inner], still])
        A, B = top[:, : self.size], top[:, self.size :]
        return A, B, whole[self.inner :], pushed[self.inner :]

    def step(self, t: float, period: float, delay: float, intensity: np.ndarray) -> Step:
        """From t - period to t, white noise of this intensity on the rates of the states."""
        start, parts = t - period, []
        for begin, end in ((start, start + delay), (start + delay, t)):
            parts.append(self._integrated(begin, end, intensity))
        (first, before, early), (last, after, late) = parts
        return Step(last @ first, last @ before, after, late + last @ early @ last.T)

    def _integrated(self, begin, end, intensity):
        n, wide = self.size, self.size + self.inputs
        if end <= begin:
            return np.eye(n), np.zeros((n, self.inputs)), np.zeros((n, n))

        def rate(t, y):
            flow, noise = y[: n * wide].reshape(n, wide), y[n * wide :].reshape(n, n)
            A, B, _, _ = self.matrices(t)
            moved = A @ flow
            moved[:, n:] += B
            return np.append(moved, A @ noise + noise @ A.T + intensity)

        y = np.append(np.eye(n, wide), np.zeros((n, n)))
        y = solve_ivp(rate, (begin, end), y, method="DOP853", rtol=1e-10, atol=1e-14).y[:, -1]
        flow = y[: n * wide].reshape(n, wide)
        return flow[:, :n], flow[:, n:], y[n * wide :].reshape(n, n)


def conditioned(
    start: tuple[np.ndarray, np.ndarray],
    steps: Sequence[Step],
    rows: Sequence[tuple[np.ndarray, np.ndarray]],
    noise: np.ndarray,
    commands: np.ndarray,
    readings: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the last state, given all readings.

    `start` is mean and covariance one step before the first sample; `rows` are C and D at the
    samples; `commands` (sample, input) acted until the samples, none before the first.
    """
    mean, covariance = start
    size, count = mean.size, len(steps)
    means, spread = [], np.zeros((count * size, count * size))
    before = np.zeros(commands.shape[1])
    for k, step in enumerate(steps):
        mean = step.transition @ mean + step.before @ before + step.after @ commands[k]
        covariance = step.transition @ covariance @ step.transition.T + step.noise
        means.append(mean)
        here = slice(k * size, (k + 1) * size)
        spread[here, here] = covariance
        spread[here, : k * size] = (
            step.transition @ spread[(k - 1) * size : k * size, : k * size] if k else 0.0
        )
        spread[: k * size, here] = spread[here, : k * size].T
        before = commands[k]
    C = np.zeros((readings.size, count * size))
    outputs = readings.shape[1]
    for k, (row, _) in enumerate(rows):
        C[k * outputs : (k + 1) * outputs, k * size : (k + 1) * size] = row
    direct = np.concatenate([D @ u for (_, D), u in zip(rows, commands, strict=True)])
    seen = C @ spread @ C.T + np.kron(np.eye(count), noise)
    gain = np.linalg.solve(seen, C @ spread).T[-size:]
    surprise = readings.reshape(-1) - C @ np.concatenate(means) - direct
    return means[-1] + gain @ surprise, (spread - np.linalg.solve(seen, C @ spread).T @ C @ spread)[
        -size:, -size:
    ]
