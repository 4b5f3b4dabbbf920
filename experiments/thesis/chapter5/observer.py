"""Sampled regulator with an observer that models the load: Fig. 5.5.

With R = 1e6 the observer hardly corrects its states by the sensor, so that they are those of its
own model: the beam without the mass of the load, but with its weight. Commands are therefore
computed for this model under its own regulator, crossed by a moving force, and applied to the beam
with the moving mass.
"""

import dataclasses

import numpy as np

import jaxbeam as jb
from experiments.thesis.cases import as_moving_force, reduction, with_duration
from experiments.thesis.chapter5 import published
from experiments.thesis.chapter5.regulator_limits import (
    COMMAND_WEIGHT,
    OTHER_SHAKER,
    optimal_gain,
    with_active_shaker,
    with_other_shaker,
)
from experiments.thesis.verdicts import Finding, make_finding
from jaxbeam.simulation.closed_loop import loop_schedule
from jaxbeam.simulation.integration_plan import IntegrationPlan, static_shapes

PERIOD, MASS, SPEED = 2e-4, 0.501, 0.5  # s, kg, m/s, of Fig. 5.4
SENSOR, TOLERANCE = 1, 1e-4


def observed_regulator(rig: jb.Case, state_weights, command_weight: float) -> Finding:
    """Reduction (%) of the peak by the observed regulator.

    `command_weight` is the other printed R, that of the experiments.
    """
    rig = jb.replace(with_active_shaker(rig), {"loads.0.mass": MASS, "loads.0.speed": SPEED})
    alternatives = {
        f"R = {command_weight:g}, as in the experiments": _reduction(
            rig, state_weights, command_weight
        ),
        OTHER_SHAKER: _reduction(with_other_shaker(rig), state_weights, COMMAND_WEIGHT),
    }
    literal = _reduction(rig, state_weights, COMMAND_WEIGHT)
    return make_finding(
        published.OBSERVED_REGULATOR, literal, alternatives, null=("no control", 0.0)
    )


def _reduction(rig: jb.Case, state_weights, command_weight: float) -> float:
    """Reduction (%) of the peak at 0.25 m."""
    duration = float(rig.beam.length / rig.loads[0].speed)
    rig = with_duration(rig, duration)
    gain = optimal_gain(rig, PERIOD, state_weights, command_weight)[0]
    law = jb.StateFeedback(gain=gain, coordinates="sine", period=PERIOD)
    sampling_instants = np.arange(round(duration / PERIOD)) * PERIOD
    model = dataclasses.replace(as_moving_force(rig), controller=law)
    commands = np.asarray(_simulate_sampled(model, sampling_instants).command)
    prescribed = jb.Prescribed(
        offsets=[0.0], times=sampling_instants, values=commands.T, period=PERIOD
    )
    controlled = _simulate_sampled(
        dataclasses.replace(rig, controller=prescribed), sampling_instants
    )
    uncontrolled = jb.simulate(rig, tolerance=TOLERANCE)
    return float(
        reduction(uncontrolled.peak_deflection[SENSOR], controlled.peak_deflection[SENSOR])
    )


def _simulate_sampled(case: jb.Case, times: np.ndarray) -> jb.Record:
    """Record of a sampled loop with one step in each period, a quarter radian of the third mode."""
    plan = IntegrationPlan(static_shapes(case), 1, 0, False, 0.0, loop_schedule(case, times))
    return jb.simulate(case, times, plan)
