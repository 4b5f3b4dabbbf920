"""Laws with the numbers that docs/howto/controllers.md prints: none is worse than no law."""

import dataclasses
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.analysis.stability import stability_margin
from jaxbeam.control.state_controller import DesignModel
from jaxbeam.files.case_file import case_from_dict, case_to_dict

PAGE = Path(__file__).parents[2] / "docs/howto/controllers.md"
BLOCKS = re.findall(r"^```toml\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.M | re.S)
LAWS = {
    content["controller"]["kind"]: content
    for content in map(tomllib.loads, BLOCKS)
    if "kind" in content.get("controller", {})
}


def strip(modes=3, sensors=(0.3,), mass=0.3, speed=1.5, entry=0.0) -> jb.Case:
    """A strip of 0.6 m with a force at midspan, which a mass crosses."""
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=modes),
        actuators=[jb.PointForce(0.3, limits=[-4.0, 4.0])],
        sensors=[jb.Sensor(x) for x in sensors],
        loads=[jb.MovingMass(mass=mass, speed=speed, entry_time=entry)],
        run=jb.Run(0.6 + entry),
    )


VELOCITY = [jb.Sensor(0.3), jb.Sensor(0.3, "velocity")]

# The strip for the law of each block, and the largest peak in terms of that without the law.
STRIPS = {
    "feedback": (strip(mass=0.5), 0.95),  # of a patch
    "internal-model-scheduled": (strip(), 0.8),
    "sliding-mode": (strip(2, (0.2, 0.4)), 0.5),
    "semi-active": (dataclasses.replace(strip(), sensors=VELOCITY), 0.98),  # by damping alone
    "h-infinity": (strip(), 0.8),
    "lqr": (strip(2, (0.2, 0.4), mass=0.4, speed=2.0), 0.7),
}


def peak_share(case: jb.Case) -> float:
    """Peak of a case in terms of that without its controller."""
    free = jb.simulate(dataclasses.replace(case, controller=None))
    return float(np.max(jb.simulate(case).peak_deflection) / np.max(free.peak_deflection))


def test_all_blocks_are_tried():
    assert set(LAWS) == set(STRIPS)


@pytest.mark.parametrize("kind", LAWS)
def test_printed_laws(kind):
    case, most = STRIPS[kind]
    case = case_from_dict(case_to_dict(case) | LAWS[kind])
    assert peak_share(case) < most
    if kind != "lqr":  # whose filter varies with its estimates
        assert stability_margin(case, verdict_only=True).verdict == "stable"


def test_sliding_mode_that_cancels_the_motion_of_the_plant():
    """Beside the printed numbers: less is left of a crossing, but a mass that stays is unstable."""
    free = STRIPS["sliding-mode"][0]
    printed = case_from_dict(case_to_dict(free) | LAWS["sliding-mode"])
    law = dataclasses.replace(
        printed.controller, rate=np.array(200.0), layer=np.array(0.05), equivalent="included"
    )
    cancelling = dataclasses.replace(printed, controller=law)
    assert 3 * peak_share(cancelling) < peak_share(printed)
    assert stability_margin(cancelling, verdict_only=True).verdict == "unstable"


@pytest.mark.filterwarnings("ignore:load 0 loses contact")  # of the cheap moves
def test_scenarios_with_the_factors_of_the_page():
    """All six plants gain by the law with dear moves; one with cheap moves does harm."""
    text = " ".join(PAGE.read_text(encoding="utf-8").split())
    assert "`stiffness_factors = [0.8, 0.8, 1.2, 1.2]`, `delays = [0.0, 0.008, 0.0, 0.008]`" in text
    assert "`move_weight = 1e-6`" in text
    free = strip(2, (0.2, 0.4), mass=0.4, speed=2.0)
    factors = {"stiffness_factors": [0.8, 0.8, 1.2, 1.2], "delays": [0.0, 0.008, 0.0, 0.008]}
    largest = {}
    for weight in (1e-6, 1e-11):
        law = jb.ScenarioMPC(
            6, 4, weight, period=0.01, nominal_plant=jb.state_space(free), **factors
        )
        cases = [
            jb.replace(
                dataclasses.replace(free, controller=dataclasses.replace(law, delay=delay)),
                {"beam.flexural_rigidity": stiffness * 11.68},
            )
            for stiffness in (0.8, 1.0, 1.2)
            for delay in (None, np.array(0.008))
        ]
        largest[weight] = max(map(peak_share, cases))
    assert largest[1e-6] < 0.55 and largest[1e-11] > 1.5


def test_positive_position_feedback_damps_and_softens():
    """The static stiffness 48 E I / L^3 falls by the gain: 2596 to 1796 N/m, nearly."""
    law = jb.PositivePositionFeedback([800.0], 17.0, damping_ratio=0.3, period=0.002)
    free, case = strip(), dataclasses.replace(strip(), controller=law)
    static = 48 * 11.68 / 0.6**3
    assert peak_share(case) == pytest.approx(static / (static - 800.0), rel=0.05)
    runs = jb.simulate(case), jb.simulate(free)
    after, free_after = (np.abs(one.deflection[one.times > 0.5]).max() for one in runs)
    assert after < 0.5 * free_after


@pytest.mark.parametrize(("modes", "bound"), [(1, 0.8), (2, 0.8)])
def test_adaptive_predictive_control_of_few_modes(modes, bound):
    law = jb.AdaptiveGPC(
        8, 2, 1e-9, probe=0.5, until=0.4, period=0.005, design=DesignModel(modes=modes)
    )
    assert peak_share(dataclasses.replace(strip(entry=0.6), controller=law)) < bound
