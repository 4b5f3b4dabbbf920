"""Linear-quadratic regulators: their weights, and the time-invariant one.

    J = x(end)' F x(end) + integral of x'Qx + u'Ru,     u = -K x        (thesis, eqs 3.3 and 3.7)

The weights are those of the states of the design plant in the chosen coordinates.
"""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.fields import NOT_NEGATIVE, ON_BEAM, POSITIVE, concrete, number
from jaxbeam.control.optimal.sampling_loss import warn_slow_sampling
from jaxbeam.control.state_controller import AbstractStateController, deflection_rows
from jaxbeam.control.state_law import GainLaw
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.riccati import lqr
from jaxbeam.runtime.arrays import Array, xp


class AbstractRegulator(AbstractStateController):
    """Settings of a linear-quadratic regulator: its weights.

    `state_weight` is the diagonal of Q, `command_weight` that of R. Deflections at `positions` are
    weighted too, eq. (3.2) of the thesis. `feedback` is the share of each state that is fed back
    (1 or 0; all if left out); the gain is designed for all of them.
    """

    state_weight: Float[Array, " state"] = number(
        "1/unit of the state^2", "weight of each state", NOT_NEGATIVE
    )
    command_weight: Float[Array, " actuator"] = number(
        "1/unit of a command^2", "weight of each command", POSITIVE
    )
    positions: Float[Array, " position"] | None = number(
        "m", "positions of weighted deflections", ON_BEAM, default=None
    )
    position_weight: Float[Array, " position"] | None = number(
        "1/m^2", "weight of the deflection at each position", NOT_NEGATIVE, default=None
    )
    feedback: Float[Array, " state"] | None = number(
        "1", "share of each state that is fed back", default=None
    )

    def sizes(self, case) -> dict[str, int]:
        """Required number of entries of each list, by name."""
        states = self.state_count(case)
        return {"state_weight": states, "command_weight": len(case.driven), "feedback": states}

    def validate(self, case):
        for name, size in self.sizes(case).items():
            value = getattr(self, name)
            if value is not None and value.shape[0] != size:
                return f"{name} must have {size} entries, not {value.shape[0]}"
        if (self.positions is None) != (self.position_weight is None):
            return "positions and position_weight belong together; give both or neither"
        if self.positions is not None and self.positions.shape != self.position_weight.shape:
            return "position_weight must have an entry for each of the positions"
        return super().validate(case)

    def warn(self, system, case):
        warn_slow_sampling(system, float(concrete(self.period)), float(concrete(case.run.duration)))

    def weights(self, plant: Plant) -> tuple[Float[Array, "state state"], Float[Array, "..."]]:
        """Q (state, state) and R (command, command) for the states of a plant."""
        Q = xp.diag(self.state_weight)
        if self.positions is not None:
            rows = deflection_rows(plant, self.positions)
            Q = Q + rows.T @ (self.position_weight[:, None] * rows)
        return Q, xp.diag(self.command_weight)

    @property
    def feedback_shares(self) -> Float[Array, " state"]:
        """Share of each state that is fed back."""
        return xp.ones_like(self.state_weight) if self.feedback is None else self.feedback

    def time_invariant_gain(self, plant: Plant) -> Float[Array, "actuator state"]:
        """Gain of the regulator for a plant without its loads, eq. (5.7) of the thesis."""
        system = plant.unloaded
        return lqr(system.A, system.B, *self.weights(plant))[0]


class LQR(AbstractRegulator):
    """Time-invariant regulator for the plant without loads, eq. (5.7) of the thesis.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.LQR(state_weight=[1e6, 1.0], command_weight=[1e-2], period=0.005),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.914 mm
    """

    kind: ClassVar[str] = "lqr"

    def design_state_law(self, plant, design_plant):
        return GainLaw(self.time_invariant_gain(design_plant) * self.feedback_shares)
