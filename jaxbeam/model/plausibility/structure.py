"""Quantities of beam, actuators, absorbers and track that are checked for plausibility.

Each comes with the address of the number that it follows from.
"""

import itertools
import math
from collections.abc import Collection, Iterator
from typing import Any, NamedTuple

import numpy as np

from jaxbeam.case.actuators.electrodynamic import Electrodynamic
from jaxbeam.model.plausibility.facts import Facts, compliance, is_elastic
from jaxbeam.model.state_space import poles

INF = math.inf
SOUND_SPEED = 5000.0  # m/s, of waves in steel, aluminium, timber along the grain; concrete 3500
LEAST_DECK = 100.0  # kg/m: beams of less are no decks, but of unit mass
LONGEST_GIRDER = 150.0  # m: the weight of longer spans hangs on cables or stands on arches
CLAMPING_STIFFNESS = 10.0  # E I / L: of two springs that hold the rotation, too


class Value(NamedTuple):
    """Value of a quantity, the address of the number it follows from, and words of its sentence."""

    address: str
    value: float
    words: dict[str, Any] = {}


def numbers_of(part: Any, address: str, *names: str) -> Iterator[tuple[str, float]]:
    """Numbers in the fields `names` of a part that has them, with their addresses."""
    for name in names:
        value = getattr(part, name, None)
        if value is not None:
            for index, number in np.ndenumerate(value):
                yield ".".join([address, name, *map(str, index)]), number


def parts_of(facts: Facts, key: str) -> list[tuple[str, Any]]:
    """The parts at a key of the case with their addresses."""
    found = getattr(facts.case, key)
    if isinstance(found, tuple):
        return [(f"{key}.{i}", part) for i, part in enumerate(found)]
    return [] if found is None else [(key, found)]


def part_numbers(
    facts: Facts, key: str, *names: str, over: str = "", kinds: Collection[str] = ()
) -> Iterator[Value]:
    """Absolute numbers in fields of the parts at a key, divided by a size of the beam, `over`.

    `kinds` restricts it to parts of these kinds.
    """
    size = getattr(facts, over) if over else 1.0
    for address, part in parts_of(facts, key):
        if not kinds or part.kind in kinds:
            for name, number in numbers_of(part, address, *names):
                yield Value(name, abs(number) / size)


# The beam: stiffness, mass, damping, supports


def limp_stiffness(facts: Facts) -> tuple[str, dict[str, Any]]:
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
    address, words = limp_stiffness(facts)
    radius = math.sqrt(facts.rigidity / facts.density) / SOUND_SPEED
    yield Value(address, facts.length / radius, words)


def _sag(facts, sag):
    if sag:
        address, words = limp_stiffness(facts)
        span = facts.numbers.span
        size = f"1/{float(f'{span / sag:.2g}'):g} of its span of {span:.4g} m"
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
        yield value._replace(address=heaviest_load(facts))


def heaviest_load(facts) -> str:
    """Address of the number that decides the weight of the heaviest load."""
    sizes = [static.max(initial=0.0) for static in facts.static_loads]
    heaviest = int(np.argmax(sizes))
    return f"loads.{heaviest}{mass_field(facts.case.loads[heaviest])}"


def sag_of_beam(facts):
    """Span over the static deflection under the beam's own weight."""
    return _sag(facts, facts.numbers.own_deflection)


def sag_of_bridge(facts):
    """The same of bridges, whose deck yields where it sags far.

    The stress of steel at a distance c from the neutral axis is (48/5) E sag c / span^2: with
    span / c = 50 it is 200 MPa at a sag of span/190.
    """
    is_girder = facts.is_bridge and facts.numbers.span <= LONGEST_GIRDER
    if is_girder and facts.density > LEAST_DECK and not list(_soft(facts)):
        yield from sag_of_beam(facts)


def _soft(facts) -> Iterator[Any]:
    """What may bear the weight of the beam before it is stiff: springs, foundations."""
    yield from (name for _, stiffness, name in facts.held() if stiffness < INF)
    yield from (k for _, k in numbers_of(facts.case.beam, "beam", "foundation_stiffness") if k)


def first_frequency(facts):
    """First elastic natural frequency (Hz)."""
    if facts.numbers.first_frequency is not None:
        address, words = limp_stiffness(facts)
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
    for name, shear in numbers_of(facts.case.beam, "beam", "shear_stiffness"):
        yield Value(name, facts.rigidity / (shear * facts.length**2))


def radius_of_rotary_inertia(facts):
    """Radius of gyration of the sections by their rotary inertia, over the length."""
    for name, inertia in numbers_of(facts.case.beam, "beam", "rotary_inertia"):
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
    for name, force in numbers_of(facts.case.beam, "beam", "axial_force"):
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
    for address, support in parts_of(facts, "supports"):
        for name, drop in numbers_of(support, address, "settlement"):
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


MASS_FIELDS = ("mass", "force", "body_mass", "forces", "masses", "force_per_length", "weight")


def mass_field(load) -> str:
    """The field that decides the weight of a load, behind a dot; empty if it has none."""
    return next((f".{n}" for n in MASS_FIELDS if getattr(load, n, None) is not None), "")


# Actuators


def influence_of_actuator(facts):
    """Largest influence of an actuator on a mode over that at the best place; none of patches."""
    for address, actuator in parts_of(facts, "actuators"):
        terms = actuator.displacement_map()
        if all(order == 0 for _, order, _ in terms):
            best = np.abs(facts.shapes).max(axis=0)
            ratio = np.max(np.abs(facts.influence(terms)) / best)
            yield Value(f"{address}.position", float(ratio), {"x": float(terms[0][0])})


def least_command(facts):
    """Distance of 0 from the range of commands of an actuator."""
    for address, actuator in parts_of(facts, "actuators"):
        limits = actuator.command_limits()
        if limits is not None and actuator.command_unit != "1":
            low, high = map(float, limits)
            words = {"low": low, "high": high, "unit": actuator.command_unit}
            words["size"] = max(abs(low), abs(high))
            looped = getattr(actuator, "inner_loop", None) is not None
            name = "inner_loop.limits" if looped else "limits"
            yield Value(f"{address}.{name}", max(low, -high, 0.0), words)


COMMAND_FIELDS = {
    "moment_per_volt": "N m/V",
    "d33": "m/V, not in pm/V",
    "force_per_volt": "N/V",
    "force_constant": "N/A",
    "limits": "N",
}


def sag_of_command(facts):
    """Deflection by the largest command of an actuator over the length."""
    for address, actuator in parts_of(facts, "actuators"):
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
    for address, patch in parts_of(facts, "actuators"):
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
    for address, actuator in parts_of(facts, "actuators"):
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
    for address, one in parts_of(facts, "actuators"):
        terms = one.displacement_map()
        found += [(name, c, terms, "N s/m") for name, c in numbers_of(one, address, "damping")]
        if one.kind == "electrodynamic" and one.back_emf is not None:
            c = float(one.force_constant * one.back_emf / one.resistance)
            found.append((f"{address}.back_emf", c, terms, "V s/m, not in mV s/m"))
    for address, one in parts_of(facts, "supports"):
        terms = ((one.position, 0, 1.0),)
        found += [(name, c, terms, "N s/m") for name, c in numbers_of(one, address, "damping")]
    for name, c, terms, unit in found:
        added = abs(float(c)) * facts.influence(terms) ** 2 * np.sqrt(compliance(facts.modes)) / 2
        yield Value(name, float(np.max(added)), {"unit": unit})


def rate_of_commands(facts):
    """Rate limit of an actuator over its range and the rate of the first mode."""
    for address, actuator in parts_of(facts, "actuators"):
        limits = actuator.command_limits()
        for name, rate in numbers_of(actuator, address, "rate_limit"):
            if limits is not None and facts.numbers.first_frequency is not None:
                needed = 2 * math.pi * facts.numbers.first_frequency * float(np.ptp(limits))
                yield Value(name, float(rate) / needed, {"unit": actuator.command_unit})


def lag_of_actuator(facts):
    """Bandwidth of an actuator, of a coil R / L, over the first natural frequency."""
    first = facts.numbers.first_frequency
    for address, actuator in parts_of(facts, "actuators"):
        rates = list(numbers_of(actuator, address, "bandwidth"))
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


# Absorbers and foundations


def _frequencies_of_absorbers(facts):
    """Absorbers with addresses of their frequency or spring, its unit, and the frequency (Hz)."""
    for address, absorber in parts_of(facts, "absorbers"):
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
    elastic = is_elastic(facts.modes)
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
        frequencies = numbers_of(facts.case.controller, "controller", *names)
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
        for name, lag in numbers_of(facts.case.controller, "controller", "lag"):
            yield Value(name, float(lag) * 2 * math.pi * facts.numbers.first_frequency)


def mass_of_absorber(facts):
    """Masses of absorbers without inerters over that of the beam."""
    for address, absorber in parts_of(facts, "absorbers"):
        if absorber.mass > 0 and not absorber.inertance and not absorber.ground_inertance:
            yield Value(f"{address}.mass", float(absorber.mass) / facts.mass)


def damping_of_absorber(facts):
    """Damping ratios of absorbers that have a damper and a spring."""
    for address, absorber in parts_of(facts, "absorbers"):
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
    for address, support in parts_of(facts, "supports"):
        for name, given in numbers_of(support, address, "stiffness"):
            if given > 0 and "free" not in facts.case.beam.ends:
                yield Value(name, float(given) / bending, {"unit": "N/m, not in kN/m or MN/m"})
        for name, given in numbers_of(support, address, "rotational_stiffness"):
            if given > 0:
                ratio = float(given) * facts.length / facts.rigidity
                yield Value(name, ratio, {"unit": "N m/rad, not in kN m/rad"})


def foundation_over_bending(facts):
    """Stiffness of a foundation over that of the first half wave of the beam in bending."""
    bending = facts.rigidity * (math.pi / facts.length) ** 4
    for name, given in numbers_of(facts.case.beam, "beam", "foundation_stiffness"):
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
    return [one for _, one in parts_of(facts, "track") if one.layered]


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
