"""Hysteresis and creep of a patch, and what the inverses that a log identifies leave of them.

The thesis sees the deflection lag behind a falling voltage (Fig. 2.33). Here the patch of rig B has
a hysteresis and a creep of 2 % a decade; both are identified from a log of commands that turn and
are held, with the noise of a laser, and their inverses are applied to another course of commands:
`python -m experiments.studies.patch_drift`.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

import jaxbeam as jb
import tuning
from experiments.studies.creep import CreepFit, fitted_creep
from jaxbeam import rigs
from jaxbeam.model.deflection_lines import static_deflection_per_command
from jaxbeam.simulation.commands import command_operator

HYSTERESIS = jb.actuators.Hysteresis([0.0, 0.5, 1.5, 3.0], [0.75, 0.12, 0.08, 0.08])
CREEP = jb.actuators.Creep([10.0, 1.0, 0.1], [0.02, 0.02, 0.02])
TURNS = np.array([0.0, 3.0, 3.0, -1.0, -1.0, 6.0, 6.0, -2.0, 7.0, 7.0, 0.0])  # V, a turn each 3 s
INTERVAL, NOISE = 0.1, 2e-7  # s; m
PERIOD = 0.05


class Left(NamedTuple):
    """Largest error of what acts, of a wanted course of commands, over its largest command."""

    straight: float
    without_creep: float
    compensated: float


def log_of_patch(seed: int = 1) -> tuning.Log:
    """Commands and deflections of the patch by itself, quasi-static, sampled at 10 Hz."""
    times = np.arange(0.0, 3.0 * (len(TURNS) - 1) + INTERVAL / 2, INTERVAL)
    commands = np.interp(times, 3.0 * np.arange(len(TURNS)), TURNS)
    operator = command_operator(HYSTERESIS, CREEP, np.asarray(INTERVAL))
    patch = dataclasses.replace(rigs.load("B"), loads=(), controller=None)
    gain = float(static_deflection_per_command(patch, 0.3)[0])
    readings = gain * _acting(operator, commands)
    readings += NOISE * np.random.default_rng(seed).normal(size=times.size)
    values = np.stack([commands, readings], axis=1)
    return tuning.Log(times, values, ("u", "w"), ("voltage", "deflection"), ("V", "m"))


def what_is_left(found: CreepFit) -> Left:
    """Errors of what acts where four smooth pulses, and then 4 V for 20 s, are wanted."""
    times = np.arange(0.0, 30.0, PERIOD)
    wanted = np.where(times < 10.0, 3 * (1 - np.cos(2 * np.pi * times / 2.5)), 4.0)
    true = command_operator(HYSTERESIS, CREEP, np.asarray(PERIOD))
    scale = float(true.hysteresis.first_output(np.asarray(7.0))) / 7.0
    errors = []
    for creep in (None, found.creep):
        fitted = command_operator(found.hysteresis, creep, np.asarray(PERIOD))
        errors.append(_acting(true, _acting(fitted.inverse(), wanted)) / scale - wanted)
    straight = _acting(true, wanted) / scale - wanted
    return Left(*(float(np.max(np.abs(e)) / wanted.max()) for e in (straight, *errors)))


def _acting(operator, commands) -> np.ndarray:
    """What acts for commands in turn, from rest."""
    state, found = operator.start(1), []
    for command in commands:
        state = operator.follow(state, np.full(1, command))
        found.append(float(operator.output(state)[0]))
    return np.array(found)


def table() -> str:
    """What is left of hysteresis and creep, in per cent of the largest command."""
    found = fitted_creep(log_of_patch(), "u", "w")
    left = what_is_left(found)
    return "\n".join(
        [
            f"identified with rates {found.creep.rates.round(3)} 1/s, weights"
            f" {found.creep.weights.round(4)}; residual {1e6 * found.residual:.2f} um of"
            f" {1e6 * found.linear_residual:.2f} um by a line",
            "largest error of what acts, of the largest command:",
            f"  commands as they are            {left.straight:6.1%}",
            f"  inverse of the hysteresis       {left.without_creep:6.1%}",
            f"  inverse of hysteresis and creep {left.compensated:6.1%}",
        ]
    )


if __name__ == "__main__":
    print(table())
