"""H-infinity control: the smallest worst-case gain, by a search over two Riccati equations.

    x+ = A x + B u + E w,      y = C x + n,      z = (x' Q x + u' R u)^(1/2)

Disturbances w and noise n of bounded energy, n in units of the covariance N, are to make no more
than `level`^2 times their energy in z. It is a game in which they oppose the command; its values
are two Riccati equations, that of the state feedback, M, and that of the filter, S, and the largest
eigenvalue of S M stays below level^2 (Basar and Bernhard, H-infinity-Optimal Control and Related
Minimax Design Problems, 1995, chapters 3 and 6). The reading of a sample acts on its command. As
the level tends to infinity, the law tends to the LQG one.
"""

from typing import ClassVar, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.controller import AbstractController, AbstractSampledLaw, ControlStep
from jaxbeam.case.fields import (
    ON_BEAM,
    POSITIVE,
    check_on_beam,
    concrete,
    is_concrete,
    number,
    part,
)
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.control.prediction import sampled_plant
from jaxbeam.control.state_controller import DesignModel
from jaxbeam.model.output_rows import row_on_states
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.matrices import InputMatrix, InputWeight, Square, symmetric_part
from jaxbeam.numerics.riccati import indefinite_dare
from jaxbeam.runtime.arrays import Array, Number, any_jax, fori_loop, solve, stop_gradient, xp

HIGHEST_LEVEL, BISECTIONS = 1e9, 36  # from 1e9 to 1e-9, in logarithms
ROUNDING = 1e-9  # of an eigenvalue that may be zero, relative to the largest


class Game(NamedTuple):
    """H-infinity problem: matrices of the plant and weights of its costs; see the module."""

    A: Square
    B: InputMatrix
    C: Float[Array, "output state"]
    E: Float[Array, "state force"]
    Q: Square
    R: InputWeight
    N: Float[Array, "output output"]


class MinimaxLaw(NamedTuple):
    """Law u = K x + D y of the predicted state x, with x+ = F x + G y + B u."""

    F: Square
    G: Float[Array, "state output"]
    K: Float[Array, "actuator state"]
    D: Float[Array, "actuator output"]


def minimax_law(game: Game, level: Float[Array, ""]) -> MinimaxLaw:
    """Law with a worst-case gain below a level; nan where there is none. Differentiable."""
    A, B, C, _, Q, R, N = game
    M, spread = values(game, level)
    informed = C.T @ solve(N, C)
    one = xp.eye(A.shape[0])
    feedback = solve(R, B.T @ M @ solve(one + _opposed(game, level) @ M, A))
    gain = solve(N, C @ spread).T  # of the readings in the worst state
    worst = solve(one + spread @ (informed - M / level**2), one)
    inward = A @ solve(one + spread @ (informed - Q / level**2), one)
    return MinimaxLaw(
        F=inward,
        G=inward @ gain,
        K=-feedback @ worst,
        D=-feedback @ worst @ gain,
    )


def values(game: Game, level: Float[Array, ""]) -> tuple[Square, Square]:
    """Value matrix M of the state feedback, and matrix of the filter, for a level.

    M = Q + A' M (1 + (B R^-1 B' - E E' / level^2) M)^-1 A, and with S in the place of M and C' of B
    the same of A', E E' and C' N^-1 C - Q / level^2.
    """
    informed = game.C.T @ solve(game.N, game.C)
    M = indefinite_dare(game.A, _opposed(game, level), game.Q)
    spread = indefinite_dare(game.A.T, informed - game.Q / level**2, game.E @ game.E.T)
    return M, spread


def is_attained(game: Game, level: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether some law has a worst-case gain below a level."""
    M, spread = values(game, level)
    finite = xp.all(xp.isfinite(M)) & xp.all(xp.isfinite(spread))
    M, spread = (xp.where(finite, part, xp.zeros_like(part)) for part in (M, spread))
    informed = game.C.T @ solve(game.N, game.C)
    root = _root(spread)
    one = xp.eye(root.shape[0])
    for matrix in (M, spread):
        eigenvalues = xp.linalg.eigvalsh(symmetric_part(matrix))
        finite = finite & (eigenvalues[0] >= -ROUNDING * xp.max(xp.abs(eigenvalues)))
    positive = (
        xp.eye(game.E.shape[1]) - game.E.T @ M @ game.E / level**2,
        one + root.T @ (informed - game.Q / level**2) @ root,
        one - root.T @ M @ root / level**2,
    )
    for matrix in positive:
        finite = finite & (xp.linalg.eigvalsh(symmetric_part(matrix))[0] > 0)
    return finite


def least_level(game: Game) -> Float[Array, ""]:
    """Smallest worst-case gain that a law can attain, to a relative 1e-9.

    Its derivative is that of the level at which the largest eigenvalue of S M is its square.
    Raises ValueError if there is none; under `jit` and `vmap` it is nan.
    """
    fixed = stop_gradient(game)
    start = xp.asarray(HIGHEST_LEVEL)

    def lower(bounds):
        attained, missed = bounds
        middle = xp.sqrt(attained * missed)
        good = is_attained(fixed, middle)
        return xp.where(good, middle, attained), xp.where(good, missed, middle)

    bounds = start, 1 / start
    bounds = fori_loop(0, BISECTIONS, lambda _, bounds: lower(bounds), bounds)
    level = xp.where(is_attained(fixed, start), bounds[0], xp.nan)
    if is_concrete(level) and not np.isfinite(concrete(level)):
        raise ValueError(
            "no law makes the loop stable: an unstable or undamped mode is not reached by the"
            " commands, or not seen by the sensors"
        )
    return level + _change(game, fixed, level) if any_jax(game) else level


def _change(game: Game, fixed: Game, level):
    """Zero, whose derivatives are those of the level at which 1 - S M / level^2 is singular.

    By its null vectors l and r: l' d(matrix) r = 0.
    """

    def coupled(game, level):
        M, spread = values(game, level)
        return xp.eye(M.shape[0]) - spread @ M / level**2

    matrix, slope = jax.jvp(lambda x: coupled(fixed, x), (level,), (xp.ones_like(level),))
    singular = stop_gradient(matrix)
    left, right = (
        xp.linalg.eigh(part)[1][:, 0] for part in (singular @ singular.T, singular.T @ singular)
    )
    change = left @ (coupled(game, level) - singular) @ right
    return -change / stop_gradient(left @ slope @ right)


def _opposed(game: Game, level) -> Square:
    """Matrix B R^-1 B' - E E' / level^2 of commands against disturbances."""
    return symmetric_part(game.B @ solve(game.R, game.B.T) - game.E @ game.E.T / level**2)


def _root(matrix: Square) -> Square:
    """Root S of a positive semidefinite matrix, S S' = matrix."""
    eigenvalues, vectors = xp.linalg.eigh(symmetric_part(matrix))
    return vectors * xp.sqrt(xp.maximum(eigenvalues, 0.0))


EXCESS = 1.05  # of the level over the least one, where none is given


class HInfinity(AbstractController):
    """Law that makes the worst gain from forces and noise to readings and commands small.

    Forces d on the beam and noise n of the readings y, in units of `force_size` and `noise_size`,
    cause readings and commands u in units of `output_size` and `command_size`; with T the period,

        sum of (y / output_size)^2 + (u / command_size)^2
            <= attenuation^2 x sum of (d / force_size)^2 + (n / noise_size)^2

    over the samples, for every course of d and n. Without `attenuation` it is 1.05 times the least
    that any linear law attains (`least_attenuation`). A larger `output_size` or a smaller
    `force_size` asks for less control. With `corner`, readings count through a first-order
    low-pass: slow deflections matter, and fast ones do not.

    The plant is that of the case without loads, or of the `design` model, exactly discretised with
    held forces and commands, and a `delay` below the period. Forces act at `positions`, by default
    those of the sensors; filters of the sensors are no part of it. The law is linear, of the order
    of this plant; it knows the commands as limited by the actuators.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.HInfinity(
    ...         output_size=2e-4, command_size=4.0, force_size=4.0, noise_size=1e-5, period=0.005
    ...     ),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.592 mm
    """

    kind: ClassVar[str] = "h-infinity"

    output_size: Float[Number, " *output"] = number(
        "unit of a reading", "size of each reading that counts as 1", POSITIVE
    )
    command_size: Float[Number, " *actuator"] = number(
        "unit of a command", "size of each command that counts as 1", POSITIVE
    )
    force_size: Float[Number, " *force"] = number(
        "N", "size of each disturbing force that counts as 1", POSITIVE
    )
    noise_size: Float[Number, " *output"] = number(
        "unit of a reading", "size of the noise of each reading that counts as 1", POSITIVE
    )
    positions: Float[Number, " force"] | None = number(
        "m",
        "places of the disturbing forces; those of the sensors if left out",
        ON_BEAM,
        default=None,
    )
    corner: Float[Number, ""] | None = number(
        "Hz",
        "corner frequency of the low-pass through which readings count",
        POSITIVE,
        default=None,
    )
    attenuation: Float[Number, ""] | None = number(
        "1", "worst gain, 1.05 times the least one if left out", POSITIVE, default=None
    )
    design: DesignModel | None = part("design model of the plant", DesignModel)

    @property
    def design_depends_on_loads(self) -> bool:
        return False

    def validate(self, case):
        outputs = len(case.sensors)
        actuators = len(case.driven)
        if self.period is None:
            return "period must be given: kind 'h-infinity' acts at samples"
        excess_delay = None if self.delay is None else self.delay - self.period
        if excess_delay is not None and is_concrete(excess_delay) and concrete(excess_delay) >= 0:
            return "delay must be less than the period: one pending command is allowed for"
        if outputs == 0:
            return "kind needs a sensor: its readings are fed back"
        for i, sensor in enumerate(case.sensors):
            quantity = QUANTITIES[sensor.quantity]
            if quantity.time_derivative > 1 or quantity.x_derivative > 1:
                return (
                    "kind needs sensors of deflection, slope or velocity, which forces do not"
                    f" move at once; sensors.{i} measures {sensor.quantity}"
                )
        forces = outputs if self.positions is None else self.positions.shape[0]
        sizes = {
            "output_size": outputs,
            "command_size": actuators,
            "force_size": forces,
            "noise_size": outputs,
        }
        for name, size in sizes.items():
            value = getattr(self, name)
            if value.shape not in ((), (size,)):
                return f"{name} must be one number or {size}, not {value.size}"
        if self.positions is not None:
            check_on_beam("controller.positions", self.positions, case.beam.length)
        error = None if self.design is None else self.design.validate(case)
        return None if error is None else f"design.{error}"

    def game(self, plant: Plant) -> Game:
        """Sampled plant of the design, in units of the sizes; its noise has the covariance 1.

        Its last states are, with a delay, the pending commands, and with a corner the filtered
        readings.
        """
        design = plant if self.design is None else self.design.design_plant(plant, "modal")
        system, sensors, model = design.unloaded, design.case.sensors, design.modal_model
        positions = self.positions
        if positions is None:
            positions = xp.stack([sensor.position for sensor in sensors])
        shapes = model.shapes(positions, (0,))[0]
        columns = xp.stack([row_on_states(model, shape, 1) for shape in shapes], axis=1)
        forces = design.from_modal(columns) * self.force_size
        sampled = sampled_plant(system.A, system.B, forces, self.period, self.delay)
        states, outputs = sampled.A.shape[0], len(sensors)
        rows = xp.pad(system.C[:outputs], ((0, 0), (0, states - system.A.shape[0])))
        A, B, E = sampled.A, sampled.B, sampled.E
        measured = rows / xp.broadcast_to(self.noise_size, (outputs,))[:, None]
        counted = rows / xp.broadcast_to(self.output_size, (outputs,))[:, None]
        if self.corner is not None:
            kept = xp.exp(-2 * xp.pi * self.corner * self.period)
            lower = xp.concatenate([(1 - kept) * counted, kept * xp.eye(outputs)], axis=1)
            A = xp.concatenate([xp.pad(A, ((0, 0), (0, outputs))), lower])
            B, E = (xp.pad(part, ((0, outputs), (0, 0))) for part in (B, E))
            measured = xp.pad(measured, ((0, 0), (0, outputs)))
            counted = xp.concatenate([xp.zeros((outputs, states)), xp.eye(outputs)], axis=1)
        weight = xp.broadcast_to(self.command_size, (B.shape[1],)) ** -2
        return Game(A, B, measured, E, counted.T @ counted, xp.diag(weight), xp.eye(outputs))

    def least_attenuation(self, plant: Plant) -> Float[Array, ""]:
        """Smallest worst-case gain of any linear law at these samples, for a plant (`state_space`).

        Raises ValueError if no law makes the loop stable.
        """
        return least_level(self.game(plant))

    def design_law(self, plant):
        """Law for a plant; raises ValueError for an attenuation that no law has."""
        game = self.game(plant)
        law = minimax_law(game, self._level(game))
        noise_size = xp.broadcast_to(self.noise_size, (game.C.shape[0],))
        return HInfinityLaw(law.F, law.G / noise_size, game.B, law.K, law.D / noise_size)

    def _level(self, game: Game) -> Float[Array, ""]:
        """Level of the design, given or 1.05 times the least; ValueError if no law has it."""
        if self.attenuation is None:
            return EXCESS * least_level(game)
        attained = is_attained(game, self.attenuation)
        if is_concrete(attained) and not concrete(attained):
            raise ValueError(
                f"controller.attenuation is {concrete(self.attenuation):g}, but no law has a worst"
                f" gain below {concrete(least_level(game)):.6g}: raise it, or leave it out"
            )
        return self.attenuation


class PredictedState(NamedTuple):
    """Predicted state x, before the effect of the last command, whose limited value comes later."""

    state: Float[Array, " state"]


class HInfinityLaw(AbstractSampledLaw):
    """Linear law u = K x + D y, x+ = F x + G y + B u, with the command u as limited."""

    F: Float[Array, "state state"]
    G: Float[Array, "state output"]
    B: Float[Array, "state actuator"]
    K: Float[Array, "actuator state"]
    D: Float[Array, "actuator output"]

    def initial_state(self):
        return PredictedState(xp.zeros(self.F.shape[0]))

    def step(self, state, measurement, t):
        readings = measurement.readings[: self.G.shape[1]]
        predicted = state.state + self.B @ measurement.command
        command = self.K @ predicted + self.D @ readings
        return ControlStep(command, PredictedState(self.F @ predicted + self.G @ readings))
