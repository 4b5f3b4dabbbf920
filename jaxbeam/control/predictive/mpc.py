"""Model predictive control, chapter 7 of the thesis: settings of a case file.

    J = sum of weight |y|^2 over the horizon + sum of move_weight |du|^2 over the moves

with y the deflections at some positions, eq. (7.6), subject to limits and rate limits of the
actuators, eq. (7.28). The first move is applied; the problem is solved again at the next sample.
"""

from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

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
from jaxbeam.control.predictive.mpc_law import MPCLaw, command_limits, output_weights
from jaxbeam.control.predictive.prediction import (
    incremental_model,
    move_basis,
    move_maps,
    predict,
    repeat_plant,
    sampled_plant,
)
from jaxbeam.control.predictive.preview import preview
from jaxbeam.control.predictive.qp import METHODS
from jaxbeam.control.state_controller import AbstractStateController, deflection_rows
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.riccati import dare
from jaxbeam.runtime.arrays import Array, xp


class MPC(AbstractStateController):
    """Model predictive control, eqs (7.1) to (7.30) of the thesis; it needs a period.

    Controlled are the deflections at `positions`, at the sensors if left out, `horizon` periods
    ahead, by `moves` moves; with a `laguerre_pole` the moves extend over the horizon and are
    combinations of as many Laguerre functions. The part of the last change of the state that the
    model does not explain is assumed to persist: this is the incremental form (7.1), which removes
    the steady deflection under constant loads. With loads "known" their weights are fed forward
    along their way, those of later loads included, and only the rest is assumed to persist; a
    "time-varying" prediction includes their masses too, with new F and Phi at each sample.
    Vehicles are predicted with their states: with loads "known" or a "time-varying" prediction the
    forces of their springs, which deflection and profile change, are those to come. The delay is
    part of the prediction.

    Limits and rate limits of each actuator are kept; a `soft_limit` on deflections is exceeded
    where that costs less, at `soft_weight` times the square of the excess. A `hard_limit` is kept
    in every predicted period; where no commands keep it there is no solution. With the `terminal`
    cost "riccati" the regulator of the unloaded plant is assumed to act after the horizon, eq.
    (7.31). `solver` is the method for the quadratic program; "unconstrained" is the law (7.9),
    clipped by the actuators only. Where no solution is found the last command is held, and the
    record counts a failure.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.MPC(horizon=4, moves=2, move_weight=1e-9, period=0.005),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.090 mm
    """

    kind: ClassVar[str] = "mpc"

    horizon: int = count("periods of the prediction")
    moves: int = count("moves, or Laguerre functions, for each actuator")
    move_weight: Float[Array, " *actuator"] = number(
        "m^2/unit of a command^2", "weight of the square of each move, r_w", POSITIVE
    )
    output_weight: Float[Array, " *output"] | None = number(
        "1", "weight of the square of each deflection; 1 if left out", NOT_NEGATIVE, default=None
    )
    horizon_weight: Float[Array, " period"] | None = number(
        "1", "weight of each period of the prediction; 1 if left out", NOT_NEGATIVE, default=None
    )
    positions: Float[Array, " position"] | None = number(
        "m", "positions of the controlled deflections", ON_BEAM, default=None
    )
    soft_limit: Float[Array, " *output"] | None = number(
        "m", "soft limit of each deflection", POSITIVE, default=None
    )
    soft_weight: Float[Array, ""] = number(
        "1", "weight of the square of the excess over a soft limit", POSITIVE, default=1e4
    )
    hard_limit: Float[Array, " *output"] | None = number(
        "m", "limit of each deflection that predictions must keep", POSITIVE, default=None
    )
    loads: str = choice(
        "weights of the loads in the prediction", "ignored", "known", default="ignored"
    )
    prediction: str = choice(
        "plant in the prediction", "time-invariant", "time-varying", default="time-invariant"
    )
    laguerre_pole: Float[Array, ""] | None = number(
        "1", "pole of Laguerre functions, 0 to 1", NOT_NEGATIVE, default=None
    )
    terminal: str = choice("cost after the horizon", "none", "riccati", default="none")
    solver: str = choice(
        "method for the quadratic program", *METHODS, "unconstrained", default="interior"
    )

    @property
    def design_depends_on_loads(self) -> bool:
        return True

    def validate(self, case):
        outputs = len(case.sensors) if self.positions is None else self.positions.shape[0]
        sizes = {
            "move_weight": ((), (len(case.actuators),)),
            "output_weight": ((), (outputs,)),
            "horizon_weight": ((self.horizon,),),
            "soft_limit": ((), (outputs,)),
            "hard_limit": ((), (outputs,)),
        }
        if self.period is None:
            return "period must be given: predictive control acts at samples"
        excess_delay = None if self.delay is None else self.delay - self.period
        if excess_delay is not None and is_concrete(excess_delay) and concrete(excess_delay) >= 0:
            return (
                "delay must be less than the period: the prediction allows for one pending command"
            )
        if self.moves > self.horizon:
            return f"moves must be at most the horizon, {self.horizon}, not {self.moves}"
        if outputs == 0:
            return "positions must be given where there are no sensors"
        for name, allowed in sizes.items():
            value = getattr(self, name)
            if value is not None and value.shape not in allowed:
                allowed_sizes = " or ".join(
                    "one number" if not s else f"{s[0]} entries" for s in allowed
                )
                return f"{name} must have {allowed_sizes}, not {value.size}"
        pole = self.laguerre_pole
        if pole is not None and is_concrete(pole) and concrete(pole) >= 1:
            return f"laguerre_pole must be below 1, not {concrete(pole):g}"
        if self.loads == "known" and not case.loads:
            return "loads must be 'ignored' where there are none"
        if self.terminal == "riccati" and outputs > len(case.actuators):
            return (
                f"terminal must be 'none': {len(case.actuators)} actuators cannot bring"
                f" {outputs} deflections to zero, so that the cost after the horizon is infinite"
            )
        return super().validate(case)

    def design_state_law(self, plant, design_plant):
        actuators, system = plant.case.actuators, design_plant.unloaded
        sampled = sampled_plant(
            system.A, system.B, xp.zeros((system.A.shape[0], 0)), self.period, self.delay
        )
        states = sampled.A.shape[0]
        positions = design_plant.case.sensor_positions if self.positions is None else self.positions
        C = deflection_rows(design_plant, positions)
        beam, loaded_plant = C.shape[1], self._loaded_plant(design_plant)
        C = xp.pad(C, ((0, 0), (0, states - beam)))  # the delay adds states
        vehicles = 0 if loaded_plant is None else loaded_plant.vehicle_states
        basis = move_basis(self.horizon, self.moves, self.laguerre_pole)
        maps = move_maps(basis, len(actuators))
        weights = output_weights(self.horizon, C.shape[0], self.horizon_weight, self.output_weight)
        # After the last of plain moves commands stay, and with them the limits are kept.
        limited_periods = self.horizon if self.laguerre_pole is not None else self.moves
        return MPCLaw(
            sampled_plant=sampled,
            prediction=predict(repeat_plant(sampled, self.horizon), C, maps, xp.zeros(0)),
            C=_with_vehicles(C, beam, vehicles, 1),
            move_maps=maps,
            limits=command_limits(actuators, maps[:limited_periods], self.period),
            output_weights=weights,
            move_weights=xp.broadcast_to(self.move_weight, (len(actuators),)),
            soft_limit=self.soft_limit,
            soft_weight=self.soft_weight,
            hard_limit=self.hard_limit,
            terminal_cost=self._terminal_cost(sampled, C, weights, vehicles),
            preview=loaded_plant and preview(loaded_plant, self.period, self.delay),
            delayed=self.delay is not None,
            known_weights=self.loads == "known",
            solver=self.solver,
        )

    def _loaded_plant(self, design_plant: Plant) -> Plant | None:
        """Plant of predictions that vary with time, or None; its wheels may be massless."""
        if self.prediction == "time-varying":
            return design_plant
        if self.loads == "ignored":
            return None
        return eqx.tree_at(
            lambda m: m.loads.wheels.inertia,
            design_plant,
            replace_fn=lambda inertia: np.zeros(inertia.shape),
        )

    def _terminal_cost(self, sampled, C, weights, vehicles):
        """P of the terminal cost, of the incremental model under its regulator, or None.

        States of vehicles have no cost of their own.
        """
        if self.terminal == "none":
            return None
        A, B, output_rows = incremental_model(sampled.A, sampled.B, C)
        Q = output_rows.T @ (weights[-1, :, None] * output_rows)
        P = dare(A, B, Q, xp.diag(xp.broadcast_to(self.move_weight, B.shape[1])))
        beam = sampled.A.shape[0] - (0 if self.delay is None else B.shape[1])
        return _with_vehicles(_with_vehicles(P, beam, vehicles, 0), beam, vehicles, 1)


def _with_vehicles(matrix, beam: int, count: int, axis: int):
    """A matrix with zeros for the states of vehicles after the `beam` ones, along an axis."""
    before, after = xp.split(matrix, [beam], axis=axis)
    zeros = xp.zeros_like(xp.take(matrix, np.zeros(count, int), axis=axis))
    return xp.concatenate([before, zeros, after], axis=axis)
