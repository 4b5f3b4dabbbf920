"""Damping ratios of bridges by material, and equivalents of hysteretic and Rayleigh damping."""

from typing import NamedTuple

from jaxtyping import Float

from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.runtime.arrays import Array, xp

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

    >>> import jaxbeam as jb
    >>> print(jb.rayleigh_coefficients([2.0, 8.0], [0.01, 0.01]).round(6))
    [0.201062 0.000318]
    """
    omega, ratios = 2 * xp.pi * xp.asarray(frequencies, float), xp.asarray(ratios, float)
    if omega.shape != (2,) or ratios.shape != (2,):
        raise ValueError("give two frequencies in Hz and two damping ratios")
    if is_concrete(omega) and concrete(omega)[0] == concrete(omega)[1]:
        raise ValueError(f"the two frequencies must differ; both are {frequencies[0]:g} Hz")
    matrix = xp.stack([1 / (2 * omega), omega / 2], axis=-1)
    return xp.linalg.solve(matrix, ratios)
