"""A simply supported span under control, from its modal equations and scipy's filters.

The motion follows the modal equations of `modal_equations` with actuators added, integrated anew
from one event to the next: a load enters or leaves, a sensor takes a sample, the controller acts,
its command begins. Events are processed in order, from a list of times. Without a clock the law
acts continuously, as part of the differential equations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.signal
from scipy.integrate import solve_ivp

from tests.oracles.crossing import GRAVITY, Load
from tests.oracles.modal_equations import Span, under

DIGITS = 12  # times that agree to so many decimals are one


@dataclass(frozen=True)
class Actuator:
    """Generalised force gain z - stiffness s - damping s' along the stroke s of its terms.

    z follows the command with z' = lag (u - z), or is the command itself without a lag.
    """

    terms: Sequence[tuple[float, int, float]]  # (position, derivative of the deflection, factor)
    gain: float
    lag: float | None = None
    stiffness: float = 0.0
    damping: float = 0.0
    limits: tuple[float, float] | None = None
    rate: float | None = None

    def row(self, span: Span) -> np.ndarray:
        return sum(factor * span.shapes(x, order) for x, order, factor in self.terms)


@dataclass(frozen=True)
class Sensor:
    """Offset, range, resolution and digital filter in this order; an analogue filter before."""

    position: float
    quantity: str = "deflection"
    fibre: float = 0.0
    offset: float = 0.0
    range: tuple[float, float] | None = None
    resolution: float | None = None
    order: int = 0  # of a Butterworth filter
    cutoff: float = 0.0  # Hz
    analogue: bool = False
    period: float | None = None
    delay: float = 0.0
    lost: Sequence[bool] = ()  # whether each reading is lost
    late: Sequence[float] = ()  # s, added to the delay of each reading

    def row(self, span: Span) -> np.ndarray:
        """Row from the modal coordinates, rates or accelerations to the signal."""
        if self.quantity == "strain":
            return -self.fibre * span.shapes(self.position, 2)
        return span.shapes(self.position, 1 if self.quantity == "slope" else 0)

    def convert(self, signal: float) -> float:
        reading = signal + self.offset
        if self.range is not None:
            reading = min(max(reading, self.range[0]), self.range[1])
        if self.resolution is not None:
            reading = self.resolution * np.round(reading / self.resolution)
        return reading


@dataclass(frozen=True)
class Clock:
    """Sampling period, delay (s) and resolution of the commands of a sampled controller.

    `lost` commands never begin, `late` (s) is added to the delay of each.
    """

    period: float
    delay: float = 0.0
    resolution: float | None = None
    lost: Sequence[bool] = ()
    late: Sequence[float] = ()


@dataclass(frozen=True)
class Motion:
    times: np.ndarray  # (time,) s
    deflection: np.ndarray  # (time, sensor) m
    command: np.ndarray  # (time, actuator), just after a change
    arrived_readings: np.ndarray  # (time, sensor) newest that has arrived; 0 without a clock
    modal: np.ndarray  # (time, mode) sqrt(kg) m
    modal_rate: np.ndarray  # (time, mode)


Law = Callable[[np.ndarray, np.ndarray, float], np.ndarray]  # of readings, state (q, q', z), time


def respond(
    span: Span,
    loads: Sequence[Load],
    actuators: Sequence[Actuator],
    sensors: Sequence[Sensor],
    law: Law,
    times: Sequence[float],
    clock: Clock | None = None,
    breaks: Sequence[float] = (),
) -> Motion:
    """The motion from rest at t = 0 at the ascending `times`; a law may jump at the `breaks`.

    Raises RuntimeError if the integration fails.
    """
    plant = _Plant(span, loads, actuators, sensors)
    loop = _Loop(plant, law, clock, times[-1])
    events = [t for load in loads for t in (load.entry_time, load.time_at(span.length))]
    marks = sorted({round(t, DIGITS) for t in [0.0, *times, *events, *breaks, *loop.times]
                    if 0.0 <= t <= times[-1] + 10.0**-DIGITS})  # fmt: skip
    samples = {round(t, DIGITS): k for k, t in enumerate(times)}
    states, commands = np.zeros((len(times), plant.size)), np.zeros((len(times), len(actuators)))
    arrived_readings = np.zeros((len(times), len(sensors)))

    state = np.zeros(plant.size)
    for start, end in zip(marks, [*marks[1:], None], strict=True):
        active = [
            load for load in loads if load.entry_time <= start + 1e-13 < load.time_at(span.length)
        ]
        loop.carry_out(start, state, active)
        if start in samples:
            states[samples[start]] = state
            commands[samples[start]] = loop.command(start, state)
            if clock is not None:
                arrived_readings[samples[start]] = loop.arrived_readings(start)
        if end is None:
            break
        solution = solve_ivp(
            lambda t, y, a=active: plant.rate(t, y, loop.command(t, y), a),
            (start, end), state, method="DOP853", rtol=1e-12, atol=1e-15,
        )  # fmt: skip
        if not solution.success:
            raise RuntimeError(solution.message)
        state = solution.y[:, -1]
    n = span.modes
    rows = np.array([span.shapes(s.position) for s in sensors]).reshape(-1, n)
    deflection, modal, rates = states[:, :n] @ rows.T, states[:, :n], states[:, n : 2 * n]
    return Motion(np.asarray(times), deflection, commands, arrived_readings, modal, rates)


class _Plant:
    """Beam, loads, actuators and analogue filters: y = (q, q', z of the actuators, filters)."""

    def __init__(self, span, loads, actuators, sensors):
        self.span, self.loads, self.actuators, self.sensors = span, loads, actuators, sensors
        n = span.modes
        self.strokes = np.array([a.row(span) for a in actuators]).reshape(-1, n)
        self.rows = np.array([s.row(span) for s in sensors]).reshape(-1, n)
        self.stiffness = np.diag(span.frequencies**2)
        self.damping = span.damping
        for actuator, row in zip(actuators, self.strokes, strict=True):
            self.stiffness = self.stiffness + actuator.stiffness * np.outer(row, row)
            self.damping = self.damping + actuator.damping * np.outer(row, row)
        self.lagging = [i for i, a in enumerate(actuators) if a.lag is not None]
        self.controlled = 2 * n + len(self.lagging)
        self.filters, self.size = {}, self.controlled
        for i, sensor in enumerate(sensors):
            if sensor.order and sensor.analogue:
                a, b, c, _ = scipy.signal.tf2ss(
                    *scipy.signal.butter(sensor.order, 1.0, analog=True)
                )
                cutoff = 2 * np.pi * sensor.cutoff
                part = slice(self.size, self.size + sensor.order)
                self.filters[i] = part, cutoff * a, cutoff * b[:, 0], c[0]
                self.size += sensor.order

    def rate(self, t, y, command, active):
        n = self.span.modes
        result = np.zeros(self.size)
        result[:n], result[n : 2 * n] = y[n : 2 * n], self.accelerations(t, y, command, active)
        for index, i in enumerate(self.lagging, 2 * n):
            result[index] = self.actuators[i].lag * (command[i] - y[index])
        for i, (part, matrix, column, _) in self.filters.items():
            result[part] = matrix @ y[part] + column * self.signal(i, y)
        return result

    def accelerations(self, t, y, command, active):
        n = self.span.modes
        q, u = y[:n], y[n : 2 * n]
        actuator_states = np.array(command, float)
        actuator_states[self.lagging] = y[2 * n : self.controlled]
        gains = [a.gain for a in self.actuators]
        mass, force = np.eye(n), (gains * actuator_states) @ self.strokes
        force = force - self.damping @ u - self.stiffness @ q
        for load in active:
            x, dx, ddx = load.motion(t, self.span.length, t > load.stop_time)
            phi, slope, curvature = under(self.span, float(x))
            force = force - load.mass * GRAVITY * phi
            if load.kind == "mass":
                mass += load.mass * phi[:, None] * phi
                convective = 2 * dx * slope @ u + dx**2 * curvature @ q + ddx * slope @ q
                force = force - load.mass * convective * phi
        return np.linalg.solve(mass, force)

    def signal(self, i, y):
        """Signal of a sensor before any filter, but for accelerations."""
        n = self.span.modes
        return self.rows[i] @ (y[n : 2 * n] if self.sensors[i].quantity == "velocity" else y[:n])

    def smooth(self, i, y):
        """Signal of a sensor after its analogue filter, if it has one."""
        if i not in self.filters:
            return self.signal(i, y)
        part, _, _, row = self.filters[i]
        return row @ y[part]


class _Loop:
    """Readings, and commands of the controller: last, delayed and active."""

    def __init__(self, plant: _Plant, law: Law, clock: Clock | None, end: float):
        self.plant, self.law, self.clock = plant, law, clock
        count = len(plant.actuators)
        self.active_command, self.last_command = np.zeros(count), np.zeros(count)
        self.delayed_commands, self.begun = {}, -1
        self.sample_numbers, self.readings, self.digital = [], [], []
        self.control_instants, self.times = {}, []
        if clock is None:
            return
        instants = clock.period * np.arange(int(end / clock.period + 1e-9) + 1)
        self.control_instants = {round(t, DIGITS): k for k, t in enumerate(instants)}
        self.times = [*instants, *(t + self._delay(k, clock) for k, t in enumerate(instants))]
        for sensor in plant.sensors:
            period = sensor.period or clock.period
            numbers = range(int(end / period + 1e-9) + 1)
            arriving = [k for k in numbers if not (len(sensor.lost) and sensor.lost[k])]
            samples = {round(k * period - self._delay(k, sensor), DIGITS): k for k in arriving}
            self.sample_numbers.append(samples)
            self.times += list(samples)
            rest = sensor.convert(0.0)
            # Time at which each reading arrives, and its value: at rest until it is taken.
            self.readings.append({-1: (-np.inf, rest)} | {k: (k * period, rest) for k in arriving})
            if sensor.order and not sensor.analogue:
                sos = scipy.signal.butter(sensor.order, sensor.cutoff, fs=1 / period, output="sos")
                self.digital.append([sos, scipy.signal.sosfilt_zi(sos) * rest])
            else:
                self.digital.append(None)

    def carry_out(self, t, state, active):
        """Take the readings and give the commands that are due at an event."""
        for i, sensor in enumerate(self.plant.sensors if self.clock else ()):
            if t in self.sample_numbers[i]:
                self._read(i, sensor, self.sample_numbers[i][t], t, state, active)
        if t in self.control_instants:
            law_output = self.law(self.arrived_readings(t), state[: self.plant.controlled], t)
            self.last_command = self._limited(law_output, self.last_command)
            number = self.control_instants[t]
            if not (len(self.clock.lost) and self.clock.lost[number]):
                begin = round(t + self._delay(number, self.clock), DIGITS)
                self.delayed_commands[begin] = number, self.last_command
        number, command = self.delayed_commands.pop(t, (-1, self.active_command))
        if number > self.begun:
            self.begun, self.active_command = number, command

    @staticmethod
    def _delay(number, part):
        """Delay of a command or of a reading of a number."""
        return part.delay + (part.late[number] if len(part.late) else 0.0)

    def arrived_readings(self, t):
        """The newest reading of each sensor that has arrived."""
        arrived = [max(r for r in each.values() if r[0] <= t + 1e-11) for each in self.readings]
        return np.array([value for _, value in arrived])

    def _read(self, i, sensor, number, t, state, active):
        if sensor.quantity == "acceleration":
            accelerations = self.plant.accelerations(t, state, self.active_command, active)
            reading = sensor.convert(self.plant.rows[i] @ accelerations)
        else:
            reading = sensor.convert(self.plant.smooth(i, state))
        if self.digital[i] is not None:
            sos, memory = self.digital[i]
            (reading,), self.digital[i][1] = scipy.signal.sosfilt(sos, [reading], zi=memory)
        self.readings[i][number] = (self.readings[i][number][0], reading)

    def command(self, t, state):
        if self.clock is not None:
            return self.active_command
        readings = [
            s.convert(self.plant.smooth(i, state)) for i, s in enumerate(self.plant.sensors)
        ]
        return self._limited(self.law(np.array(readings), state[: self.plant.controlled], t), None)

    def _limited(self, law_output, previous):
        command = np.array(law_output, float)
        if self.clock is not None and self.clock.resolution is not None:
            command = self.clock.resolution * np.round(command / self.clock.resolution)
        for i, actuator in enumerate(self.plant.actuators):
            if actuator.limits is not None:
                command[i] = np.clip(command[i], *actuator.limits)
            if actuator.rate is not None and previous is not None:
                change = actuator.rate * self.clock.period
                command[i] = np.clip(command[i], previous[i] - change, previous[i] + change)
        return command
