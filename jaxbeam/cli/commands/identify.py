"""Commands on fits of a case to logs: `identify`, `compare-models`, `design-experiment`."""

import dataclasses
from pathlib import Path

from jaxbeam.cli.arguments import (
    bounds_in_si,
    check_exists,
    pair_in_si,
    parse_assignment,
    parse_bounds,
    parse_prior,
    refuse_option,
    split_case_and_logs,
)
from jaxbeam.cli.options import (
    CaseOptions,
    Free,
    LogOptions,
    Output,
    PictureOptions,
    PrintOptions,
    Resume,
    Seed,
    Starts,
    enable_compile_cache,
    print_message,
    table,
)
from jaxbeam.files.report import check_report_folder


def identify(
    *files: Path,
    free: Free = (),
    prior: tuple[str, ...] = (),
    scale: tuple[str, ...] = (),
    loss: str = "squares",
    stage: tuple[str, ...] = (),
    starts: Starts = 1,
    seed: Seed = 0,
    mask: tuple[str, ...] = (),
    profile: tuple[str, ...] = (),
    draws: int = 0,
    noise: str = "fixed",
    validate: bool = False,
    report: Path | None = None,
    output: Output = None,
    pictures: PictureOptions = PictureOptions(),
    resume: Resume = False,
    reading: LogOptions = LogOptions(),
    options: CaseOptions = CaseOptions(),
) -> None:
    """Identify parameters of a case from logs; without --free, the modes of a free decay.

    Parameters of the logs have addresses such as logs.*.loads.0.speed: the speed of the load in
    every log.

    `--plot` draws measured and fitted signals to a PNG beside the output, or named after the
    log.

    Parameters
    ----------
    files
        [CASE.toml] LOG...: the case to fit, if any, and the logs, with all the runs they hold.
    prior
        ADDRESS=MEAN:DEVIATION: normal prior of a free parameter, also with units, as
        beam.length='25 m:10 cm'; repeat it for more.
    scale
        ADDRESS=log or ADDRESS=logit: scale on which a parameter is searched between its bounds.
    loss
        squares, or soft-l1 or huber, which give outliers less weight.
    stage
        ADDRESS,ADDRESS,...: free parameters to fit first, the others fixed; repeat it for more
        stages.
    mask
        missing, dropouts, spikes, saturation or stuck: samples to leave out; repeat it for more.
    profile
        ADDRESS: free parameter whose profile likelihood to compute; repeat it for more.
    draws
        Number of draws from the posterior in each of four chains (extra bayes).
    noise
        Noise levels of the draws: fixed at those of the fit, or estimated with each draw.
    validate
        Predict each log from a fit to the others (cross-validation).
    report
        Write a report with tables and figures to this folder: report.md and report.html.
    output
        Write the fitted case to this file, FIT.toml, and the whole fit beside it, FIT.npz.
    """
    case, logs = split_case_and_logs(files, free)
    if case and free:
        refuse_option(
            resume and not output, "--resume goes on with what is kept beside the output: -o"
        )
        picture = pictures.path(output, logs[0])
        options.check_outputs(output, _with_suffix(output, ".npz"), picture)
        if report:
            check_report_folder(report, options.overwrite)
        arguments = _prior_arguments(free, prior, scale)
        check_exists("log file", *logs)
        options.check_case(case)

        import tuning  # sets XLA's threads, therefore before the case is read
        from tuning.checkpoint import kept_in

        parsed_case = options.read(case, judged="structure")
        bounds, normals, scales = arguments
        normals = {
            address: pair_in_si(parsed_case, address, pair, "--prior")
            for address, pair in normals.items()
        }
        priors = _priors(bounds_in_si(parsed_case, bounds), normals, scales)
        if options.overwrite and not resume:
            _remove_checkpoints(output)
        searched, drawn = (_with_suffix(output, f".{name}.npz") for name in ("search", "draws"))
        with kept_in(searched, drawn):
            fit = tuning.identify(
                parsed_case,
                _read_logs(logs, mask, reading),
                priors,
                loss=loss,
                starts=starts,
                seed=seed,
                stages=[text.split(",") for text in stage],
                checkpoint=searched if starts > 1 else None,
                resume=resume,
                progress=not options.json_,
            )
            assessment = _assess(
                fit, profile, draws, {"seed": seed, "noise": noise}, validate, output, resume
            )
        _write_and_print(fit, assessment, report, output, picture, pictures, options)
        return
    refuse_option(
        bool(output or options.set_),
        "-o and --set are for fitting a case; name what is free with --free ADDRESS",
    )
    given = (prior, scale, stage, profile, draws, validate, report, resume, mask, starts > 1)
    refuse_option(
        any(given),
        "the options of fits are for fitting a case; name what is free with --free ADDRESS",
    )
    refuse_option(
        pictures.picture is not None and len(logs) > 1,
        "--picture names one file, and each log has a picture: use --plot",
    )
    check_exists("log file", *logs)
    if case:
        print_message(
            f"nothing is named with --free, so {case} is not used; modes of the free decay:"
        )
    files_of_logs = [pictures.path(None, log) for log in logs]
    options.check_outputs(*files_of_logs)
    _identify_modes(logs, files_of_logs, pictures, reading, options)


def _with_suffix(output: Path | None, suffix: str) -> Path | None:
    return None if output is None else output.with_suffix(suffix)


def _remove_checkpoints(output: Path | None) -> None:
    """Remove the checkpoints of searches and draws beside the output."""
    for suffix in (".search.npz", ".draws.npz") if output else ():
        output.with_suffix(suffix).unlink(missing_ok=True)


def _read_logs(files, fault_kinds, reading: LogOptions) -> list:
    """Logs of the files without the samples that have faults of the given kinds."""
    import tuning

    if "missing" in fault_kinds:
        reading = dataclasses.replace(reading, missing="mask")
    logs = [log for path in files for log in reading.read_runs(path)]
    masked_kinds = [kind for kind in fault_kinds if kind != "missing"]
    return [tuning.logs.mask(log, masked_kinds) for log in logs] if masked_kinds else logs


def _prior_arguments(free, prior, scale) -> tuple[dict, dict, dict]:
    """Bounds, means with deviations, and scales by address, of the options that name them.

    Raises ValueError for malformed options, and for priors and scales of fixed parameters.
    """
    bounds = dict(parse_bounds(text) for text in free)
    scales = dict(parse_assignment("--scale", text) for text in scale)
    normals = dict(parse_prior(text) for text in prior)
    for address in (*scales, *normals):
        refuse_option(
            address not in bounds, f"{address} has a prior or a scale, but is not free: --free"
        )
    return bounds, normals, scales


def _priors(bounds, normals, scales) -> dict:
    """Priors by address. Raises ValueError, naming the address, for one that is impossible."""
    from tuning.parameters import Prior

    priors = {}
    for address, pair in bounds.items():
        low, high = pair or (None, None)
        mean, deviation = normals.get(address, (None, None))
        try:
            priors[address] = Prior(low, high, mean, deviation, scale=scales.get(address, "linear"))
        except ValueError as error:
            raise ValueError(f"{address}: {error}") from None
    return priors


def _assess(fit, profile, draws, sampling, validate, output, resume) -> dict:
    """Profiles, posterior and cross-validation of a fit, as far as they are asked for."""
    from tuning.fit.model_validation import cross_validate
    from tuning.fit.uncertainty import profile as profile_of, sample

    assessment = {"profiles": [profile_of(fit, address) for address in profile]}
    if validate:
        assessment["held_out"] = cross_validate(fit)
    if draws:
        checkpoint = _with_suffix(output, ".draws.npz")
        assessment["posterior"] = sample(
            fit, draws, checkpoint=checkpoint, resume=resume, **sampling
        )
    return assessment


def _write_and_print(
    fit, assessment, report, output, picture, pictures, options: CaseOptions
) -> None:
    """Write case, fit, picture and report, print the result, and remove the checkpoints."""
    from jaxbeam.files.case_file import save_case
    from tuning.fit.report import write_report
    from tuning.fit.result import save_fit

    if output:
        save_case(fit.case, output, overwrite=True)  # checked before the work
        save_fit(fit, output.with_suffix(".npz"), overwrite=True)
    if picture:
        pictures.save(pictures.titled(fit.plot()), picture)
    if report:
        write_report(report, fit, overwrite=True, **assessment)
    _remove_checkpoints(output)
    profiles, held_out = assessment["profiles"], assessment.get("held_out", ())
    posterior = assessment.get("posterior")
    content = fit.to_dict() | {
        "profiles": {p.address: {"interval": p.interval, "verdict": p.verdict} for p in profiles}
    }
    if posterior:
        content["posterior"] = posterior.to_dict()
    content["left_out"] = {found.log: found.residual_ratio for found in held_out}
    lines = [str(fit), *(found.verdict for found in (*profiles, *held_out))]
    if posterior:
        lines.append(str(posterior))
    page = report and report / "report.html"
    options.report(content, lines, output, _with_suffix(output, ".npz"), picture, page)


def _identify_modes(
    logs, files, pictures: PictureOptions, reading: LogOptions, options: CaseOptions
) -> None:
    enable_compile_cache()
    import tuning

    content = {}
    for log, picture in zip(logs, files, strict=True):
        fit = tuning.identify_modes(reading.read(log))
        content[str(log)] = fit.to_dict()
        if picture:
            pictures.save(pictures.titled(fit.plot()), picture)
        if not options.json_:
            options.report({}, [f"{log}\n{fit}"], picture)
    if options.json_:
        options.report(content, [])


def compare_models(
    *fits: Path,
    held_out: tuple[Path, ...] = (),
    options: PrintOptions = PrintOptions(),
) -> None:
    """Compare fitted models of the same logs by AIC and BIC, and by errors on held-out logs.

    Parameters
    ----------
    fits
        FIT.npz...: files written by `identify -o`; two or more are compared, best BIC first.
    held_out
        A log that no fit used, to be predicted by each; repeat it for more.
    """
    refuse_option(
        not fits, "give at least one fit: jaxbeam compare-models FIT.npz... [--held-out LOG]"
    )
    refuse_option(
        len(fits) < 2 and not held_out,
        "one fit alone: give another, or a log with --held-out LOG",
    )
    names = [path.stem for path in fits]
    refuse_option(len(set(names)) < len(names), "two fits have the same name; rename one")
    check_exists("fit", *fits)
    check_exists("log file", *held_out)
    enable_compile_cache()
    import tuning

    fits_by_name = dict(zip(names, map(tuning.load_fit, fits), strict=True))
    logs = [log for path in held_out for log in tuning.read_logs(path)]
    criteria = tuning.fit.compare_fits(fits_by_name) if len(fits_by_name) > 1 else []
    predictions = {
        name: tuning.fit.predict_held_out(fit, logs) if logs else []
        for name, fit in fits_by_name.items()
    }
    error_ratios = {
        name: {prediction.log: prediction.residual_ratio for prediction in found}
        for name, found in predictions.items()
    }
    lines = table(
        ("model", "parameters", "log likelihood", "AIC", "BIC", "weight"),
        [
            (
                model.name,
                model.parameter_count,
                f"{model.log_likelihood:.6g}",
                f"{model.aic:.6g}",
                f"{model.bic:.6g}",
                f"{model.weight:.3f}",
            )
            for model in criteria
        ],
    )
    lines += [
        f"{name}: {prediction.verdict}"
        for name, found in predictions.items()
        for prediction in found
    ]
    models = [model.to_dict() for model in criteria]
    options.report(
        # "rivals" and "unseen" are the old names, for one release.
        {"models": models, "held_out": error_ratios, "rivals": models, "unseen": error_ratios},
        lines,
    )


def design_experiment(
    case: Path,
    /,
    *,
    free: tuple[str, ...] = (),
    vary: tuple[str, ...] = (),
    target: str | None = None,
    noise: float = 1e-5,
    output: Output = None,
    options: CaseOptions = CaseOptions(),
) -> None:
    """Choose parameters of an experiment for the least uncertainty of the free parameters.

    Parameters
    ----------
    case
        Case file, TOML, with likely values of the free parameters.
    free
        ADDRESS: a parameter that will be identified from the experiment; repeat it for more.
    vary
        ADDRESS=LOW:HIGH: a parameter of the experiment to choose, such as the position of a sensor
        or a speed; repeat it for more.
    target
        ADDRESS: the free parameter whose uncertainty counts; all of them if left out.
    noise
        Standard deviation (SI) of the samples of sensors without a `noise` of their own.
    output
        Write the case with the chosen experiment to this file, TOML.
    """
    options.check_outputs(output)
    refuse_option(not free, "name what will be identified with --free ADDRESS")
    refuse_option(not vary, "name what can be chosen with --vary ADDRESS=LOW:HIGH")
    for text in vary:
        parse_assignment("--vary", text)
    bounds = dict(parse_bounds(text, "--vary") for text in vary)
    options.check_case(case)

    import tuning  # sets XLA's threads, therefore before the case is read
    from jaxbeam.files.case_file import save_case

    parsed_case = options.read(case)
    bounds = bounds_in_si(parsed_case, bounds, "--vary")
    design = tuning.design_experiment(parsed_case, free, bounds, target=target, noise=noise)
    if output:
        save_case(design.case, output, overwrite=True)  # checked before the work
    options.report(design.to_dict(), [str(design)], output)
