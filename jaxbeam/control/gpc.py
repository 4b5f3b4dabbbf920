"""Generalised predictive control, of a polynomial model that is given or identified on line.

Source: Clarke, Mohtadi and Tuffs, Automatica 23, 1987. The sampled plant is the CARIMA model

    A(q) y(k) = B(q) u(k - 1) + e(k) / (1 - q),     q the delay of one sample,

and the moves du of the commands minimise

    sum from N1 to N2 of weight (w - y(k + j))^2 + sum of move_weight du(k + j - 1)^2, j = 1 ... Nu.

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

from jaxbeam.case.controller import AbstractController, AbstractSampledLaw, ControlStep
from jaxbeam.case.fields import (
    NOT_NEGATIVE,
    POSITIVE,
    concrete,
    count,
    deciding,
    is_concrete,
    number,
    part,
)
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.control.prediction import sampled_plant
from jaxbeam.control.state_controller import DesignModel
from jaxbeam.model.state_space import Plant
from jaxbeam.runtime.arrays import Array, Number, add_at, solve, take, xp
from jaxbeam.runtime.printer import counted

SAME_SAMPLE = 1e-9  # of a period: a time that is nearer to a sample is at it


class PolynomialModel(NamedTuple):
    """Plant y(k) + a_1 y(k - 1) + ... = B_1 u(k - 1) + B_2 u(k - 2) + ..., all outputs with one a.

    `denominator` are a_1 ... a_n, `numerators` B_1 ... B_n.
    """

    denominator: Float[Array, " power"]
    numerators: Float[Array, "power output actuator"]


class PredictiveGains(NamedTuple):
    """Gains of the law u(k) = reference_command - sum H_i y(k - i) - sum K_i u(k - 1 - i).

    i = 0, 1, ...; H are the `reading_gains`, K the `command_gains`.
    """

    reading_gains: Float[Array, "past actuator output"]
    command_gains: Float[Array, "power actuator actuator"]
    reference_command: Float[Array, " actuator"]


def polynomial_model(
    A: Float[Array, "state state"],
    B: Float[Array, "state actuator"],
    C: Float[Array, "output state"],
) -> PolynomialModel:
    """Polynomial model of x(k+1) = A x(k) + B u(k), y = C x, by Faddeev and LeVerrier.

    With M_1 = 1, the numerators are C M_i B, a_i = -tr(A M_i) / i, and M_(i+1) = A M_i + a_i.
    """
    identity = xp.eye(A.shape[0])
    M, denominator, numerators = identity, [], []
    for i in range(1, A.shape[0] + 1):
        numerators.append(C @ M @ B)
        product = A @ M
        denominator.append(-xp.trace(product) / i)
        M = product + denominator[-1] * identity
    return PolynomialModel(xp.stack(denominator), xp.stack(numerators))


def predicted_outputs(
    model: PolynomialModel, horizon: int, moves: int
) -> tuple[
    Float[Array, "horizon output past output"],
    Float[Array, "horizon output before actuator"],
    Float[Array, "horizon output move actuator"],
]:
    """Matrices that predict the outputs y(k+1) ... y(k+horizon) from readings and moves.

    The first multiplies the readings y(k), y(k-1), ..., the second the past moves du(k-1),
    du(k-2), ..., the third, the step response, the future moves du(k), du(k+1), ...
    """
    a = xp.concatenate([xp.ones(1), model.denominator])
    powers, outputs, actuators = model.numerators.shape
    one = xp.concatenate([a, xp.zeros(1)]) - xp.concatenate([xp.zeros(1), a])  # A (1 - q)
    past, before = powers + 1, powers - 1
    columns = past * outputs + (before + moves) * actuators
    # Rows of past and future numbers themselves: readings back from k, moves from k - before.
    identity = xp.eye(columns)
    reading_rows = [identity[i * outputs : (i + 1) * outputs] for i in range(past)][::-1]
    steps = [
        identity[past * outputs + i * actuators : past * outputs + (i + 1) * actuators]
        for i in [*range(before)[::-1], *range(before, before + moves)]
    ]
    predictions = []
    for j in range(1, horizon + 1):
        row = xp.zeros((outputs, columns))
        for i in range(1, past + 1):
            row = row - one[i] * reading_rows[-i]
        for i in range(1, powers + 1):
            index = before + j - i  # of du(k + j - i)
            if 0 <= index < before + moves:
                row = row + model.numerators[i - 1] @ steps[index]
        reading_rows.append(row)
        predictions.append(row)
    stacked = xp.stack(predictions)
    shapes = (past, outputs), (before, actuators), (moves, actuators)
    ends = np.cumsum([past * outputs, before * actuators])
    parts = xp.split(stacked, ends, axis=-1)
    readings, last, future = (
        block.reshape(horizon, outputs, *shape) for block, shape in zip(parts, shapes, strict=True)
    )
    return readings, last, future


def predictive_gains(
    model: PolynomialModel,
    horizons: tuple[int, int, int],
    output_weights: Float[Array, " output"],
    move_weights: Float[Array, " actuator"],
    reference: Float[Array, " output"],
) -> PredictiveGains:
    """Gains of the first move without limits, for the horizons (N1, N2, Nu)."""
    first, horizon, moves = horizons
    past, before, future = (
        block[first - 1 :] for block in predicted_outputs(model, horizon, moves)
    )
    actuators = move_weights.shape[0]
    G = future.reshape(-1, moves * actuators)
    weights = xp.tile(output_weights, horizon - first + 1)
    hessian = G.T @ (weights[:, None] * G) + xp.diag(xp.tile(move_weights, moves))
    first_move = solve(hessian, G.T * weights)[:actuators]
    on_outputs = first_move.reshape(actuators, horizon - first + 1, -1)
    reading_gains = xp.einsum("aho,hopr->par", on_outputs, past)
    move_gains = xp.einsum("aho,hopb->pab", on_outputs, before)
    # Moves are differences of commands, and the last command is what the move is added to.
    none = xp.zeros((1, actuators, actuators))
    command_gains = xp.concatenate([move_gains, none]) - xp.concatenate([none, move_gains])
    command_gains = add_at(command_gains, 0, -xp.eye(actuators))
    return PredictiveGains(
        reading_gains, command_gains, xp.einsum("aho,o->a", on_outputs, reference)
    )


class GPC(AbstractController):
    """Generalised predictive control of the readings, by past readings and past commands.

    From `first` to `horizon` periods ahead the readings of all sensors are led to the `reference`,
    by `moves` moves of each actuator; after these the command stays. The moves are found without
    limits, then clipped by the actuators; the next sample goes on from the clipped command. A
    steady load leaves no error at rest, where the readings are as many as the actuators. The plant
    is that of the case without loads, or of the `design` model: 2 `modes` past readings and
    commands are fed back, with those of actuator lags and of a delay. Filters of the sensors are no
    part of it.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3, limits=[-4.0, 4.0])],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.GPC(horizon=8, moves=2, move_weight=1e-9, period=0.005),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.883 mm
    """

    kind: ClassVar[str] = "gpc"

    horizon: int = count("last period of the prediction, N2")
    moves: int = count("moves of each actuator, Nu")
    move_weight: Float[Number, " *actuator"] = number(
        "unit of a reading^2/unit of a command^2", "weight of the square of each move", POSITIVE
    )
    first: int = count("first period of the prediction, N1", default=1)
    output_weight: Float[Number, " *output"] | None = number(
        "1", "weight of the square of each reading; 1 if left out", NOT_NEGATIVE, default=None
    )
    reference: Float[Number, " output"] | None = number(
        "unit of a reading", "reference of each reading; 0 if left out", default=None
    )
    design: DesignModel | None = part("design model of the plant", DesignModel)

    @property
    def design_depends_on_loads(self) -> bool:
        return False

    def validate(self, case):
        outputs, actuators = len(case.sensors), len(case.driven)
        if self.period is None:
            return "period must be given: kind 'gpc' acts at samples"
        excess_delay = None if self.delay is None else self.delay - self.period
        if excess_delay is not None and is_concrete(excess_delay) and concrete(excess_delay) >= 0:
            return "delay must be less than the period: one pending command is allowed for"
        for name in ("moves", "first"):
            if getattr(self, name) > self.horizon:
                return f"{name} must be at most the horizon, {self.horizon}"
        if outputs == 0:
            return "kind needs a sensor: its readings are predicted"
        for i, sensor in enumerate(case.sensors):
            quantity = QUANTITIES[sensor.quantity]
            if quantity.time_derivative > 1 or quantity.x_derivative > 1:
                return (
                    "kind needs sensors of deflection, slope or velocity, which commands do not"
                    f" move at once; sensors.{i} measures {sensor.quantity}"
                )
        sizes = {"move_weight": actuators, "output_weight": outputs, "reference": outputs}
        for name, size in sizes.items():
            value = getattr(self, name)
            allowed = [(size,)] if name == "reference" else [(), (size,)]
            if value is not None and value.shape not in allowed:
                return f"{name} must have {counted(size, 'entry', 'entries')}, not {value.size}"
        error = None if self.design is None else self.design.validate(case)
        return None if error is None else f"design.{error}"

    def design_model(self, plant: Plant) -> PolynomialModel:
        """Polynomials of the sampled plant of the design, without loads."""
        design = plant if self.design is None else self.design.design_plant(plant, "modal")
        system, outputs = design.unloaded, len(design.case.sensors)
        none = xp.zeros((system.A.shape[0], 0))
        sampled = sampled_plant(system.A, system.B, none, self.period, self.delay)
        C = system.C[:outputs]
        C = xp.pad(C, ((0, 0), (0, sampled.A.shape[0] - C.shape[1])))
        return polynomial_model(sampled.A, sampled.B, C)

    def weights(self, plant: Plant) -> tuple[Array, Array, Array]:
        """Weights of the readings and of the moves, and the references."""
        outputs, actuators = len(plant.case.sensors), plant.commands
        weight = 1.0 if self.output_weight is None else self.output_weight
        return (
            xp.broadcast_to(xp.asarray(weight), (outputs,)),
            xp.broadcast_to(self.move_weight, (actuators,)),
            xp.zeros(outputs) if self.reference is None else self.reference,
        )

    def design_law(self, plant):
        horizons = self.first, self.horizon, self.moves
        gains = predictive_gains(self.design_model(plant), horizons, *self.weights(plant))
        return GPCLaw(*gains)


class GPCLaw(AbstractSampledLaw):
    """Law of `PredictiveGains`; its state is the readings and commands before the last ones."""

    reading_gains: Float[Array, "past actuator output"]
    command_gains: Float[Array, "power actuator actuator"]
    reference_command: Float[Array, " actuator"]

    def initial_state(self):
        past, _, outputs = self.reading_gains.shape
        powers, actuators, _ = self.command_gains.shape
        return xp.zeros((past - 1, outputs)), xp.zeros((powers - 1, actuators))

    def step(self, state, measurement, t):
        outputs = self.reading_gains.shape[2]
        readings = xp.concatenate([measurement.readings[None, :outputs], state[0]])
        commands = xp.concatenate([measurement.command[None], state[1]])
        command = self.reference_command - xp.einsum("pao,po->a", self.reading_gains, readings)
        command = command - xp.einsum("pab,pb->a", self.command_gains, commands)
        return ControlStep(command, (readings[:-1], commands[:-1]))


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

    forgetting: Float[Number, ""] = number(
        "1", "weight of the last sample", POSITIVE, default=0.995
    )
    deviation: Float[Number, ""] = number(
        "1", "relative standard deviation of the design model", POSITIVE, default=0.5
    )
    measurement_noise: Float[Number, ""] = number(
        "unit of a reading", "standard deviation of increments of readings", POSITIVE, default=1e-6
    )
    more_delay: int = count("periods of delay beyond those of the design", default=2)
    until: Float[Number, ""] | None = number(
        "s", "time up to which the plant is identified", POSITIVE, default=None
    )
    probe: Float[Number, " *actuator"] | None = number(
        "unit of a command", "amplitude of the probing commands", NOT_NEGATIVE, default=None
    )

    def validate(self, case):
        if is_concrete(self.forgetting) and concrete(self.forgetting) > 1:
            return "forgetting must be at most 1, which forgets nothing"
        if self.probe is not None and self.until is None:
            return "probe needs a time to end: give until"
        if self.probe is not None and self.probe.shape not in ((), (len(case.driven),)):
            return (
                f"probe must have {counted(len(case.driven), 'entry', 'entries')}, not"
                f" {self.probe.size}"
            )
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

    without_reading: ClassVar[str] = (
        "Identification pauses while one is missing or among the past readings."
    )

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
        # By numbers of samples, as rounding of a time may decide otherwise where it is `until`.
        last = self.until / self.period
        active = (sample <= last + SAME_SAMPLE) & (sample > 0) & (complete > past)
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
            wanted = xp.where(
                sample < last - SAME_SAMPLE, self.probe * take(signs, sample % len(signs)), wanted
            )
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


@functools.cache
def probe_signs() -> Float[np.ndarray, " sample"]:
    """Signs of the probing sequence: a maximum-length one, whose spectrum is white."""
    from scipy.signal import max_len_seq  # half a second, and most cases do not probe

    return 2.0 * max_len_seq(PROBE_BITS)[0] - 1.0
