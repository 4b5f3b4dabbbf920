"""Checks of a case in plain Python, before anything compiles.

The first fault raises an error that names the address and says how to mend it. Numbers that are
not known yet (a case inside `jit` or `vmap`) are passed over, so a case may be checked anywhere.
"""

import dataclasses
import functools
import itertools
from collections.abc import Iterator
from typing import Any

from jaxtyping import Array, Float

from jaxbeam.case.actuators import AbstractActuator
from jaxbeam.case.beam import Beam, Support
from jaxbeam.case.case import Case, Run
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.declared_checks import (
    POSITION_TOLERANCE,
    check_fields,
    check_on_beam,
    describe_value,
)
from jaxbeam.case.fields import ON_BEAM, concrete, is_concrete
from jaxbeam.case.loads import AbstractLoad
from jaxbeam.case.sensors import Sensor

# Parts that say themselves what belongs together within them.
SELF_VALIDATING = Beam | AbstractActuator | Sensor | AbstractLoad


def check_case(case: Case) -> None:
    """Check a case; units as declared by its fields, addresses as in `case.addresses`.

    Raises ValueError at the first fault: a number that is missing, not finite, of the wrong shape
    or out of its range; a place off the beam; contradicting or missing descriptions of section,
    load or sensor; two rigid supports at one place. Beams that can move as a rigid body, such as
    free-free, are allowed.
    """
    for address, part, kind in _parts(case):
        if not isinstance(part, kind):
            raise ValueError(
                f"{address} holds {describe_value(part)}; it takes objects of type {kind.__name__}"
            )
        check_fields(address, part)
        _check_positions(address, part, case.beam.length)
    for address, part, _ in _parts(case):
        # A method of a module takes longer to get than most of these take to run.
        error = type(part).validate(part, address) if isinstance(part, SELF_VALIDATING) else None
        if error is not None:
            raise ValueError(error)
    _check_supports(case.supports, case.beam.length)
    for i, sensor in enumerate(case.sensors):
        _check_sampling(f"sensors.{i}", sensor, case)
    if case.controller is not None:
        _check_controller(case)


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


def _check_positions(address: str, part: Any, length: Float[Array, ""]) -> None:
    for name in _position_fields(type(part)):
        value = getattr(part, name)
        if value is not None:
            check_on_beam(f"{address}.{name}", value, length)


@functools.cache
def _position_fields(kind: type) -> list[str]:
    """Fields that must lie on the beam."""
    return [f.name for f in dataclasses.fields(kind) if f.metadata.get("must") == ON_BEAM]


def _check_supports(supports: tuple[Support, ...], length: Float[Array, ""]) -> None:
    rigid = [
        (float(concrete(support.position)), i)
        for i, support in enumerate(supports)
        if support.stiffness is None and is_concrete(support.position)
    ]
    for (left, i), (right, j) in itertools.pairwise(sorted(rigid)):
        if is_concrete(length) and right - left <= POSITION_TOLERANCE * concrete(length):
            raise ValueError(
                f"supports.{min(i, j)} and supports.{max(i, j)} both hold the beam rigidly at"
                f" {left:g} m; remove one"
            )


def _check_sampling(address: str, sensor: Sensor, case: Case) -> None:
    """The sensor samples within the run, and fast enough for its digital filter."""
    period, run = sensor.sampling_period, case.run
    if period is not None:
        if (
            is_concrete(period)
            and is_concrete(run.duration)
            and concrete(period) > concrete(run.duration)
        ):
            raise ValueError(
                f"{address}.sampling_period must not exceed the run's duration,"
                f" {concrete(run.duration):g} s; it is {concrete(period):g} s"
            )
    elif case.controller is not None and case.controller.period is not None:
        period = case.controller.period
    elif case.controller is None or case.controller.open_loop:
        period = 1 / concrete(run.sample_rate) if is_concrete(run.sample_rate) else None
    filter = sensor.filter
    if filter is None or filter.realisation != "digital" or period is None:
        return
    if is_concrete(filter.cutoff) and is_concrete(period):
        nyquist = 0.5 / concrete(period)
        if concrete(filter.cutoff) >= nyquist:
            raise ValueError(
                f"{address}.filter.cutoff must be below half the sampling frequency,"
                f" {nyquist:g} Hz; it is {concrete(filter.cutoff):g} Hz: lower it, or sample faster"
            )


def _check_controller(case: Case) -> None:
    controller = case.controller
    if not case.actuators:
        raise ValueError("controller has nothing to command: add an actuator, or leave it out")
    error = controller.validate(case)
    if error is not None:
        raise ValueError(f"controller.{error}")
    for i, sensor in enumerate(case.sensors):
        analogue = sensor.filter is not None and sensor.filter.realisation == "analogue"
        if analogue and sensor.quantity == "acceleration" and not controller.open_loop:
            raise ValueError(
                f"sensors.{i}.filter cannot be analogue on an acceleration that a controller looks"
                " at: make it digital"
            )
    period, duration = controller.period, case.run.duration
    if period is not None:
        if is_concrete(period) and is_concrete(duration) and concrete(period) > concrete(duration):
            raise ValueError(
                f"controller.period must not exceed the run's duration, {concrete(duration):g} s;"
                f" it is {concrete(period):g} s"
            )
        return
    # What acts at every instant can neither wait nor remember.
    needs_sampling = {
        "controller.delay": controller.delay is not None,
        "controller.resolution": controller.resolution is not None,
        "the controller's memory": not controller.stateless,
    }
    for i, actuator in enumerate(case.actuators):
        needs_sampling[f"the rate limit of actuators.{i}"] = (
            actuator.command_rate_limit() is not None
        )
    if not controller.open_loop:
        for i, sensor in enumerate(case.sensors):
            digital = sensor.filter is not None and sensor.filter.realisation == "digital"
            needs_sampling |= {
                f"sensors.{i}.filter, which is digital,": digital,
                f"sensors.{i}.sampling_period": sensor.sampling_period is not None,
                f"sensors.{i}.delay": sensor.delay is not None,
                f"sensors.{i}.noise": sensor.noise is not None,
                f"sensors.{i}.resolution": sensor.resolution is not None,
                f"the acceleration of sensors.{i}": sensor.quantity == "acceleration",
            }
    for name, given in needs_sampling.items():
        if given:
            raise ValueError(f"{name} needs a controller that samples: give controller.period")
