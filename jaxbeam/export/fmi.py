"""Beam and controller as FMI 3.0 units for co-simulation, and their steps.

A unit is written by pythonfmu3 (extra `fmi`). It holds the case file and a script; where it runs,
the Python of its host needs jaxbeam.
"""

import dataclasses
import math
import os
import shutil
import tempfile
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxbeam.case.actuators.base import limited_loops
from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.control.estimation.sampled_plant import SampleTiming
from jaxbeam.files.case_file import save_case
from jaxbeam.model.contact import may_have_kinks
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.sensor_signals import (
    MAX_READING,
    filtered_reading,
    initial_filter_state,
    sensor_sections,
    to_reading,
)
from jaxbeam.model.state_space import state_space
from jaxbeam.numerics.stages import balance
from jaxbeam.runtime.arrays import to_numpy
from jaxbeam.runtime.output_file import whole_file
from jaxbeam.simulation.commands import command_path

STEP_OF_FASTEST = 0.1  # of a radian of the fastest mode, the longest step of Magnus' method


class BeamSteps:
    """Beam, supports, actuators and loads of a case, integrated step by step from rest at t = 0.

    Commands are held over a step of any length, within the limits of the actuators. Steps are
    split where wheels enter and leave the beam, and go by Magnus' method of order 4 in between;
    readings are those of ideal sensors, in SI units. The controller of the case is left out.

    Raises ValueError for an invalid case, for actuators with hysteresis, creep or limits of the
    voltage within an inner loop, and for rigid wheels over kinks, whose impulses only `simulate`
    has.

    >>> import jaxbeam as jb
    >>> from jaxbeam.export.fmi import BeamSteps
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ... )
    >>> beam = BeamSteps(case)
    >>> beam.step(0.04)
    >>> beam.step(0.01)
    >>> print(f"{beam.time:.2f} s, {1e3 * beam.readings[0]:.3f} mm")
    0.05 s, -1.467 mm
    """

    def __init__(self, case: Case):
        check_case(case)
        if limited := limited_loops(case.actuators):
            raise ValueError(
                f"actuators.{limited[0]}.limits bound the voltage within its inner loop, and an"
                " exported beam is linear: leave them out"
            )
        case = concrete_case(dataclasses.replace(case, controller=None))
        for i, actuator in enumerate(case.actuators):
            if actuator.hysteresis is not None or actuator.creep is not None:
                raise ValueError(
                    f"actuators.{i} has a hysteresis or creep, which only a sampled loop has: leave"
                    " it out of the beam that is exported"
                )
        if may_have_kinks(case):
            raise ValueError(
                "rigid wheels pass a kink of their path, and the impulse there is in no exported"
                " beam: take sprung wheels, or a path without kinks"
            )
        self._plant = state_space(case)
        self._state = np.concatenate(
            [np.zeros(len(self._plant.states)), np.asarray(self._plant.augmented_start)]
        )
        start = self._plant.augmented(0.0)
        self._scale = np.asarray(balance(np.asarray(start.A)))
        fastest = np.max(np.abs(np.linalg.eigvals(np.asarray(self._plant.unloaded.A))), initial=1.0)
        self._longest = STEP_OF_FASTEST / fastest
        loads = self._plant.loads
        windows, others = loads.events(np.zeros(0))
        times = np.unique(np.concatenate([np.ravel(windows), np.ravel(others)]))
        self._events = times[(times > 0) & (times < 1e30)]
        limits = [actuator.command_limits() for actuator in case.actuators]
        self._low = np.array([-np.inf if pair is None else pair[0] for pair in limits])
        self._high = np.array([np.inf if pair is None else pair[1] for pair in limits])
        self.commands = np.zeros(len(case.actuators))
        self.time = 0.0

    def step(self, duration: float, commands: ArrayLike | None = None) -> None:
        """Advance by a `duration` (s) under `commands` (V, A or N), the last ones if None.

        Raises ValueError for a duration that is not positive.
        """
        if not duration > 0:
            raise ValueError(f"a step must last longer than {duration:g} s")
        if commands is not None:
            self.commands = np.clip(np.asarray(commands, float), self._low, self._high)
        end = self.time + duration
        within = self._events[(self._events > self.time) & (self._events < end)]
        edges = np.concatenate([[self.time], within, [end]])
        for first, last in zip(edges[:-1], edges[1:], strict=True):
            self._advance(first, last)
        self.time = end

    @property
    def readings(self) -> Float[np.ndarray, " sensor"]:
        """Readings of the ideal sensors at the present time, under the last commands."""
        system = self._plant.augmented(self.time)
        return np.asarray(system.C @ self._state + system.D @ self.commands)

    def _advance(self, start: float, end: float) -> None:
        """Advance the state over an interval (s) without events."""
        steps = max(1, math.ceil((end - start) / self._longest))
        span = (end - start) / steps
        size, actuators = self._state.size, self.commands.size

        def matrices(times):
            system = self._plant.augmented(times)
            B = np.broadcast_to(np.asarray(system.B), (*np.shape(times), size, actuators))
            return np.asarray(system.A), B

        ends = start + span * np.arange(1, steps + 1)
        timing = SampleTiming(np.asarray(span), None)
        found = timing.transition(matrices, np.zeros((size, size)), self._scale, ends)
        inputs = np.asarray(found.input_matrix) @ self.commands
        for matrix, own in zip(np.asarray(found.matrix), inputs, strict=True):
            self._state = matrix @ self._state + own


CLOCK_TOLERANCE = 1e-6  # of a period, by which a time may miss a sample


class ControllerSteps:
    """Law of a case at its samples, with estimator, filters, limits and delay.

    Readings are those of ideal sensors in SI units; offset, range, resolution and digital filter
    are part of it, noise is not. A reading that is NaN or infinite is missing: the last one stays
    in its place, and the law knows. A law with a number that is not finite starts again, and its
    last command stays. A command is held until the next one begins.

    Raises ValueError for an invalid case, one without a controller that samples, sensors with an
    analogue filter, a delay or a sampling period of their own, dropout or jitter, and a law that
    uses the true state.

    >>> import jaxbeam as jb
    >>> from jaxbeam.export.fmi import ControllerSteps
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3, limits=[-1.0, 1.0])],
    ...     sensors=[jb.Sensor(0.3)],
    ...     controller=jb.Feedback([2e3], period=0.005),
    ... )
    >>> law = ControllerSteps(case)
    >>> print(law.step(0.0, [-1e-4]), law.step(0.0025, [-3e-4]), law.step(0.005, [-9e-4]))
    [0.2] [0.2] [1.]
    """

    def __init__(self, case: Case):
        check_case(case)
        case = concrete_case(case)
        controller = case.controller
        if controller is None or controller.period is None:
            raise ValueError("the exported controller needs a period: it acts at samples")
        self._check_sensors(case)
        self._sensors = case.sensors
        self._period = float(controller.period)
        self._delay = 0.0 if controller.delay is None else float(controller.delay)
        plant = state_space(case, layout=mesh_layout(case))
        self._law, self._wanted = to_numpy(controller.law(plant)), np.zeros(len(case.actuators))
        self._sections = [sensor_sections(sensor, self._period) for sensor in case.sensors]
        self._path = command_path(case)
        self._memory = self._path.start(1, round(np.ceil(self._delay / self._period)))
        self._restart()
        self._unknown = np.full(len(plant.states), np.nan)
        self._sample = 0
        self._waiting: list[tuple[float, np.ndarray]] = []
        self.commands = np.zeros(len(case.actuators))
        self._check_state()

    def step(self, time: float, readings: ArrayLike) -> Float[np.ndarray, " actuator"]:
        """Commands that act from a time (s) on, after a sample of the readings if one is due then.

        Times must not decrease. Raises ValueError if a sample was skipped.
        """
        due, tolerance = self._sample * self._period, CLOCK_TOLERANCE * self._period
        if time > due + tolerance:
            raise ValueError(
                f"the sample at {due:.6g} s was passed over: take communication steps that divide"
                f" the period of the controller, {self._period:g} s"
            )
        if time > due - tolerance:
            self._take_sample(due, np.asarray(readings, float))
        while self._waiting and self._waiting[0][0] <= time + tolerance:
            self.commands = self._waiting.pop(0)[1]
            self._memory = self._path.begin(self._memory, len(self._waiting))
        return self.commands

    def _take_sample(self, due: float, readings) -> None:
        """Step the law at the sample due; its commands begin after the delay."""
        present = np.abs(readings) <= MAX_READING
        for i in np.flatnonzero(present):
            self._readings[i], self._filters[i] = filtered_reading(
                self._sensors[i], self._sections[i], self._filters[i], readings[i]
            )
        known_commands = self._path.assumed_commands(self._memory)[:, 0]
        measurement = Measurement(self._readings.copy(), self._unknown, known_commands, present)
        found = self._law.step(self._state, measurement, np.asarray(due))
        self._state, command = found.state, np.asarray(found.command)
        numbers = [*jax.tree.leaves((self._state, self._filters)), self._readings, command]
        if all(np.all(np.abs(part) <= MAX_READING) for part in numbers):
            self._wanted = command
        else:
            self._restart()
        self._memory = self._path.send(self._memory, self._wanted[:, None])
        self._waiting.append((due + self._delay, np.array(self._memory.queue[0][:, 0])))
        self._sample += 1

    def _restart(self) -> None:
        """Set law, filters and readings to rest."""
        pairs = list(zip(self._sensors, self._sections, strict=True))
        self._state = self._law.initial_state()
        self._filters = [initial_filter_state(*pair, np.zeros(())) for pair in pairs]
        self._readings = np.array([to_reading(sensor, 0.0) for sensor, _ in pairs])

    def _check_state(self) -> None:
        """Raise ValueError if the first command depends on the true state."""
        zero = np.zeros(len(self._sensors))
        measurement = Measurement(zero, self._unknown, np.zeros_like(self.commands))
        found = self._law.step(self._state, measurement, np.zeros(()))
        if not np.all(np.isfinite(np.asarray(found.command))):
            raise ValueError(
                "the law uses the true state, which no sensor gives: give controller.estimator"
            )

    @staticmethod
    def _check_sensors(case: Case) -> None:
        for i, sensor in enumerate(case.sensors):
            analogue = sensor.filter is not None and not sensor.has_digital_filter
            for name, given in (
                ("an analogue filter", analogue),
                ("a delay", sensor.delay is not None),
                ("a sampling period", sensor.sampling_period is not None),
                ("a dropout", sensor.dropout is not None),
                ("a jitter", sensor.jitter is not None),
            ):
                if given:
                    raise ValueError(
                        f"sensors.{i} has {name} of its own, which belongs to the other unit:"
                        " leave it out of the controller that is exported"
                    )
        for name in ("dropout", "jitter"):
            if getattr(case.controller, name) is not None:
                raise ValueError(
                    f"controller.{name} belongs to the line between the units: leave it out of the"
                    " controller that is exported"
                )


PARTS = {"beam": BeamSteps, "controller": ControllerSteps}

SCRIPT = '''"""Unit for co-simulation of a {part} of jaxbeam."""

from pathlib import Path

from pythonfmu3 import DefaultExperiment, Fmi3Causality, Fmi3Slave, Fmi3Variability, Float64

import jaxbeam as jb
from jaxbeam.export.fmi import PARTS


class {name}(Fmi3Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        case = jb.load_case(Path(self.resources) / "case.toml")
        self.description = case.title or "{part} of jaxbeam"
        self.steps, self.time = PARTS["{part}"](case), 0.0
        self.default_experiment = DefaultExperiment(
            start_time=0.0, stop_time=float(case.run.duration), step_size={step}
        )
        varies = dict(variability=Fmi3Variability.continuous)
        time = Float64("time", causality=Fmi3Causality.independent, **varies)
        self.register_variable(time)
        commands = [f"command_{{i}}" for i in range(len(case.actuators))]
        readings = [f"sensor_{{i}}" for i in range(len(case.sensors))]
        self.inputs, self.outputs = ({inputs})
        for names, causality in ((self.inputs, "input"), (self.outputs, "output")):
            for name in names:
                setattr(self, name, 0.0)
                start = dict(start=0.0) if causality == "input" else {{}}
                kind = getattr(Fmi3Causality, causality)
                self.register_variable(Float64(name, causality=kind, **varies, **start))

    def do_step(self, current_time, step_size):
        given = [float(getattr(self, name)) for name in self.inputs]
        {step_text}
        for name, value in zip(self.outputs, found):
            setattr(self, name, float(value))
        self.time = current_time + step_size
        return True
'''
STEPS = {
    "beam": "self.steps.step(step_size, given); found = self.steps.readings",
    "controller": "found = self.steps.step(current_time, given)",
}
INPUTS = {"beam": "commands, readings", "controller": "readings, commands"}


@checks_classes
def write_fmu(case: Case, path: str | os.PathLike, part: str = "beam", overwrite=False) -> Path:
    """Write the beam or the controller of a case as a unit for co-simulation by FMI 3.0.

    The beam has the inputs command_0, ... (V, A or N, held over a step) and the outputs sensor_0,
    ... (SI units); a controller the other way round. In a loop the master steps the controller
    first, from t with the readings at t, then the beam with its commands, by communication steps
    that divide the period. The name of the file is that of the model.

    Raises ValueError for another part, a name that is none in Python, and cases that `BeamSteps` or
    `ControllerSteps` refuse; FileExistsError for a file that exists, without `overwrite`;
    ImportError, with what to install, without pythonfmu3.
    """
    path = Path(path)
    if part not in PARTS:
        raise ValueError(f"part may be {' or '.join(PARTS)}, not {part!r}")
    if path.suffix != ".fmu" or not (path.stem.isidentifier() and path.stem.isascii()):
        raise ValueError(f"{path.name} cannot be the name of a unit: take letters, digits, _, .fmu")
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists already; choose another name, or overwrite it")
    try:
        from pythonfmu3 import FmuBuilder
    except ImportError:
        raise ImportError(
            "units for co-simulation are written by pythonfmu3, which is not installed: pip install"
            " pythonfmu3, or pip install 'jaxbeam[fmi]'"
        ) from None
    PARTS[part](case)  # its errors, before anything is written
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        save_case(case, scratch / "case.toml")
        period = 0.0 if case.controller is None else float(case.controller.period or 0.0)
        text = SCRIPT.format(
            part=part,
            name=path.stem,
            step=period or 1 / float(case.run.sample_rate),
            inputs=INPUTS[part],
            step_text=STEPS[part],
        )
        script = scratch / f"{path.stem}_unit.py"
        with open(script, "w", encoding="utf-8") as file:
            file.write(text)
        built = FmuBuilder.build_FMU(script, scratch / "out", [scratch / "case.toml"])
        with whole_file(path, overwrite) as partial:
            shutil.copy(built, partial)
    return path
