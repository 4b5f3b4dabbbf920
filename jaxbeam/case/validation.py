"""Validation of a case in plain Python, before anything compiles.

The first error names the address and the remedy. Numbers traced by `jit` or `vmap` are skipped.
"""

import dataclasses
import functools
import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbeam.case.absorbers import Absorber
from jaxbeam.case.actuators.base import AbstractActuator, limited_loops
from jaxbeam.case.beam import END_CONDITIONS, Beam, Support, has
from jaxbeam.case.case import Case, check_is_case, list_sizes, parts
from jaxbeam.case.contact import ONE_RUN, AbstractContact
from jaxbeam.case.fields import (
    ON_BEAM,
    POSITION_TOLERANCE,
    all_concrete,
    check_fields,
    check_on_beam,
    concrete,
    is_concrete,
)
from jaxbeam.case.loads.base import (
    AbstractLoad,
    VehicleModel,
    wheel_distances,
)
from jaxbeam.case.loads.vehicle_parts import VehicleSensor
from jaxbeam.case.profiles.shapes import AbstractProfile
from jaxbeam.case.sensors import NO_TORSION, QUANTITIES, Sensor, nyquist_error, sensor_labels
from jaxbeam.case.toml_file import MAX_WHEELS, check_length
from jaxbeam.case.track import Track
from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.printer import counted

# Parts with a method `validate(address)`.
SELF_VALIDATING = (
    Beam
    | Absorber
    | AbstractActuator
    | Sensor
    | AbstractLoad
    | Track
    | AbstractProfile
    | AbstractContact
)


def check_case(case: Case) -> None:
    """Validate a case; units as declared by its fields, addresses as in `case.addresses`.

    Raises ValueError at the first error: a number that is missing, not finite, of the wrong shape
    or out of its range; a position off the beam; contradicting or missing descriptions of section,
    load or sensor; two rigid supports at one position; a controller that contradicts actuators or
    sensors. Beams that can move as a rigid body, such as free-free, are allowed.
    """
    check_plant(case)
    for i, sensor in enumerate(case.sensors):
        _check_sampling(f"sensors.{i}", sensor, case)
    if case.controller is not None:
        _check_controller(case)
    elif limited := limited_loops(case.actuators):
        raise ValueError(
            f"actuators.{limited[0]}.limits bound the voltage of its inner loop in runs under a"
            " controller only: give one, as kind prescribed with offsets of 0 for none, or leave"
            " the limits out"
        )


def check_plant(case: Case) -> None:
    """Validate a case without its controller: neither its design, nor sensors that it samples.

    Raises ValueError as `check_case`.
    """
    check_is_case(case)
    for key, count in list_sizes(case).items():
        check_length(key, count)
    for address, part, _ in parts(case):
        check_fields(address, part)
        _check_positions(address, part, case.beam.length)
    for address, part, _ in parts(case):
        # Looking up a method on a module takes longer than most of these take to run.
        error = type(part).validate(part, address) if isinstance(part, SELF_VALIDATING) else None
        if error is not None:
            raise ValueError(error)
    _check_supports(case.supports, case.beam.length)
    _check_wheels(case)
    _check_track(case)
    _check_torsion(case)
    _check_kinks(case)
    _check_profile(case)
    _check_labels(case.sensors)
    for i, sensor in enumerate(case.vehicle_sensors):
        _check_vehicle_sensor(f"vehicle_sensors.{i}", sensor, case)
        _check_sampling(f"vehicle_sensors.{i}", sensor, case)


def _check_positions(address: str, part: Any, length: Float[Array, ""]) -> None:
    for name in _position_fields(type(part)):
        value = getattr(part, name)
        if value is not None:
            check_on_beam(f"{address}.{name}", value, length)


@functools.cache
def _position_fields(part_class: type) -> list[str]:
    """Names of the fields that are positions on the beam."""
    fields = dataclasses.fields(part_class)
    return [field.name for field in fields if field.metadata.get("constraint") == ON_BEAM]


def _check_supports(supports: tuple[Support, ...], length: Float[Array, ""]) -> None:
    for i, support in enumerate(supports):
        damping = support.damping
        damped = damping is not None and is_concrete(damping) and float(concrete(damping)) > 0
        for name, given in (("mass", support.mass is not None), ("damping", damped)):
            if given and support.stiffness is None:
                raise ValueError(
                    f"supports.{i}.{name} would have no effect, since the support is rigid: give"
                    f" supports.{i}.stiffness too, or leave the {name} out"
                )
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


def _check_wheels(case: Case) -> None:
    """Validate that all loads together have no more wheels than can be computed."""
    wheels = sum(map(_wheel_count, case.loads))
    if wheels > MAX_WHEELS:
        raise ValueError(
            f"the loads have {wheels} wheels in all; {MAX_WHEELS} are the most: make several"
            " cases of them"
        )


def _check_track(case: Case) -> None:
    """Validate that the track spreads forces that enter the beam, and shorter than it is."""
    if case.track is None:
        return
    if case.absorbers:
        raise ValueError(
            "track and absorbers cannot be together: the track would spread what hangs on the beam;"
            " leave one of them out"
        )
    if case.controller is not None:
        raise ValueError(
            "track and controller cannot be together: laws are designed for loads at points; leave"
            " one of them out"
        )
    if case.track.layered:
        _check_layers(case)
        return
    lowest, highest = case.track.ends()
    length = case.beam.length
    if all(map(is_concrete, (lowest, highest, length))):
        width = float(concrete(highest) - concrete(lowest))
        if not width < float(concrete(length)):
            raise ValueError(
                f"track spreads an axle over {width:g} m, which must be less than the length of the"
                f" beam, {float(concrete(length)):g} m"
            )
    for i, load in enumerate(case.loads):
        vehicle = load.vehicle(case.run.gravity)
        masses = vehicle.wheel_masses
        if vehicle.names or not is_concrete(masses) or np.any(concrete(masses)):
            raise ValueError(
                f"track spreads forces, and loads.{i} has mass, which follows the beam at a point:"
                " take the weights of its axles as forces, or leave the track out"
            )
        _check_start(f"loads.{i}", load, case)


def _check_layers(case: Case) -> None:
    """Validate that a case with a track of layers has nothing that its modes leave out."""
    beam = case.beam
    ratios = beam.damping_ratio is not None and np.ndim(beam.damping_ratio) > 0
    others = {
        "contact.kind 'unilateral'": case.lifts,
        "beam.torsional_rigidity": beam.twists,
        "several damping ratios in beam.damping_ratio": ratios,
        "a loss_factor of one of beam.segments": any(
            s.loss_factor is not None for s in beam.segments
        ),
        "a settlement of supports": any(s.settlement is not None for s in case.supports),
    }
    for name, given in others.items():
        if given:
            raise ValueError(
                f"track.rail_rigidity and {name} cannot be together: the modes of beam and track"
                " do not have it; leave one of them out"
            )
    if all_concrete(case.track) and is_concrete(beam.length):
        least = case.track.least_modes(beam.length)
        if beam.modes < least:
            raise ValueError(
                f"beam.modes is {beam.modes}; a rail of this track and length needs {least} at"
                " least to bend under a wheel: raise it, or make track.approach shorter"
            )
    for i, load in enumerate(case.loads):
        _check_start(f"loads.{i}", load, case)


def _check_torsion(case: Case) -> None:
    """Validate that a beam of eccentric loads and of sensors of twist twists, and that it is held.

    Left out are couplings that the theory does not have: of controllers, of actuators and dampers
    with an eccentric mass, and of rigid masses over kinks of the twist.
    """
    eccentric = [i for i, load in enumerate(case.loads) if load.eccentricity is not None]
    if not case.beam.twists:
        for i in eccentric:
            raise ValueError(f"loads.{i}.eccentricity would have no effect: {NO_TORSION}")
        for i, sensor in enumerate(case.sensors):
            if QUANTITIES[sensor.quantity].of_twist:
                raise ValueError(f"sensors.{i} measures {sensor.quantity}: {NO_TORSION}")
            if sensor.eccentricity is not None:
                raise ValueError(f"sensors.{i}.eccentricity would have no effect: {NO_TORSION}")
        for i, support in enumerate(case.supports):
            if support.torsional_stiffness is not None:
                raise ValueError(
                    f"supports.{i}.torsional_stiffness would have no effect: {NO_TORSION}"
                )
        return
    if case.controller is not None:
        raise ValueError(
            "beam.torsional_rigidity and controller cannot be together: laws are designed for"
            " beams that bend; leave one of them out"
        )
    if case.beam.mass_eccentricity is not None:
        damped = [f"supports.{i}" for i, one in enumerate(case.supports) if one.damping is not None]
        for part in (*damped, *(f"actuators.{i}" for i in range(len(case.actuators)))):
            raise ValueError(
                f"beam.mass_eccentricity and {part} cannot be together: its force would twist the"
                " beam; leave one of them out"
            )
    springs = [one.torsional_stiffness for one in case.supports]
    ends = (case.beam.left_end, case.beam.right_end)
    if not any(END_CONDITIONS[end][0] for end in ends) and not any(
        (support.stiffness is None if k is None else not is_concrete(k) or concrete(k) > 0)
        for support, k in zip(case.supports, springs, strict=True)
    ):
        raise ValueError(
            "nothing holds the beam against twist: give a support a torsional_stiffness, or leave"
            " it out of a rigid one"
        )
    sprung = [i for i, k in enumerate(springs) if k is not None]
    for i in eccentric if sprung else ():
        masses = case.loads[i].vehicle(case.run.gravity).wheel_masses
        if not is_concrete(masses) or np.any(concrete(masses)):
            raise ValueError(
                f"loads.{i} has an eccentricity and mass that is rigidly on it, with a kink"
                f" at the torsional_stiffness of supports.{sprung[0]}: take its weight as a force,"
                " or leave the stiffness out"
            )


def _check_start(address: str, load: AbstractLoad, case: Case) -> None:
    """Validate that no point force of a load is on the beam before the run."""
    start, speed = load.start_position, load.speed
    if start is None or speed is None or not all(map(all_concrete, (case.track, load))):
        return
    first = float(concrete(case.track.start(speed, case.beam.length)))
    if (concrete(start) - first) * concrete(speed) > POSITION_TOLERANCE * abs(concrete(speed)):
        where = "part of the axle is on the beam already; the first force enters at"
        if case.track.layered:
            where = "the load is on the rail already, which begins at"
        raise ValueError(
            f"{address}.start_position is {concrete(start):g} m, where {where} {first:g} m"
        )


def _wheel_count(load: AbstractLoad) -> int:
    """Estimated number of wheels of a load, without building its vehicles, which may take long."""
    lists = (getattr(load, name, None) for name in ("axles", "offsets", "coaches"))
    of_vehicle = max(1, *(0 if one is None else len(one) for one in lists))
    return of_vehicle * getattr(load, "count", 1) * getattr(load, "people", 1)


def _check_kinks(case: Case) -> None:
    """Validate that no rigid wheel turns round on a path with kinks: each is passed once."""
    beam, profile = case.beam, case.profile
    in_profile = profile is not None and profile.slope_kinks()[0].shape[0]
    sheared = has(beam, "shear_stiffness") and (case.supports or beam.segments)
    if not (beam.hinges or sheared or in_profile):
        return
    for i, load in enumerate(case.loads):
        if load.positions is None or not all(map(all_concrete, (load, case.run))):
            continue
        steps = np.diff(concrete(load.positions))
        turns = np.any(steps > 0) and np.any(steps < 0)
        if turns and np.any(concrete(load.vehicle(case.run.gravity).wheel_masses)):
            raise ValueError(
                f"loads.{i}.positions turn round: a mass that is rigidly on the surface can do so"
                " only where no slope jumps; use a sprung wheel or a force, or positions that only"
                " rise or only fall"
            )


def _check_profile(case: Case) -> None:
    """Validate that wheels can follow the profile, and that it is defined wherever they travel."""
    profile = case.profile
    if profile is None or not case.loads:
        return
    ends = [(0.0, case.beam.length)]
    for load in case.loads:
        if not all(map(all_concrete, (load, case.run, case.beam))):
            continue
        vehicle = load.vehicle(case.run.gravity)
        if vehicle.names:
            ends.append(_travel(load, vehicle, case))
    if not all(map(is_concrete, itertools.chain(*ends))):
        return
    starts, ends = zip(*(map(concrete, pair) for pair in ends), strict=True)
    error = profile.validate_travel("profile", min(starts), max(ends))
    if error is not None:
        raise ValueError(error)


def _travel(load: AbstractLoad, vehicle: VehicleModel, case: Case) -> tuple[float, float]:
    """Lowest and highest position (m) of any wheel, from the start until all have left the beam."""
    length = float(concrete(case.beam.length))
    behind = float(np.max(concrete(wheel_distances(load, vehicle))))
    path = case.trajectory(load)
    places = path.kinematics(concrete(case.run.duration) * np.array([0.0, 1.0]))[0]
    if load.positions is not None:
        places = np.append(places, concrete(load.positions))
    low, high = float(np.min(concrete(places))), float(np.max(concrete(places)))
    if concrete(path.direction()) > 0:
        return low - behind, min(high, length + behind)
    return max(low, -behind), high + behind


def _check_labels(sensors: tuple[Sensor, ...]) -> None:
    labels = sensor_labels(sensors)
    for i, label in enumerate(labels):
        if label in labels[:i]:
            raise ValueError(
                f"sensors.{labels.index(label)} and sensors.{i} are both called {label!r} in"
                f" results; give sensors.{i} another name"
            )


def _check_vehicle_sensor(address: str, sensor: VehicleSensor, case: Case) -> None:
    """Validate that the body of a sensor is one of the loads or absorbers."""
    if sensor.absorber is not None:
        _check_absorber_sensor(address, sensor, case)
        return
    if sensor.quantity == "stroke":
        raise ValueError(f"{address}.quantity is 'stroke', that of an absorber: give its number")
    if sensor.load >= len(case.loads):
        raise ValueError(
            f"{address}.load is {sensor.load}, but the case has"
            f" {counted(len(case.loads), 'load')}, counted from 0"
        )
    load = case.loads[sensor.load]
    names = load.vehicle(case.run.gravity).names
    if sensor.body not in names or sensor.body.endswith(" pitch"):
        heights = [name for name in names if not name.endswith(" pitch")]
        has = f"they are {', '.join(heights)}" if heights else "it has none, without suspension"
        raise ValueError(
            f"{address}.body is {sensor.body!r}, which is no body of loads.{sensor.load}; {has}"
        )
    if sensor.vehicle >= load.spacings().shape[0]:
        raise ValueError(
            f"{address}.vehicle is {sensor.vehicle}, but loads.{sensor.load} has"
            f" {load.spacings().shape[0]} in a row, counted from 0"
        )
    position = sensor.position
    pitches = f"{sensor.body} pitch" in names
    if not pitches and is_concrete(position) and concrete(position) != 0:
        raise ValueError(
            f"{address}.position would have no effect: the {sensor.body} of loads.{sensor.load}"
            " does not pitch; leave it out"
        )


def _check_absorber_sensor(address: str, sensor: VehicleSensor, case: Case) -> None:
    """Validate that the absorber of a sensor exists, and that the sensor names no vehicle."""
    if sensor.absorber >= len(case.absorbers):
        raise ValueError(
            f"{address}.absorber is {sensor.absorber}, but the case has {len(case.absorbers)}"
            " absorbers, counted from 0"
        )
    of_vehicle = sensor.load, sensor.vehicle, sensor.body != "body"
    shifted = is_concrete(sensor.position) and concrete(sensor.position) != 0
    if any(of_vehicle) or shifted:
        raise ValueError(
            f"{address} has an absorber, whose one body does not pitch: leave out load, vehicle,"
            " body and position"
        )


def _check_sampling(address: str, sensor: Sensor | VehicleSensor, case: Case) -> None:
    """Validate the sampling period of a sensor: within the run, and short enough for its filter.

    Controllers sample the sensors of the beam only.
    """
    period, run = sensor.sampling_period, case.run
    controller = case.controller if isinstance(sensor, Sensor) else None
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
    elif controller is not None and controller.period is not None:
        period = controller.period
    elif controller is None or controller.open_loop:
        period = 1 / concrete(run.sample_rate) if is_concrete(run.sample_rate) else None
    filter = sensor.filter
    if filter is not None and filter.realisation == "digital" and period is not None:
        error = nyquist_error(f"{address}.filter.cutoff", filter.cutoff, period)
        if error is not None:
            raise ValueError(error)


def _check_controller(case: Case) -> None:
    if case.lifts:
        raise ValueError(ONE_RUN)
    controller = case.controller
    if not case.driven:
        raise ValueError(
            "controller has nothing to command: add an actuator that takes commands, or leave the"
            " controller out"
        )
    nominal = controller.nominal_plant
    designed_for = case if nominal is None else nominal.case
    error = controller.validate(designed_for)
    if error is not None:
        raise ValueError(f"controller.{error}")
    for i, sensor in enumerate(case.sensors):
        analogue = sensor.filter is not None and not sensor.has_digital_filter
        if analogue and sensor.has_feedthrough and not controller.open_loop:
            raise ValueError(
                f"sensors.{i}.filter cannot be analogue on an {sensor.quantity} that a controller"
                " uses: make it digital"
            )
        if QUANTITIES[sensor.quantity].has_active_moment and not controller.open_loop:
            _check_outside_patches(f"sensors.{i}", sensor, case)
    period, duration = controller.period, case.run.duration
    if period is not None:
        if is_concrete(period) and is_concrete(duration) and concrete(period) > concrete(duration):
            raise ValueError(
                f"controller.period must not exceed the run's duration, {concrete(duration):g} s;"
                f" it is {concrete(period):g} s"
            )
        return
    for feature in _sampled_features(case):
        raise ValueError(f"{feature} needs a controller that samples: give controller.period")


def _check_outside_patches(address: str, sensor: Sensor, case: Case) -> None:
    """Validate that no controller reads a moment or stress in a section that its patch bends."""
    for i, actuator in enumerate(case.actuators):
        ends = [place for place, order, _ in actuator.displacement_map() if order == 1]
        if ends and all(is_concrete(x) for x in (sensor.position, *ends)):
            left, right = (concrete(edge(*map(concrete, ends))) for edge in (min, max))
            if left <= concrete(sensor.position) <= right:
                raise ValueError(
                    f"{address} reads the {sensor.quantity} of a section on which actuators.{i}"
                    " acts, which no controller can use: measure its strain or curvature, or move"
                    " the sensor"
                )


def _sampled_features(case: Case) -> Iterator[str]:
    """Features of controller, actuators and sensors that exist at samples only, as in messages."""
    for name in ("delay", "resolution", "dropout", "jitter"):
        if getattr(case.controller, name) is not None:
            yield f"controller.{name}"
    for i, actuator in enumerate(case.actuators):
        if actuator.command_rate_limit() is not None:
            yield f"the rate limit of actuators.{i}"
        for name in ("hysteresis", "compensation", "creep", "creep_compensation"):
            if getattr(actuator, name) is not None:
                yield f"the {name} of actuators.{i}"
    if not case.controller.open_loop:
        for i, sensor in enumerate(case.sensors):
            yield from sensor.sampled_features(f"sensors.{i}")
