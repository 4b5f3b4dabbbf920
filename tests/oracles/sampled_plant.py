"""A span with actuators and at most one load as a linear plant, in continuous time and sampled.

Its matrices are rates of the modal equations for unit states and inputs, its transitions are
integrated by scipy. The last state is the weight of the load, if there is one. Also Gaussian
conditioning of the joint vector of all states and readings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from tests.oracles.closed_loop import Actuator, Sensor, _Plant
from tests.oracles.crossing import GRAVITY, Load
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

        def rates_and_outputs(y, command):
            rates = self.plant.rate(t, y, command, active)
            n = self.plant.span.modes
            outputs = [
                self.plant.rows[i] @ rates[n : 2 * n]
                if sensor.quantity == "acceleration"
                else self.plant.signal(i, y)
                for i, sensor in enumerate(self.plant.sensors)
            ]
            return np.append(rates, outputs)

        rest = rates_and_outputs(np.zeros(self.inner), np.zeros(self.inputs))
        states = [rates_and_outputs(e, np.zeros(self.inputs)) - rest for e in np.eye(self.inner)]
        weights = [rest / (load.mass * GRAVITY) for load in self.loads]
        inputs = [rates_and_outputs(np.zeros(self.inner), e) - rest for e in np.eye(self.inputs)]
        state_columns, input_columns = np.array([*states, *weights]).T, np.array(inputs).T
        zero_rows = np.zeros((len(self.loads), self.size + self.inputs))
        top = np.vstack([np.hstack([state_columns, input_columns])[: self.inner], zero_rows])
        A, B = top[:, : self.size], top[:, self.size :]
        return A, B, state_columns[self.inner :], input_columns[self.inner :]

    def step(self, t: float, period: float, delay: float, intensity: np.ndarray) -> Step:
        """From t - period to t, white noise of this intensity on the rates of the states."""
        start, parts = t - period, []
        for begin, end in ((start, start + delay), (start + delay, t)):
            parts.append(self._integrated(begin, end, intensity))
        (first, before, early), (last, after, late) = parts
        return Step(last @ first, last @ before, after, late + last @ early @ last.T)

    def _integrated(self, begin, end, intensity):
        n, columns = self.size, self.size + self.inputs
        if end <= begin:
            return np.eye(n), np.zeros((n, self.inputs)), np.zeros((n, n))

        def rate(t, y):
            transition, noise = y[: n * columns].reshape(n, columns), y[n * columns :].reshape(n, n)
            A, B, _, _ = self.matrices(t)
            transition_rate = A @ transition
            transition_rate[:, n:] += B
            return np.append(transition_rate, A @ noise + noise @ A.T + intensity)

        y = np.append(np.eye(n, columns), np.zeros((n, n)))
        y = solve_ivp(rate, (begin, end), y, method="DOP853", rtol=1e-10, atol=1e-14).y[:, -1]
        transition = y[: n * columns].reshape(n, columns)
        return transition[:, :n], transition[:, n:], y[n * columns :].reshape(n, n)


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
    means, joint_covariance = [], np.zeros((count * size, count * size))
    before = np.zeros(commands.shape[1])
    for k, step in enumerate(steps):
        mean = step.transition @ mean + step.before @ before + step.after @ commands[k]
        covariance = step.transition @ covariance @ step.transition.T + step.noise
        means.append(mean)
        here = slice(k * size, (k + 1) * size)
        joint_covariance[here, here] = covariance
        joint_covariance[here, : k * size] = (
            step.transition @ joint_covariance[(k - 1) * size : k * size, : k * size] if k else 0.0
        )
        joint_covariance[: k * size, here] = joint_covariance[here, : k * size].T
        before = commands[k]
    C = np.zeros((readings.size, count * size))
    outputs = readings.shape[1]
    for k, (row, _) in enumerate(rows):
        C[k * outputs : (k + 1) * outputs, k * size : (k + 1) * size] = row
    feedthrough = np.concatenate([D @ u for (_, D), u in zip(rows, commands, strict=True)])
    output_covariance = C @ joint_covariance @ C.T + np.kron(np.eye(count), noise)
    gain = np.linalg.solve(output_covariance, C @ joint_covariance).T[-size:]
    innovation = readings.reshape(-1) - C @ np.concatenate(means) - feedthrough
    return means[-1] + gain @ innovation, (
        joint_covariance
        - np.linalg.solve(output_covariance, C @ joint_covariance).T @ C @ joint_covariance
    )[-size:, -size:]


# A time-varying plant x' = A(t) x + B(t) u over a period with held inputs u, by scipy.

INSIDE = 1e-12  # s: matrices are taken so far inside an interval, as they jump at events


def over_period(
    matrices_at: Callable, start: float, end: float, events: Sequence[float] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Transition and input matrix from one time (s) to another; no interval contains an event."""
    cuts = np.unique([start, *[t for t in events if start < t < end], end])
    states, inputs = matrices_at((start + end) / 2)[1].shape
    shape = states, states + inputs
    total = np.eye(*shape)
    for early, late in zip(cuts[:-1], cuts[1:], strict=True):

        def rate(t, flat, early=early, late=late):
            A, B = matrices_at(np.clip(t, early + INSIDE, late - INSIDE))
            rates = A @ flat.reshape(shape)
            rates[:, states:] += B
            return rates.ravel()

        settings = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-13 * np.abs(total).max()}
        total = solve_ivp(rate, (early, late), total.ravel(), **settings).y[:, -1]
        total = total.reshape(shape)
    return total[:, :states], total[:, states:]
