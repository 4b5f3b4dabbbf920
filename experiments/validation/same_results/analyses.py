"""Bounds, stability, comparisons, responses, matrices, modes: each public function is a case."""

import numpy as np

import jaxbeam as jb
from experiments.validation.same_results.arrays import Arrays, named, of_command
from experiments.validation.same_results.parts import (
    BEAM,
    CUBIC,
    MASS,
    MIDSPAN,
    PATCH,
    PATCH_BEAM,
    RUN,
    SHAKER,
    TWO_SPANS,
    first_of,
    read,
    word,
)


def least_achievable_peak() -> Arrays:
    """The least achievable peak, its commands, and the active constraints."""
    rated = PATCH + "rate_limit = 200.0\n"
    bound = jb.bound(read(PATCH_BEAM, rated, MIDSPAN, MASS, RUN), [0.2, 0.3, 0.4], 0.02)
    constraints = first_of(bound, "active_constraints", "binding")
    parts = zip(("places", "instants", "weights"), constraints, strict=True)
    return {
        "peaks": np.array([bound.peak, bound.uncontrolled, bound.reduction]),
        "times": np.asarray(bound.times),
        "commands": np.asarray(bound.commands),
        **{f"binding.{name}": np.asarray(part) for name, part in parts},
    }


def stability() -> Arrays:
    """Margins, frozen poles, growth, multipliers of a stream, limits of mass and speed."""
    file = "".join((PATCH_BEAM, PATCH, MIDSPAN, MASS, CUBIC.replace("2.0e9", "2000.0")))
    file = file.replace("power = 3\n", "") + RUN
    return of_command("stability", "--limits", word("--headway", "--spacing"), "0.6", file=file)


def comparison_of_controllers() -> Arrays:
    """Performance of a controller beside the least peak, limit cycles and margins."""
    strip = PATCH_BEAM.replace("modes = 3", "modes = 2")
    return of_command("compare", file="".join((strip, PATCH, MIDSPAN, MASS, CUBIC, RUN)))


def frequency_responses() -> Arrays:
    """Responses between commands, forces, sensors and positions, with a stationary mass."""
    file = "".join((BEAM, SHAKER, MIDSPAN, RUN))
    pairs = (
        ("--pair", "actuators.0:sensors.0"),
        ("--pair", "force@0.2:acceleration@0.45"),
        ("--pair", "actuators.0:actuators.0.transmitted_force"),
    )
    words = [text for pair in pairs for text in pair]
    return of_command(
        "frf", *words, "--mass-at", "0.3=0.5", "--to", "400", "--points", "200", file=file
    )


def state_spaces() -> Arrays:
    """System matrices without load, at an instant of the crossing, discrete, and augmented."""
    kinds = """
[[sensors]]
position = 0.3
quantity = "acceleration"
"""
    beam = read(BEAM, SHAKER, MIDSPAN, kinds, MASS, RUN)
    arrays: Arrays = {}
    for coordinates in ("modal", "sine"):
        model = jb.state_space(beam, coordinates)
        systems = {
            "unloaded": model.unloaded,
            "loaded": model.at(0.3),
            "augmented": model.augmented(0.3),
            "discrete": model.at(0.3).discretize(0.002),
        }
        for name, system in systems.items():
            parts = {matrix: np.asarray(getattr(system, matrix)) for matrix in "ABCD"}
            arrays |= named(**{f"{coordinates}.{name}": parts})
        arrays[f"{coordinates}.B_f"] = np.asarray(model.B_f(0.3))
    arrays["sampling_limit"] = np.asarray(jb.sampling_limit(beam))
    return arrays


def natural_modes() -> Arrays:
    """Frequencies, damping and shapes: several ends, springs, bonded patches, two spans."""
    bonded = PATCH + "added_mass = 0.1\nadded_rigidity = 2.0\n"
    spring = "[[supports]]\nposition = 0.4\nstiffness = 3.0e4\nrotational_stiffness = 8.0\n"
    wide = BEAM.replace("modes = 3", 'modes = 8\nends = "{}"')
    ends = ("pinned-clamped", "free-guided")
    cases = {end: read(wide.format(end), RUN) for end in ends}
    cases["bonded"] = read(PATCH_BEAM, spring, bonded, RUN)
    cases["two spans"] = read(TWO_SPANS, RUN)
    arrays: Arrays = {}
    for name, one in cases.items():
        modes, positions = jb.modes(one), np.linspace(0.0, float(one.beam.length), 41)
        arrays |= named(
            **{
                name: {
                    "frequencies": np.asarray(modes.frequencies),
                    "damping_ratios": np.asarray(modes.damping_ratios),
                    "shapes": np.asarray(modes.shapes(positions)),
                    "curvatures": np.asarray(modes.shapes(positions, 2)),
                }
            }
        )
    return arrays
