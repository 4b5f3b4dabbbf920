"""Generalised predictive control of a plant that is identified while it runs.

Recursive least squares with forgetting (Astrom and Wittenmark, Adaptive Control, 2nd edition, 1995,
section 2.2) follow the polynomials of `gpc` from increments of readings and commands,

    dy(k) = -a_1 dy(k - 1) - ... + B_1 du(k - 1) + B_2 du(k - 2) + ...,

in which a steady load is not seen. Lift and delay of the plant follow from the polynomials. The
covariance is kept as a product of square roots (Potter's algorithm: Bierman, Factorization Methods
for Discrete Sequential Estimation, 1977, section V.2): the difference of two covariances, almost
equal where the noise is small, loses twice as many digits.
"""

import functools
from typing import ClassVar, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.controller import AbstractSampledLaw, ControlStep
from jaxbeam.case.fields import (
    NOT_NEGATIVE,
    POSITIVE,
    concrete,
    count,
    deciding,
    is_concrete,
    number,
)
from jaxbeam.control.predictive.gpc import (
    GPC,
    PolynomialModel,
    predictive_gains,
)
from jaxbeam.runtime.arrays import Array, take, xp

PROBE_BITS = 7  # of the shift register of the probing sequence, which repeats after 127 samples

Square = Float[Array, "parameter parameter"]


class AdaptiveGPC(GPC):
    """Generalised predictive control with polynomials that are identified on line.

    Identification starts from the design model, with a standard deviation `deviation` of all
    coefficients relative to the largest of their kind, and takes readings with noise of standard
    deviation `measurement_noise`; what is older than 1 / (1 - `forgetting`) samples counts little.
    `more_delay` periods of delay, of filters and sensors, say, are allowed for beyond those of the
    design. Up to `until` (s) the commands are a probe, a pseudorandom binary sequence of the
    amplitude `probe`, if that is given, and the plant is identified; then it stays as it is. Let no
    load cross before: it would be taken for the plant. Without `until` identification goes on. It
    pauses while a reading is missing, now or among the past ones of the model.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     actuators=[jb.PointForce(0.3, limits=[-4.0, 4.0])],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0, entry_time=0.2)],
    ...     controller=jb.AdaptiveGPC(
    ...         horizon=8, moves=2, move_weight=1e-9, period=0.005, until=0.2, probe=0.5
    ...     ),
    ...     run=jb.Run(0.35),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.509 mm
    """

    kind: ClassVar[str] = "gpc-adaptive"

    forgetting: Float[Array, ""] = number("1", "weight of the last sample", POSITIVE, default=0.995)
    deviation: Float[Array, ""] = number(
        "1", "relative standard deviation of the design model", POSITIVE, default=0.5
    )
    measurement_noise: Float[Array, ""] = number(
        "unit of a reading", "standard deviation of increments of readings", POSITIVE, default=1e-6
    )
    more_delay: int = count("periods of delay beyond those of the design", default=2)
    until: Float[Array, ""] | None = number(
        "s", "time up to which the plant is identified", POSITIVE, default=None
    )
    probe: Float[Array, " *actuator"] | None = number(
        "unit of a command", "amplitude of the probing commands", NOT_NEGATIVE, default=None
    )

    def validate(self, case):
        if is_concrete(self.forgetting) and concrete(self.forgetting) > 1:
            return "forgetting must be at most 1, which forgets nothing"
        if self.probe is not None and self.until is None:
            return "probe needs a time to end: give until"
        if self.probe is not None and self.probe.shape not in ((), (len(case.driven),)):
            return f"probe must have {len(case.driven)} entries, not {self.probe.size}"
        return super().validate(case)

    def design_law(self, plant):
        model, weights = self.design_model(plant), self.weights(plant)
        _, outputs, actuators = model.numerators.shape
        more = ((0, self.more_delay), (0, 0), (0, 0))
        padded = PolynomialModel(
            xp.pad(model.denominator, (0, self.more_delay)), xp.pad(model.numerators, more)
        )
        start = parameters(padded)
        # Further powers of the denominator stay zero: a delay adds none.
        size = xp.max(xp.abs(model.denominator))
        sizes = PolynomialModel(
            xp.pad(xp.full(model.denominator.shape, size), (0, self.more_delay)),
            xp.full(padded.numerators.shape, xp.max(xp.abs(model.numerators))),
        )
        deviations = self.deviation * parameters(sizes)
        probe = xp.zeros(actuators) if self.probe is None else self.probe
        return AdaptiveGPCLaw(
            start,
            xp.diag(deviations),
            self.forgetting,
            self.measurement_noise,
            self.period,
            xp.asarray(xp.inf) if self.until is None else deciding(self.until, "controller.until"),
            xp.broadcast_to(probe, (actuators,)),
            *weights,
            (self.first, self.horizon, self.moves),
            outputs,
            self.probe is not None,
        )


class AdaptiveState(NamedTuple):
    """Coefficients, a square root S of their covariance S S', past readings and commands.

    `complete` is the number of samples with complete readings until now, of a few at most.
    """

    coefficients: Float[Array, " parameter"]
    root: Square
    readings: Float[Array, "past output"]
    commands: Float[Array, "past actuator"]
    complete: Float[Array, ""]


class AdaptiveGPCLaw(AbstractSampledLaw):
    """Self-tuning law: the gains are those of the model identified so far."""

    start: Float[Array, " parameter"]
    start_root: Square
    forgetting: Float[Array, ""]
    noise: Float[Array, ""]
    period: Float[Array, ""]
    until: Float[Array, ""]
    probe: Float[Array, " actuator"]
    output_weights: Float[Array, " output"]
    move_weights: Float[Array, " actuator"]
    reference: Float[Array, " output"]
    horizons: tuple[int, int, int] = eqx.field(static=True)
    outputs: int = eqx.field(static=True)
    probes: bool = eqx.field(static=True)

    @property
    def powers(self) -> int:
        """Number of past readings and commands in the model."""
        return self.start.shape[0] // (1 + self.outputs * self.probe.shape[0])

    def initial_state(self):
        past = self.powers + 1
        commands = xp.zeros((past, self.probe.shape[0]))
        readings = xp.zeros((past, self.outputs))
        return AdaptiveState(
            self.start, self.start_root, readings, commands, xp.asarray(past + 1.0)
        )

    def model(self, state: AdaptiveState) -> PolynomialModel:
        """Model identified so far."""
        powers, actuators = self.powers, self.probe.shape[0]
        numerators = state.coefficients[powers:].reshape(powers, self.outputs, actuators)
        return PolynomialModel(state.coefficients[:powers], numerators)

    def step(self, state, measurement, t):
        readings, command = measurement.readings[: self.outputs], measurement.command
        commands = xp.concatenate([command[None], state.commands[:-1]])
        identified = self.identified(state, readings, commands)
        sample = xp.floor(t / self.period + 0.5).astype(int)
        # Increments need two readings, and the model's past; before, everything is at rest.
        now_complete = measurement.complete(range(self.outputs))
        past = self.powers + 1
        complete = xp.where(now_complete, xp.minimum(state.complete + 1.0, past + 1.0), 0.0)
        active = (t <= self.until) & (sample > 0) & (complete > past)
        coefficients, root = (
            xp.where(active, new, old) for new, old in zip(identified, state[:2], strict=True)
        )
        readings = xp.concatenate([readings[None], state.readings[:-1]])
        state = AdaptiveState(coefficients, root, readings, commands, complete)
        gains = predictive_gains(
            self.model(state), self.horizons, self.output_weights, self.move_weights, self.reference
        )
        wanted = gains.reference_command
        wanted = wanted - xp.einsum("pao,po->a", gains.reading_gains, readings)
        powers = gains.command_gains.shape[0]
        wanted = wanted - xp.einsum("pab,pb->a", gains.command_gains, commands[:powers])
        if self.probes:
            signs = probe_signs()
            wanted = xp.where(t < self.until, self.probe * take(signs, sample % len(signs)), wanted)
        return ControlStep(wanted, state)

    def identified(
        self, state: AdaptiveState, readings: Float[Array, " output"], commands
    ) -> tuple[Float[Array, " parameter"], Square]:
        """Coefficients and the root of their covariance after new readings, one by one."""
        powers, actuators = self.powers, self.probe.shape[0]
        moves = -xp.diff(commands, axis=0)[:powers]
        increments = -xp.diff(state.readings, axis=0)[:powers]
        coefficients, root = state.coefficients, state.root / xp.sqrt(self.forgetting)
        for output in range(self.outputs):
            of_output = (np.arange(self.outputs) == output)[None, :, None]
            numerators = xp.where(of_output, moves[:, None, :], 0.0)
            numerators = xp.broadcast_to(numerators, (powers, self.outputs, actuators))
            row = xp.concatenate([-increments[:, output], numerators.reshape(-1)])
            error = readings[output] - state.readings[0, output] - row @ coefficients
            along = root.T @ row
            spread, size = root @ along, self.noise**2 + along @ along
            coefficients = coefficients + spread / size * error
            root = root - spread[:, None] * (along / (size + self.noise * xp.sqrt(size)))
        # Without excitation, forgetting would let the covariance grow without limit.
        excess = xp.sum(root**2) / xp.sum(self.start_root**2)
        return coefficients, root / xp.sqrt(xp.maximum(excess, 1.0))


def parameters(model: PolynomialModel) -> Float[Array, " parameter"]:
    """Coefficients of a model in one vector: a, then B by powers."""
    return xp.concatenate([model.denominator, model.numerators.reshape(-1)])


def lift_and_delay(
    model: PolynomialModel,
) -> tuple[Float[Array, "output actuator"], Float[Array, "output actuator"]]:
    """Static response to each command, and the delay (periods) of slow ones behind it.

    With A(1) = 1 + sum of a and B(1) = sum of B, lift B(1) / A(1), and the group delay at zero
    frequency, sum of i B_i / B(1) - sum of i a_i / A(1).
    """
    powers = xp.arange(1.0, model.denominator.shape[0] + 1)
    A, B = 1 + xp.sum(model.denominator), xp.sum(model.numerators, axis=0)
    of_numerators = xp.einsum("p,poa->oa", powers, model.numerators) / B
    return B / A, of_numerators - powers @ model.denominator / A


@functools.cache
def probe_signs() -> Float[np.ndarray, " sample"]:
    """Signs of the probing sequence: a maximum-length one, whose spectrum is white."""
    from scipy.signal import max_len_seq  # half a second, and most cases do not probe

    return 2.0 * max_len_seq(PROBE_BITS)[0] - 1.0
