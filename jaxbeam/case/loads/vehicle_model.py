"""Vehicle: bodies on springs and dampers whose wheels roll on the beam.

The heights u of the degrees of freedom, positive upwards, are measured from static equilibrium on a
level surface. With the height y of the surface under each wheel (deflection plus profile), the
force of a wheel on the surface, positive in compression, and the motion of the vehicle are

    F = P + k (y - N u) + c (y' - N u') + m y'',
    M u'' + C u' + K u = N^T (k (y - N u) + c (y' - N u')),

with static wheel loads P, contact stiffness k and damping c, the unsprung mass m that follows the
surface, and N u the heights above the wheels. A mass has no degree of freedom, and k = c = 0.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.runtime.arrays import Array, cholesky, solve, xp
from jaxbeam.runtime.module import Module


class VehicleModel(Module):
    """Matrices of one vehicle: equations of motion, and what its wheels do to the surface.

    `offsets` are the distances (m) of the wheels behind the first one. Wheels have static loads P
    (N), unsprung masses m (kg), and k (N/m) and c (N s/m) of the springs between surface and
    vehicle. M, C, K belong to the vehicle without these; `wheel_map` is N. `names` are those of the
    degrees of freedom: heights in m, and pitch angles in rad where the name ends in "pitch".
    """

    offsets: Float[Array, " wheel"]
    static_loads: Float[Array, " wheel"]
    wheel_masses: Float[Array, " wheel"]
    contact_stiffness: Float[Array, " wheel"]
    contact_damping: Float[Array, " wheel"]
    mass: Float[Array, "dof dof"]
    damping: Float[Array, "dof dof"]
    stiffness: Float[Array, "dof dof"]
    wheel_map: Float[Array, "wheel dof"]
    names: tuple[str, ...] = eqx.field(static=True)

    @property
    def full_stiffness(self) -> Float[Array, "dof dof"]:
        """Stiffness (N/m) of the vehicle on a rigid surface."""
        contact = self.contact_stiffness[:, None] * self.wheel_map
        return self.stiffness + self.wheel_map.T @ contact

    @property
    def full_damping(self) -> Float[Array, "dof dof"]:
        """Damping (N s/m) of the vehicle on a rigid surface."""
        contact = self.contact_damping[:, None] * self.wheel_map
        return self.damping + self.wheel_map.T @ contact

    def natural_frequencies(self) -> Float[Array, " dof"]:
        """Undamped natural frequencies (Hz) on a rigid surface, ascending.

        det(K - (2 pi f)^2 M) = 0 with the springs of the wheels in K.
        """
        if not self.names:
            return xp.zeros(0)
        half_solved = solve(factor := cholesky(self.mass), self.full_stiffness)
        scaled = solve(factor, half_solved.T)
        values = xp.linalg.eigvalsh((scaled + scaled.T) / 2)
        return xp.sqrt(xp.maximum(values, 0.0)) / (2 * np.pi)


def plain_wheels(
    static_loads: Float[Array, "*wheel"],
    masses: Float[Array, "*wheel"],
    offsets: Float[Array, " wheel"] | None = None,
) -> VehicleModel:
    """Wheels without a vehicle above them: forces (N) and masses (kg) that follow the surface."""
    static_loads, masses = xp.reshape(static_loads, -1), xp.reshape(masses, -1)
    wheels = static_loads.shape[0]
    none, nothing = xp.zeros(wheels), np.zeros((0, 0))
    offsets = none if offsets is None else offsets
    matrices = nothing, nothing, nothing, np.zeros((wheels, 0))
    return VehicleModel(offsets, static_loads, masses, none, none, *matrices, ())
