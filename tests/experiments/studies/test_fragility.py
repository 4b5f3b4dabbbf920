"""Laws set by hand, and changes of plants and gates that laws do not know."""

import dataclasses

import numpy as np
import pytest

import jaxbeam as jb
from experiments.studies import fragility, hand_set
from experiments.studies.tune_feedforward import COMMAND_LIMITS
from jaxbeam import rigs
from jaxbeam.case.controller import Measurement


@pytest.mark.parametrize("rig", ["B", "C"])
def test_hand_set_laws_stay_within_the_limits(rig):
    law, table = hand_set.trapezium(rig), hand_set.drawn_table(rig)
    low, high = COMMAND_LIMITS
    for values in (law.values, table.values):
        assert values.min() >= low and values.max() == high
    assert law.values.shape == (len(rigs.load(rig).actuators), law.shares.shape[0])


def test_trapezium_of_rig_b_has_the_four_numbers():
    law = hand_set.trapezium("B")
    np.testing.assert_allclose(law.shares, [0, 0.2, 0.9, 1])
    np.testing.assert_allclose(law.values, [[0, 7.5, 7.5, 0]])


@pytest.mark.parametrize("error", [-0.1, 0.1])
def test_a_misplaced_gate_makes_the_load_seem_faster_or_slower(error):
    """Commands over time against the table at the position that the gates suggest."""
    case = fragility.standard_case(rigs.load("B"))
    law = hand_set.trapezium("B")
    case = fragility.with_gate_error(dataclasses.replace(case, controller=law), error)
    designed = case.controller.law(jb.state_space(case))
    entry, gate = fragility.HELD_OUT_ENTRY_TIME, float(law.gates[1])
    for t in (0.1, 0.4, 0.9):
        seen = (t + float(law.lead) - entry - gate / fragility.SPEED) * fragility.SPEED
        position = gate + seen * (1 + error)
        expected = np.interp(position / 0.6, law.shares, law.values[0], left=0, right=0)
        step = designed.step((), Measurement(np.zeros(1), np.zeros(6), np.zeros(1)), t)
        np.testing.assert_allclose(step.command, [expected], atol=1e-9)


def test_a_softer_plant_keeps_the_design_of_the_law():
    by_law = fragility.laws(fragility.standard_case(rigs.load("B")))
    case = by_law[fragility.SENSORS_ONLY]
    softer = fragility.with_rigidity(case, 0.8)
    assert float(softer.beam.flexural_rigidity) == pytest.approx(0.8 * 13.211)
    np.testing.assert_allclose(
        softer.controller.law(jb.state_space(softer)).static_lift,
        case.controller.law(jb.state_space(case)).static_lift,
    )
