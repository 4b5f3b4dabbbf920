"""Step of a program in C as a function in Python: from measurements to limited commands.

It is traced and translated to C; NumPy runs it as well.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.c_code.recorded_loop import FilteredLaw, filters_in_program
from jaxbeam.case.case import Case
from jaxbeam.case.controller import AbstractSampledLaw, Measurement
from jaxbeam.case.fields import concrete
from jaxbeam.control.feedforward import ConfirmedFeedforwardLaw, FeedforwardLaw
from jaxbeam.control.load_identification import GateIdentifier, GivenLoad
from jaxbeam.control.optimal.crossing_gains import GainSchedule
from jaxbeam.model.sensing.sensor_signals import possible_readings
from jaxbeam.runtime.arrays import Array, is_jax, xp
from jaxbeam.runtime.module import Module
from jaxbeam.simulation.closed_loop import command_lag
from jaxbeam.simulation.commands import CommandMemory, CommandPath, command_path

GATE_TIMES = "gate_times"
SETTINGS = {  # numbers of a law that may be changed while a program runs
    GivenLoad: ("mass", "speed", "entry_time"),
    GainSchedule: ("start", "end"),
    **dict.fromkeys((GateIdentifier, FeedforwardLaw, ConfirmedFeedforwardLaw), (GATE_TIMES,)),
}
NEVER = 1e30  # s, of a gate that has not been passed


class ProgramState(NamedTuple):
    """State of a program from sample to sample.

    It has the state of the law with its filters and last readings; the last command of the law
    before limits; delayed commands, of one run; and numbers that may be set, by their names.
    """

    law: Any
    wanted: Float[Array, " actuator"]
    commands: CommandMemory
    settings: dict[str, Array]


class SampledProgram(Module):
    """Law of a case with the filters of its sensors, and limits and delay of its commands.

    `ranges` (sensor, 2) are those of the readings; `begun` is the age at which commands act.
    """

    law: FilteredLaw
    path: CommandPath
    ranges: Float[np.ndarray, "sensor 2"]
    begun: int
    settings: dict[str, Array]

    def start(self) -> ProgramState:
        """Initial state of a run, at rest."""
        return ProgramState(
            self.law.initial_state(),
            np.zeros(len(self.path.case.actuators)),
            self.path.start(1, self.begun),
            self.settings,
        )

    def step(
        self,
        state: ProgramState,
        measurements: Float[Array, " sensor"],
        plant_state: Float[Array, " state"],
        t: Float[Array, ""],
    ) -> tuple[Float[Array, " actuator"], ProgramState]:
        """Commands to be sent at a time (s), and the next state.

        A measurement that is no number, or outside of its range, is missing. A law with a number
        that is not finite starts again, and its last command stays.
        """
        low, high = self.ranges.T
        present = (measurements >= low) & (measurements <= high)
        last = state.law.readings
        readings = xp.where(present, measurements, last) if low.size else last
        known_command = self.path.assumed_commands(state.commands)[:, 0]
        measurement = Measurement(readings, plant_state, known_command, present)
        law = with_settings(self.law, state.settings)
        found = law.step(state.law, measurement, t)
        leaves = jax.tree.leaves((found.state, found.command))
        numbers = xp.concatenate([xp.ravel(leaf) for leaf in leaves if _is_real(leaf)])
        finite = xp.all(xp.isfinite(numbers))
        wanted = xp.where(finite, found.command, state.wanted)
        start = self.law.initial_state()
        after = jax.tree.map(lambda new, old: xp.where(finite, new, old), found.state, start)
        commands = self.path.send(state.commands, wanted[:, None])
        sent = commands.queue[0][:, 0]
        commands = self.path.begin(commands, np.array(self.begun))
        return sent, ProgramState(after, wanted, commands, state.settings)


def sampled_program(case: Case, law: AbstractSampledLaw, samples: int) -> SampledProgram:
    """Program of a case and its designed law, with tables over so many samples."""
    sections = filters_in_program(case)
    filtered = FilteredLaw(law, sections, case.sensors)
    times = np.arange(samples) * float(concrete(case.controller.period))
    # A reading that comes filtered may be beyond the range of its samples.
    ranges = [
        possible_readings(
            dataclasses.replace(sensor, range=None)
            if sensor.has_digital_filter and part is None
            else sensor
        )
        for sensor, part in zip(case.sensors, sections, strict=True)
    ]
    path = command_path(case)
    without = dataclasses.replace(path, operators=(None,) * len(case.actuators))
    return SampledProgram(
        filtered.tabulated(times),
        without,
        np.reshape(ranges, (-1, 2)).astype(float),
        command_lag(case) - 1,
        settings_of(law),
    )


def settings_of(law: AbstractSampledLaw) -> dict[str, np.ndarray]:
    """Initial values of the numbers of a law that may be set, by their names.

    Gates have not been passed then.
    """
    found: dict[str, np.ndarray] = {}
    for part in jax.tree.leaves(law, is_leaf=_has_settings):
        for name in _names(part):
            values = np.asarray(getattr(part, name), float)
            values = np.where(np.isnan(values), 0.0, values)  # not used
            found[name] = np.full(values.shape, NEVER) if name == GATE_TIMES else values
    return found


def with_settings(law, settings: dict[str, Array]):
    """Law with other values of numbers that may be set."""

    def changed(part):
        names = _names(part)
        return (
            dataclasses.replace(part, **{name: settings[name] for name in names}) if names else part
        )

    return jax.tree.map(changed, law, is_leaf=_has_settings)


def gate_times_of(law: AbstractSampledLaw) -> Float[np.ndarray, "load 2"]:
    """Times (s) at which the loads of a case pass the gates of its law; none without gates."""
    for part in jax.tree.leaves(law, is_leaf=_has_settings):
        if GATE_TIMES in _names(part):
            return np.reshape(np.asarray(getattr(part, GATE_TIMES), float), (-1, 2))
    return np.zeros((0, 2))


def _has_settings(part: Any) -> bool:
    return bool(_names(part))


def _names(part: Any) -> tuple[str, ...]:
    """Names of the numbers of a part that may be set; of tables of schedules there are none."""
    names = SETTINGS.get(type(part), ())
    return (
        names if GATE_TIMES in names or all(np.ndim(getattr(part, n)) == 0 for n in names) else ()
    )


def _is_real(leaf: Any) -> bool:
    dtype = leaf.dtype if is_jax(leaf) else np.asarray(leaf).dtype
    return np.issubdtype(dtype, np.floating)
