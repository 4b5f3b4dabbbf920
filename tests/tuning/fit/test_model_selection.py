"""Model selection by information criteria: an elastic support of span two, and a delayed actuator.

A finite-element rig has both effects, and the criteria select the model with both.
"""

import dataclasses

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.case import replace
from tests.oracles import finite_elements
from tests.tuning.finite_element_rigs import SAGGING, SHAKER, SimulatedIdentification, plant
from tuning.fit.model_validation import compare_fits
from tuning.parameters.free import to_unbounded

DELAY = 4e-3  # s
STIFF, PROMPT = 1e7, 1e4  # N/m and 1/s: without either effect
BANDWIDTH, SUPPORT = "actuators.0.bandwidth", "supports.1.stiffness"


@pytest.fixture(scope="module")
def identification() -> SimulatedIdentification:
    """A delayed shaker on the second span, whose outer support is elastic."""
    rig = plant(
        2,
        11.68,
        0.535,
        [jb.Shaker(**(SHAKER | {"position": 0.9}))],
        [finite_elements.Suspension(0.9, *list(SHAKER.values())[1:3])],
        {0.6: 1e7, 1.2: SAGGING},
        [(0.3,), (0.9,)],
        modes=5,
        ends="pinned-free",
    )
    delayed = dataclasses.replace(rig, case=replace(rig.case, {BANDWIDTH: 1 / DELAY}))
    truth = {name: rig.truth[name] for name in ("beam.flexural_rigidity", SUPPORT)}
    return SimulatedIdentification(
        dataclasses.replace(delayed, truth=truth | {BANDWIDTH: 1 / DELAY})
    )


def test_criteria_select_elastic_supports_and_delayed_actuators(identification):
    noise = np.random.default_rng(0).normal(size=identification.clean.shape)
    names = list(identification.truth)
    held = identification.truth | {SUPPORT: STIFF, BANDWIDTH: PROMPT}
    point = to_unbounded(identification.parameters, [held[name] for name in names])
    models = {
        "neither": [names[0]],
        "sags": [names[0], SUPPORT],
        "late": [names[0], BANDWIDTH],
        "both": names,
    }
    fits, summaries = {}, {}
    for name, free in models.items():
        free = np.array([address in free for address in names])
        fit = identification.result(noise, identification.fit(noise, free, point))
        summaries[name] = str(fit)
        moving = [p for p, moves in zip(identification.parameters, free, strict=True) if moves]
        fits[name] = dataclasses.replace(fit, parameters=moving)
    ranked = compare_fits(fits)
    assert ranked[0].name == "both" and ranked[-1].name == "neither"
    assert ranked[1].bic - ranked[0].bic > 10 and ranked[0].weight > 0.99
    values = dict(zip(names, fits["both"].values, strict=True))
    assert values[SUPPORT] == pytest.approx(SAGGING, rel=0.05)
    # The model has a lag in place of the pure delay; they agree at low frequencies only.
    assert 1 / values[BANDWIDTH] == pytest.approx(DELAY, rel=0.2)
    assert "unreliable" in summaries["sags"] and "unreliable" in summaries["late"]
