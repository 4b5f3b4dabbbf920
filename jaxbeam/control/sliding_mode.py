"""Sliding-mode control: deflections are led along w' = -rate w, in spite of bounded disturbances.

Source: Slotine and Li, Applied Nonlinear Control, Prentice Hall 1991, chapter 7. With

    s = w' + rate w  (m/s),     s' = -reaching_rate sat(s / layer) + d,

a disturbance d (m/s^2) below the reaching rate keeps |s| below the layer, |w| below layer / rate.
"""

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from jaxbeam.case.controller import ControlStep
from jaxbeam.case.fields import ON_BEAM, POSITIVE, choice, concrete, is_concrete, number
from jaxbeam.control.state_controller import (
    AbstractStateController,
    AbstractStateLaw,
    deflection_rows,
)
from jaxbeam.runtime.arrays import Array, Number, solve, xp
from jaxbeam.runtime.printer import counted

SMALLEST_EFFECT = 1e-9  # of the commands on the surfaces, of that on all modes


class SlidingMode(AbstractStateController):
    """Sliding-mode control of one deflection w for each actuator that takes commands.

    The surface of each deflection is s = w' + rate w, in m/s. The commands

        u = -(S B)^-1 (S A x + reaching_rate sat(s / layer)),     s = S x,

    of the plant without loads, x' = A x + B u, cancel its own motion in s (the "equivalent"
    control, left out by "none") and drive s to zero at the reaching rate; sat is linear from -1 to
    1, so that commands do not chatter. Lags of the actuators are left out of A and B:
    reaching_rate / layer should be well below their bandwidths and, in 1/s, below the sampling
    frequency. The state is the true one, or that of an `estimator`: "inversion" takes it from
    measured deflections and their rates.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.SlidingMode(200.0, reaching_rate=60.0, layer=0.05, period=0.001),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.106 mm
    """

    kind: ClassVar[str] = "sliding-mode"

    rate: Float[Number, " *output"] = number(
        "1/s", "rate at which deflections decay on the surface", POSITIVE
    )
    reaching_rate: Float[Number, " *output"] = number(
        "m/s^2", "rate of s outside the layer: acceleration of disturbances rejected", POSITIVE
    )
    layer: Float[Number, " *output"] = number(
        "m/s", "half the thickness of the boundary layer of s", POSITIVE
    )
    positions: Float[Number, " output"] | None = number(
        "m", "positions of the deflections; those of the first sensors", ON_BEAM, default=None
    )
    equivalent: str = choice(
        "cancelling the plant's own motion in s", "included", "none", default="included"
    )

    def validate(self, case):
        outputs = len(case.driven)
        if outputs == 0:
            return "kind needs an actuator that takes commands"
        if self.positions is None and len(case.sensors) < outputs:
            return (
                f"positions must be given: there are {counted(len(case.sensors), 'sensor')}"
                f" for {outputs}"
                " actuators"
            )
        if self.positions is not None and self.positions.shape[0] != outputs:
            return (
                f"positions must have an entry for each of {outputs} actuators that take commands,"
                f" not {self.positions.shape[0]}"
            )
        for name in ("rate", "reaching_rate", "layer"):
            shape = getattr(self, name).shape
            if shape not in ((), (outputs,)):
                return f"{name} must be one number or {outputs}, one a surface, not {shape[0]}"
        period, slope = self.period, self.reaching_rate / self.layer
        if period is not None and is_concrete(slope) and is_concrete(period):
            steepest = float(np.max(concrete(slope)))
            if steepest * float(concrete(period)) >= 2:
                return (
                    "layer must be above reaching_rate times half the period, or s passes zero"
                    f" further at each sample: reaching_rate / layer is {steepest:g} 1/s, and must"
                    f" be below {2 / float(concrete(period)):g}"
                )
        return super().validate(case)

    def design_state_law(self, plant, design_plant):
        outputs = len(plant.case.driven)
        sensors = design_plant.case.sensor_positions[:outputs]
        positions = sensors if self.positions is None else self.positions
        A, B = _without_lags(design_plant)
        modes = A.shape[0] // 2
        rows = deflection_rows(design_plant, positions)[:, :modes]
        rates, reaching_rate, layer = (
            xp.broadcast_to(part, outputs) for part in (self.rate, self.reaching_rate, self.layer)
        )
        surface = xp.concatenate([rates[:, None] * rows, rows], axis=1)
        effect = surface @ B
        _check_effect(effect, rows, B[modes:])
        no_motion = xp.zeros((outputs, A.shape[0]))
        own_motion = surface @ A if self.equivalent == "included" else no_motion
        gains = solve(effect, xp.concatenate([own_motion, xp.diag(reaching_rate)], axis=1))
        return SlidingModeLaw(
            surface / layer[:, None], gains[:, : A.shape[0]], gains[:, A.shape[0] :]
        )


class SlidingModeLaw(AbstractStateLaw):
    """u = -equivalent_gain x - reaching_gain sat(surface x), of the states of the beam.

    `surface` (1) is S over the layer, `reaching_gain` in units of the commands.
    """

    surface: Float[Array, "output state"]
    equivalent_gain: Float[Array, "actuator state"]
    reaching_gain: Float[Array, "actuator output"]

    def step(self, state, estimate, measurement, t):
        x = estimate.state[: self.surface.shape[1]]
        reaching = xp.clip(self.surface @ x, -1.0, 1.0)
        return ControlStep(-self.equivalent_gain @ x - self.reaching_gain @ reaching, state)


def _without_lags(plant):
    """A and B of the beam's own states, with those of the actuators at rest under command."""
    system, beam = plant.unloaded, 2 * plant.coordinate_scale.shape[0]
    A, B = system.A, system.B
    if A.shape[0] == beam:
        return A, B
    steady = -solve(A[beam:, beam:], xp.concatenate([A[beam:, :beam], B[beam:]], axis=1))
    coupled = A[:beam, beam:] @ steady
    return A[:beam, :beam] + coupled[:, :beam], B[:beam] + coupled[:, beam:]


def _check_effect(effect, rows, input_rows) -> None:
    """Check that the commands can move each surface independently, if numbers are concrete.

    Raises ValueError if they cannot.
    """
    if not all(is_concrete(part) for part in (effect, rows, input_rows)):
        return
    effect, rows, input_rows = (concrete(part) for part in (effect, rows, input_rows))
    largest = np.linalg.norm(rows, axis=1)[:, None] * np.linalg.norm(input_rows, axis=0)
    singular = np.linalg.svd(effect / np.where(largest > 0, largest, 1.0), compute_uv=False)
    if singular[-1] < SMALLEST_EFFECT:
        raise ValueError(
            "controller.positions: no commands hold each of the deflections there apart from the"
            " others; take positions near the actuators"
        )
