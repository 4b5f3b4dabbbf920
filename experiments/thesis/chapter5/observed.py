"""Sampled control by an observer that knows the load: Fig. 5.5.

With R = 1e6 the observer hardly listens to its sensor, so its states are those of the model it
was made of: the beam without the mass of the load, but with its weight. Commands are therefore
those of this model under its own regulator, a moving force on it, and are sent to the beam with
the mass.
"""

import dataclasses

import numpy as np

import jaxbeam as jb
from experiments.thesis import published
from experiments.thesis.beams import as_force
from experiments.thesis.chapter5.regulator_limits import (
    EFFORT,
    UNLIKE,
    active,
    optimal_gain,
    unlike,
)
from experiments.thesis.verdicts import Finding, finding

PERIOD, MASS, SPEED = 2e-4, 0.501, 0.5  # s, kg, m/s, of Fig. 5.4
SENSOR, TOLERANCE = 1, 1e-4


def observed(rig: jb.Case, weights, effort: float, obstacle: str) -> Finding:
    """How far the observed regulator reduces the peak; `effort` is another R that is printed."""
    rig = jb.replace(active(rig), {"loads.0.mass": MASS, "loads.0.speed": SPEED})
    others = {
        f"R = {effort:g}, as in the experiments": _less(rig, weights, effort),
        UNLIKE: _less(unlike(rig), weights, EFFORT),
    }
    return finding(
        published.OBSERVED,
        _less(rig, weights, EFFORT),
        {word: np.atleast_1d(value) for word, value in others.items()},
        obstacle,
    )


def _less(rig: jb.Case, weights, effort: float) -> float:
    """By how much (%) the peak at 0.25 m is below that without control."""
    duration = float(rig.beam.length / rig.loads[0].speed)
    run = dataclasses.replace(rig.run, duration=np.asarray(duration))
    rig = dataclasses.replace(rig, run=run)
    gain = optimal_gain(rig, PERIOD, weights, effort)[0]
    law = jb.StateFeedback(gain=gain, coordinates="sine", period=PERIOD)
    ticks = np.arange(round(duration / PERIOD)) * PERIOD
    model = dataclasses.replace(as_force(rig), controller=law)
    commands = np.asarray(jb.simulate(model, ticks, tolerance=TOLERANCE).command)
    sent = jb.Prescribed(offsets=[0.0], times=ticks, values=commands.T)
    free, controlled = (
        float(jb.simulate(one, tolerance=TOLERANCE).peak_deflection[SENSOR])
        for one in (rig, dataclasses.replace(rig, controller=sent))
    )
    return 100 * (1 - controlled / free)
