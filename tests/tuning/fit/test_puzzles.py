"""Two questions of the thesis: yielding supports of the second span, and a late actuator.

A rig of finite elements has both; information criteria select the model that has both, too.
"""

import dataclasses

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.case import replace
from tests.oracles import finite_elements
from tests.tuning.rehearsals import SAGGING, SHAKER, Rehearsal, plant
from tuning.fit.model_validation import compare_fits
from tuning.parameters.free import to_unbounded

LATE = 4e-3  # s
STIFF, PROMPT = 1e7, 1e4  # N/m and 1/s: without either effect
BANDWIDTH, SUPPORT = "actuators.0.bandwidth", "supports.1.stiffness"


@pytest.fixture(scope="module")
def rehearsal() -> Rehearsal:
    """A late shaker on the second span, whose outer support yields."""
    made = plant(
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
    late = dataclasses.replace(made, case=replace(made.case, {BANDWIDTH: 1 / LATE}))
    truth = {name: made.truth[name] for name in ("beam.flexural_rigidity", SUPPORT)}
    return Rehearsal(dataclasses.replace(late, truth=truth | {BANDWIDTH: 1 / LATE}))


@pytest.mark.slow
def test_criteria_select_yielding_supports_and_late_actuators(rehearsal):
    noise = np.random.default_rng(0).normal(size=rehearsal.clean.shape)
    names = list(rehearsal.truth)
    held = rehearsal.truth | {SUPPORT: STIFF, BANDWIDTH: PROMPT}
    point = to_unbounded(rehearsal.parameters, [held[name] for name in names])
    models = {
        "neither": [names[0]],
        "sags": [names[0], SUPPORT],
        "late": [names[0], BANDWIDTH],
        "both": names,
    }
    fits, summaries = {}, {}
    for name, free in models.items():
        free = np.array([address in free for address in names])
        fit = rehearsal.result(noise, rehearsal.fit(noise, free, point))
        summaries[name] = str(fit)
        moving = [p for p, moves in zip(rehearsal.parameters, free, strict=True) if moves]
        fits[name] = dataclasses.replace(fit, parameters=moving)
    ranked = compare_fits(fits)
    assert ranked[0].name == "both" and ranked[-1].name == "neither"
    assert ranked[1].bic - ranked[0].bic > 10 and ranked[0].weight > 0.99
    found = dict(zip(names, fits["both"].values, strict=True))
    assert found[SUPPORT] == pytest.approx(SAGGING, rel=0.05)
    # The model has a lag in place of the pure delay; they agree at low frequencies only.
    assert 1 / found[BANDWIDTH] == pytest.approx(LATE, rel=0.2)
    assert "unreliable" in summaries["sags"] and "unreliable" in summaries["late"]
