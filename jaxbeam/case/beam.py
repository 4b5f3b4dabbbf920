"""Beam and supports: section, material, modal damping, end conditions."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.declared_checks import suggestion, validate_direct_or_derived
from jaxbeam.case.fields import (
    NOT_NEGATIVE,
    ON_BEAM,
    POSITIVE,
    choice,
    concrete,
    count,
    is_concrete,
    number,
)
from jaxbeam.runtime.arrays import Array

MAX_MODES = 1000  # more modes would take minutes to compute

# Whether an end condition holds the deflection and the rotation of the end.
END_CONDITIONS = {
    "pinned": (True, False),
    "clamped": (True, True),
    "free": (False, False),
    "guided": (False, True),
}


class Support(eqx.Module):
    """Support at a position along a beam, rigid or elastic.

    Without a `stiffness` it holds the deflection rigidly; with one it is a vertical spring.
    Supports enter the modes of the beam, except for their dampers, which couple the modes.
    """

    position: Float[Array, ""] = number("m", "distance from the left end", ON_BEAM)
    stiffness: Float[Array, ""] | None = number(
        "N/m", "vertical spring; rigid if left out", NOT_NEGATIVE, default=None
    )
    damping: Float[Array, ""] = number("N s/m", "vertical damper", NOT_NEGATIVE, default=0.0)
    rotational_stiffness: Float[Array, ""] = number(
        "N m/rad", "spring against rotation", NOT_NEGATIVE, default=0.0
    )


class Beam(eqx.Module):
    """Straight Euler-Bernoulli beam of uniform section.

    Give either `flexural_rigidity` and `mass_per_length`, or the rectangular section and material
    `width`, `height`, `youngs_modulus`, `density` (height is measured in the bending direction).

    Damping is modal: one `damping_ratio` for all modes or one for each; or, when
    `rayleigh_damping` is given, proportional to mass and stiffness, D = a M + b K.
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

    @property
    def bending_stiffness(self) -> Float[Array, ""]:
        """Bending stiffness E I in N m^2, given or from the rectangular section."""
        if self.flexural_rigidity is not None:
            return self.flexural_rigidity
        return self.youngs_modulus * self.width * self.height**3 / 12

    @property
    def linear_density(self) -> Float[Array, ""]:
        """Mass per length in kg/m, given or from section and density."""
        if self.mass_per_length is not None:
            return self.mass_per_length
        return self.density * self.width * self.height

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
        if self.modes > MAX_MODES:
            return f"{address}.modes must not exceed {MAX_MODES}; it is {self.modes}"
        return self._validate_damping(address)

    def _validate_damping(self, address: str) -> str | None:
        ratio_shape = np.shape(self.damping_ratio)
        if ratio_shape and ratio_shape != (self.modes,):
            return (
                f"{address}.damping_ratio lists {ratio_shape[0]} values for {self.modes} modes;"
                " give one for each mode, or a single number for all"
            )
        both_given = self.rayleigh_damping is not None and is_concrete(self.damping_ratio)
        if both_given and concrete(self.damping_ratio).any():
            return f"{address} has both damping_ratio and rayleigh_damping; leave one out"
        return None
