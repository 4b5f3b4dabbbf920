"""Quantities of a case that are checked, each with the address of the number it follows from."""

import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from jaxbeam.case.actuators.electrodynamic import Electrodynamic
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.case.trajectory import NEVER
from jaxbeam.model.layout import NODE_TOLERANCE
from jaxbeam.model.plausibility.facts import GRAVITY, Facts, compliance
from jaxbeam.model.state_space import poles

INF = math.inf
SOUND_SPEED = 5000.0  # m/s, of waves in steel, aluminium, timber along the grain; concrete 3500
WALKING, LARGEST_PERSON = (0.5, 3.0), 1200.0  # m/s, N
ROAD_KINDS = ("quarter-car", "half-car")
ROAD_SPEED, RAIL_SPEED = 60.0, 120.0  # m/s; 1.2 times 350 km/h is 117 m/s
CLAMPING_STIFFNESS = 10.0  # E I / L: of two springs that hold the rotation, too
LEAST_SAMPLES = 2.0  # in a period
LARGEST_IN_KHZ = 10.0  # of a sample rate of 10 kHz
LATE_BY_TABLE = 100.0  # times the run, until a load leaves
SMALL_UNITS = {"m": "mm", "m/s": "mm/s", "m/s^2": "mm/s^2", "1": "1e-6", "Pa": "MPa"}


class Value(NamedTuple):
    """Value of a quantity, the address of the number it follows from, and words of its sentence."""

    address: str
    value: float
    words: dict[str, Any] = {}


Values = Callable[[Facts], Iterator[Value]]
Size = Callable[[Facts], float]


def _numbers(part: Any, address: str, *names: str) -> Iterator[tuple[str, float]]:
    """Numbers in the fields `names` of a part that has them, with their addresses."""
    for name in names:
        value = getattr(part, name, None)
        if value is not None:
            for index, number in np.ndenumerate(value):
                yield ".".join([address, name, *map(str, index)]), number


def _parts(facts: Facts, key: str) -> list[tuple[str, Any]]:
    """The parts at a key of the case with their addresses."""
    found = getattr(facts.case, key)
    if isinstance(found, tuple):
        return [(f"{key}.{i}", part) for i, part in enumerate(found)]
    return [] if found is None else [(key, found)]


def part_numbers(key: str, *names: str, over: Size | None = None, kinds: tuple = ()) -> Values:
    """Quantity: absolute numbers in fields of the parts at a key, divided by `over`.

    `kinds` restricts it to parts of these kinds.
    """

    def values(facts):
        for address, part in _parts(facts, key):
            if not kinds or part.kind in kinds:
                for name, number in _numbers(part, address, *names):
                    yield Value(name, abs(number) / (over(facts) if over else 1.0))

    return values


def beam_numbers(*names: str, over: Size | None = None) -> Values:
    """Quantity: absolute numbers in fields of the beam, divided by `over`."""
    return part_numbers("beam", *names, over=over)


def length(facts: Facts) -> float:
    """Length of the beam (m)."""
    return facts.length


def rigidity(facts: Facts) -> float:
    """Bending stiffness of the beam (N m^2)."""
    return facts.rigidity


def density(facts: Facts) -> float:
    """Mass per length of the beam (kg/m)."""
    return facts.density


def mass(facts: Facts) -> float:
    """Mass of the beam (kg)."""
    return facts.density * facts.length


# The beam: stiffness, mass, damping, supports


def _stiffness(facts: Facts) -> tuple[str, dict[str, Any]]:
    """Address of the stiffness that lets the beam sag, and words of its unit and of the mass."""
    beam, held = facts.case.beam, list(facts.held())
    springs = [name for _, k, name in held if k < INF]
    words = {"mass": "beam.mass_per_length in kg/m"}
    if beam.density is not None:
        words = {"mass": "beam.density in kg/m^3"}
    if springs and len(held) - len(springs) < 2:  # the beam hangs on springs
        return f"{springs[0]}.stiffness", words | {"unit": "N/m, not in kN/m"}
    if beam.flexural_rigidity is not None:
        return "beam.flexural_rigidity", words | {"unit": "N m^2, not in kN m^2 or GN m^2"}
    if any(one.flexural_rigidity is not None for one in beam.segments):
        address = "beam.segments.0.flexural_rigidity"
        return address, words | {"unit": "N m^2, not in kN m^2 or GN m^2"}
    return "beam.youngs_modulus", words | {"unit": "Pa, not in GPa, beam.height in m"}


def slenderness(facts):
    """Length of the beam over its radius of gyration, if waves run in it as in solid material."""
    address, words = _stiffness(facts)
    radius = math.sqrt(facts.rigidity / facts.density) / SOUND_SPEED
    yield Value(address, facts.length / radius, words)


def _sag(facts, sag):
    if sag:
        address, words = _stiffness(facts)
        span = facts.numbers.span
        size = f"1/{span / sag:.2g} of its span of {span:.4g} m"
        size = "more than its length" if sag > facts.length else size
        words |= {"sag": sag, "size": size, "stiffness": address}
        yield Value(address, span / sag, words)


def sag_of_loads(facts):
    """Span over the largest static deflection under the loads."""
    return _sag(facts, facts.numbers.deflection)


def rise_of_loads(facts):
    """Span over static deflection, at the address of the heaviest load, if that is too light."""
    for value in sag_of_loads(facts):
        if facts.numbers.deflection < 1e-12 * facts.length:
            return  # they stand on supports
        yield value._replace(address=_heaviest(facts))


def _heaviest(facts) -> str:
    """Address of the number that decides the weight of the heaviest load."""
    sizes = [static.max(initial=0.0) for static in facts.static_loads]
    heaviest = int(np.argmax(sizes))
    return f"loads.{heaviest}{_mass_field(facts.case.loads[heaviest])}"


def sag_of_beam(facts):
    """Span over the static deflection under the beam's own weight."""
    return _sag(facts, facts.numbers.own_deflection)


def first_frequency(facts):
    """First elastic natural frequency (Hz)."""
    if facts.numbers.first_frequency is not None:
        address, words = _stiffness(facts)
        yield Value(address, facts.numbers.first_frequency, words)


def damping_ratio(facts):
    """Largest modal damping ratio, however it is given; on a track of layers that of the first."""
    beam, name = facts.case.beam, "beam.loss_factor"
    ratios = facts.modes.damping_ratios[: 1 if _layers(facts) else None]
    if beam.rayleigh_damping is not None:
        ratios, name = ratios[:1], "beam.rayleigh_damping"
    elif np.any(beam.damping_ratio):
        ratios, name = beam.damping_ratio, "beam.damping_ratio"
    elif any(one.loss_factor is not None for one in beam.segments):
        name = "beam.segments"
    yield Value(name, float(np.max(ratios)))


def rigidity_over_shear(facts):
    """Bending stiffness over shear stiffness and the square of the length."""
    for name, shear in _numbers(facts.case.beam, "beam", "shear_stiffness"):
        yield Value(name, facts.rigidity / (shear * facts.length**2))


def radius_of_rotary_inertia(facts):
    """Radius of gyration of the sections by their rotary inertia, over the length."""
    for name, inertia in _numbers(facts.case.beam, "beam", "rotary_inertia"):
        yield Value(name, math.sqrt(inertia / facts.density) / facts.length)


def step_of_segments(facts):
    """Ratio of stiffness, and of mass, from segment to segment."""
    for name in ("flexural_rigidity", "mass_per_length"):
        sizes = [getattr(one, name) for one in facts.case.beam.segments]
        for i, (left, right) in enumerate(itertools.pairwise(sizes)):
            if left is not None and right is not None:
                ends = abs(np.ravel(left)[0]), abs(np.ravel(right)[0])
                if min(ends) > 0:
                    yield Value(f"beam.segments.{i + 1}.{name}", max(ends) / min(ends))


def axial_over_buckling(facts):
    """Axial force over that at which a pinned beam buckles."""
    for name, force in _numbers(facts.case.beam, "beam", "axial_force"):
        if force:
            yield Value(name, abs(float(force)) * facts.length**2 / (math.pi**2 * facts.rigidity))


def rigid_motions(facts):
    """Motions that nothing resists, of a beam that has hinges or on which something presses."""
    beam = facts.case.beam
    pressed = any(np.any(loads > 0) for loads in facts.static_loads)
    if beam.hinges or pressed:
        motions = facts.modes.stiffness.size - facts.frequencies.size
        address = "beam.hinges" if beam.hinges else "beam.ends"
        remedy = "leave a hinge out, or add" if beam.hinges else "choose other ends, or add"
        yield Value(address, motions, {"remedy": remedy})


def settlement(facts):
    """Settlements of supports over the length."""
    for address, support in _parts(facts, "supports"):
        for name, drop in _numbers(support, address, "settlement"):
            yield Value(name, abs(drop) / facts.length, {"drop": drop})


def clamping_distance(facts):
    """Distances of neighbours that hold the deflection, over the length, if they are stiff."""
    unit = facts.rigidity / facts.length
    for (left, k, first), (right, other, second) in itertools.pairwise(sorted(facts.held())):
        flexibility = sum(1 / each if each else INF for each in (k, other))
        apart = right - left
        if apart > 0 and apart * apart > CLAMPING_STIFFNESS * unit * flexibility:
            address = f"{second if second.startswith('supports') else first}.position"
            words = {"apart": apart, "first": first, "second": second}
            yield Value(address, apart / facts.length, words)


# Actuators


def influence_of_actuator(facts):
    """Largest influence of an actuator on a mode over that at the best place; none of patches."""
    for address, actuator in _parts(facts, "actuators"):
        terms = actuator.displacement_map()
        if all(order == 0 for _, order, _ in terms):
            best = np.abs(facts.shapes).max(axis=0)
            ratio = np.max(np.abs(facts.influence(terms)) / best)
            yield Value(f"{address}.position", float(ratio), {"x": float(terms[0][0])})


def least_command(facts):
    """Distance of 0 from the range of commands of an actuator."""
    for address, actuator in _parts(facts, "actuators"):
        limits = actuator.command_limits()
        if limits is not None and actuator.command_unit != "1":
            low, high = map(float, limits)
            words = {"low": low, "high": high, "unit": actuator.command_unit}
            words["size"] = max(abs(low), abs(high))
            name = "limits" if actuator.limits is not None else "inner_loop.limits"
            yield Value(f"{address}.{name}", max(low, -high, 0.0), words)


FEEDBACK = ("feedback", "output-feedback", "feedback-scheduled", "pd", "ppf")
COMMAND_FIELDS = {
    "moment_per_volt": "N m/V",
    "d33": "m/V, not in pm/V",
    "force_per_volt": "N/V",
    "force_constant": "N/A",
    "limits": "N",
}


def sag_of_command(facts):
    """Deflection by the largest command of an actuator over the length."""
    for address, actuator in _parts(facts, "actuators"):
        sag = facts.sag_of_command(actuator)
        if sag:
            name = next(n for n in COMMAND_FIELDS if getattr(actuator, n, None) is not None)
            words = {"sag": sag, "unit": COMMAND_FIELDS[name]}
            yield Value(f"{address}.{name}", sag / facts.length, words)


def reach_of_command(facts):
    """Deflection by the largest command of an actuator over that under the loads."""
    for address, sag, words in sag_of_command(facts):
        if facts.numbers.deflection:
            yield Value(address, sag * facts.length / facts.numbers.deflection, words)


def gain_in_decibels(facts):
    """Largest command of a patch over the voltage that it bears, if its gain fits as dB only."""
    for address, patch in _parts(facts, "actuators"):
        if patch.kind == "patch" and patch.limits is not None:
            gain = float(patch.amplifier_gain)
            used = float(np.max(np.asarray(patch.limits) / np.asarray(patch.depolarisation)))
            fits = used * gain < 0.5 < used * 10 ** (min(gain, 200.0) / 20) < 1.1
            words = {"gain": gain, "factor": 10 ** (min(gain, 200.0) / 20)}
            yield Value(f"{address}.amplifier_gain", used * gain if fits else 1.0, words)


def spring_of_actuator(facts):
    """Stiffness of an actuator over that of the beam at its place, of rigs.

    Shakers with a moving mass, and those on bridges, may hang softly.
    """
    for address, actuator in _parts(facts, "actuators"):
        given = float(getattr(actuator, "stiffness", 0.0))
        if given > 0 and not facts.is_bridge and not float(getattr(actuator, "mass", 0.0)):
            moved = facts.influence(actuator.displacement_map())
            ratio = given * float(np.sum(compliance(facts.modes) * moved**2))
            yield Value(f"{address}.stiffness", ratio)


def damping_at_places(facts):
    """Largest damping ratio that a damper of an actuator or support adds to a mode.

    The back-EMF of a coil that is shorted is one, K_f K_v / R.
    """
    found = []
    for address, one in _parts(facts, "actuators"):
        terms = one.displacement_map()
        found += [(name, c, terms, "N s/m") for name, c in _numbers(one, address, "damping")]
        if one.kind == "electrodynamic" and one.back_emf is not None:
            c = float(one.force_constant * one.back_emf / one.resistance)
            found.append((f"{address}.back_emf", c, terms, "V s/m, not in mV s/m"))
    for address, one in _parts(facts, "supports"):
        terms = ((one.position, 0, 1.0),)
        found += [(name, c, terms, "N s/m") for name, c in _numbers(one, address, "damping")]
    for name, c, terms, unit in found:
        added = abs(float(c)) * facts.influence(terms) ** 2 * np.sqrt(compliance(facts.modes)) / 2
        yield Value(name, float(np.max(added)), {"unit": unit})


def rate_of_commands(facts):
    """Rate limit of an actuator over its range and the rate of the first mode."""
    for address, actuator in _parts(facts, "actuators"):
        limits = actuator.command_limits()
        for name, rate in _numbers(actuator, address, "rate_limit"):
            if limits is not None and facts.numbers.first_frequency is not None:
                needed = 2 * math.pi * facts.numbers.first_frequency * float(np.ptp(limits))
                yield Value(name, float(rate) / needed, {"unit": actuator.command_unit})


def lag_of_actuator(facts):
    """Bandwidth of an actuator, of a coil R / L, over the first natural frequency."""
    first = facts.numbers.first_frequency
    for address, actuator in _parts(facts, "actuators"):
        rates = list(_numbers(actuator, address, "bandwidth"))
        unit = "1/s, 2 pi times the frequency in Hz, not in kHz"
        if actuator.kind == "electrodynamic" and actuator.inner_loop is None:
            rate = float(actuator.resistance) / float(actuator.inductance)
            rates, unit = (
                [(f"{address}.inductance", rate)],
                "H, not in mH, and the resistance in ohm",
            )
        for name, bandwidth in rates:
            if first is not None:
                yield Value(name, bandwidth / (2 * math.pi * first), {"unit": unit})


def growth_of_inner_loops(facts):
    """Largest rate of growth (1/s) of the beam with inner loops of actuators."""
    looped = [
        f"actuators.{i}.inner_loop"
        for i, actuator in enumerate(facts.case.actuators)
        if isinstance(actuator, Electrodynamic) and actuator.inner_loop is not None
    ]
    if looped:
        fastest = max(poles(facts.case), key=lambda pole: pole.real)
        hertz = abs(fastest.imag) / (2 * math.pi)
        yield Value(" and ".join(looped), float(fastest.real), {"hertz": hertz})


# Loads: vehicles, weights, people


def sag_of_spring(facts):
    """Static deflections (m) of the springs of vehicles."""
    for stage in facts.stages:
        if stage.stiffness > 0:
            yield Value(stage.spring, stage.carried * GRAVITY / stage.stiffness)


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
            yield from (Value(*pair) for pair in _numbers(load, address, "spacing"))


MASS_FIELDS = ("mass", "force", "body_mass", "forces", "masses", "force_per_length", "weight")


def _mass_field(load) -> str:
    """The field that decides the weight of a load, behind a dot; empty if it has none."""
    return next((f".{n}" for n in MASS_FIELDS if getattr(load, n, None) is not None), "")


def _weights(facts, kinds):
    """Largest static load (kN) of a wheel, and the field that decides it, on bridges."""
    for (address, load), static in zip(facts.loads(), facts.static_loads, strict=True):
        if load.kind in kinds and facts.is_bridge and static.size:
            name = _mass_field(load)
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
            yield Value(f"{address}.amplitudes", largest / GRAVITY / mass(facts))


def mass_ratio(facts):
    """Mass of the loads on the beam at once over that of the beam."""
    if facts.numbers.mass_ratio:
        yield Value(_heaviest(facts), facts.numbers.mass_ratio, _stiffness(facts)[1])


def largest_phase(facts):
    """Sizes of phases (rad)."""
    parts = [*facts.loads("varying-force", "pedestrian", "crowd")]
    for address, part in (*parts, *_parts(facts, "profile"), *_parts(facts, "controller")):
        for name, phase in _numbers(part, address, "phase", "phases"):
            yield Value(name, abs(phase))


# Absorbers and foundations


def _frequencies_of_absorbers(facts):
    """Absorbers with addresses of their frequency or spring, its unit, and the frequency (Hz)."""
    for address, absorber in _parts(facts, "absorbers"):
        own = math.sqrt(float(absorber.spring) / float(absorber.moving_mass)) / (2 * math.pi)
        by_spring = absorber.stiffness is not None
        name = "stiffness" if by_spring else "frequency"
        unit = "N/m, not in kN/m, and the mass in kg" if by_spring else "Hz"
        yield absorber, f"{address}.{name}", own, unit


def absorber_over_first_frequency(facts):
    """Natural frequencies of absorbers over that of the first mode."""
    first = facts.numbers.first_frequency
    for _, address, own, unit in _frequencies_of_absorbers(facts):
        if first is not None:
            yield Value(address, own / first, {"frequency": own, "unit": unit})


def frequency_off_modes(facts):
    """Ratio of frequencies to the nearest that they may be tuned to, of absorbers and laws.

    Those of absorbers, above that of the first mode, to that of a mode, f_m / (1 + mu) by Den
    Hartog with the mass ratio mu of the mode, or of a force: they may miss it by 40 %. One that
    fits better as rad/s may miss by 5 %, that of positive position feedback, too: these are 1.
    """
    elastic = facts.modes.stiffness > 1e-9 * facts.modes.stiffness_unit
    forced = [float(f) for _, load in facts.loads("varying-force") for f in load.frequencies]
    forced += [float(load.pace) for _, load in facts.loads("pedestrian", "crowd")]
    found = []
    for absorber, address, own, unit in _frequencies_of_absorbers(facts):
        shapes = np.asarray(facts.modes.shapes(np.asarray(float(absorber.position))))
        ratios = float(absorber.moving_mass) * shapes[elastic] ** 2
        tuned = np.append(facts.frequencies / (1 + ratios), forced)
        found.append((address, own, unit, tuned, True))
    if getattr(facts.case.controller, "kind", "") == "ppf":
        names = "frequency", "further_frequencies"
        frequencies = _numbers(facts.case.controller, "controller", *names)
        found += [(name, float(f), "Hz", facts.frequencies, False) for name, f in frequencies]
    for address, own, unit, tuned, is_absorber in found:
        if not facts.frequencies.size or own < facts.frequencies[0]:
            continue
        miss, in_radians = (
            float(np.min(np.abs(np.log(f / tuned)))) for f in (own, own / (2 * math.pi))
        )
        likely = in_radians < min(miss, 0.1)
        off_all = is_absorber and own < 1.4 * tuned.max()  # higher modes may be left out
        if off_all or likely:
            words = {"frequency": own, "hertz": own / (2 * math.pi), "ratio": math.exp(miss)}
            words["unit"] = f"{unit}, not in rad/s" if unit == "Hz" else unit
            yield Value(address, miss / math.log(1.05 if likely else 1.4), words)


def lag_of_controller(facts):
    """Time constants of lags of a controller times the rate of the first mode."""
    if facts.numbers.first_frequency is not None:
        for name, lag in _numbers(facts.case.controller, "controller", "lag"):
            yield Value(name, float(lag) * 2 * math.pi * facts.numbers.first_frequency)


def mass_of_absorber(facts):
    """Masses of absorbers without inerters over that of the beam."""
    for address, absorber in _parts(facts, "absorbers"):
        if absorber.mass > 0 and not absorber.inertance and not absorber.ground_inertance:
            yield Value(f"{address}.mass", float(absorber.mass) / mass(facts))


def damping_of_absorber(facts):
    """Damping ratios of absorbers that have a damper and a spring."""
    for address, absorber in _parts(facts, "absorbers"):
        critical = 2 * math.sqrt(float(absorber.spring) * float(absorber.moving_mass))
        if absorber.damper > 0 and critical > 0:
            given = absorber.damping_ratio is None
            name, unit = ("damping", "in N s/m, not in kN s/m") if given else (
                "damping_ratio", "a fraction of critical damping, 0.1 for ten per cent"
            )  # fmt: skip
            yield Value(f"{address}.{name}", float(absorber.damper) / critical, {"unit": unit})


def support_over_bending(facts):
    """Stiffness of springs under a beam that has other supports, over that in bending at midspan.

    Soft springs may hold a beam with free ends, so that it moves as if nothing did.
    """
    bending = facts.rigidity * math.pi**4 / (2 * facts.length**3)
    for address, support in _parts(facts, "supports"):
        for name, given in _numbers(support, address, "stiffness"):
            if given > 0 and "free" not in facts.case.beam.ends:
                yield Value(name, float(given) / bending, {"unit": "N/m, not in kN/m or MN/m"})
        for name, given in _numbers(support, address, "rotational_stiffness"):
            if given > 0:
                ratio = float(given) * facts.length / facts.rigidity
                yield Value(name, ratio, {"unit": "N m/rad, not in kN m/rad"})


def foundation_over_bending(facts):
    """Stiffness of a foundation over that of the first half wave of the beam in bending."""
    bending = facts.rigidity * (math.pi / facts.length) ** 4
    for name, given in _numbers(facts.case.beam, "beam", "foundation_stiffness"):
        if given > 0:
            yield Value(name, float(given) / bending)


def sag_on_foundation(facts):
    """Deflection of a long beam on a foundation k under its heaviest wheel over the length of it.

    Under P it is P lambda / (2 k), with lambda^4 = k / (4 E I): Hetenyi (1946), Beams on elastic
    foundation, chapter 2. Only where the foundation carries more than bending does.
    """
    heaviest = max((float(loads.max(initial=0.0)) for loads in facts.static_loads), default=0.0)
    for name, ratio, _ in foundation_over_bending(facts):
        k = ratio * facts.rigidity * (math.pi / facts.length) ** 4
        decay = (k / (4 * facts.rigidity)) ** 0.25
        if decay * facts.length > math.pi:
            sag = heaviest * decay / (2 * k)
            yield Value(name, sag * decay, {"sag": sag, "wave": 1 / decay})


# The track of layers


def _layers(facts):
    return [one for _, one in _parts(facts, "track") if one.layered]


def sinking_of_rail(facts):
    """Deflection (m) of a long rail on its springs under the heaviest wheel, by the softer ones.

    Under P it is P (4 B k^3)^(-1/4) / 2: Hetenyi (1946), as for `sag_on_foundation`.
    """
    heaviest = max((float(loads.max(initial=0.0)) for loads in facts.static_loads), default=0.0)
    for track in _layers(facts):
        pads, ballast = float(track.pad_stiffness), float(track.ballast_stiffness)
        k = 1.0 / (1.0 / pads + 1.0 / ballast) / float(track.sleeper_spacing)
        sunk = heaviest / 2 / (4 * float(track.rail_rigidity) * k**3) ** 0.25
        yield Value(f"track.{'pad' if pads <= ballast else 'ballast'}_stiffness", sunk)


def sleepers_over_rail(facts):
    """Mass of the sleepers over that of the rail."""
    for track in _layers(facts):
        of_sleepers = float(track.sleeper_mass) / float(track.sleeper_spacing)
        yield Value("track.sleeper_mass", of_sleepers / float(track.rail_mass))


def damping_of_sleepers(facts):
    """Damping ratio of a sleeper between its springs by either damper, unless that is 0."""
    for track in _layers(facts):
        stiffness = float(track.pad_stiffness) + float(track.ballast_stiffness)
        critical = 2 * math.sqrt(stiffness * float(track.sleeper_mass))
        for name in ("pad_damping", "ballast_damping"):
            if damper := float(getattr(track, name)):
                yield Value(f"track.{name}", damper / critical)


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
    for address, profile in _parts(facts, "profile"):
        _, heights = facts.profile
        name = next((f".{n}" for n in PROFILE_FIELDS if hasattr(profile, n)), "")
        height = float(np.ptp(heights))
        words = {"height": height, "should": _profile_unit(name)}
        yield Value(f"{address}{name}", height / facts.length, words)


def rise_of_waves(facts):
    """Rise (m) of a sine, bump or step of the surface of a bridge, whose height is one number."""
    for address, profile in _parts(facts, "profile"):
        if facts.is_bridge and profile.kind in WAVES:
            name, rise = WAVES[profile.kind]
            yield Value(f"{address}.{name}", rise * abs(float(getattr(profile, name))))


def slope_of_profile(facts):
    """Steepest slope of the profile, but of one with a step."""
    for address, profile in _parts(facts, "profile"):
        x, heights = facts.profile
        name = next((f".{n}" for n in PROFILE_FIELDS if hasattr(profile, n)), "")
        slope = float(np.max(np.abs(np.diff(heights)))) / (x[1] - x[0])
        slope = slope if profile.kind != "step" else 0.0
        yield Value(f"{address}{name}", slope, {"should": _profile_unit(name)})


def _profile_unit(name: str) -> str:
    return "it is a factor of the heights" if name == ".scale" else "is it in m, not in mm?"


def length_of_waves(facts):
    """Wavelengths, and distances of the points of a table, over the length of the beam."""
    yield from part_numbers("profile", "wavelength", over=length)(facts)
    for address, profile in _parts(facts, "profile"):
        if profile.kind == "table":
            apart = float(np.min(np.diff(profile.positions), initial=INF))
            yield Value(f"{address}.positions", apart / facts.length)


def acceleration_of_waves(facts):
    """Largest vertical acceleration of wheels on a sine longer than the beam, over gravity."""
    speed = facts.numbers.speed
    for address, profile in _parts(facts, "profile"):
        if profile.kind == "sine" and speed and float(profile.wavelength) > facts.length:
            rate = 2 * math.pi * speed / float(profile.wavelength)
            ratio = abs(float(profile.amplitude)) * rate**2 / GRAVITY
            yield Value(f"{address}.wavelength", ratio or 1.0)


def bump_under_loads(facts):
    """1 for a bump or table that no load meets on the beam or as far before and behind it."""
    for address, profile in _parts(facts, "profile"):
        if profile.kind in ("bump", "table") and np.ptp(facts.profile[1]) == 0:
            name = "start" if profile.kind == "bump" else "positions"
            heights = profile.height if profile.kind == "bump" else np.ptp(profile.point_heights)
            yield Value(f"{address}.{name}", float(abs(heights) > 0))


def cutoff_over_crossing(facts):
    """Cutoffs of filters of sensors times the time at which the last load has left."""
    for address, sensor in _parts(facts, "sensors"):
        for name, cutoff in _numbers(sensor.filter, f"{address}.filter", "cutoff"):
            if facts.last_exit > 0:
                words = {"cutoff": cutoff, "last": facts.last_exit}
                yield Value(name, cutoff * facts.last_exit, words)


def size_of_section_modulus(facts):
    """Side of a cube as large as a section modulus, over the length."""
    for name, modulus, _ in part_numbers("sensors", "section_modulus")(facts):
        side = modulus ** (1 / 3)
        yield Value(name, side / facts.length, {"side": side})


def error_over_reading(facts):
    """Noise, resolution and offset of sensors over the size of their readings.

    The noise that an estimator expects, too; one number for all sensors is that of the largest.
    """
    found = _parts(facts, "sensors")
    sizes = [facts.reading(sensor) or 0.0 for _, sensor in found]
    for (address, sensor), size in zip(found, sizes, strict=True):
        for name, given in _numbers(sensor, address, "noise", "resolution", "offset"):
            yield from _error_of(sensor, size, name, given)
    estimator = getattr(facts.case.controller, "estimator", None)
    noises = list(_numbers(estimator, "controller.estimator", "measurement_noise"))
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


def sides_of_jumps(facts):
    """1 for a sensor, at a place where its quantity jumps, of which it has one side by default."""
    where, at = facts.jumps, [(float(s.position), s.quantity) for s in facts.case.sensors]
    for (address, sensor), (x, quantity) in zip(_parts(facts, "sensors"), at, strict=True):
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
    for address, part in (*_parts(facts, "sensors"), *_parts(facts, "controller")):
        yield from _numbers(part, address, "delay", "jitter")


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
