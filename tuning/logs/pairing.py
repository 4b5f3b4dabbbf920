"""A log matched with a case: sensors, commands and loads, checked against each other."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.case import Case, crossing_times, replace
from jaxbeam.case.controller import commanded
from jaxbeam.case.fields import concrete, kind_of
from jaxbeam.case.loads.base import AbstractLoad
from jaxbeam.case.sensors import unit_of
from jaxbeam.case.trajectory import NEVER
from jaxbeam.control.feedforward import Prescribed
from tuning.logs.log import Log
from tuning.logs.quality import samples_held

MAX_START_DURATIONS = 10.0  # first time of a log, in its durations, that is simulated from 0 on
COMMAND_UNITS = {"voltage": "V", "force": "N"}


def case_of_log(case: Case, log: Log, times: Float[np.ndarray, " time"]) -> Case:
    """The case with the loads and commands of a log, until its end.

    Commands are linear from sample to sample. One that stays for two samples or more is held by its
    converter, and is weighted with its neighbours so that its steps are where they are in the log:
    half a sample early, they would take k dt / 2 from the damping of a spring k.
    `times` (s) are those of the log and of its padding, in which the last commands stay. Raises
    ValueError, naming the log, for a command that no actuator of the case accepts.
    """
    if log.loads is not None:
        case = dataclasses.replace(case, loads=tuple(log.loads))
    if any(actuator is not None for actuator in log.actuators):
        commands = np.zeros((len(case.actuators), times.size))
        for channel, actuator in enumerate(log.actuators):
            if actuator is not None:
                _check_command(case, log, channel, actuator)
                more = times.size - log.times.size
                commands[actuator] = np.pad(_acting(log.values[:, channel]), (0, more), mode="edge")
        case = _prescribing(case, times, commands)
    return replace(case, {"run.duration": float(log.times[-1])})


def _acting(command: Float[np.ndarray, " time"]) -> Float[np.ndarray, " time"]:
    """The command, or if its samples are held, values that act alike when joined by lines.

    Held from sample to sample it is sinc(x) exp(-i x) of its samples, x = omega dt / 2, and lines
    are sinc(x)^2: these weights make up for exp(-i x) / sinc(x) up to x^4.
    """
    if samples_held(command) == 1.0:
        return command
    at = np.pad(command, (2, 1), mode="edge")  # at[2:-1] is the command
    return (7 * (at[2:-1] + at[1:-2]) - at[3:] - at[:-3]) / 12


def pad_cases(cases: list[Case], times: list[Float[np.ndarray, " time"]]) -> list[Case]:
    """The cases padded to one structure, by zero commands and by loads that enter after the end.

    Thus a crossing without commands and a shaken beam without loads have the same structure.
    """
    prescribed = any(isinstance(case.controller, Prescribed) for case in cases)
    longest = max((case.loads for case in cases), key=len)
    made = []
    for case, own in zip(cases, times, strict=True):
        if prescribed and case.controller is None:
            case = _prescribing(case, own, np.zeros((len(case.actuators), own.size)))
        absent_loads = tuple(_entering_at(load, 2 * own[-1]) for load in longest[len(case.loads) :])
        made.append(dataclasses.replace(case, loads=(*case.loads, *absent_loads)))
    return made


def _prescribing(case: Case, times, commands: Float[np.ndarray, "actuator time"]) -> Case:
    """The case with a table of commands for its actuators but springs and dampers."""
    values = commands[np.array(commanded(case.actuators), int)]
    controller = Prescribed(offsets=np.zeros(len(values)), times=times, values=values)
    return dataclasses.replace(case, controller=controller)


def _entering_at(load: AbstractLoad, time: float) -> AbstractLoad:
    """The load with another entry time (s)."""
    if load.times is None:
        return dataclasses.replace(load, entry_time=time)
    return dataclasses.replace(load, times=load.times - load.times[0] + time)


def _check_command(case: Case, log: Log, channel: int, actuator: int) -> None:
    if not 0 <= actuator < len(case.actuators):
        raise ValueError(
            f"{log.source}: {log.names[channel]} is the command to actuators.{actuator}, but the"
            f" case has {len(case.actuators)} actuators, counted from 0"
        )
    if log.actuators.count(actuator) > 1:
        raise ValueError(f"{log.source}: two of its channels are commands to actuators.{actuator}")
    if case.controller is not None:
        raise ValueError(
            f"{log.source}: its commands and the controller of the case contradict each other;"
            " leave one out"
        )
    device = case.actuators[actuator]
    unit = device.command_unit
    if unit == "1":
        raise ValueError(
            f"{log.source}: {log.names[channel]} is the command to actuators.{actuator}, a"
            f" {kind_of(type(device))}, which takes none; actuators are counted from 0"
        )
    if COMMAND_UNITS.get(log.quantities[channel]) != unit:
        raise ValueError(
            f"{log.source}: {log.names[channel]} holds {log.quantities[channel]} in"
            f" {log.units[channel]}, but the command to actuators.{actuator} is in {unit}"
        )
    limits = device.command_limits()
    low, high = (-np.inf, np.inf) if limits is None else concrete(limits)
    least, most = log.values[:, channel].min(), log.values[:, channel].max()
    if least < low or most > high:
        raise ValueError(
            f"{log.source}: {log.names[channel]} goes from {least:g} to {most:g} {unit}, beyond"
            f" what actuators.{actuator} takes, {low:g} to {high:g} {unit}: correct its limits"
        )


def sensor_readings(
    case: Case, log: Log
) -> tuple[Float[np.ndarray, "time sensor"], Bool[np.ndarray, "time sensor"]]:
    """Readings of a log in the order of `Case.all_sensors` (time, sensor), and which are valid.

    A log that does not name its sensors has all of them, in their order. Raises ValueError, naming
    the log, if its channels do not match the sensors.
    """
    sensors, on_beam = case.all_sensors, len(case.sensors)
    if not sensors:
        raise ValueError("the case has no sensors to compare the logs with")
    named = [(number, i) for i, number in enumerate(log.sensors) if number is not None]
    _check_known(log, [number for number, _ in named], "sensors", on_beam)
    pairs = [(number, i) for i, number in enumerate(log.vehicle_sensors) if number is not None]
    on_vehicles = len(case.vehicle_sensors)
    _check_known(log, [number for number, _ in pairs], "vehicle_sensors", on_vehicles)
    named += [(on_beam + number, i) for number, i in pairs]
    read = [i for i, actuator in enumerate(log.actuators) if actuator is None]
    order = dict(named) if named else dict(enumerate(read))
    if len(named) > len(order):
        raise ValueError(f"{log.source}: two of its channels are of the same sensor of the case")
    if not named and len(order) != len(sensors):
        raise _mismatch(log, len(sensors))
    values = np.zeros((log.times.size, len(sensors)))
    valid = np.zeros(values.shape, bool)
    for number, channel in order.items():
        sensor, unit = sensors[number], unit_of(log.quantities[channel])
        if unit != sensor.unit:
            listed = "sensors" if number < on_beam else "vehicle_sensors"
            own = number if number < on_beam else number - on_beam
            raise ValueError(
                f"{log.source}: {log.names[channel]} holds {log.quantities[channel]} in "
                f"{log.units[channel]}, but {listed}.{own} measures {sensor.quantity}"
            )
        values[:, number], valid[:, number] = log.values[:, channel], log.valid[:, channel]
    return values, valid


def _check_known(log: Log, numbers: list[int], name: str, count: int) -> None:
    if any(not 0 <= number < count for number in numbers):
        raise _mismatch(log, count, name.replace("_", " "))


def _mismatch(log: Log, count: int, name: str = "sensors") -> ValueError:
    listed = f"{count} {name}" if count != 1 else f"one {name.removesuffix('s')}"
    key = name.replace(" ", "_").removesuffix("s")
    return ValueError(
        f"{log.source}: its channels {', '.join(log.names)} do not match the case's {listed}; "
        f"say in the TOML file beside it which `{key}` each column is, counted from 0"
    )


def check_times(log: Log) -> None:
    """Check the times of a log, for runs start at t = 0 from rest.

    Raises ValueError, naming the log, for too few samples, times below 0 and a start much later
    than the log is long.
    """
    first, last = float(log.times[0]), float(log.times[-1])
    if log.times.size < 3:
        raise ValueError(f"{log.source}: a fit needs at least 3 samples, not {log.times.size}")
    if first < 0:
        raise ValueError(
            f"{log.source}: it starts at {first:.4g} s, but runs start at 0, at rest; add "
            f"{-first:.4g} s to its times and to the loads' entry times"
        )
    if first > MAX_START_DURATIONS * (last - first):
        raise ValueError(
            f"{log.source}: it starts only at {first:.6g} s, while runs start at 0; subtract the "
            "time at which the recording began from its times and from the loads' entry times"
        )


def check_loads(log: Log, case: Case) -> None:
    """Raises ValueError unless the log has a load, which has crossed before the log ends."""
    if case.controller is not None and not case.loads:
        return
    if not case.loads:
        raise ValueError(
            f"{log.source}: no load is known, neither in the case nor in the TOML file beside the "
            "log; without loads, only modes can be identified (`identify_modes`)"
        )
    entries, exits = crossing_times(case).T
    end = float(log.times[-1])
    if end < min(entries):
        raise ValueError(
            f"{log.source}: it ends at {end:.4g} s, before the first load enters at "
            f"{min(entries):.4g} s"
        )
    crossing = [leave for leave in exits if leave < NEVER]
    if crossing and end < min(crossing):
        raise ValueError(
            f"{log.source}: it ends at {end:.4g} s, before the first load has crossed at "
            f"{min(crossing):.4g} s; check the load's speed and entry time"
        )
