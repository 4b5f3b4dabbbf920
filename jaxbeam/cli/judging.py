"""Commands that judge fits, and plan better experiments."""

from pathlib import Path

from jaxbeam.cli.app import Json, Output, Overwrite, Settings, app
from jaxbeam.cli.arguments import assignment, bounds_of, check_outputs, read_case, refuse
from jaxbeam.cli.printing import print_json, print_written


@app.command
def judge(
    *fits: Path,
    unseen: tuple[Path, ...] = (),
    json_: Json = False,
) -> None:
    """Judge fits: rival models of the same logs by their criteria, and logs they have not seen.

    Parameters
    ----------
    fits
        FIT.npz...: what `identify -o` wrote; several are compared by AIC and BIC, best first.
    unseen
        A log that no fit used, to be predicted by each; repeat it for more.
    """
    import tuning

    refuse(not fits, "judge needs at least one fit: jaxbeam judge FIT.npz... [--unseen LOG]")
    refuse(len(fits) < 2 and not unseen, "one fit alone: give a rival, or a log with --unseen LOG")
    names = [path.stem for path in fits]
    refuse(len(set(names)) < len(names), "two fits have the same name; rename one")
    fits_by_name = dict(zip(names, map(tuning.load_fit, fits), strict=True))
    logs = [log for path in unseen for log in tuning.read_logs(path)]
    rivals = tuning.compare_fits(fits_by_name) if len(fits_by_name) > 1 else []
    held_out = {
        name: tuning.predict_held_out(fit, logs) if logs else []
        for name, fit in fits_by_name.items()
    }
    if json_:
        error_ratios = {
            name: {u.log: u.residual_ratio for u in found} for name, found in held_out.items()
        }
        print_json({"rivals": [rival.to_dict() for rival in rivals], "unseen": error_ratios})
        return
    if rivals:
        width = max(map(len, names))
        print(f"{'':{width}}  numbers  log likelihood        AIC        BIC  weight")
    for r in rivals:
        print(
            f"{r.name:{width}}  {r.parameter_count:7}  {r.log_likelihood:14.6g}  {r.aic:9.6g}  "
            f"{r.bic:9.6g}  {r.weight:6.3f}"
        )
    for name, found in held_out.items():
        for one in found:
            print(f"{name}: {one.verdict}")


@app.command
def sharpen(
    case: Path,
    /,
    *,
    free: tuple[str, ...] = (),
    over: tuple[str, ...] = (),
    target: str | None = None,
    noise: float = 1e-5,
    output: Output = None,
    set_: Settings = (),
    overwrite: Overwrite = False,
    json_: Json = False,
) -> None:
    """Plan an experiment: choose numbers of it such that a fit will tell the most.

    Parameters
    ----------
    case
        Case file, TOML, with the likely values of what is to be identified.
    free
        ADDRESS: a number that will be identified; repeat it for more.
    over
        ADDRESS=LOW:HIGH: a number of the experiment to choose, such as a place or a speed.
    target
        ADDRESS: the free number that matters; all of them if left out.
    noise
        Standard deviation of a sample (SI) of sensors that do not say theirs.
    output
        Write the case with the chosen experiment to this file, TOML.
    """
    import tuning
    from jaxbeam.files.case_file import save_case

    check_outputs(overwrite, output)
    refuse(not free, "name what will be identified with --free ADDRESS")
    refuse(not over, "name what can be chosen with --over ADDRESS=LOW:HIGH")
    for text in over:
        assignment("--over", text)
    bounds = dict(bounds_of(text, "--over") for text in over)
    design = tuning.design_experiment(
        read_case(case, set_), free, bounds, target=target, noise=noise
    )
    if output:
        save_case(design.case, output, overwrite=True)  # checked before the work
    if json_:
        print_json(design.to_dict())
    else:
        print(design)
        print_written(output)
