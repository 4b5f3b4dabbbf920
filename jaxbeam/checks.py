"""Checks of a case in plain Python, before anything compiles.

The first fault raises an error that names the address and says how to mend it. Numbers that are
not known yet (a case inside `jit` or `vmap`) are passed over, so a case may be checked anywhere.
"""

import dataclasses
import difflib
import itertools
from collections.abc import Iterable, Iterator
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.actuators import AbstractActuator, Patch
from jaxbeam.actuators.patch import MATERIAL
from jaxbeam.beam import ENDS, Beam, Support
from jaxbeam.case import Case, Run
from jaxbeam.controller import AbstractController
from jaxbeam.fields import (
    INCREASING,
    NOT_NEGATIVE,
    ON_BEAM,
    POSITIVE,
    fits,
    is_known,
    known,
    shape_in_words,
)
from jaxbeam.loads import AbstractLoad, MovingForce
from jaxbeam.sensors import Sensor

ROUNDING = 1e-9  # of the length: 3 * 0.2 is still on a beam of 0.6 m


def check(case: Case) -> None:
    """Check a case; units as declared by its fields, addresses as in `case.addresses`.

    Raises ValueError at the first fault: a number that is missing, not finite, of the wrong shape
    or out of its range; a place off the beam; contradicting or missing descriptions of section,
    load or sensor; two rigid supports at one place. Beams that can move as a rigid body, such as
    free-free, are allowed.
    """
    for address, part, kind in _parts(case):
        if not isinstance(part, kind):
            raise ValueError(
                f"{address} holds {_words(part)}; it takes objects of type {kind.__name__}"
            )
        _check_part(address, part)
        _check_places(address, part, case.beam.length)
    _check_beam(case.beam)
    _check_supports(case.supports, case.beam.length)
    for i, actuator in enumerate(case.actuators):
        if isinstance(actuator, Patch):
            _check_patch(f"actuators.{i}", actuator)
    for i, sensor in enumerate(case.sensors):
        _check_sensor(f"sensors.{i}", sensor)
        _check_clock(f"sensors.{i}", sensor, case)
    for i, load in enumerate(case.loads):
        _check_load(f"loads.{i}", load)
    if case.controller is not None:
        _check_controller(case)


def check_on_beam(name: str, place: Any, length: Float[Array, ""]) -> None:
    """Check that positions lie on a beam of a length, all in m, as far as they are known.

    Raises ValueError with the name of the positions.
    """
    if not (is_known(place) and is_known(length)):
        return
    end, numbers = float(known(length)), known(place)
    off = ~((numbers >= -ROUNDING * end) & (numbers <= (1 + ROUNDING) * end))
    if off.any():
        raise ValueError(
            f"{name} must {ON_BEAM}, between 0 and {end:g} m; it is {numbers[off].flat[0]:g} m"
        )


def suggestion(word: str, known_words: Iterable[str]) -> str:
    """The end of a sentence about an unknown word: the nearest known one, or all of them."""
    known_words = list(known_words)
    near = difflib.get_close_matches(word, known_words, n=1)
    return f"did you mean {near[0]!r}?" if near else f"it may be {', '.join(known_words)}"


def missing(address: str, field: dataclasses.Field) -> ValueError:
    """The error for a field that was not given and has no default."""
    return ValueError(f"{address} is missing; give the {field.metadata['meaning']}{_in(field)}")


def check_field(address: str, value: Any, field: dataclasses.Field) -> None:
    """Check one field of a part of a case by what its declaration says.

    Raises ValueError naming the address.
    """
    if "unit" in field.metadata:
        _check_number(address, value, field)
    elif "least" in field.metadata:
        least = field.metadata["least"]
        if value is None and field.default is None:
            return
        if not isinstance(value, int) or isinstance(value, bool) or value < least:
            raise ValueError(f"{address} must be a whole number, {least} or more; it is {value!r}")
    elif "part" in field.metadata:
        kind = field.metadata["part"]
        kinds = tuple(kind.values()) if isinstance(kind, dict) else (kind,)
        if value is not None and not isinstance(value, kinds):
            names = " or ".join(made.__name__ for made in kinds)
            raise ValueError(
                f"{address} holds {_words(value)}; it takes a table of its own, in Python a {names}"
            )
        if value is not None:
            _check_part(address, value)
    elif "meaning" in field.metadata:
        if not isinstance(value, str):
            raise ValueError(f"{address} must be a word in quotes, not {_words(value)}")
        allowed = field.metadata["allowed"]
        if allowed and value not in allowed:
            raise ValueError(f"{address} cannot be {value!r}; {suggestion(value, allowed)}")


def _parts(case: Case) -> Iterator[tuple[str, Any, type]]:
    """The parts of a case with their addresses and the types they must have."""
    yield "beam", case.beam, Beam
    yield "run", case.run, Run
    if case.controller is not None:
        yield "controller", case.controller, AbstractController
    lists = {
        "supports": Support,
        "actuators": AbstractActuator,
        "sensors": Sensor,
        "loads": AbstractLoad,
    }
    for name, kind in lists.items():
        for i, part in enumerate(getattr(case, name)):
            yield f"{name}.{i}", part, kind


def _check_part(address: str, part: Any) -> None:
    for field in dataclasses.fields(part):
        check_field(f"{address}.{field.name}", getattr(part, field.name), field)


def _check_number(address: str, value: Any, field: dataclasses.Field) -> None:
    if value is None:
        if field.default is not None:
            raise missing(address, field)
        return
    if not isinstance(value, jax.Array | np.ndarray | np.generic | float | int):
        raise ValueError(f"{address} must be {shape_in_words(field)}, not {_words(value)}")
    if not fits(field, np.shape(value)):
        shape = np.shape(value)
        given = f"an array of shape {shape}" if shape else "one number"
        raise ValueError(f"{address} must be {shape_in_words(field)}, not {given}")
    if not is_known(value):
        return
    numbers = np.atleast_1d(known(value))
    names = [f"{address}.{i}" for i in range(numbers.size)] if np.ndim(value) else [address]
    must, unit = field.metadata["must"], _unit(field)
    for name, x in zip(names, numbers.flat, strict=True):
        if not np.isfinite(x):
            raise ValueError(f"{name} must be a finite number; it is {x}")
        if (must == POSITIVE and x <= 0) or (must == NOT_NEGATIVE and x < 0):
            raise ValueError(f"{name} must {must}; it is {x:g}{unit}")
    if must == INCREASING:
        _check_increasing(names, numbers, unit)


def _check_increasing(names: list[str], numbers: np.ndarray, unit: str) -> None:
    back = np.flatnonzero(np.diff(numbers) <= 0)
    if back.size:
        i = back[0] + 1
        raise ValueError(
            f"{names[i]} must be above the entry before it;"
            f" {numbers[i]:g}{unit} follows {numbers[i - 1]:g}{unit}"
        )


def _check_places(address: str, part: Any, length: Float[Array, ""]) -> None:
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if field.metadata.get("must") == ON_BEAM and value is not None:
            check_on_beam(f"{address}.{field.name}", value, length)


def _check_beam(beam: Beam) -> None:
    ends = beam.ends.split("-")
    if len(ends) != 2:
        raise ValueError(
            f"beam.ends must name the left and the right end, such as 'pinned-clamped';"
            f" it is {beam.ends!r}"
        )
    for end in ends:
        if end not in ENDS:
            raise ValueError(f"beam.ends: no end is called {end!r}; {suggestion(end, ENDS)}")

    section = ("width", "height")
    _check_described("beam", beam, "flexural_rigidity", ("youngs_modulus",), section)
    _check_described("beam", beam, "mass_per_length", ("density",), section)
    if beam.youngs_modulus is None and beam.density is None:
        for name in ("width", "height"):
            if getattr(beam, name) is not None:
                raise ValueError(
                    f"beam.{name} would have no effect: leave it out, or give"
                    " youngs_modulus and density instead of flexural_rigidity and mass_per_length"
                )

    ratios = np.shape(beam.damping_ratio)
    if ratios and ratios != (beam.modes,):
        raise ValueError(
            f"beam.damping_ratio lists {ratios[0]} values for {beam.modes} modes;"
            " give one for each mode, or a single number for all"
        )
    if (
        beam.rayleigh_damping is not None
        and is_known(beam.damping_ratio)
        and known(beam.damping_ratio).any()
    ):
        raise ValueError("beam has both damping_ratio and rayleigh_damping; leave one out")


def _check_described(
    address: str, part: Any, direct: str, own: tuple[str, ...], shared: tuple[str, ...] = ()
) -> None:
    """A property is given either directly or by all that it follows from.

    What is `shared` serves other properties too, so it may stand beside the direct number.
    """
    if getattr(part, direct) is not None:
        for name in own:
            if getattr(part, name) is not None:
                raise ValueError(
                    f"{address}.{direct} and {address}.{name} contradict each other; leave one out"
                )
        return
    sources = (*shared, *own)
    absent = [name for name in sources if getattr(part, name) is None]
    if absent:
        raise ValueError(
            f"{address}.{direct} is missing; give it, or all of {', '.join(sources[:-1])} and"
            f" {sources[-1]} (of which {', '.join(absent)} is missing)"
        )


def _check_supports(supports: tuple[Support, ...], length: Float[Array, ""]) -> None:
    rigid = [
        (float(known(support.position)), i)
        for i, support in enumerate(supports)
        if support.stiffness is None and is_known(support.position)
    ]
    for (left, i), (right, j) in itertools.pairwise(sorted(rigid)):
        if is_known(length) and right - left <= ROUNDING * known(length):
            raise ValueError(
                f"supports.{min(i, j)} and supports.{max(i, j)} both hold the beam rigidly at"
                f" {left:g} m; remove one"
            )


def _check_patch(address: str, patch: Patch) -> None:
    _check_described(address, patch, "moment_per_volt", MATERIAL)
    if is_known(patch.start) and is_known(patch.end):
        start, end = known(patch.start), known(patch.end)
        if start >= end:
            raise ValueError(
                f"{address}.end must lie to the right of {address}.start;"
                f" {end:g} m is not beyond {start:g} m"
            )
    limits = patch.command_limits()
    if is_known(limits) and known(limits)[0] >= known(limits)[1]:
        low, high = known(patch.depolarisation / patch.amplifier_gain)
        raise ValueError(
            f"{address}.limits leave no command that the patch takes: its depolarisation limits"
            f" over its amplifier_gain allow {low:g} to {high:g} V"
        )


def _check_sensor(address: str, sensor: Sensor) -> None:
    if sensor.quantity == "strain" and sensor.fibre_distance is None:
        raise ValueError(
            f"{address}.fibre_distance is missing: strain needs the height of the gauge above"
            " the neutral axis in m"
        )
    if sensor.quantity != "strain" and sensor.fibre_distance is not None:
        raise ValueError(
            f"{address}.fibre_distance would have no effect on a sensor of {sensor.quantity};"
            " leave it out, or set quantity to 'strain'"
        )


def _check_clock(address: str, sensor: Sensor, case: Case) -> None:
    """The sensor samples within the run, and fast enough for its digital filter."""
    period, run = sensor.sampling_period, case.run
    if period is not None:
        if is_known(period) and is_known(run.duration) and known(period) > known(run.duration):
            raise ValueError(
                f"{address}.sampling_period must not exceed the run's duration,"
                f" {known(run.duration):g} s; it is {known(period):g} s"
            )
    elif case.controller is not None and case.controller.period is not None:
        period = case.controller.period
    elif case.controller is None or case.controller.blind:
        period = 1 / run.sample_rate
    filter = sensor.filter
    if filter is None or filter.realisation != "digital" or period is None:
        return
    if is_known(filter.cutoff) and is_known(period):
        highest = 0.5 / known(period)
        if known(filter.cutoff) >= highest:
            raise ValueError(
                f"{address}.filter.cutoff must be below half the sampling frequency,"
                f" {highest:g} Hz; it is {known(filter.cutoff):g} Hz: lower it, or sample faster"
            )


def _check_controller(case: Case) -> None:
    controller = case.controller
    if not case.actuators:
        raise ValueError("controller has nothing to command: add an actuator, or leave it out")
    fault = controller.fault(case)
    if fault is not None:
        raise ValueError(f"controller.{fault}")
    for i, sensor in enumerate(case.sensors):
        smooth = sensor.filter is not None and sensor.filter.realisation == "analogue"
        if smooth and sensor.quantity == "acceleration" and not controller.blind:
            raise ValueError(
                f"sensors.{i}.filter cannot be analogue on an acceleration that a controller looks"
                " at: make it digital"
            )
    period, duration = controller.period, case.run.duration
    if period is not None:
        if is_known(period) and is_known(duration) and known(period) > known(duration):
            raise ValueError(
                f"controller.period must not exceed the run's duration, {known(duration):g} s;"
                f" it is {known(period):g} s"
            )
        return
    # What acts at every instant can neither wait nor remember.
    sampled = {
        "controller.delay": controller.delay is not None,
        "controller.resolution": controller.resolution is not None,
        "the controller's memory": not controller.memoryless,
    }
    for i, actuator in enumerate(case.actuators):
        sampled[f"the rate limit of actuators.{i}"] = actuator.command_rate() is not None
    if not controller.blind:
        for i, sensor in enumerate(case.sensors):
            digital = sensor.filter is not None and sensor.filter.realisation == "digital"
            sampled |= {
                f"sensors.{i}.filter, which is digital,": digital,
                f"sensors.{i}.sampling_period": sensor.sampling_period is not None,
                f"sensors.{i}.delay": sensor.delay is not None,
                f"sensors.{i}.noise": sensor.noise is not None,
                f"sensors.{i}.resolution": sensor.resolution is not None,
                f"the acceleration of sensors.{i}": sensor.quantity == "acceleration",
            }
    for name, given in sampled.items():
        if given:
            raise ValueError(f"{name} needs a controller that samples: give controller.period")


def _check_load(address: str, load: AbstractLoad) -> None:
    if isinstance(load, MovingForce):
        _check_either(address, load, "force", "mass")
    if (load.times is None) != (load.positions is None):
        missing = "times" if load.times is None else "positions"
        raise ValueError(f"{address}.{missing} is missing; a table has both times and positions")
    _check_either(address, load, "speed", "times")
    if load.times is None or load.positions is None:
        if load.speed is not None and is_known(load.speed) and known(load.speed) == 0:
            raise ValueError(
                f"{address}.speed must not be 0: the load would never enter; a load that stands"
                " on the beam is a table of times and positions"
            )
        return
    points = np.shape(load.times)[0]
    if points != np.shape(load.positions)[0]:
        raise ValueError(
            f"{address} has {points} times and {np.shape(load.positions)[0]} positions;"
            " a table needs one position for each time"
        )
    if points < 2:
        raise ValueError(f"{address}.times needs at least two points; it has {points}")
    for name in ("entry_time", "deceleration"):
        value = getattr(load, name)
        if is_known(value) and known(value) != 0:
            raise ValueError(
                f"{address}.{name} would have no effect: the load follows its table; leave it out"
            )


def _check_either(address: str, part: Any, first: str, second: str) -> None:
    """Exactly one of two fields is given."""
    given = [name for name in (first, second) if getattr(part, name) is not None]
    if not given:
        raise ValueError(f"{address} has neither {first} nor {second}; give one of them")
    if len(given) == 2:
        raise ValueError(f"{address} has both {first} and {second}; leave one out")


def _unit(field: dataclasses.Field) -> str:
    """The unit to put after a number."""
    unit = field.metadata.get("unit", "1")
    return "" if unit in ("1", "unit of quantity") else f" {unit}"


def _in(field: dataclasses.Field) -> str:
    return f" in{_unit(field)}" if _unit(field) else ""


def _words(value: Any) -> str:
    """A wrong value in the words of an error message."""
    if isinstance(value, str | bool | int | float | list):
        return repr(value)
    return f"a {type(value).__name__}"
