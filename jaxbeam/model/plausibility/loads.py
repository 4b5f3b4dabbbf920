"""Quantities of loads, profile, sensors, controller and run that are checked for plausibility.

Each comes with the address of the number that it follows from.
"""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxbeam.case.contact import UnilateralContact
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.case.trajectory import NEVER
from jaxbeam.model.elements import NODE_TOLERANCE
from jaxbeam.model.plausibility.facts import GRAVITY
from jaxbeam.model.plausibility.structure import (
    INF,
    Value,
    heaviest_load,
    limp_stiffness,
    mass_field,
    numbers_of,
    part_numbers,
    parts_of,
)

WALKING, LARGEST_PERSON = (0.5, 3.0), 1200.0  # m/s, N
ROAD_KINDS = ("quarter-car", "half-car")
ROAD_SPEED, RAIL_SPEED = 60.0, 120.0  # m/s; 1.2 times 350 km/h is 117 m/s
LEAST_SAMPLES = 2.0  # in a period
LARGEST_IN_KHZ = 10.0  # of a sample rate of 10 kHz
LATE_BY_TABLE = 100.0  # times the run, until a load leaves
FEEDBACK = ("feedback", "output-feedback", "feedback-scheduled", "pd", "ppf")
SMALL_UNITS = {"m": "mm", "m/s": "mm/s", "m/s^2": "mm/s^2", "1": "1e-6", "Pa": "MPa"}
LARGE_UNITS = {"m/s^2": "g", "Pa": "MPa", "1": "per cent"}


# Loads: vehicles, weights, people


def sag_of_spring(facts):
    """Static deflections (m) of the springs of vehicles."""
    for stage in facts.stages:
        if stage.stiffness > 0:
            yield Value(stage.spring, stage.carried * GRAVITY / stage.stiffness)


def compression_of_contact(facts):
    """Static compression of the spring of contact by the heaviest wheel, over the beam's length."""
    contact = facts.case.contact
    spring = contact.spring() if isinstance(contact, UnilateralContact) else None
    if spring is not None and facts.case.loads:
        heaviest = max(float(np.max(one)) for one in facts.static_loads)
        name, unit = "stiffness", "N/m"
        if contact.hertz_stiffness is not None:
            name, unit = "hertz_stiffness", "N/m^1.5"
        compression = (max(heaviest, 0.0) / spring[0]) ** (1 / spring[1])
        yield Value(f"contact.{name}", compression / facts.length, {"unit": unit})


def stage_damping(facts):
    """Damping ratios of springs and dampers of vehicles with the masses that they carry."""
    for stage in facts.stages:
        if stage.damping > 0 and stage.stiffness > 0 and stage.carried > 0:
            critical = 2 * math.sqrt(stage.stiffness * stage.carried)
            yield Value(stage.damper, stage.damping / critical)


def _tyre_over_suspension(facts, quantity):
    for address, load in facts.loads(*ROAD_KINDS):
        upper, lower = (
            np.ravel(getattr(load, f"{part}_{quantity}")) for part in ("suspension", "tyre")
        )
        if np.all(upper > 0):
            words = {"other": f"{address}.tyre_{quantity}"}
            yield Value(f"{address}.suspension_{quantity}", np.max(lower / upper), words)


def tyre_over_suspension_stiffness(facts):
    """Largest ratio of the stiffness of a tyre to that of its suspension."""
    return _tyre_over_suspension(facts, "stiffness")


def tyre_over_suspension_damping(facts):
    """Largest ratio of the damping of a tyre to that of its suspension."""
    return _tyre_over_suspension(facts, "damping")


def primary_over_secondary_stiffness(facts):
    """Stiffness of the primary springs of a bogie over that of the secondary ones."""
    for address, load in facts.loads("wagon"):
        ratio = 2 * float(load.primary_stiffness) / float(load.secondary_stiffness)
        words = {"other": f"{address}.primary_stiffness"}
        yield Value(f"{address}.secondary_stiffness", ratio, words)


def unsprung_over_sprung(facts):
    """Masses below the suspension over that of the body."""
    for name in ("axle_mass", "axle_masses", "bogie_mass", "wheelset_mass"):
        for address, load in facts.loads(*ROAD_KINDS, "wagon"):
            if hasattr(load, name):
                ratio = np.sum(getattr(load, name)) / load.body_mass
                if ratio > 0:
                    yield Value(f"{address}.{name}", ratio, {"upper": f"{address}.body_mass"})
    for address, load in facts.loads("vehicle"):
        bodies = sum(float(body.mass) for body in load.bodies)
        for i, axle in enumerate(load.axles):
            if axle.mass > 0 and bodies > 0:
                ratio = float(axle.mass) * len(load.axles) / bodies
                yield Value(f"{address}.axles.{i}.mass", ratio, {"upper": f"{address}.bodies"})


def gyration_over_wheelbase(facts):
    """Radii of gyration in pitch over half the distance of what carries the body."""
    for address, load in facts.loads("half-car", "wagon"):
        if load.kind == "half-car":
            rows = [("body", np.ptp(load.axle_positions))]
        else:
            rows = [("body", load.bogie_distance), ("bogie", load.wheelset_distance)]
        for name, distance in rows:
            inertia, mass = (getattr(load, f"{name}_{what}") for what in ("inertia", "mass"))
            radius = math.sqrt(float(inertia) / float(mass))
            yield Value(f"{address}.{name}_inertia", 2 * radius / float(distance))
    for address, load in facts.loads("vehicle"):
        for i, body in enumerate(load.bodies):
            joints = [s.position for s in load.springs if body.name in (s.first, s.second)]
            joints += [axle.position for axle in load.axles if axle.body == body.name]
            if body.inertia is not None and body.mass > 0 and np.ptp(joints or [0.0]) > 0:
                radius = math.sqrt(float(body.inertia) / float(body.mass))
                yield Value(f"{address}.bodies.{i}.inertia", 2 * radius / float(np.ptp(joints)))


PLACES = {"axles": "offsets", "half-car": "axle_positions", "wagon": "bogie_distance"}


def distance_of_axles(facts):
    """Largest distance (m) from axle to axle of a vehicle, and from vehicle to vehicle."""
    for address, load in facts.loads(*PLACES, "vehicle"):
        gaps = np.diff(np.sort(load.vehicle(facts.case.run.gravity).offsets))
        if facts.is_bridge and gaps.size and not getattr(load, "train", ""):
            name = f"{address}.{PLACES.get(load.kind, 'axles')}"
            yield Value(name, float(gaps.max()))
        if facts.is_bridge:
            yield from (Value(*pair) for pair in numbers_of(load, address, "spacing"))


def _weights(facts, kinds):
    """Largest static load (kN) of a wheel, and the field that decides it, on bridges."""
    for (address, load), static in zip(facts.loads(), facts.static_loads, strict=True):
        if load.kind in kinds and facts.is_bridge and static.size:
            name = mass_field(load)
            should = "N" if "force" in name else "kg, not its weight in N"
            yield Value(f"{address}{name}", float(static.max()) / 1e3, {"should": should})


def weight_of_axle(facts):
    """Largest static load (kN) of an axle of a vehicle on a bridge."""
    return _weights(facts, (*ROAD_KINDS, "wagon", "axles", "vehicle"))


def weight_of_load(facts):
    """Weight (kN) of a single load on a bridge."""
    return _weights(facts, ("mass", "force", "oscillator"))


def mass_on_foot(facts):
    """Mass (kg) of a load that moves as fast as people walk, if it may be a weight in N."""
    for address, load in facts.loads("mass", "oscillator"):
        mass = float(load.mass)
        walks = load.speed is not None and WALKING[0] <= abs(float(load.speed)) <= WALKING[1]
        if facts.is_bridge and walks and mass <= LARGEST_PERSON:
            words = {"speed": abs(float(load.speed)), "people": mass / GRAVITY}
            yield Value(f"{address}.mass", mass, words)


def weight_over_force(facts):
    """Weight of the masses of axles over the forces with which they press."""
    for address, load in facts.loads("axles"):
        if load.masses is not None and load.forces is not None and float(facts.case.run.gravity):
            ratios = np.asarray(load.masses) * GRAVITY / np.where(load.forces > 0, load.forces, INF)
            yield Value(f"{address}.masses", float(np.max(ratios)))


def amplitude_of_forces(facts):
    """Largest amplitude of a varying force, without a steady part, over the weight of the beam."""
    for address, load in facts.loads("varying-force"):
        largest = float(np.max(np.abs(load.amplitudes), initial=0.0))
        if largest > 0 and not float(load.force):
            yield Value(f"{address}.amplitudes", largest / GRAVITY / facts.mass)


def mass_ratio(facts):
    """Mass of the loads on the beam at once over that of the beam."""
    if facts.numbers.mass_ratio:
        yield Value(heaviest_load(facts), facts.numbers.mass_ratio, limp_stiffness(facts)[1])


def largest_phase(facts):
    """Sizes of phases (rad)."""
    parts = [*facts.loads("varying-force", "pedestrian", "crowd")]
    for address, part in (*parts, *parts_of(facts, "profile"), *parts_of(facts, "controller")):
        for name, phase in numbers_of(part, address, "phase", "phases"):
            yield Value(name, abs(phase))


# Loads: their travel


def entry_over_duration(facts):
    """Time at which a load enters over the duration of the run."""
    duration = float(facts.case.run.duration)
    for (address, load), (enter, _) in zip(facts.loads(), facts.windows, strict=True):
        when = f"it would at t = {enter:.4g} s" if enter < NEVER else "it stops before"
        late = float(load.entry_time) >= duration
        likely = f"is {address}.entry_time in s, not in ms?" if late else "lengthen run.duration"
        words = {"when": when, "duration": duration, "likely": likely}
        yield Value(address, enter / duration, words)


def exit_before_run(facts):
    """Times (s) by which loads have left the beam before the run begins."""
    for (address, load), (_, leave) in zip(facts.loads(), facts.windows, strict=True):
        if leave <= 0:
            name = "entry_time" if load.times is None else "times"
            yield Value(f"{address}.{name}", -float(leave))


def exit_over_duration(facts):
    """Time at which a load leaves over the duration of the run."""
    duration = float(facts.case.run.duration)
    for (address, load), (enter, leave) in zip(facts.loads(), facts.windows, strict=True):
        if enter < duration and leave < NEVER:
            likely = "lengthen run.duration, or peaks may be missed"
            if load.times is not None and leave > LATE_BY_TABLE * duration:
                likely += f"; are {address}.times in s, not in ms?"
            words = {"leave": leave, "duration": duration, "likely": likely}
            yield Value(address, leave / duration, words)


def braking_to_stop(facts):
    """1 for a load that its deceleration stops on the beam during the run."""
    for (address, load), (enter, leave) in zip(facts.loads(), facts.windows, strict=True):
        if load.speed is None or not float(load.deceleration) > 0 or not enter < NEVER <= leave:
            continue
        speed, braking = float(load.speed), float(load.deceleration)
        if float(load.entry_time) + abs(speed) / braking > float(facts.case.run.duration):
            continue
        track = facts.case.track
        lowest, highest = (0.0, 0.0) if track is None else map(float, track.ends())
        start = float(facts.case.trajectory(load).kinematics(float(load.entry_time))[0])
        rolled = speed * abs(speed) / 2 / braking
        behind = float(np.max(facts.behind(load)))
        way = (facts.length - lowest - start if speed > 0 else start + highest) + behind
        words = {"braking": braking, "x": start + rolled, "need": speed**2 / 2 / way}
        yield Value(f"{address}.deceleration", 1.0, words)


def duration_over_crossing(facts):
    """Duration of the run over the time at which its last load leaves."""
    if facts.last_exit > 0:
        duration = float(facts.case.run.duration)
        words = {"duration": duration, "last": facts.last_exit}
        yield Value("run.duration", duration / facts.last_exit, words)


def _speed(facts) -> tuple[str, dict[str, Any]]:
    """Address of the fastest load, and words of its speed and the unit of that."""
    speed, loads = facts.numbers.speed, list(facts.loads())
    tables = [address for address, load in loads if load.speed is None]
    sizes = [(abs(float(load.speed)), name) for name, load in loads if load.speed is not None]
    address = f"{max(sizes)[1]}.speed" if sizes else f"{tables[0]}.positions"
    unit = "in m/s, not in km/h" if sizes else "in m, not in mm, and are times in s"
    return address, {"speed": speed, "kmh": 3.6 * speed, "unit": unit}


def speed_over_traffic(facts):
    """Largest speed on a bridge over the highest of such traffic."""
    if facts.numbers.speed is not None and facts.is_bridge:
        address, words = _speed(facts)
        profile = facts.case.profile
        on_road = any(load.kind in ROAD_KINDS for load in facts.case.loads) or (
            profile is not None and profile.kind == "iso8608"
        )
        limit, traffic = (ROAD_SPEED, "road vehicle") if on_road else (RAIL_SPEED, "train in use")
        yield Value(address, facts.numbers.speed / limit, words | {"traffic": traffic})


def speed_ratio(facts):
    """Largest speed over the critical speed."""
    if facts.numbers.speed_ratio is not None:
        address, words = _speed(facts)
        words["critical"] = facts.numbers.critical_speed
        yield Value(address, facts.numbers.speed_ratio, words)


# Profile, sensors, controller, run


WAVES = {"sine": ("amplitude", 2.0), "bump": ("height", 1.0), "step": ("height", 1.0)}
PROFILE_FIELDS = ("amplitude", "height", "point_heights", "amplitudes", "scale")


def height_of_profile(facts):
    """Height of the profile from lowest to highest over the length of the beam."""
    for address, profile in parts_of(facts, "profile"):
        _, heights = facts.profile
        name = next((f".{n}" for n in PROFILE_FIELDS if hasattr(profile, n)), "")
        height = float(np.ptp(heights))
        words = {"height": height, "should": _profile_unit(name)}
        yield Value(f"{address}{name}", height / facts.length, words)


def rise_of_waves(facts):
    """Rise (m) of a sine, bump or step of the surface of a bridge, whose height is one number."""
    for address, profile in parts_of(facts, "profile"):
        if facts.is_bridge and profile.kind in WAVES:
            name, rise = WAVES[profile.kind]
            yield Value(f"{address}.{name}", rise * abs(float(getattr(profile, name))))


def slope_of_profile(facts):
    """Steepest slope of the profile, but of one with a step."""
    for address, profile in parts_of(facts, "profile"):
        x, heights = facts.profile
        name = next((f".{n}" for n in PROFILE_FIELDS if hasattr(profile, n)), "")
        slope = float(np.max(np.abs(np.diff(heights)))) / (x[1] - x[0])
        slope = slope if profile.kind != "step" else 0.0
        yield Value(f"{address}{name}", slope, {"should": _profile_unit(name)})


def _profile_unit(name: str) -> str:
    return "it is a factor of the heights" if name == ".scale" else "is it in m, not in mm?"


def length_of_waves(facts):
    """Wavelengths, and distances of the points of a table, over the length of the beam."""
    yield from part_numbers(facts, "profile", "wavelength", over="length")
    for address, profile in parts_of(facts, "profile"):
        if profile.kind == "table":
            apart = float(np.min(np.diff(profile.positions), initial=INF))
            yield Value(f"{address}.positions", apart / facts.length)


def acceleration_of_waves(facts):
    """Largest vertical acceleration of wheels on a sine longer than the beam, over gravity."""
    speed = facts.numbers.speed
    for address, profile in parts_of(facts, "profile"):
        if profile.kind == "sine" and speed and float(profile.wavelength) > facts.length:
            rate = 2 * math.pi * speed / float(profile.wavelength)
            ratio = abs(float(profile.amplitude)) * rate**2 / GRAVITY
            yield Value(f"{address}.wavelength", ratio or 1.0)


def bump_under_loads(facts):
    """1 for a bump or table that no load meets on the beam or as far before and behind it."""
    for address, profile in parts_of(facts, "profile"):
        if profile.kind in ("bump", "table") and np.ptp(facts.profile[1]) == 0:
            name = "start" if profile.kind == "bump" else "positions"
            heights = profile.height if profile.kind == "bump" else np.ptp(profile.point_heights)
            yield Value(f"{address}.{name}", float(abs(heights) > 0))


def cutoff_over_crossing(facts):
    """Cutoffs of filters of sensors times the time at which the last load has left."""
    for address, sensor in parts_of(facts, "sensors"):
        for name, cutoff in numbers_of(sensor.filter, f"{address}.filter", "cutoff"):
            if facts.last_exit > 0:
                words = {"cutoff": cutoff, "last": facts.last_exit}
                yield Value(name, cutoff * facts.last_exit, words)


def size_of_section_modulus(facts):
    """Side of a cube as large as a section modulus, over the length."""
    for name, modulus, _ in part_numbers(facts, "sensors", "section_modulus"):
        side = modulus ** (1 / 3)
        yield Value(name, side / facts.length, {"side": side})


def error_over_reading(facts):
    """Noise, resolution and offset of sensors over the size of their readings.

    The noise that an estimator expects, too; one number for all sensors is that of the largest.
    """
    found = parts_of(facts, "sensors")
    sizes = [facts.reading(sensor) or 0.0 for _, sensor in found]
    for (address, sensor), size in zip(found, sizes, strict=True):
        for name, given in numbers_of(sensor, address, "noise", "resolution", "offset"):
            yield from _error_of(sensor, size, name, given)
    estimator = getattr(facts.case.controller, "estimator", None)
    noises = list(numbers_of(estimator, "controller.estimator", "measurement_noise"))
    for i, (name, given) in enumerate(noises if found else ()):
        sensor = i if len(noises) == len(found) else int(np.argmax(sizes))
        yield from _error_of(found[sensor][1], sizes[sensor], name, given)


def _error_of(sensor, size: float, name: str, given: float) -> Iterator[Value]:
    """An error of a sensor over the size of its readings, unless it reads nothing."""
    if size:
        small = SMALL_UNITS.get(sensor.unit, f"1e-3 {sensor.unit}")
        unit = "m/m" if sensor.unit == "1" else sensor.unit
        words = {"given": abs(given), "unit": unit, "size": size, "small": small}
        yield Value(name, abs(given) / size, words)


def rest_off_range(facts):
    """Distance of the reading of a sensor at rest, its offset, from its range."""
    for address, sensor in parts_of(facts, "sensors"):
        if sensor.range is not None:
            (low, high), rest = map(float, sensor.range), float(sensor.offset)
            words = {"low": low, "high": high, "rest": rest, "unit": sensor.unit}
            words["size"] = max(abs(low), abs(high))
            yield Value(f"{address}.range", max(low - rest, rest - high, 0.0), words)


def readings_over_range(facts):
    """Size of the readings of a sensor over what its range leaves on the wider side of rest."""
    for address, _, words in rest_off_range(facts):
        sensor = facts.case.sensors[int(address.split(".")[1])]
        size, room = (
            facts.reading(sensor),
            max(words["high"] - words["rest"], words["rest"] - words["low"]),
        )
        if size and room > 0:
            large = LARGE_UNITS.get(sensor.unit, f"1e3 {sensor.unit}")
            unit = "m/m" if sensor.unit == "1" else sensor.unit
            yield Value(address, size / room, {"size": size, "large": large, "unit": unit})


def sides_of_jumps(facts):
    """1 for a sensor, at a place where its quantity jumps, of which it has one side by default."""
    where, at = facts.jumps, [(float(s.position), s.quantity) for s in facts.case.sensors]
    for (address, sensor), (x, quantity) in zip(parts_of(facts, "sensors"), at, strict=True):
        entry, tolerance = QUANTITIES[quantity], NODE_TOLERANCE * facts.length
        bends = entry.x_derivative == 2 and not entry.section_force
        kinds = (entry.x_derivative, "bend") if bends else (entry.x_derivative,)
        found = (
            name for kind in kinds for place, name in where[kind] if abs(place - x) < tolerance
        )
        name = next(found, "") if 0 < x < facts.length and not sensor.side else ""
        if name:
            yield Value(f"{address}.side", 1.0, {"quantity": quantity, "x": x, "name": name})


def _delays(facts):
    for address, part in (*parts_of(facts, "sensors"), *parts_of(facts, "controller")):
        yield from numbers_of(part, address, "delay", "jitter")


def delay_over_duration(facts):
    """Delays over the duration of the run."""
    duration = float(facts.case.run.duration)
    for name, delay in _delays(facts):
        yield Value(name, delay / duration, {"delay": delay, "duration": duration})


def delay_over_period(facts):
    """Delays over the period of the first mode."""
    if facts.numbers.first_frequency is not None:
        for name, delay in _delays(facts):
            yield Value(name, delay * facts.numbers.first_frequency)


def samples_in_period(facts):
    """Samples of the controller in a period of the highest mode that it is made for."""
    controller = facts.case.controller
    if controller is None or controller.period is None or controller.open_loop:
        return
    if facts.frequencies.size:
        mode = min(_controlled_modes(facts), facts.frequencies.size)
        frequency, period = float(facts.frequencies[mode - 1]), float(controller.period)
        words = {"mode": mode, "frequency": frequency, "longest": 0.5 / frequency}
        yield Value("controller.period", 1 / (period * frequency), words)


def effect_of_gains(facts):
    """Deflection that feedback of the sizes of readings commands, over that under the loads."""
    controller, driven = facts.case.controller, facts.case.driven
    deflection, first = facts.numbers.deflection, facts.numbers.first_frequency
    if not deflection or first is None or getattr(controller, "kind", "") not in FEEDBACK:
        return
    power = getattr(controller, "power", 1)
    sizes = np.array([facts.reading(sensor) or 0.0 for sensor in facts.case.sensors]) ** power
    all_read = controller.kind == "output-feedback"
    columns = sizes if all_read else sizes[: len(driven), None]
    sags = np.array([facts.sag_per_command(actuator) for actuator in driven])
    for name, rate in (("gains", 1.0), ("rate_gains", 2 * math.pi * first)):
        if hasattr(controller, name):
            gains = np.abs(np.broadcast_to(getattr(controller, name), np.shape(controller.gains)))
            commands = np.max(np.reshape(gains, (len(driven), -1)) * columns, axis=1)
            effect = float(np.max(commands * sags)) * rate / deflection
            if effect > 0:
                yield Value(f"controller.{name}", effect)


def step_of_commands(facts):
    """Resolution of commands over their range, without limits over commands of some effect.

    That is a command by which the beam bends as under the loads.
    """
    ratios, step = [], getattr(facts.case.controller, "resolution", None)
    for actuator in () if step is None else facts.case.driven:
        limits, sag = actuator.command_limits(), facts.sag_per_command(actuator)
        reach = (facts.numbers.deflection or 0.0) / sag if sag else 0.0
        if limits is not None or reach:
            reach = reach if limits is None else float(np.ptp(limits))
            ratios.append((float(step) / reach, actuator.command_unit))
    if ratios:
        ratio, unit = max(ratios)
        yield Value("controller.resolution", ratio, {"unit": unit, "step": float(step)})


def _controlled_modes(facts) -> int:
    """Number of the highest mode with a weight in the design, as it deflects; 1 without weights."""
    controller = facts.case.controller
    weight = getattr(controller, "state_weight", None)
    if weight is None or getattr(controller, "coordinates", "") != "modal":
        return 1
    design = controller.design
    modes = facts.case.beam.modes if design is None or design.modes is None else design.modes
    modes = min(modes, facts.modes.stiffness.size)
    with_compliance = np.asarray(weight)[:modes] / np.asarray(facts.modes.stiffness)[:modes] ** 2
    weighted = np.flatnonzero(with_compliance > 1e-3 * np.max(with_compliance))
    return int(weighted[-1]) + 1 if weighted.size else 1


def samples_of_record(facts):
    """Samples of the record in a period of the first mode; with accelerometers of the third."""
    if not facts.frequencies.size or not (facts.case.loads or facts.case.controller is not None):
        return
    rate, mode = float(facts.case.run.sample_rate), 1
    if any(sensor.quantity == "acceleration" for sensor in facts.case.sensors):
        mode = min(3, facts.frequencies.size)
    frequency = float(facts.frequencies[mode - 1])
    likely = f"give more than {LEAST_SAMPLES * frequency:.3g} Hz"
    if rate < 1:
        likely += f", or {1 / rate:.4g} Hz if it is the time step in s"
    elif rate < LARGEST_IN_KHZ:
        likely += ", or is it in kHz?"
    words = {"rate": rate, "what": f"mode {mode}", "frequency": frequency, "likely": likely}
    yield Value("run.sample_rate", rate / frequency, words)


def samples_of_force(facts):
    """Samples of the record in a period of the highest frequency of each varying force."""
    rate = float(facts.case.run.sample_rate)
    for address, load in facts.loads("varying-force"):
        highest = float(np.max(load.frequencies, initial=0.0))
        if highest > 0:
            words = {"rate": rate, "frequency": highest, "least": LEAST_SAMPLES * highest}
            yield Value(f"{address}.frequencies", rate / highest, words)


def gravity(facts):
    """Acceleration of gravity (m/s^2), unless there is none."""
    if float(facts.case.run.gravity) > 0:
        yield Value("run.gravity", float(facts.case.run.gravity))


def sensor_count(facts):
    """Sensors of a case with loads."""
    if facts.case.loads:
        yield Value("sensors", len(facts.case.all_sensors))
