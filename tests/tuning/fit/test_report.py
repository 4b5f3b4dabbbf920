"""Summary, remarks and report of a fit."""

import dataclasses
import re

import numpy as np
import pytest

from tests.tuning.stand_in import NOISE, TRUTH, clean, fit, least_squares
from tuning.fit.model_validation import compare_fits, cross_validate
from tuning.fit.multi_start import LocalMinimum
from tuning.fit.report import write_report
from tuning.fit.uncertainty.posterior import with_diagnostics
from tuning.fit.uncertainty.profile import Profile
from tuning.parameters.prior import Prior


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
