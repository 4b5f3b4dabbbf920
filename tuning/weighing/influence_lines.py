"""Influence lines of the sensors of a bridge: of its model, or calibrated by known vehicles.

Readings of sensors while a force of one newton crosses a beam at constant speed are

    z' = A z - B psi(x(t)),    y = C z - D psi(x(t)) - G(x(t)),

with the modes psi at the force, the state space of the modal model, and the static correction G of
curvature, strain and section forces (see `jaxbeam.model.output_rows`). Velocities and
accelerations follow from these states, which are exact for a psi that is linear between fine steps;
other readings are static, with z' = 0: a heavy load changes the frequencies of the beam.
"""

import dataclasses
import functools
from typing import NamedTuple

import numpy as np
import scipy.signal
from jaxtyping import Bool, Float

from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete, refuses_traced
from jaxbeam.case.sensors import Sensor
from jaxbeam.model.flexibility import check_supported
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.output_rows import sensor_rows, static_correction
from jaxbeam.model.sensor_signals import needs_times, sampled_readings
from jaxbeam.runtime.printer import counted, text_table

STEPS_PER_CROSSING = 200
STEPS_PER_PERIOD = 12  # of the highest mode
MAX_STEPS = 20_000


class UnitForce:
    """Response of the sensors of a case, without its loads, for `duration` (s) after an entry.

    Sensors are ideal but for their analogue filters and delays. `frequencies` (Hz) are those of the
    modes.

    Raises ValueError for a beam that can move as a rigid body.
    """

    def __init__(self, case: Case, duration: float):
        empty = {"loads": (), "vehicle_sensors": (), "controller": None, "profile": None}
        bare = dataclasses.replace(case, **empty)
        model = modal_model(bare)
        check_supported(bare, model.modes.layout)
        outputs = sensor_rows(model, bare, bare.sensors)
        commands = len(case.actuators)
        inputs = np.zeros((model.state_count, commands + model.mode_count))
        inputs[model.rate_index, commands:] = np.eye(model.mode_count)
        C, D = outputs.of_system(model, model.A, inputs)
        self.model, self.duration = model, duration
        self.signals = [_signal(sensor) for sensor in bare.sensors]
        self.length = float(concrete(case.beam.length))
        self.correction = static_correction(model, bare, bare.sensors, outputs)
        self.frequencies = np.asarray(model.modes.frequencies)
        # In coordinates that decouple the states.
        self.poles, self.vectors = np.linalg.eig(model.A)
        self.inputs = np.linalg.solve(self.vectors, inputs[:, commands:])
        self.outputs, self.feedthrough = C @ self.vectors, D[:, commands:]
        self.vibrates = np.array([order > 0 for order in outputs.time_derivatives])

    def modes(self, positions: Float[np.ndarray, " point"], count: int) -> tuple:
        """First frequency (Hz), shapes, ratios of frequencies, and damping ratios of modes."""
        own = np.flatnonzero(self.poles.imag > 1e-6 * np.abs(self.poles))
        own = own[np.argsort(np.abs(self.poles[own]))][:count]
        size = np.abs(self.poles[own])
        motion = self.vectors[self.model.coordinate_index][:, own]
        shapes = np.asarray(self.model.shapes(positions, (0,))[0]) @ motion
        largest = shapes[np.argmax(np.abs(shapes), axis=0), np.arange(own.size)]
        ratios, damping = size / size[0], -self.poles[own].real / size
        return float(size[0] / (2 * np.pi)), (shapes / largest).real, ratios, damping

    def readings(
        self, speed: float, since_entry: Float[np.ndarray, " time"]
    ) -> Float[np.ndarray, "time sensor"]:
        """Readings (SI units per newton) at times (s) since the entry; zero before it."""
        times, table = self._history(speed)
        columns = [np.interp(since_entry, times, column, left=0.0) for column in table.T]
        return np.stack(columns, axis=1)

    @functools.lru_cache(maxsize=256)  # noqa: B019  (as many as a search has speeds)
    def _history(self, speed: float):
        crossing = self.length / abs(speed)
        step = crossing / STEPS_PER_CROSSING
        if self.vibrates.any():
            step = min(step, 1 / (STEPS_PER_PERIOD * self.frequencies.max()))
        step = max(step, self.duration / MAX_STEPS)
        step = crossing / np.ceil(crossing / step)  # the exit is at the end of a step
        times = step * np.arange(int(np.ceil(self.duration / step)) + 2)
        on_beam = times < crossing * (1 + 1e-9)
        place = speed * times + (0.0 if speed > 0 else self.length)
        place = np.clip(place, 0.0, self.length)
        force = -np.where(on_beam[:, None], self.model.shapes(place, (0,))[0], 0.0)
        inputs = force @ self.inputs.T
        table = (-(inputs / self.poles) @ self.outputs.T).real
        if self.vibrates.any():
            states = driven(self.poles, inputs, step)
            moving = (states @ self.outputs.T).real + force @ self.feedthrough.T
            table = np.where(self.vibrates, moving, table)
        if self.correction is not None:
            influence = self.correction.influence.of_forces_at(place, place)
            table = table - np.where(on_beam[:, None], influence, 0.0)
        for i, sensor in enumerate(self.signals):
            if needs_times(sensor):
                table[:, i] = np.asarray(sampled_readings(sensor, times, table[:, i], None))
        return times, table


def _signal(sensor: Sensor) -> Sensor:
    """Sensor with only its analogue filter and delay, which act before sampling."""
    no_samples = {"offset": np.zeros(()), "noise": None, "range": None, "resolution": None}
    no_filter = {"filter": None} if sensor.has_digital_filter else {}
    return dataclasses.replace(sensor, sampling_period=None, **no_samples, **no_filter)


def driven(poles, inputs, step):
    """States z' = pole z + input from rest, exact for inputs that are linear within each step.

    Each input has its own pole, or all have one.
    """
    exponent = poles * step
    growth = np.exp(exponent)
    small = np.abs(exponent) < 1e-6
    safe = np.where(small, 1.0, exponent)
    first = np.where(small, 1 + exponent / 2, (growth - 1) / safe)
    second = np.where(small, 0.5 + exponent / 6, (first - 1) / safe)
    if np.ndim(poles) == 0:
        return scipy.signal.lfilter(
            [step * second, step * (first - second)], [1.0, -growth], inputs, axis=0
        )
    states = [
        scipy.signal.lfilter([step * b, step * (a - b)], [1.0, -factor], column)
        for a, b, factor, column in zip(first, second, growth, inputs.T, strict=True)
    ]
    return np.stack(states, axis=1)


POINTS = 81  # equally spaced, and one at each sensor, where lines of strain have a kink
# The bridge vibrates in as many modes as have this fraction of the squares of its influence lines,
# and in modes that dynamic wheel forces excite, below a frequency (Hz); at most in MODES.
MODE_FRACTION, DRIVEN, MODES = 0.8, 22.0, 3
USUAL_SHARE = 0.07  # of dynamic wheel forces in the static ones, on an average road
FORMAT = "jaxbeam influence lines 2"


@dataclasses.dataclass(frozen=True)
class AxleGeometry:
    """Speed (m/s), time (s) at which the first axle enters, distances (m) of the axles behind it.

    At a negative speed the axles enter at the right end of the beam of a length (m).
    """

    speed: float
    entry_time: float
    offsets: Float[np.ndarray, " axle"]
    length: float

    def positions(self, times: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time axle"]:
        """Positions (m) of the axles at times (s)."""
        travelled = abs(self.speed) * (times[:, None] - self.entry_time) - self.offsets
        return travelled if self.speed > 0 else self.length - travelled


class InfluenceLines(NamedTuple):
    """Readings of sensors (SI unit per newton downwards) with a force at positions (m).

    `deviations` of calibrated lines are independent of each other, of one standard deviation each:
    their products sum to the covariance of all ordinates. The bridge vibrates about the static
    readings in modes of these `shapes`, of `ratios` times the first `frequency` (Hz), and
    `damping_ratios`; without a frequency it does not vibrate. Dynamic wheel forces on its road are
    about `dynamic_share` of the static ones (standard deviation).

    >>> import numpy as np
    >>> import tuning
    >>> lines = tuning.weighing.InfluenceLines(
    ...     np.array([0.0, 5.0, 10.0]), np.array([[0.0], [-2e-8], [0.0]])
    ... )
    >>> print(lines.at(np.array([2.5])))
    [[-1.e-08]]
    """

    positions: Float[np.ndarray, " point"]
    values: Float[np.ndarray, "point sensor"]
    deviations: Float[np.ndarray, "number point sensor"] | None = None
    frequency: float | None = None
    shapes: Float[np.ndarray, "point mode"] | None = None
    ratios: Float[np.ndarray, " mode"] | None = None
    damping_ratios: Float[np.ndarray, " mode"] | None = None
    dynamic_share: float = USUAL_SHARE

    def at(self, x: Float[np.ndarray, "*force"]) -> Float[np.ndarray, "*force sensor"]:
        """Readings per newton with the force at x (m), zero off the beam."""
        lines = (np.interp(x, self.positions, line, 0.0, 0.0) for line in self.values.T)
        return np.stack(list(lines), axis=-1)

    @property
    def length(self) -> float:
        """Length (m) of the beam."""
        return float(self.positions[-1])

    def of_sensors(self, chosen: Bool[np.ndarray, " sensor"]) -> "InfluenceLines":
        """The lines of some of the sensors."""
        own = None if self.deviations is None else self.deviations[:, :, chosen]
        return self._replace(values=self.values[:, chosen], deviations=own)

    @checks_classes
    def crossing(
        self, geometry: AxleGeometry, times: Float[np.ndarray, " time"]
    ) -> Float[np.ndarray, "time axle sensor"]:
        """Readings of a force of one newton at each axle, with the vibration that it leaves."""
        found = self.at(geometry.positions(times))
        since = times[:, None] - geometry.entry_time - geometry.offsets / abs(geometry.speed)
        for mode in self.modes:
            found = found + mode.swing(since, geometry.speed)[:, :, None] * (
                mode.parts @ self.values
            )
        return found

    @checks_classes
    def modulated(
        self,
        geometry: AxleGeometry,
        times: Float[np.ndarray, " time"],
        waves: Float[np.ndarray, "time wave"],
    ) -> Float[np.ndarray, "time axle wave sensor"]:
        """Readings of forces at the axles that vary in time as `waves` (N), with vibration."""
        x = geometry.positions(times)
        found = waves[:, None, :, None] * self.at(x)[:, :, None, :]
        grid = np.linspace(times[0], times[-1], times.size)
        even = np.allclose(grid, times, atol=0.01 * (grid[1] - grid[0]))
        for mode in self.modes:
            shape = np.interp(x, self.positions, mode.shape, 0.0, 0.0)
            force = (shape[:, :, None] * waves[:, None, :]).reshape(times.size, -1)
            own = force if even else _interpolated(grid, times, force)
            swing = mode.motion(own, grid[1] - grid[0]) - own
            swing = swing if even else _interpolated(times, grid, swing)
            found += swing.reshape(*shape.shape, -1, 1) * (mode.parts @ self.values)
        return found

    def tuned(self, logs: Float[np.ndarray, " mode"]) -> "InfluenceLines":
        """Lines whose modes have other frequencies, by the logarithms of their ratios to these."""
        if self.frequency is None or self.ratios is None:
            return self
        ratios = self.ratios * np.exp(logs - logs[0])
        return self._replace(frequency=float(self.frequency * np.exp(logs[0])), ratios=ratios)

    @property
    def modes(self) -> "list[_Mode]":
        """Modes in which the bridge vibrates."""
        if self.frequency is None:
            return []
        assert self.shapes is not None
        # An influence line is the sum of the shapes times what these rows make of it.
        parts = np.linalg.solve(self.shapes.T @ self.shapes, self.shapes.T)
        rows = zip(self.shapes.T, self.ratios, self.damping_ratios, parts, strict=True)
        return [
            _Mode(self.positions, shape, float(self.frequency * ratio), float(damping), part)
            for shape, ratio, damping, part in rows
        ]

    @property
    def errors(self) -> Float[np.ndarray, "point sensor"]:
        """Standard errors of the ordinates; zero for the lines of a case."""
        if self.deviations is None:
            return np.zeros(self.values.shape)
        return np.sqrt(np.sum(self.deviations**2, axis=0))

    def __str__(self) -> str:
        sizes = np.abs(self.values)
        rows = [
            [str(i), f"{self.values[k, i]:.4g}", f"{self.positions[k]:.4g}",
             f"{100 * self.errors[k, i] / max(sizes[k, i], 1e-300):.2g}"]
            for i, k in enumerate(sizes.argmax(axis=0).tolist())
        ]  # fmt: skip
        head = ("sensor", "largest ordinate (SI unit/N)", "at (m)", "standard error (%)")
        about = "" if self.frequency is None else (
            f"; the first mode vibrates at {self.frequency:.4g} Hz, dynamic wheel forces are"
            f" {self.dynamic_share:.2g} of the static ones"
        )  # fmt: skip
        count = self.values.shape[1]
        first = f"influence lines of {counted(count, 'sensor')}{about}"
        return "\n".join([first, *text_table(head, rows, ">>>>")])

    def to_dict(self) -> dict:
        """Plain numbers, from which `lines_from_dict` makes the lines again."""
        return {
            "format": FORMAT,
            "positions_m": self.positions.tolist(),
            "ordinates": self.values.T.tolist(),
            "deviations": _listed(self.deviations),
            "frequency_hz": self.frequency,
            "shapes": _listed(self.shapes),
            "frequency_ratios": _listed(self.ratios),
            "damping_ratios": _listed(self.damping_ratios),
            "dynamic_share": self.dynamic_share,
        }


def _listed(table: np.ndarray | None) -> list | None:
    return None if table is None else table.tolist()


def lines_from_dict(content: dict) -> InfluenceLines:
    """Influence lines from the numbers of `InfluenceLines.to_dict`.

    Raises ValueError for content of another format.
    """
    found = content.get("format") if isinstance(content, dict) else None
    if found != FORMAT:
        raise ValueError(
            f"these are no calibrated influence lines: format {found!r}, not {FORMAT!r}; write them"
            " by weigh calibrate CASE LOG -o FILE"
        )
    names = "deviations", "shapes", "frequency_ratios", "damping_ratios"
    tables = [None if content[name] is None else np.array(content[name]) for name in names]
    return InfluenceLines(
        np.array(content["positions_m"]), np.array(content["ordinates"]).T, tables[0],
        content["frequency_hz"], *tables[1:],
        dynamic_share=content["dynamic_share"],
    )  # fmt: skip


class _Mode(NamedTuple):
    """Mode z'' + 2 zeta w z' + w^2 z = w^2 s; `parts` are its weights in an influence line."""

    positions: Float[np.ndarray, " point"]
    shape: Float[np.ndarray, " point"]
    frequency: float
    damping_ratio: float
    parts: Float[np.ndarray, " point"]

    def swing(self, since: Float[np.ndarray, "*time"], speed: float) -> Float[np.ndarray, "*time"]:
        """Dynamic part z - s of the response to a crossing force, at times (s) since its entry."""
        passage = float(self.positions[-1]) / abs(speed)
        last = max(float(since.max()), passage)
        fine = min(passage / 200, 1 / (24 * self.frequency), last / 8)
        step = passage / np.ceil(passage / fine)
        times = step * np.arange(int(np.ceil(last / step)) + 2)
        place = times * abs(speed)
        if speed < 0:
            place = self.positions[-1] - place
        force = np.interp(place, self.positions, self.shape, 0.0, 0.0)
        motion = self.motion(force[:, None], step)[:, 0]
        return np.interp(since, times, motion - force, left=0.0)

    def motion(
        self, force: Float[np.ndarray, "time number"], step: float
    ) -> Float[np.ndarray, "time number"]:
        """Response z from rest to forces s at equal steps (s)."""
        w, damping = 2 * np.pi * self.frequency, self.damping_ratio
        pole = complex(-damping * w, w * np.sqrt(1 - damping**2))
        # z is the imaginary part of the response of one pole to w^2 / w_d times the force.
        return driven(pole, force, step).imag * (w**2 / pole.imag)


def _interpolated(x, points, table: Float[np.ndarray, "point number"]):
    """Columns of a table at points, interpolated at x."""
    return np.stack([np.interp(x, points, column) for column in table.T], axis=1)


@refuses_traced("a table of influences")
def model_influence_lines(case: Case) -> InfluenceLines:
    """Influence lines of a case at points, linear in between, and its first modes.

    Lines of moments and other section forces are corrected statically; lines of deflections are
    sums of the modes of the case.

    Raises ValueError for a sensor of velocity or acceleration, and a beam that can move as a rigid
    body.

    >>> import numpy as np
    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.Case(jb.Beam(20.0, 8e9, 12e3), sensors=[jb.Sensor(10.0)])
    >>> lines = tuning.weighing.model_influence_lines(case)
    >>> print(f"{lines.at(np.array([10.0]))[0, 0]:.2e} m/N, {-(20**3) / 48 / 8e9:.2e} m/N")
    -2.08e-08 m/N, -2.08e-08 m/N
    """
    check_static(case)
    unit_force = UnitForce(case, 1.0)
    positions = _stations(case)
    values = unit_force.readings(unit_force.length, positions / unit_force.length)
    return InfluenceLines(positions, values, None, *_first_modes(case, positions))


def lines_for(case: Case, lines: InfluenceLines | None) -> InfluenceLines:
    """Influence lines for the sensors of a case: those given, or else its own.

    Raises ValueError for a sensor of velocity or acceleration, and lines of other sensors.
    """
    check_static(case)
    if lines is None:
        return model_influence_lines(case)
    if lines.values.shape[1] != len(case.sensors):
        raise ValueError(
            f"the influence lines are of {lines.values.shape[1]} sensors, the case has "
            f"{len(case.sensors)}: calibrate with this case"
        )
    return lines


def _stations(case: Case) -> Float[np.ndarray, " point"]:
    """Equally spaced points (m) of a beam, and its sensors."""
    length = float(concrete(case.beam.length))
    sensors = [float(concrete(sensor.position)) for sensor in case.sensors]
    points = np.sort(np.concatenate([np.linspace(0.0, length, POINTS), sensors]))
    return points[np.append(True, np.diff(points) > 1e-6 * length)]


def _first_modes(case: Case, positions: Float[np.ndarray, " point"]) -> tuple:
    """First modes in which the bridge of a case vibrates."""
    unit_force = UnitForce(case, 1.0)
    values = unit_force.readings(unit_force.length, positions / unit_force.length)
    count, left = 0, np.inf
    while count < MODES and left > 1 - MODE_FRACTION:
        count += 1
        modes = unit_force.modes(positions, count)
        rest = values - modes[1] @ np.linalg.lstsq(modes[1], values, rcond=None)[0]
        left = float(np.mean(np.sum(rest**2, axis=0) / np.sum(values**2, axis=0)))
    driven = unit_force.modes(positions, MODES)
    frequencies = driven[0] * driven[2]
    return unit_force.modes(positions, max(count, int(np.sum(frequencies < DRIVEN))))


def check_static(case: Case) -> None:
    """Raises ValueError, naming the sensor, for one whose influence line is zero, or for none."""
    if not case.sensors:
        raise ValueError("weighing needs a sensor on the beam; the case has none")
    for i, sensor in enumerate(case.sensors):
        if sensor.quantity in ("velocity", "acceleration"):
            raise ValueError(
                f"sensors.{i} measures {sensor.quantity}, which has no influence line; weigh axles"
                " by deflection, strain and the like"
            )
