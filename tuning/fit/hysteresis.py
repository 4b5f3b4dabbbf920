"""Hysteresis of an actuator from a log of slow commands and the readings that follow them."""

import dataclasses

import numpy as np
import scipy.optimize
from jaxtyping import Float

from jaxbeam.case.actuators.hysteresis import Hysteresis
from tuning.logs.log import Log

DEFAULT_PLAYS = 8  # thresholds, evenly spaced up to the largest command


@dataclasses.dataclass(frozen=True)
class HysteresisFit:
    """Fitted hysteresis, scaled so that the first excursion to the largest command is unchanged.

    Readings are `offset` + `gain` H[u]; `residual` is the standard deviation of their residuals,
    `linear_residual` that after a fitted line in the commands, in units of the reading.
    """

    hysteresis: Hysteresis
    gain: float
    offset: float
    residual: float
    linear_residual: float


def fitted_hysteresis(
    log: Log,
    command: str,
    reading: str,
    thresholds: Float[np.ndarray, " play"] | None = None,
) -> HysteresisFit:
    """Prandtl-Ishlinskii operator from channels of a log, by non-negative least squares.

    Commands are to be slow, so that the beam follows statically, and to turn at several sizes from
    rest; the first sample is at rest. `thresholds` begin with zero; by default they are spaced
    evenly up to the largest command.

    Raises ValueError for a channel that the log lacks, commands that are constant, thresholds that
    do not begin with zero and increase, and readings that do not rise or fall with the command.

    >>> import jaxbeam as jb, numpy as np, tuning
    >>> from tuning.fit.hysteresis import fitted_hysteresis
    >>> true = jb.actuators.Hysteresis([0.0, 1.0], [0.8, 0.25])
    >>> commands = np.concatenate([np.linspace(0, 5, 50), np.linspace(5, -5, 99)[1:]])
    >>> values = np.stack([commands, 1e-5 * true.outputs(commands)], axis=1)
    >>> kinds = ("voltage", "deflection"), ("V", "m")
    >>> log = tuning.Log(np.arange(148.0), values, ("u", "w"), *kinds)
    >>> print(fitted_hysteresis(log, "u", "w", np.array([0.0, 1.0])).hysteresis.weights)
    [0.8  0.25]
    """
    _, commands, readings = channel_pair(log, command, reading)
    thresholds = checked_thresholds(thresholds, commands)
    plays = plays_of(thresholds, commands)
    sign = 1.0 if np.cov(commands, readings)[0, 1] >= 0 else -1.0
    weights, offset = non_negative(sign * plays, readings)
    if not weights[0] > 0:
        raise ValueError(
            f"{reading!r} does not follow {command!r} where it turns: take a slower log, or fewer"
            " thresholds"
        )
    size = np.max(np.abs(commands))
    scale = weights @ np.maximum(size - thresholds, 0.0) / size
    left = readings - offset - sign * plays @ weights
    return HysteresisFit(
        Hysteresis(thresholds, weights / scale),
        float(sign * scale),
        float(offset),
        float(np.std(left)),
        spread_after_line(commands, readings),
    )


def channel_pair(log: Log, command: str, reading: str) -> tuple[np.ndarray, ...]:
    """Times (s), commands and readings of the samples that are valid in both channels.

    Raises ValueError for a channel that the log lacks and for commands that are constant.
    """
    for name in (command, reading):
        if name not in log.names:
            raise ValueError(f"the log has no channel {name!r}; it has {', '.join(log.names)}")
    places = [log.names.index(name) for name in (command, reading)]
    rows = slice(None) if log.valid is None else np.all(log.valid[:, places], axis=1)
    commands, readings = log.values[rows][:, places].T
    if np.ptp(commands) == 0:
        raise ValueError(f"the commands {command!r} are constant: a hysteresis shows as they turn")
    return np.asarray(log.times)[rows], commands, readings


def checked_thresholds(thresholds, commands) -> Float[np.ndarray, " play"]:
    """Thresholds of plays, by default evenly spaced up to the largest command.

    Raises ValueError if they do not begin with zero and increase.
    """
    if thresholds is None:
        return np.max(np.abs(commands)) * np.arange(DEFAULT_PLAYS) / DEFAULT_PLAYS
    thresholds = np.asarray(thresholds, float)
    if thresholds.size == 0 or thresholds[0] != 0 or np.any(np.diff(thresholds) <= 0):
        raise ValueError("thresholds must begin with 0 and increase")
    return thresholds


def spread_after_line(commands, readings) -> float:
    """Standard deviation of the residuals of readings after a fitted line in the commands."""
    line = np.polynomial.Polynomial.fit(commands, readings, 1)(commands)
    return float(np.std(readings - line))


def plays_of(thresholds, commands) -> Float[np.ndarray, "time play"]:
    """States of plays of unit weight at each sample, from rest."""
    operator, plays, found = Hysteresis(thresholds, np.ones(thresholds.size)), thresholds * 0, []
    for one in commands:
        plays = operator.follow(plays, np.asarray(one))
        found.append(plays)
    return np.array(found)


def non_negative(plays, readings) -> tuple[Float[np.ndarray, " play"], float]:
    """Weights of columns, such as plays, and an offset of either sign, by least squares.

    Columns are scaled, so that no unit matters.
    """
    columns = np.column_stack([plays, np.ones(len(plays)), -np.ones(len(plays))])
    norms = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    size = np.max(np.abs(readings)) or 1.0
    found = scipy.optimize.nnls(columns / norms, readings / size)[0] * size / norms
    return found[:-2], float(found[-2] - found[-1])
