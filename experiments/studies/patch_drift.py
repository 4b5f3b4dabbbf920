"""Hysteresis and creep of a patch, and the errors left by inverses identified from a log.

The thesis sees the deflection lag behind a falling voltage (Fig. 2.33). Here the patch of rig B has
a hysteresis and a creep of 2 % a decade; both are identified from a log of commands that turn and
are held, with the noise of a laser, and their inverses are applied to another course of commands:
`python -m experiments.studies.patch_drift`.

Hysteresis and creep of an actuator from a log of commands that turn, and then are held.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

import jaxbeam as jb
import tuning
from jaxbeam.case.actuators.hysteresis import Creep, Hysteresis
from jaxbeam.case.library import rigs
from jaxbeam.model.deflection_lines import static_deflection_per_command
from jaxbeam.simulation.commands import command_operator
from tuning.fit.hysteresis import (
    channel_pair,
    checked_thresholds,
    non_negative,
    plays_of,
    spread_after_line,
)
from tuning.logs.log import Log

MAX_ITERATIONS = 200
LEAST_DECREASE = 1e-10  # of the residual, relative, at which the iteration ends


@dataclasses.dataclass(frozen=True)
class CreepFit:
    """Fitted operators; the first excursion to the largest command acts as that command at once.

    Readings are `offset` + `gain` (v + sum of c_i z_i) with v = H[u], with the standard deviation
    `residual` of what is left and `linear_residual` of what a line through the commands leaves, in
    units of the reading.
    """

    hysteresis: Hysteresis
    creep: Creep
    gain: float
    offset: float
    residual: float
    linear_residual: float


def fitted_creep(
    log: Log,
    command: str,
    reading: str,
    rates: Float[np.ndarray, " lag"] | None = None,
    thresholds: Float[np.ndarray, " play"] | None = None,
) -> CreepFit:
    """Hysteresis and creep from channels of a log, by non-negative least squares in turn.

    The readings are linear in the weights of the plays for given weights of the lags, and the other
    way round; each step lowers the residual. Between samples commands go straight. They are to turn
    at several sizes from rest and to be held, or to turn slowly, for as long as creep matters; the
    beam follows statically. `rates` (1/s) are a decade apart by default, from half of the
    sampling rate down to one over the length of the log; `thresholds` as in `fitted_hysteresis`,
    [0] for a creep without hysteresis.

    Raises ValueError as `fitted_hysteresis` does, and for rates that are not positive.

    >>> import jaxbeam as jb, numpy as np, tuning
    >>> from experiments.studies.patch_drift import fitted_creep
    >>> times, commands = np.arange(0.0, 40.0, 0.1), np.ones(400)
    >>> readings = 1 + 0.1 * (1 - np.exp(-0.5 * times))  # a step, then creep
    >>> commands[0] = readings[0] = 0.0
    >>> log = tuning.Log(
    ...     times,
    ...     np.stack([commands, 1e-5 * readings], axis=1),
    ...     ("u", "w"),
    ...     ("voltage", "deflection"),
    ...     ("V", "m"),
    ... )
    >>> found = fitted_creep(log, "u", "w", np.array([0.5]), np.zeros(1))
    >>> print(found.creep.weights.round(2))
    [0.1]
    """
    times, commands, readings = channel_pair(log, command, reading)
    thresholds = checked_thresholds(thresholds, commands)
    if rates is None:
        slowest, fastest = 1 / np.ptp(times), 0.5 / np.median(np.diff(times))
        decades = max(1, round(np.log10(fastest / slowest)))
        rates = np.geomspace(fastest, slowest, decades + 1)
    rates = np.asarray(rates, float)
    if rates.size == 0 or np.any(rates <= 0):
        raise ValueError("rates of creep must be positive, one or more, in 1/s")
    sign = 1.0 if np.cov(commands, readings)[0, 1] >= 0 else -1.0
    plays = sign * plays_of(thresholds, commands)
    lagged = np.stack([lags_of(rates, times, play) for play in plays.T], axis=1)
    creep, last = np.zeros(rates.size), np.inf
    for _ in range(MAX_ITERATIONS):
        weights, offset = non_negative(plays + np.einsum("tpl,l->tp", lagged, creep), readings)
        if not weights[0] > 0:
            raise ValueError(
                f"{reading!r} does not follow {command!r} where it turns: sample faster, or take"
                " fewer thresholds and lags"
            )
        at_once, lags = plays @ weights, np.einsum("tpl,p->tl", lagged, weights)
        scaled, offset = non_negative(np.column_stack([at_once, lags]), readings)
        weights, creep = weights * scaled[0], scaled[1:] / scaled[0]
        left = readings - offset - scaled[0] * (at_once + lags @ creep)
        if np.std(left) > (1 - LEAST_DECREASE) * last:
            break
        last = np.std(left)
    size = np.max(np.abs(commands))
    scale = weights @ np.maximum(size - thresholds, 0.0) / size
    return CreepFit(
        Hysteresis(thresholds, weights / scale),
        Creep(rates, creep),
        float(sign * scale),
        float(offset),
        float(np.std(left)),
        spread_after_line(commands, readings),
    )


def lags_of(rates, times, values) -> Float[np.ndarray, "time lag"]:
    """Lags z_i' = a_i (v - z_i) at each sample, from z = 0, with v straight between samples."""
    found, lags = np.zeros((len(times), len(rates))), np.zeros(len(rates))
    for i, step in enumerate(np.diff(times)):
        decay = rates * step
        slope = (values[i + 1] - values[i]) / decay  # over a unit of decay
        behind = lags - values[i] + slope
        lags = values[i + 1] - slope + behind * np.exp(-decay)
        found[i + 1] = lags
    return found


HYSTERESIS = jb.actuators.Hysteresis([0.0, 0.5, 1.5, 3.0], [0.75, 0.12, 0.08, 0.08])
CREEP = jb.actuators.Creep([10.0, 1.0, 0.1], [0.02, 0.02, 0.02])
TURNS = np.array([0.0, 3.0, 3.0, -1.0, -1.0, 6.0, 6.0, -2.0, 7.0, 7.0, 0.0])  # V, a turn each 3 s
INTERVAL, NOISE = 0.1, 2e-7  # s; m
PERIOD = 0.05


class RemainingErrors(NamedTuple):
    """Largest errors of the effective command, over the largest desired command, by inverse."""

    straight: float
    without_creep: float
    compensated: float


def log_of_patch() -> tuning.Log:
    """Commands and deflections of the patch by itself, quasi-static, sampled at 10 Hz."""
    times = np.arange(0.0, 3.0 * (len(TURNS) - 1) + INTERVAL / 2, INTERVAL)
    commands = np.interp(times, 3.0 * np.arange(len(TURNS)), TURNS)
    operator = command_operator(HYSTERESIS, CREEP, np.asarray(INTERVAL))
    patch = dataclasses.replace(rigs.load("B"), loads=(), controller=None)
    gain = float(static_deflection_per_command(patch, 0.3)[0])
    readings = gain * _effective(operator, commands)
    readings += NOISE * np.random.default_rng(1).normal(size=times.size)
    values = np.stack([commands, readings], axis=1)
    return tuning.Log(times, values, ("u", "w"), ("voltage", "deflection"), ("V", "m"))


def remaining_errors(found: CreepFit) -> RemainingErrors:
    """Errors of the effective command for four smooth pulses, and then 4 V for 20 s."""
    times = np.arange(0.0, 30.0, PERIOD)
    wanted = np.where(times < 10.0, 3 * (1 - np.cos(2 * np.pi * times / 2.5)), 4.0)
    true = command_operator(HYSTERESIS, CREEP, np.asarray(PERIOD))
    scale = float(true.hysteresis.first_output(np.asarray(7.0))) / 7.0
    errors = []
    for creep in (None, found.creep):
        fitted = command_operator(found.hysteresis, creep, np.asarray(PERIOD))
        errors.append(_effective(true, _effective(fitted.inverse(), wanted)) / scale - wanted)
    straight = _effective(true, wanted) / scale - wanted
    return RemainingErrors(*(float(np.max(np.abs(e)) / wanted.max()) for e in (straight, *errors)))


def _effective(operator, commands) -> np.ndarray:
    """Output of a hysteresis and creep operator for successive commands, from rest."""
    state, found = operator.start(1), []
    for command in commands:
        state = operator.follow(state, np.full(1, command))
        found.append(float(operator.output(state)[0]))
    return np.array(found)


def table() -> str:
    """Text of the errors by hysteresis and creep, in per cent of the largest command."""
    found = fitted_creep(log_of_patch(), "u", "w")
    left = remaining_errors(found)
    return "\n".join(
        [
            f"identified with rates {found.creep.rates.round(3)} 1/s, weights"
            f" {found.creep.weights.round(4)}; residual {1e6 * found.residual:.2f} um of"
            f" {1e6 * found.linear_residual:.2f} um by a line",
            "largest error of the effective command, over the largest command:",
            f"  commands as they are            {left.straight:6.1%}",
            f"  inverse of the hysteresis       {left.without_creep:6.1%}",
            f"  inverse of hysteresis and creep {left.compensated:6.1%}",
        ]
    )


if __name__ == "__main__":
    print(table())
