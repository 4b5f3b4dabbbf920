"""Report on an identification: sections of remarks, tables and figures."""

import os
from collections.abc import Sequence

import numpy as np

from jaxbeam.case.fields import refuses_traced
from jaxbeam.files import report
from jaxbeam.files.report import ReportFigure, ReportSection, ReportTable
from tuning.fit.model_validation import HeldOutPrediction, ModelCriteria
from tuning.fit.result import Fit, interval_text
from tuning.fit.uncertainty import Posterior, Profile


@refuses_traced("a report")
def write_report(
    folder: str | os.PathLike,
    fit: Fit,
    *,
    profiles: Sequence[Profile] = (),
    posterior: Posterior | None = None,
    held_out: Sequence[HeldOutPrediction] = (),
    models: Sequence[ModelCriteria] = (),
    overwrite: bool = False,
) -> None:
    """Write a report on a fit, report.md and report.html with figures, to a folder.

    Raises FileExistsError if the folder is not empty and `overwrite` is not set.

    It has `profiles` of parameters, a `posterior`, predictions of `held_out` logs and the
    comparison with other `models` where they are given.

    >>> from pathlib import Path
    >>> import tuning
    >>> tuning.fit.write_report("report", tuning.load_fit("fit.npz"))
    >>> Path("report/report.md").exists()
    True
    """
    sections = report_sections(fit, profiles, posterior, held_out, models)
    title = fit.case.title or "Identification"
    report.write_report(folder, title, sections, overwrite=overwrite)


def report_sections(
    fit: Fit,
    profiles: Sequence[Profile] = (),
    posterior: Posterior | None = None,
    held_out: Sequence[HeldOutPrediction] = (),
    models: Sequence[ModelCriteria] = (),
) -> list[ReportSection]:
    """Sections of the report on a fit; arguments left out have no section."""
    from tuning.fit.uncertainty import plot_posterior, plot_profiles

    tables = [_parameter_table(fit), *_minima_table(fit)]
    measured = [ReportFigure("fit", fit.plot()), _residual_table(fit)]
    sections = [
        ReportSection("Parameters", [fit.verdict + ".", *tables]),
        ReportSection("Remarks", fit.remarks),
        ReportSection("Measured and fitted", measured),
    ]
    if len(fit.parameters) > 1:
        sections.append(ReportSection("Correlations", [_correlation_table(fit)]))
    if profiles:
        verdicts = [found.verdict + "." for found in profiles]
        figure = ReportFigure("profiles", plot_profiles(profiles))
        sections.append(ReportSection("Profiles", [*verdicts, figure]))
    if posterior:
        figure = ReportFigure("posterior", plot_posterior(posterior))
        parts = [posterior.verdict + ".", posterior.table, figure]
        sections.append(ReportSection("Posterior", parts))
    if held_out:
        verdicts = [found.verdict + "." for found in held_out]
        sections.append(ReportSection("Held-out logs", verdicts))
    if models:
        sections.append(ReportSection("Models compared", [_model_table(models)]))
    return sections


def _parameter_table(fit: Fit) -> ReportTable:
    rows = []
    for parameter, value, error, interval in zip(
        fit.parameters, fit.values, fit.errors, fit.intervals, strict=True
    ):
        prior = parameter.prior
        rows.append(
            (
                parameter.address,
                parameter.unit,
                f"{parameter.start:.5g}",
                "" if prior.mean is None else f"{prior.mean:.5g} ± {prior.deviation:.3g}",
                f"{value:.6g}",
                f"{error:.2g}" if np.isfinite(error) else "",
                interval_text(interval),
            )
        )
    header = ("parameter", "unit", "start", "prior", "fitted", "standard error", "95 % interval")
    return ReportTable(header, rows)


def _minima_table(fit: Fit) -> list[ReportTable]:
    if not fit.minima:
        return []
    rows = [
        (f"{found.cost:.6g}", str(found.starts), *(f"{value:.5g}" for value in found.values))
        for found in fit.minima
    ]
    return [ReportTable(("misfit", "starts", *fit.addresses), rows)]


def _residual_table(fit: Fit) -> ReportTable:
    rows = [
        (
            fit.dataset.logs[found.log].source,
            str(found.sensor),
            f"{found.noise:.3g}",
            f"{found.p_value:.2g}",
            f"{found.autocorrelation_factor:.3g}",
            f"{1e3 * found.time_shift:.2g} ± {2e3 * found.time_shift_sd:.2g}",
        )
        for found in fit.channel_residuals
    ]
    header = ("log", "sensor", "residual (SI)", "p-value of whiteness", "variances times")
    return ReportTable((*header, "delay (ms)"), rows)


def _correlation_table(fit: Fit) -> ReportTable:
    rows = []
    for address, row in zip(fit.addresses, fit.correlation, strict=True):
        cells = ("" if np.isnan(entry) else f"{entry:.2f}" for entry in row)
        rows.append((address, *cells))
    return ReportTable(("", *fit.addresses), rows)


def _model_table(models: Sequence[ModelCriteria]) -> ReportTable:
    rows = [
        (r.name, str(r.parameter_count), f"{r.log_likelihood:.2f}", f"{r.aic:.2f}", f"{r.bic:.2f}",
         f"{r.weight:.2g}")
        for r in models
    ]  # fmt: skip
    return ReportTable(("model", "parameters", "ln L", "AIC", "BIC", "weight"), rows)
