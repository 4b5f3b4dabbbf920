"""Statically corrected deflection of a record."""

from jaxtyping import Float

from jaxbeam.model.static_correction import corrected_history
from jaxbeam.runtime.arrays import Array
from jaxbeam.simulation.record import Record


def corrected_deflection(record: Record, x, derivative: int = 0) -> Float[Array, "time *position"]:
    """Statically corrected history of a record's deflection at x (m), in m.

    Sum of the modes, plus the residual of the modes under the forces of each instant (see
    `corrected_history`); `derivative` (up to 3) gives that x-derivative instead. Accurate where
    forces and commands change slowly compared with the first truncated mode.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> case = jb.Case(
    ...     beam, sensors=[jb.Sensor(0.3)], loads=[jb.MovingMass(mass=0.5, speed=2.0)]
    ... )
    >>> print(jb.sections.corrected_deflection(jb.simulate(case), 0.3).shape)
    (1001,)
    """
    return corrected_history(record.case, record.modes, record.motion, x, derivative)
