"""Commands about fitted models: `compare-models`, `design-experiment`."""

from pathlib import Path

from jaxbeam.cli.arguments import (
    bounds_in_si,
    check_exists,
    parse_assignment,
    parse_bounds,
    refuse_option,
)
from jaxbeam.cli.options import (
    CaseOptions,
    Output,
    PrintOptions,
    enable_compile_cache,
    table,
)


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
