"""Forces of the steps of a person, as harmonics of the pace.

    F(t) = G (1 + sum over i of a_i sin(2 pi i f (t - t_0) + phase_i))

with the weight G (N), the pace f (Hz, steps a second), the time t_0 of a step, and the dynamic load
factors a_i, the amplitudes as shares of the weight.

Walking: the design factors of Young (2001) and CCIP-016, as coded in StructuralDesignKit_Holz,
Vibrations - Legacy.cs (github.com/knippershelbig, commit 3b7def4):

    a_1 = 0.41 (f - 0.95), at most 0.56;    a_2 = 0.069 + 0.0056 (2 f);
    a_3 = 0.033 + 0.0064 (3 f);             a_4 = 0.013 + 0.0065 (4 f),

whose phases are not given there: zero. Jogging: half-sine pulses of the contact time t_c, in which
the mean force is the weight (Bachmann and Ammann 1987), whose Fourier series has

    a_i = 2 cos(pi u) / (1 - (2 u)^2),    phase_i = pi / 2 - pi u,    u = i f t_c,

with t_0 the time at which a foot comes down, and t_c = 1.8 s f^-2.05 (f in Hz) if it is not given
(Rebelo, Negrao and Rigueiro 2005, figure 2, as coded in EC1_pedestrian_load_models.py of
github.com/xcfem/xc, commit 25a7afe; the factors of that file are not those of a half-sine).
"""

import numpy as np
from jaxtyping import Float

from jaxbeam.runtime.arrays import Array, xp

WEIGHT = 700.0  # N, of the reference pedestrian of prEN 1991-2, annex X, as coded in xcfem/xc
LEAST_WALKING_PACE = 0.95  # Hz, at which the first factor of walking is zero

Factors = Float[Array, "*person harmonic"]


def walking_factors(pace: Float[Array, "*person"]) -> Factors:
    """Dynamic load factors a_1 to a_4 of walking at a pace (Hz); see the module."""
    first = xp.clip(0.41 * (pace - LEAST_WALKING_PACE), 0.0, 0.56)
    further = 0.069 + 0.0056 * 2 * pace, 0.033 + 0.0064 * 3 * pace, 0.013 + 0.0065 * 4 * pace
    return xp.stack([first, *further], axis=-1)


def contact_time(pace: Float[Array, "*person"]) -> Float[Array, "*person"]:
    """Time (s) for which a foot of a jogger is on the ground, at a pace (Hz)."""
    return 1.8 * pace**-2.05


def jogging_factors(
    pace: Float[Array, "*person"], contact: Float[Array, "*person"], harmonics: int
) -> tuple[Factors, Factors]:
    """Dynamic load factors of half-sine pulses, and their phases (rad); see the module.

    `contact` is the contact time (s).
    """
    u = xp.asarray((pace * contact)[..., None] * np.arange(1, harmonics + 1))
    # cos(pi u) / (1 - 4 u^2), which is finite at u = 1/2 too.
    factors = np.pi / 2 * (xp.sinc(u - 0.5) + xp.sinc(u + 0.5))
    return factors, xp.asarray(np.pi / 2 - np.pi * u)
