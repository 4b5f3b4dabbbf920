"""Commands that identify numbers from logs, and show how."""

from pathlib import Path

from jaxbeam.cli.app import Json, Output, Overwrite, Settings, app, print_message
from jaxbeam.cli.arguments import (
    assignment,
    bounds_of,
    check_outputs,
    picture_path,
    read_case,
    refuse,
    split_files,
)
from jaxbeam.cli.printing import print_json, print_written


@app.command
def demo(
    *,
    output: Output = None,
    json_: Json = False,
) -> None:
    """Identify a rig from logs, sweep it, and tune a controller for it, in a minute or two.

    Parameters
    ----------
    output
        Folder for figures, cases and results; a fresh one below `out` if left out.
    """
    from experiments import demo as demonstration

    demonstration.run(output, json=json_)


@app.command
def identify(
    *files: Path,
    free: tuple[str, ...] = (),
    prior: tuple[str, ...] = (),
    scale: tuple[str, ...] = (),
    loss: str = "squares",
    stage: tuple[str, ...] = (),
    starts: int = 1,
    seed: int = 0,
    mask: tuple[str, ...] = (),
    profile: tuple[str, ...] = (),
    draws: int = 0,
    noise: str = "held",
    validate: bool = False,
    report: Path | None = None,
    output: Output = None,
    plot: bool = False,
    resume: bool = False,
    set_: Settings = (),
    overwrite: Overwrite = False,
    json_: Json = False,
) -> None:
    """Identify numbers of a case from logs; without --free, the modes seen in a free decay.

    Parameters
    ----------
    files
        [CASE.toml] LOG...: the case to fit, if any, and the logs; all runs that they hold.
    free
        ADDRESS[=LOW:HIGH]: a number to identify, between bounds; repeat it for more. A number of
        every log is at logs.*.ADDRESS.
    prior
        ADDRESS=MEAN:DEVIATION: what is known of a free number beforehand.
    scale
        ADDRESS=log or ADDRESS=logit: the scale on which a number is searched between its bounds.
    loss
        squares, or soft-l1 or huber, for which outliers count less.
    stage
        ADDRESS,ADDRESS,...: free numbers to fit first, the others held; repeat it for more stages.
    starts
        How many points to search from; the first is the case as it is.
    seed
        Which random points the others are, and which random draws.
    mask
        missing, spikes, saturation or stuck: samples to leave out; repeat it for more.
    profile
        ADDRESS: a free number whose profile likelihood to compute; repeat it for more.
    draws
        How many draws of the posterior to make in each of four chains (extra bayes).
    noise
        held at the levels found by the fit, or estimated with each draw.
    validate
        Leave out one log after the other, and predict it.
    report
        Write an account with tables and pictures to this folder: report.md and report.html.
    output
        Write the fitted case to this file, FIT.toml, and all of the fit beside it, FIT.npz.
    plot
        Draw measured and fitted to a PNG beside the output, or named after the log.
    resume
        Go on with searches and draws that were stopped; they are kept beside the output.
    """
    case, logs = split_files(files, free)
    if case and free:
        refuse(resume and not output, "--resume goes on with what is kept beside the output: -o")
        picture = picture_path(output, logs[0]) if plot else None
        check_outputs(overwrite, output, _with_suffix(output, ".npz"), picture)
        _check_report_folder(report, overwrite)
        settings = {"loss": loss, "starts": starts, "seed": seed, "resume": resume}
        settings["stages"] = [text.split(",") for text in stage]
        fit = _fit(
            read_case(case, set_), logs, mask, free, prior, scale, output, overwrite, settings
        )
        assessment = _assess(
            fit, profile, draws, {"seed": seed, "noise": noise}, validate, output, resume
        )
        _write_and_print(fit, assessment, report, output, picture, json_)
        return
    refuse(
        bool(output or set_),
        "-o and --set are for fitting a case; name what is free with --free ADDRESS",
    )
    given = (prior, scale, stage, profile, draws, validate, report, resume, mask, starts > 1)
    refuse(
        any(given),
        "the options of fits are for fitting a case; name what is free with --free ADDRESS",
    )
    if case:
        print_message(
            f"nothing is named with --free, so {case} is not used; modes of the free decay:"
        )
    pictures = [picture_path(None, log) if plot else None for log in logs]
    check_outputs(overwrite, *pictures)
    _identify_modes(logs, pictures, json_)


def _with_suffix(output: Path | None, suffix: str) -> Path | None:
    return None if output is None else output.with_suffix(suffix)


def _remove_checkpoints(output: Path | None) -> None:
    """Remove what searches and draws kept beside the output on their way."""
    for suffix in (".search.npz", ".draws.npz") if output else ():
        output.with_suffix(suffix).unlink(missing_ok=True)


def _check_report_folder(folder: Path | None, overwrite: bool) -> None:
    if folder and folder.exists() and any(folder.iterdir()) and not overwrite:
        raise FileExistsError(
            f"the folder {folder} is not empty; choose another or add --overwrite"
        )


def _fit(case, files, fault_kinds, free, prior, scale, output, overwrite, settings):
    """Read the logs and fit the case to them."""
    import tuning

    priors = _priors_by_address(free, prior, scale)
    missing = "mask" if "missing" in fault_kinds else "refuse"
    logs = [log for path in files for log in tuning.read_logs(path, missing=missing)]
    masked_kinds = [kind for kind in fault_kinds if kind != "missing"]
    logs = [tuning.mask(log, masked_kinds) for log in logs] if masked_kinds else logs
    if overwrite and not settings["resume"]:
        _remove_checkpoints(output)
    checkpoint = _with_suffix(output, ".search.npz") if settings["starts"] > 1 else None
    return tuning.identify(case, logs, priors, checkpoint=checkpoint, **settings)


def _priors_by_address(free, prior, scale) -> dict:
    """Bounds, priors and scales by address, of the options that name them."""
    from tuning.parameters.prior import Prior

    scales = dict(assignment("--scale", text) for text in scale)
    priors = {}
    for text in prior:
        address, value = assignment("--prior", text)
        parts = value.split(":")
        try:
            mean, deviation = map(float, parts)
        except ValueError:
            raise ValueError(
                f"--prior takes ADDRESS=MEAN:DEVIATION, such as beam.damping_ratio=0.02:0.005, not "
                f"{text!r}"
            ) from None
        priors[address] = mean, deviation
    bounds = dict(bounds_of(text) for text in free)
    for address in (*scales, *priors):
        refuse(address not in bounds, f"{address} has a prior or a scale, but is not free: --free")
    priors_by_address = {}
    for address, pair in bounds.items():
        prior = priors.get(address, (None, None))
        try:
            priors_by_address[address] = Prior(
                *(pair or (None, None)), *prior, scale=scales.get(address, "plain")
            )
        except ValueError as error:
            raise ValueError(f"{address}: {error}") from None
    return priors_by_address


def _assess(fit, profile, draws, sampling, validate, output, resume) -> dict:
    """Profiles, posterior and cross-validation, as far as they are asked for."""
    from tuning.fit.model_validation import cross_validate
    from tuning.fit.uncertainty.posterior import sample
    from tuning.fit.uncertainty.profile import profile as profile_of

    assessment = {"profiles": [profile_of(fit, address) for address in profile]}
    if validate:
        assessment["held_out"] = cross_validate(fit)
    if draws:
        checkpoint = _with_suffix(output, ".draws.npz")
        assessment["posterior"] = sample(
            fit, draws, checkpoint=checkpoint, resume=resume, **sampling
        )
    return assessment


def _write_and_print(fit, assessment, report, output, picture, json_) -> None:
    """Write and print what was found; then what was kept on the way is needed no longer."""
    from jaxbeam.files.case_file import save_case
    from tuning.fit.report import write_report
    from tuning.fit.storage import save_fit

    if output:
        save_case(fit.case, output, overwrite=True)  # checked before the work
        save_fit(fit, output.with_suffix(".npz"), overwrite=True)
    if picture:
        fit.plot().savefig(picture)
    if report:
        write_report(report, fit, overwrite=True, **assessment)
    _remove_checkpoints(output)
    posterior = assessment.get("posterior")
    if json_:
        summary = fit.to_dict()
        summary["profiles"] = {p.address: {"interval": p.interval, "verdict": p.verdict}
                            for p in assessment["profiles"]}  # fmt: skip
        if posterior:
            summary["posterior"] = posterior.to_dict()
        summary["left_out"] = {u.log: u.residual_ratio for u in assessment.get("held_out", ())}
        print_json(summary)
        return
    print(fit)
    for found in (*assessment["profiles"], *assessment.get("held_out", ())):
        print(found.verdict)
    if posterior:
        print(posterior)
    print_written(output, _with_suffix(output, ".npz"), picture)
    print_written(report and report / "report.html")


def _identify_modes(logs, pictures, json_) -> None:
    import tuning

    found = {}
    for log, picture in zip(logs, pictures, strict=True):
        fit = found[str(log)] = tuning.identify_modes(tuning.read_log(log))
        if picture:
            fit.plot().savefig(picture)
        if not json_:
            print(f"{log}\n{fit}")
            print_written(picture)
    if json_:
        print_json({log: fit.to_dict() for log, fit in found.items()})
