"""Beam of a case: its ends, sections, damping, segments, hinges and supports.

The `beam` is a `jaxbeam.case.beam.Beam`, which has the parts of this package.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.display import ReprWithUnits
from jaxbeam.case.fields import (
    NOT_NEGATIVE,
    ON_BEAM,
    POSITIVE,
    check_on_beam,
    choice,
    concrete,
    count,
    is_concrete,
    number,
    parts,
    suggestion,
    validate_direct_or_derived,
)
from jaxbeam.runtime.arrays import Array, Number, xp
from jaxbeam.runtime.printer import counted

LIMIT_SPAN = 20.0  # m: shorter spans have more damping


class MaterialDamping(NamedTuple):
    """Lower bounds of the damping of railway bridges: ratio of long spans, increase per m below."""

    ratio: float
    increase: float

    def at(self, span: Float[Array, ""]) -> Float[Array, ""]:
        """Damping ratio of a span (m)."""
        return self.ratio + self.increase * xp.maximum(LIMIT_SPAN - span, 0.0)


# EN 1991-2, table 6.6; numbers as in the function `ec1damping` of a public solver in Julia.
MATERIALS = {
    "steel": MaterialDamping(0.005, 0.00125),
    "composite": MaterialDamping(0.005, 0.00125),
    "prestressed-concrete": MaterialDamping(0.01, 0.0007),
    "reinforced-concrete": MaterialDamping(0.015, 0.0007),
    "filler-beam": MaterialDamping(0.015, 0.0007),
}


def rayleigh_coefficients(frequencies, ratios) -> Float[Array, "2"]:
    """Coefficients a (1/s) and b (s) of Rayleigh damping D = a M + b K with two given ratios.

    zeta = a / (2 omega) + b omega / 2 holds at both `frequencies` (2,) in Hz for the damping
    `ratios` (2,): `rayleigh_damping` of a beam. Raises ValueError for equal frequencies.

    >>> from jaxbeam.case.beam import rayleigh_coefficients
    >>> print(rayleigh_coefficients([2.0, 8.0], [0.01, 0.01]).round(6))
    [0.201062 0.000318]
    """
    omega, ratios = 2 * xp.pi * xp.asarray(frequencies, float), xp.asarray(ratios, float)
    if omega.shape != (2,) or ratios.shape != (2,):
        raise ValueError("give two frequencies in Hz and two damping ratios")
    if is_concrete(omega) and concrete(omega)[0] == concrete(omega)[1]:
        raise ValueError(f"the two frequencies must differ; both are {frequencies[0]:g} Hz")
    matrix = xp.stack([1 / (2 * omega), omega / 2], axis=-1)
    return xp.linalg.solve(matrix, ratios)


class Hinge(ReprWithUnits):
    """Hinge between the ends of a beam: no bending moment, or that of a rotational spring.

    The deflection is continuous, the rotation jumps. A moment M = k (phi_right - phi_left) is that
    of a semi-rigid joint of `rotational_stiffness` k.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(10.0, 2e7, 400.0, ends="clamped-pinned", hinges=[jb.Hinge(6.0)])
    >>> print(jb.modes(jb.Case(beam)).frequencies.round(2)[:2])
    [ 2.52 16.91]
    """

    position: Float[Number, ""] = number("m", "distance from the left end", ON_BEAM)
    rotational_stiffness: Float[Number, ""] = number(
        "N m/rad", "spring between both sides", NOT_NEGATIVE, default=0.0
    )


class Segment(ReprWithUnits):
    """Length of a beam over which stiffness and mass are constant or polynomials.

    Each property is one number, or the coefficients c_0, c_1, ... of

        c_0 + c_1 s + c_2 s^2 + ...,    s = 0 at the left end of the segment, 1 at its right end,

    so that [1.0, -0.5] falls from 1.0 to 0.5. A property that is left out is that of the beam.
    `width` and `height` (in the bending direction) are those of a rectangular section of the
    beam's `youngs_modulus` and `density`. The last segment may leave out its `length`: it ends
    where the beam does.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(
    ...     10.0, segments=[jb.Segment(6.0, 2e7, 400.0), jb.Segment(4.0, 1e7, 300.0)]
    ... )
    >>> print(jb.modes(jb.Case(beam)).frequencies.round(2)[:2])
    [ 3.22 12.83]
    """

    length: Float[Number, ""] | None = number("m", "length", POSITIVE, default=None)
    flexural_rigidity: Float[Number, " *power"] | None = number(
        "N m^2", "bending stiffness E I", default=None
    )
    mass_per_length: Float[Number, " *power"] | None = number(
        "kg/m", "mass per length", default=None
    )
    width: Float[Number, " *power"] | None = number("m", "section width", default=None)
    height: Float[Number, " *power"] | None = number("m", "section height", default=None)
    shear_stiffness: Float[Number, " *power"] | None = number(
        "N", "shear stiffness kappa G A", default=None
    )
    rotary_inertia: Float[Number, " *power"] | None = number(
        "kg m", "mass moment of inertia per length, rho I", default=None
    )
    foundation_stiffness: Float[Number, " *power"] | None = number(
        "N/m^2", "elastic foundation, force per length and deflection", default=None
    )
    loss_factor: Float[Number, ""] | None = number(
        "1", "loss factor of its material", NOT_NEGATIVE, default=None
    )


OPTIONAL = ("shear_stiffness", "rotary_inertia", "foundation_stiffness")
CHECKED_POSITIONS = np.linspace(0, 1, 129)  # in a segment: where its properties are validated
LENGTH_TOLERANCE = 1e-9  # of the length of the beam


def polynomial(coefficients, s) -> Float[Array, "*position"]:
    """Polynomial c_0 + c_1 s + ... at s, of a list of coefficients or one number."""
    coefficients = xp.atleast_1d(coefficients)
    total = xp.zeros(xp.shape(s)) + coefficients[-1]
    for power in range(coefficients.shape[0] - 2, -1, -1):
        total = total * s + coefficients[power]
    return total


def degree(coefficients) -> int:
    """Degree of a polynomial by its list of coefficients."""
    return 0 if coefficients is None else max(xp.size(coefficients), 1) - 1


def polynomial_degree(beam) -> int:
    """Largest degree of any property of any segment."""
    return max(
        max(
            degree(segment.width) + 3 * degree(segment.height),
            *(degree(getattr(segment, name)) for name in OPTIONAL),
            degree(segment.flexural_rigidity),
            degree(segment.mass_per_length),
        )
        for segment in beam.segments or (Segment(),)
    )


def has(beam, name: str) -> bool:
    """Whether the beam or one of its segments has an optional property."""
    return any(getattr(part, name) is not None for part in (beam, *beam.segments))


def segment_edges(beam) -> list:
    """Positions (m) of the edges of the segments, from 0 to the length of the beam."""
    edges = [xp.zeros(())]
    for segment in beam.segments[:-1]:
        edges.append(edges[-1] + segment.length)
    return [*edges, beam.length]


def rigidity(beam, segment: Segment, s) -> Float[Array, "*position"]:
    """Bending stiffness E I (N m^2) at relative positions s, 0 to 1, of a segment."""
    if segment.flexural_rigidity is not None:
        return polynomial(segment.flexural_rigidity, s)
    if segment.width is None and segment.height is None and beam.flexural_rigidity is not None:
        return xp.zeros(xp.shape(s)) + beam.flexural_rigidity
    width, height = _rectangle(beam, segment, s)
    return beam.youngs_modulus * width * height**3 / 12


def mass_per_length(beam, segment: Segment, s) -> Float[Array, "*position"]:
    """Mass per length (kg/m) at relative positions s, 0 to 1, of a segment."""
    if segment.mass_per_length is not None:
        return polynomial(segment.mass_per_length, s)
    if segment.width is None and segment.height is None and beam.mass_per_length is not None:
        return xp.zeros(xp.shape(s)) + beam.mass_per_length
    width, height = _rectangle(beam, segment, s)
    return beam.density * width * height


def optional_property(beam, segment: Segment, name: str, s) -> Float[Array, "*position"]:
    """Shear stiffness, rotary inertia or foundation stiffness at s; zero if there is none."""
    own = getattr(segment, name)
    value = getattr(beam, name) if own is None else own
    return xp.zeros(xp.shape(s)) if value is None else polynomial(value, s)


def _rectangle(beam, segment: Segment, s):
    sizes = (
        getattr(beam if getattr(segment, name) is None else segment, name)
        for name in ("width", "height")
    )
    return [polynomial(size, s) for size in sizes]


def mean(beam, of) -> Float[Array, ""]:
    """Mean over the length of a property, `rigidity` or `mass_per_length`."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    edges, total = segment_edges(beam), xp.zeros(())
    for i, segment in enumerate(beam.segments):
        values = of(beam, segment, (nodes + 1) / 2)
        total = total + (edges[i + 1] - edges[i]) * xp.sum(weights / 2 * values)
    return total / beam.length


def validate_segments(address: str, beam) -> str | None:
    """First inconsistency of the segments of a beam as an error message, or None."""
    name = "shear_stiffness"
    lacking = [i for i, segment in enumerate(beam.segments) if getattr(segment, name) is None]
    if lacking and has(beam, name) and getattr(beam, name) is None:
        return (
            f"{address}.segments.{lacking[0]}.{name} is missing: give it to every segment, or"
            f" {address}.{name} for those without"
        )
    for i, segment in enumerate(beam.segments):
        error = _validate_segment(f"{address}.segments.{i}", beam, segment, i)
        if error is not None:
            return error
    lengths = [segment.length for segment in beam.segments if segment.length is not None]
    if lengths and all(map(is_concrete, (*lengths, beam.length))):
        total, whole = sum(float(concrete(length)) for length in lengths), concrete(beam.length)
        complete = len(lengths) == len(beam.segments)
        if complete and abs(total - whole) > LENGTH_TOLERANCE * whole:
            return (
                f"the lengths of {address}.segments add up to {total:g} m, but {address}.length is"
                f" {whole:g} m; leave out the length of the last segment to let it take the rest"
            )
        if not complete and total >= (1 - LENGTH_TOLERANCE) * whole:
            return (
                f"the lengths of {address}.segments add up to {total:g} m and leave nothing of"
                f" {address}.length, {whole:g} m, for the last segment"
            )
    return None


def _validate_segment(address: str, beam, segment: Segment, index: int) -> str | None:
    if segment.length is None and index < len(beam.segments) - 1:
        return f"{address}.length is missing; give the length in m"
    properties = [("flexural_rigidity", "youngs_modulus"), ("mass_per_length", "density")]
    for name, source in properties:
        resized = segment.width is not None or segment.height is not None
        if getattr(segment, name) is not None:
            continue
        if resized or getattr(beam, name) is None:
            sizes = [
                size
                for size in ("width", "height")
                if getattr(segment, size) is None and getattr(beam, size) is None
            ]
            absent = [f"beam.{source}"] if getattr(beam, source) is None else []
            absent += [f"{address}.{size}" for size in sizes]
            if absent:
                return (
                    f"{address}.{name} is missing; give it, or {' and '.join(absent)}, from which"
                    " it follows"
                )
    positive = [("flexural_rigidity", rigidity), ("mass_per_length", mass_per_length)]
    numbers = [leaf for part in (beam, segment) for leaf in jax.tree.leaves(part)]
    if not all(map(is_concrete, numbers)):
        return None
    for name, of in positive:
        lowest = np.min(concrete(of(beam, segment, CHECKED_POSITIONS)))
        if not lowest > 0:
            return f"{address}.{name} must be positive all along; it falls to {lowest:g}"
    for name in OPTIONAL:
        values = concrete(optional_property(beam, segment, name, CHECKED_POSITIONS))
        if np.min(values) < 0 or (
            name == "shear_stiffness" and has(beam, name) and not np.all(values > 0)
        ):
            least = "positive" if name == "shear_stiffness" else "not negative"
            return f"{address}.{name} must be {least} all along; it falls to {np.min(values):g}"
    return None


SAME_POSITION = 1e-9  # of the length: closer positions are one

# Whether an end condition holds the deflection and the rotation of the end.
END_CONDITIONS = {
    "pinned": (True, False),
    "clamped": (True, True),
    "free": (False, False),
    "guided": (False, True),
}


class Support(ReprWithUnits):
    """Support at a position along a beam, rigid or elastic.

    Without a `stiffness` it holds the deflection rigidly; with one it is a vertical spring.
    Supports enter the modes of the beam, except for their dampers, which couple the modes. A run
    starts at rest on settled supports: see `jaxbeam.model.transfer_matrices`.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(1.2, 12.0, 0.5)
    >>> two_spans = jb.Case(beam, supports=[jb.Support(0.6)])
    >>> print(jb.modes(two_spans).frequencies.round(2)[:2])
    [21.38 33.39]
    """

    position: Float[Number, ""] = number("m", "distance from the left end", ON_BEAM)
    stiffness: Float[Number, ""] | None = number(
        "N/m", "vertical spring; rigid if left out", NOT_NEGATIVE, default=None
    )
    damping: Float[Number, ""] | None = number(
        "N s/m", "vertical damper of an elastic support", NOT_NEGATIVE, default=None
    )
    rotational_stiffness: Float[Number, ""] = number(
        "N m/rad", "spring against rotation", NOT_NEGATIVE, default=0.0
    )
    mass: Float[Number, ""] | None = number(
        "kg", "mass of an elastic bearing that moves with the beam", NOT_NEGATIVE, default=None
    )
    torsional_stiffness: Float[Number, ""] | None = number(
        "N m/rad",
        "spring against twist; if left out, a rigid support holds it and an elastic one does not",
        NOT_NEGATIVE,
        default=None,
    )
    settlement: Float[Number, ""] | None = number(
        "m", "lowering of its foot before the run, positive downwards", default=None
    )


class Beam(ReprWithUnits):
    """Straight beam, by default an Euler-Bernoulli beam of uniform section.

    Give either `flexural_rigidity` and `mass_per_length`, or the rectangular section and material
    `width`, `height`, `youngs_modulus`, `density` (height is measured in the bending direction).

    `segments`, from left to right, make it stepped or tapered; `hinges` lie between its ends. With
    a `shear_stiffness` it is a Timoshenko beam; `rotary_inertia` is that of its sections. A Winkler
    foundation pushes back with `foundation_stiffness` times the deflection. The `axial_force` is
    constant, tension positive, compression negative.

    Damping is modal: one `damping_ratio` for all modes or one for each; or, when
    `rayleigh_damping` is given, proportional to mass and stiffness, D = a M + b K. A `loss_factor`
    eta of hysteretic damping is taken as the equivalent ratio eta / 2 of every mode; those of
    `segments` count by their fraction of the strain energy of each mode. A `material` has the ratio
    of EN 1991-2, table 6.6, for the longest span of the beam.

    With a `torsional_rigidity` G J and a `polar_inertia` it twists, too, by St Venant's law; both
    are constant along it. The axis is then that of the shear centres. Ends that hold the deflection
    and rigid supports hold the twist, as forks. The `modes` are the lowest of all, of bending and
    of torsion; a `mass_eccentricity` couples them.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(0.6, width=0.03, height=0.005, youngs_modulus=69e9, density=2700.0)
    >>> print(f"EI = {beam.bending_stiffness:.2f} N m^2, m = {beam.linear_density:.3f} kg/m")
    EI = 21.56 N m^2, m = 0.405 kg/m
    """

    length: Float[Number, ""] = number("m", "total length", POSITIVE)
    flexural_rigidity: Float[Number, ""] | None = number(
        "N m^2", "bending stiffness E I", POSITIVE, default=None
    )
    mass_per_length: Float[Number, ""] | None = number(
        "kg/m", "mass per length", POSITIVE, default=None
    )
    damping_ratio: Float[Number, " *modes"] = number(
        "1", "modal damping ratio, one for all modes or a list", NOT_NEGATIVE, default=0.0
    )
    ends: str = choice("end conditions, left-right", default="pinned-pinned")
    modes: int = count("number of modes of the supported beam", default=3)
    width: Float[Number, ""] | None = number("m", "section width", POSITIVE, default=None)
    height: Float[Number, ""] | None = number("m", "section height", POSITIVE, default=None)
    youngs_modulus: Float[Number, ""] | None = number(
        "Pa", "Young's modulus", POSITIVE, default=None
    )
    density: Float[Number, ""] | None = number("kg/m^3", "density", POSITIVE, default=None)
    rayleigh_damping: Float[Number, "2"] | None = number(
        "1/s, s", "coefficients a (of mass) and b (of stiffness)", NOT_NEGATIVE, default=None
    )
    shear_stiffness: Float[Number, ""] | None = number(
        "N", "shear stiffness kappa G A; rigid in shear if left out", POSITIVE, default=None
    )
    rotary_inertia: Float[Number, ""] | None = number(
        "kg m", "mass moment of inertia per length, rho I", NOT_NEGATIVE, default=None
    )
    foundation_stiffness: Float[Number, ""] | None = number(
        "N/m^2", "elastic foundation, force per length and deflection", NOT_NEGATIVE, default=None
    )
    loss_factor: Float[Number, ""] | None = number(
        "1", "loss factor of hysteretic damping", NOT_NEGATIVE, default=None
    )
    material: str = choice("material of a bridge, for its damping", "", *MATERIALS, default="")
    axial_force: Float[Number, ""] | None = number(
        "N", "axial force, tension positive", default=None
    )
    torsional_rigidity: Float[Number, ""] | None = number(
        "N m^2", "torsional rigidity G J; no twist if left out", POSITIVE, default=None
    )
    polar_inertia: Float[Number, ""] | None = number(
        "kg m", "mass moment of inertia per length about the axis of twist", POSITIVE, default=None
    )
    mass_eccentricity: Float[Number, ""] | None = number(
        "m", "centre of mass left of the axis of twist, looking right", default=None
    )
    segments: Sequence[Segment] = parts("segments, from left to right", Segment)
    hinges: Sequence[Hinge] = parts("hinges between the ends", Hinge)

    @property
    def bending_stiffness(self) -> Float[Array, ""]:
        """Bending stiffness E I in N m^2, given or from the rectangular section.

        Of segments the mean over the length.
        """
        if self.segments:
            return mean(self, rigidity)
        if self.flexural_rigidity is not None:
            return self.flexural_rigidity
        return self.youngs_modulus * self.width * self.height**3 / 12

    @property
    def linear_density(self) -> Float[Array, ""]:
        """Mass per length in kg/m, given or from section and density; of segments the mean."""
        if self.segments:
            return mean(self, mass_per_length)
        if self.mass_per_length is not None:
            return self.mass_per_length
        return self.density * self.width * self.height

    @property
    def is_uniform(self) -> bool:
        """Whether it is rigid in shear, without segments, hinges, axial force and foundation."""
        others = (self.axial_force, *(getattr(self, name) for name in OPTIONAL))
        return not (self.segments or self.hinges) and all(value is None for value in others)

    @property
    def twists(self) -> bool:
        """Whether it has a torsional rigidity."""
        return self.torsional_rigidity is not None

    @property
    def left_end(self) -> str:
        """End condition at x = 0."""
        return self.ends.split("-")[0]

    @property
    def right_end(self) -> str:
        """End condition at x = length."""
        return self.ends.split("-")[1]

    def validate(self, address: str) -> str | None:
        """First inconsistency between its fields as an error message, or None."""
        ends = self.ends.split("-")
        if len(ends) != 2:
            return (
                f"{address}.ends must name the left and the right end, such as 'pinned-clamped';"
                f" it is {self.ends!r}"
            )
        for end in ends:
            if end not in END_CONDITIONS:
                return (
                    f"{address}.ends: no end is called {end!r}; {suggestion(end, END_CONDITIONS)}"
                )
        if self.segments:
            inconsistent = validate_segments(address, self)
        else:
            inconsistent = self._validate_section(address)
        if inconsistent is not None:
            return inconsistent
        for check in (self._validate_hinges, self._validate_damping, self._validate_torsion):
            inconsistent = inconsistent or check(address)
        return inconsistent

    def _validate_torsion(self, address: str) -> str | None:
        rigidity, inertia, arm = (
            self.torsional_rigidity,
            self.polar_inertia,
            self.mass_eccentricity,
        )
        if (rigidity is None) != (inertia is None):
            absent = "torsional_rigidity" if rigidity is None else "polar_inertia"
            return f"{address}.{absent} is missing; a beam that twists has both G J and its inertia"
        if rigidity is None and arm is not None:
            return (
                f"{address}.mass_eccentricity would have no effect on a beam that does not twist:"
                " give torsional_rigidity and polar_inertia, or leave it out"
            )
        lossy = [i for i, one in enumerate(self.segments) if one.loss_factor is not None]
        if rigidity is not None and lossy:
            return (
                f"{address}.segments.{lossy[0]}.loss_factor is that of bending, and the beam"
                f" twists: give {address}.damping_ratio or {address}.loss_factor for all modes"
            )
        if inertia is None or arm is None or not all(map(is_concrete, jax.tree.leaves(self))):
            return None
        least = float(concrete(self.linear_density)) * float(concrete(arm)) ** 2
        if not concrete(inertia) > least:
            return (
                f"{address}.polar_inertia is about the axis of twist and must exceed that of the"
                f" mass at its eccentricity, {least:g} kg m; it is {concrete(inertia):g} kg m"
            )
        return None

    def _validate_section(self, address: str) -> str | None:
        section = ("width", "height")
        unclear = validate_direct_or_derived(
            address, self, "flexural_rigidity", ("youngs_modulus",), section
        ) or validate_direct_or_derived(address, self, "mass_per_length", ("density",), section)
        if unclear is not None:
            return unclear
        if self.youngs_modulus is None and self.density is None:
            for name in section:
                if getattr(self, name) is not None:
                    return (
                        f"{address}.{name} would have no effect: leave it out, or give"
                        " youngs_modulus and density instead of flexural_rigidity and"
                        " mass_per_length"
                    )
        return None

    def _validate_hinges(self, address: str) -> str | None:
        positions = []
        for i, hinge in enumerate(self.hinges):
            if not (is_concrete(hinge.position) and is_concrete(self.length)):
                return None
            check_on_beam(f"{address}.hinges.{i}.position", hinge.position, self.length)
            position, length = float(concrete(hinge.position)), float(concrete(self.length))
            margin = SAME_POSITION * length
            if not margin < position < length - margin:
                return (
                    f"{address}.hinges.{i} is at an end of the beam, at {position:g} m; write"
                    f" {address}.ends = 'pinned-pinned', say, for an end that turns"
                )
            if any(abs(position - other) < margin for other in positions):
                return f"{address}.hinges.{i} is at the position of another, {position:g} m"
            positions.append(position)
        return None

    def _validate_damping(self, address: str) -> str | None:
        ratio_shape = np.shape(self.damping_ratio)
        if ratio_shape and ratio_shape != (self.modes,):
            return (
                f"{address}.damping_ratio lists {counted(ratio_shape[0], 'value')} for"
                f" {self.modes} modes; give one for each mode, or a single number for all"
            )
        given = []
        if is_concrete(self.damping_ratio) and concrete(self.damping_ratio).any():
            given.append("damping_ratio")
        for name in ("rayleigh_damping", "loss_factor", "material"):
            value = getattr(self, name)
            if value is not None and not (isinstance(value, str) and not value):
                given.append(name)
        lossy = [i for i, one in enumerate(self.segments) if one.loss_factor is not None]
        if lossy and "loss_factor" not in given:
            given.append(f"segments.{lossy[0]}.loss_factor")
        if len(given) > 1:
            return f"{address} has both {given[0]} and {given[1]}; leave one out"
        return None
