"""Regulator with integral action: readings reach their references under unknown loads."""

from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.controller import ControlStep
from jaxbeam.case.fields import POSITIVE, concrete, is_concrete, number
from jaxbeam.control.optimal.lqr import AbstractRegulator
from jaxbeam.control.optimal.sampled_lqr import discrete_lq_problem
from jaxbeam.control.state_law import AbstractStateLaw
from jaxbeam.estimation.sampled_plant import sample_timing
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.riccati import dlqr
from jaxbeam.runtime.arrays import Array, block_diag, xp


class IntegralLQR(AbstractRegulator):
    """Time-invariant regulator of the plant without loads, with the integral of errors as states.

    With the readings y of the first sensors, deflections, as many as `reference` has entries,

        e(k+1) = e(k) + h (y(k) - reference),     u = -K (x, e, last command),

    where h is the period. The cost is that of `DiscreteLQR` plus `integral_weight` times h e^2 at
    each sample. At rest y is the reference, whatever constant load acts, while the commands are
    within their limits; beyond them e stands still. The last command is fed back with a delay.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.IntegralLQR(
    ...         state_weight=[1e7, 10.0],
    ...         command_weight=[1e-3],
    ...         integral_weight=[1e6],
    ...         reference=[0.0],
    ...         period=0.005,
    ...     ),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.518 mm
    """

    kind: ClassVar[str] = "lqr-integral"

    integral_weight: Float[Array, " output"] = number(
        "1/(m^2 s^2)", "weight of the integral of each error", POSITIVE, kw_only=True
    )
    reference: Float[Array, " output"] = number(
        "m", "reference of each of the first sensors", kw_only=True
    )

    def augmented_gain(self, plant: Plant) -> Float[Array, "actuator column"]:
        """Gain of the states of a plant, the last command with a delay, and the integrals."""
        system, timing = plant.unloaded, sample_timing(self)
        Q, R = self.weights(plant)
        A, B, Q, R, N = discrete_lq_problem(
            system.A, system.B, Q, R, timing.period, timing.input_delay
        )
        if self.delay is None:
            states = system.A.shape[0]
            A, B, Q, N = A[:states, :states], B[:states], Q[:states, :states], N[:states]
        outputs = self.reference.shape[0]
        rows = xp.pad(system.C[:outputs], ((0, 0), (0, A.shape[0] - system.A.shape[0])))
        A = xp.block(
            [[A, xp.zeros((A.shape[0], outputs))], [timing.period * rows, xp.eye(outputs)]]
        )
        B, N = (xp.pad(part, ((0, outputs), (0, 0))) for part in (B, N))
        Q = block_diag(Q, timing.period * xp.diag(self.integral_weight))
        return dlqr(A, B, Q, R, N)[0]

    def design_state_law(self, plant, design_plant):
        limits = [actuator.command_limits() for actuator in plant.case.driven]
        unlimited = np.array([-np.inf, np.inf])
        limits = xp.stack([unlimited if part is None else part for part in limits])
        return IntegralLaw(
            self.augmented_gain(design_plant),
            self.feedback_shares,
            self.reference,
            self.period,
            limits,
            self.delay is not None,
        )

    def validate(self, case):
        if self.period is None:
            return "period must be given: kind 'lqr-integral' acts at samples"
        known = self.delay is not None and is_concrete(self.delay) and is_concrete(self.period)
        if known and concrete(self.delay) >= concrete(self.period):
            return "delay must be less than the period: one pending command is allowed for"
        outputs = self.reference.shape[0]
        if self.integral_weight.shape != self.reference.shape:
            return f"integral_weight must have an entry for each of {outputs} references"
        if outputs > len(case.driven):
            return (
                f"reference must have at most {len(case.driven)} entries, one for each actuator:"
                " so many deflections can be commanded"
            )
        sensors = case.sensors[:outputs]
        if len(sensors) < outputs or any(sensor.quantity != "deflection" for sensor in sensors):
            return (
                f"reference needs a sensor of deflection for each of {outputs} entries, before all"
                " other sensors"
            )
        return super().validate(case)


class IntegralLaw(AbstractStateLaw):
    """u = -K (x, last command, e) with the integrals e of the errors as the state of the law.

    `limits` (actuator, 2) are those of the commands, within which e goes on; `shares` those of the
    states that are fed back.
    """

    gain: Float[Array, "actuator column"]
    shares: Float[Array, " state"]
    reference: Float[Array, " output"]
    period: Float[Array, ""]
    limits: Float[Array, "actuator 2"]
    feeds_back_command: bool = eqx.field(static=True)

    def initial_state(self):
        return xp.zeros_like(self.reference)

    def step(self, state, estimate, measurement, t):
        last = measurement.command if self.feeds_back_command else xp.zeros(0)
        command = -self.gain @ xp.concatenate([self.shares * estimate.state, last, state])
        within = xp.all((command >= self.limits[:, 0]) & (command <= self.limits[:, 1]))
        error = measurement.readings[: self.reference.shape[0]] - self.reference
        return ControlStep(command, state + xp.where(within, self.period, 0.0) * error)
