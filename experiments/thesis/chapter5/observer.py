"""Sampled control by an observer that knows the load: Fig. 5.5.

With R = 1e6 the observer hardly listens to its sensor, so its states are those of the model it
was made of: the beam without the mass of the load, but with its weight. Commands are therefore
those of this model under its own regulator, a moving force on it, and are sent to the beam with
the mass.
"""

import dataclasses

import numpy as np

import jaxbeam as jb
from experiments.thesis.cases import as_moving_force
from experiments.thesis.chapter5 import published
from experiments.thesis.chapter5.regulator_limits import (
    COMMAND_WEIGHT,
    OTHER_SHAKER,
    optimal_gain,
    with_active_shaker,
    with_other_shaker,
)
from experiments.thesis.verdicts import Finding, make_finding

PERIOD, MASS, SPEED = 2e-4, 0.501, 0.5  # s, kg, m/s, of Fig. 5.4
SENSOR, TOLERANCE = 1, 1e-4


def observed_regulator(rig: jb.Case, weights, effort: float, obstacle: str) -> Finding:
    """How far the observed regulator reduces the peak; `effort` is another R that is printed."""
    rig = jb.replace(with_active_shaker(rig), {"loads.0.mass": MASS, "loads.0.speed": SPEED})
    interpretations = {
        f"R = {effort:g}, as in the experiments": _reduction(rig, weights, effort),
        OTHER_SHAKER: _reduction(with_other_shaker(rig), weights, COMMAND_WEIGHT),
    }
    return make_finding(
        published.OBSERVED_REGULATOR,
        _reduction(rig, weights, COMMAND_WEIGHT),
        {word: np.atleast_1d(value) for word, value in interpretations.items()},
        obstacle,
    )


def _reduction(rig: jb.Case, weights, effort: float) -> float:
    """By how much (%) the peak at 0.25 m is below that without control."""
    duration = float(rig.beam.length / rig.loads[0].speed)
    run = dataclasses.replace(rig.run, duration=np.asarray(duration))
    rig = dataclasses.replace(rig, run=run)
    gain = optimal_gain(rig, PERIOD, weights, effort)[0]
    law = jb.StateFeedback(gain=gain, coordinates="sine", period=PERIOD)
    sampling_instants = np.arange(round(duration / PERIOD)) * PERIOD
    model = dataclasses.replace(as_moving_force(rig), controller=law)
    commands = np.asarray(jb.simulate(model, sampling_instants, tolerance=TOLERANCE).command)
    prescribed = jb.Prescribed(offsets=[0.0], times=sampling_instants, values=commands.T)
    uncontrolled, controlled = (
        float(jb.simulate(one, tolerance=TOLERANCE).peak_deflection[SENSOR])
        for one in (rig, dataclasses.replace(rig, controller=prescribed))
    )
    return 100 * (1 - controlled / uncontrolled)
