"""Beam and supports: section, material, modal damping, end conditions."""

import numpy as np
from jaxtyping import Float

from jaxbeam.case.beam_parts.damping import MATERIALS
from jaxbeam.case.beam_parts.hinge import Hinge
from jaxbeam.case.beam_parts.properties import (
    OPTIONAL,
    mass_per_length,
    mean,
    rigidity,
    validate_segments,
)
from jaxbeam.case.beam_parts.segment import Segment
from jaxbeam.case.declared_checks import check_on_beam, suggestion, validate_direct_or_derived
from jaxbeam.case.display.parts import ReprWithUnits
from jaxbeam.case.fields import (
    NOT_NEGATIVE,
    ON_BEAM,
    POSITIVE,
    choice,
    concrete,
    count,
    is_concrete,
    number,
    parts,
)
from jaxbeam.runtime.arrays import Array

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
    starts at rest on settled supports: see `jaxbeam.model.settlement`.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(1.2, 12.0, 0.5)
    >>> two_spans = jb.Case(beam, supports=[jb.Support(0.6)])
    >>> print(jb.modes(two_spans).frequencies.round(2)[:2])
    [21.38 33.39]
    """

    position: Float[Array, ""] = number("m", "distance from the left end", ON_BEAM)
    stiffness: Float[Array, ""] | None = number(
        "N/m", "vertical spring; rigid if left out", NOT_NEGATIVE, default=None
    )
    damping: Float[Array, ""] | None = number(
        "N s/m", "vertical damper of an elastic support", NOT_NEGATIVE, default=None
    )
    rotational_stiffness: Float[Array, ""] = number(
        "N m/rad", "spring against rotation", NOT_NEGATIVE, default=0.0
    )
    mass: Float[Array, ""] | None = number(
        "kg", "mass of an elastic bearing that moves with the beam", NOT_NEGATIVE, default=None
    )
    settlement: Float[Array, ""] | None = number(
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
    `segments` count by their shares of the strain energy of each mode. A `material` has the ratio
    of EN 1991-2, table 6.6, for the longest span of the beam.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(0.6, width=0.03, height=0.005, youngs_modulus=69e9, density=2700.0)
    >>> print(f"EI = {beam.bending_stiffness:.2f} N m^2, m = {beam.linear_density:.3f} kg/m")
    EI = 21.56 N m^2, m = 0.405 kg/m
    """

    length: Float[Array, ""] = number("m", "total length", POSITIVE)
    flexural_rigidity: Float[Array, ""] | None = number(
        "N m^2", "bending stiffness E I", POSITIVE, default=None
    )
    mass_per_length: Float[Array, ""] | None = number(
        "kg/m", "mass per length", POSITIVE, default=None
    )
    damping_ratio: Float[Array, " *modes"] = number(
        "1", "modal damping ratio, one for all modes or a list", NOT_NEGATIVE, default=0.0
    )
    ends: str = choice("end conditions, left-right", default="pinned-pinned")
    modes: int = count("number of modes of the supported beam", default=3)
    width: Float[Array, ""] | None = number("m", "section width", POSITIVE, default=None)
    height: Float[Array, ""] | None = number("m", "section height", POSITIVE, default=None)
    youngs_modulus: Float[Array, ""] | None = number(
        "Pa", "Young's modulus", POSITIVE, default=None
    )
    density: Float[Array, ""] | None = number("kg/m^3", "density", POSITIVE, default=None)
    rayleigh_damping: Float[Array, "2"] | None = number(
        "1/s, s", "coefficients a (of mass) and b (of stiffness)", NOT_NEGATIVE, default=None
    )
    shear_stiffness: Float[Array, ""] | None = number(
        "N", "shear stiffness kappa G A; rigid in shear if left out", POSITIVE, default=None
    )
    rotary_inertia: Float[Array, ""] | None = number(
        "kg m", "mass moment of inertia per length, rho I", NOT_NEGATIVE, default=None
    )
    foundation_stiffness: Float[Array, ""] | None = number(
        "N/m^2", "elastic foundation, force per length and deflection", NOT_NEGATIVE, default=None
    )
    loss_factor: Float[Array, ""] | None = number(
        "1", "loss factor of hysteretic damping", NOT_NEGATIVE, default=None
    )
    material: str = choice("material of a bridge, for its damping", "", *MATERIALS, default="")
    axial_force: Float[Array, ""] | None = number(
        "N", "axial force, tension positive", default=None
    )
    segments: tuple[Segment, ...] = parts("segments, from left to right", Segment)
    hinges: tuple[Hinge, ...] = parts("hinges between the ends", Hinge)

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
        """Whether it has a uniform section, rigid in shear, without anything that this excludes."""
        others = (self.axial_force, *(getattr(self, name) for name in OPTIONAL))
        return not (self.segments or self.hinges) and all(value is None for value in others)

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
        return self._validate_hinges(address) or self._validate_damping(address)

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
                f"{address}.damping_ratio lists {ratio_shape[0]} values for {self.modes} modes;"
                " give one for each mode, or a single number for all"
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
