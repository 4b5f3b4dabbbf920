"""Model selection by information criteria: an elastic support of span two, and a delayed actuator.

A finite-element rig has both effects, and the criteria select the model with both.
"""

import dataclasses
import re

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.case import replace
from tests.oracles import finite_elements
from tests.tuning.finite_element_rigs import SAGGING, SHAKER, SimulatedIdentification, plant
from tests.tuning.stand_in import NOISE, TRUTH, clean, fit, least_squares
from tuning.fit.least_squares import LocalMinimum
from tuning.fit.model_validation import compare_fits, cross_validate
from tuning.fit.report import write_report
from tuning.fit.uncertainty.posterior import with_diagnostics
from tuning.fit.uncertainty.profile import Profile
from tuning.parameters.free import Prior, to_unbounded

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


# Summary, remarks and report of a fit.


@pytest.fixture(scope="module")
def plain():
    return fit()


def test_a_report_with_all_sections(plain, tmp_path):
    minima = tuple(LocalMinimum(cost, plain.values, plain.values, 3, True) for cost in (1.5, 40.0))
    with_minima = dataclasses.replace(plain, minima=minima)
    values = np.linspace(0.19, 0.21, 5)
    offset = Profile("sensors.0.offset", "m", values, (values - 0.2) ** 2 * 1e5, 4.0,
                     (0.195, np.inf), (0.194, 0.206))  # fmt: skip
    draws = plain.values + plain.errors * np.random.default_rng(0).normal(size=(2, 50, 3))
    held = plain.least_squares.solve(plain.dataset.measured, free=np.array([True, False, True]))
    worse = dataclasses.replace(plain, fitted=held.predicted, parameters=plain.parameters[:2])
    write_report(
        tmp_path / "report",
        with_minima,
        profiles=[offset],
        posterior=with_diagnostics(plain.addresses, draws, 0),
        held_out=cross_validate(plain),
        models=compare_fits({"free": plain, "held & <fast>": worse}),
    )
    text = (tmp_path / "report" / "report.md").read_text()
    page = (tmp_path / "report" / "report.html").read_text()
    for heading in ("Parameters", "Remarks", "Measured and fitted", "Correlations", "Profiles",
                    "Posterior", "Held-out logs", "Models compared"):  # fmt: skip
        assert f"## {heading}\n" in text and f"<h2>{heading}</h2>" in page
    assert "the data only say that sensors.0.offset is above 0.195 m." in text
    assert re.search(r"\| beam.flexural_rigidity \| N m\^2 \| 19 \|  \| 20\.\d+ \| 0\.\d+ \|", text)
    assert "<td>held &amp; &lt;fast&gt;</td>" in page
    assert "2 minima from 6 starts:\n  misfit 1.5 from 3 starts: " in str(with_minima)
    for name in re.findall(r"!\[.*\]\((.*)\)", text):
        assert (tmp_path / "report" / name).stat().st_size > 1000
        assert f'src="{name}"' in page
    with pytest.raises(FileExistsError, match="report is not empty; choose another"):
        write_report(tmp_path / "report", plain)


def test_remarks_on_priors_and_on_logs():
    measured = clean() + NOISE * np.random.default_rng(0).normal(size=clean().shape)
    measured[1, 60] += 2.0
    prior = {"beam.damping_ratio": Prior(mean=0.03, deviation=1e-5)}
    fitted = fit(least_squares(measured=measured, free=dict.fromkeys(TRUTH) | prior))
    remarks = "\n".join(fitted.remarks)
    assert "beam.damping_ratio is determined by its prior more than by the logs" in remarks
    assert "run 1: w has spikes (one sample), first at t = 1.2 s (not masked)" in remarks
