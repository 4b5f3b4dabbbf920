"""Pedestrian streams on footbridges: equivalent numbers, accelerations of modes, comfort classes.

A stream of n people with random paces has the effect of n' people in step, spread over the deck and
in the direction of a mode shape (HIVOSS 2008, and clause 7.3.3.5 of CSA S7),

    n' = 10.8 sqrt(zeta n)  below 1 person/m^2,     n' = 1.85 sqrt(n)  from there on,

each with a force P cos(2 pi f t) at the frequency f of the mode, so that the largest acceleration
of a mass-normalised shape psi is

    a = max|psi| integral of p |psi| dx / (2 zeta),      p = P n' / L  (N/m).

P is that of the harmonic of the pace which is nearest to f; the pace is 2.188 - 0.644 d + 0.099 d^2
Hz at a density d (CSA S7, 7.3.3.3). Lateral streams, in which people fall in step with the bridge,
are not in the model.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete, suggestion
from jaxbeam.model.modes import modes
from jaxbeam.runtime.printer import TableViews

DENSITIES = {"TC2": 0.2, "TC3": 0.5, "TC4": 1.0, "TC5": 1.5}  # people/m^2 of traffic classes
COMFORT = {"CL1": 0.5, "CL2": 1.0, "CL3": 2.5}  # m/s^2, largest vertical acceleration of a class
FORCE = 280.0  # N, first harmonic of a person: 0.4 of 700 N
# Of the first five harmonics, 0.4, 0.1, 0.042, 0.041 and 0.027 of the weight, over the first.
# The one open text of the clause has 0.42 for the third, above the first: taken for 0.042.
HARMONICS = 1.0, 0.25, 0.105, 0.1025, 0.0675
DENSE = 1.0  # people/m^2: density from which on paces are no longer free
POINTS = 2001  # along the beam, of the integral of a shape


@dataclasses.dataclass(frozen=True, repr=False)  # a table
class StreamResponse(TableViews):
    """Largest accelerations (m/s^2) of modes in resonance with a stream, and frequencies (Hz).

    `equivalent` is the number of people in step of each mode, as it depends on the damping.
    """

    frequencies: Float[np.ndarray, " mode"]
    equivalent: Float[np.ndarray, " mode"]
    accelerations: Float[np.ndarray, " mode"]

    @property
    def comfort(self) -> tuple[str, ...]:
        """Comfort class of each mode, "" beyond the last."""
        return tuple(comfort_class(float(one)) for one in self.accelerations)

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """Frequency, people in step, acceleration and comfort class of each mode, by head."""
        return {
            "frequency (Hz)": self.frequencies,
            "people in step": self.equivalent,
            "acceleration (m/s^2)": self.accelerations,
            "comfort class": np.array(self.comfort),
        }


def comfort_class(acceleration: float) -> str:
    """Comfort class of a vertical acceleration (m/s^2): CL1, CL2, CL3, or "" beyond.

    >>> from jaxbeam.analysis.footbridges import comfort_class
    >>> print(comfort_class(0.7))
    CL2
    """
    return next((name for name, limit in COMFORT.items() if acceleration <= limit), "")


def harmonic_fractions(
    frequencies: Float[np.ndarray, " mode"], density: float
) -> Float[np.ndarray, " mode"]:
    """Forces of people at some frequencies (Hz), as fractions of their first harmonic.

    Each is that of the harmonic of the pace at the `density` (people/m^2) which is nearest; 0 below
    half the pace, and beyond the fifth harmonic.

    >>> import numpy as np
    >>> from jaxbeam.analysis.footbridges import harmonic_fractions
    >>> print(harmonic_fractions(np.array([0.5, 2.0, 4.2, 12.0]), 0.5))
    [0.   1.   0.25 0.  ]
    """
    pace = 2.188 - 0.644 * density + 0.099 * density**2
    harmonic = np.rint(frequencies / pace).astype(int)
    return np.array([0.0, *HARMONICS, 0.0])[np.minimum(harmonic, len(HARMONICS) + 1)]


def stream_response(
    case: Case, density: float | str, width: float, reduction=None, force: float = FORCE
) -> StreamResponse:
    """Accelerations of the modes of a footbridge under a stream of people on the whole deck.

    `density` is one of `DENSITIES`, or people/m^2; `width` that of the deck (m). `reduction`, one
    number or one for each mode, is the fraction of `force` (N), that of the first harmonic, at its
    frequency; 0 leaves a mode out. If left out, it is that of the nearest harmonic
    (`harmonic_fractions`). Each mode is taken by itself, in resonance, on the beam without the mass
    of the people. Raises ValueError for an unknown class and for numbers that are not positive.

    >>> import jaxbeam as jb
    >>> from jaxbeam.analysis.footbridges import stream_response
    >>> bridge = jb.Case(jb.Beam(40.0, 10.4e9, 2500.0, damping_ratio=0.005, modes=1))
    >>> found = stream_response(bridge, "TC3", width=3.0)
    >>> print(f"{found.equivalent[0]:.2f} in step, {found.accelerations[0]:.2f} m/s^2")
    5.92 in step, 2.11 m/s^2
    """
    if isinstance(density, str):
        if density not in DENSITIES:
            raise ValueError(
                f"there is no traffic class {density!r}; {suggestion(density, DENSITIES)}"
            )
        density = DENSITIES[density]
    for name, value in (("density", density), ("width", width), ("force", force)):
        if not 0 < value < np.inf:
            raise ValueError(f"{name} must be positive, not {value:g}")
    found, length = modes(case), float(concrete(case.beam.length))
    ratios = np.asarray(found.damping_ratios)
    people = density * width * length
    free = 10.8 * np.sqrt(ratios * people)
    equivalent = free if density < DENSE else np.full(ratios.shape, 1.85 * np.sqrt(people))
    x = np.linspace(0.0, length, POINTS)
    shapes = np.abs(np.asarray(found.shapes(x)))  # mass-normalised, (position, mode)
    if reduction is None:
        reduction = harmonic_fractions(np.asarray(found.frequencies), density)
    load = np.asarray(reduction) * force * equivalent / length
    pushed = load * np.trapezoid(shapes, x, axis=0)
    accelerations = pushed * shapes.max(axis=0) / (2 * ratios)
    return StreamResponse(np.asarray(found.frequencies), equivalent, accelerations)
