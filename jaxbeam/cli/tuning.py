"""The command that tunes controllers."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from jaxbeam.cli.app import Json, Output, Overwrite, Settings, app
from jaxbeam.cli.arguments import (
    bounds_of,
    check_outputs,
    check_suffix,
    picture_path,
    read_case,
    refuse,
)
from jaxbeam.cli.printing import print_json, print_written


@app.command
def tune(
    case: Path,
    /,
    *,
    free: tuple[str, ...] = (),
    cases: Path,
    objective: tuple[str, ...] = (),
    over: str = "worst",
    limit: tuple[str, ...] = (),
    rank: str = "",
    front: str = "",
    choose: tuple[str, ...] = (),
    keep: int | None = None,
    plant: Path | None = None,
    plants: int = 4,
    sampled: bool = False,
    stable: float | None = None,
    reserve: float = 0.0,
    spread: tuple[str, ...] = (),
    method: str | None = None,
    steps: int = 80,
    batch: int | None = None,
    starts: int = 1,
    seed: int = 0,
    bounds: Annotated[bool, Parameter(negative="--no-bounds")] = True,
    output: Output = None,
    plot: bool = False,
    resume: bool = False,
    set_: Settings = (),
    overwrite: Overwrite = False,
    json_: Json = False,
) -> None:
    """Tune numbers of a controlled case by gradients, and prove them on runs held out.

    Parameters
    ----------
    case
        Case file with a controller, TOML.
    free
        ADDRESS[=LOW:HIGH]: a number to tune, between bounds; repeat it for more.
    cases
        Load cases, TOML: tables [training] and [held_out] with lists of values by address.
    objective
        MERIT=WEIGHT: peak, shortfall, rms, after_exit, effort or contact; the peak alone if left
        out.
    over
        How runs are taken together: worst, mean, or cvar (the mean of the worst quarter).
    limit
        MERIT=NUMBER: a figure of merit that must not exceed a number; repeat it for more.
    rank
        MERIT,MERIT,...: in place of an objective, merits in order of rank; each is lowered as far
        as those before it allow.
    front
        MERIT=NUMBER,NUMBER,...: tune under each of these limits, and print what they cost.
    choose
        ADDRESS=NUMBER,NUMBER,...: whole numbers to try, such as controller.horizon=4,6,8; repeat it
        for all combinations.
    keep
        How many states a regulator, such as kind lqr, is to feed back: which, is found as well.
    plant
        FIT.npz, or the FIT.toml beside it, of jaxbeam identify: the plant that was identified.
    plants
        With --plant: so many plants that the fit leaves possible, to train on, and as many others
        for the runs held out.
    sampled
        With --plant: draw them from the posterior (extra bayes), not from the covariance.
    stable
        Largest real part (1/s) that a pole may have with loads frozen along the crossings.
    reserve
        With --stable: delay (s) more than the controller's that must not bring it down.
    spread
        With --stable: ADDRESS=SHARE by which a number may be off, such as
        beam.flexural_rigidity=0.1; repeat it for more.
    method
        adam or lbfgs (optax), or bfgs (optimistix); if left out adam, for fronts and ranks lbfgs.
    steps
        Steps of the search.
    batch
        How many training runs, drawn anew, each step of adam looks at; all if left out.
    starts
        How many points to search from at once; the first is the case as it is.
    seed
        Which random points the others are.
    bounds
        Whether to compute the least peak possible for every run.
    output
        Write the tuned case to this file, TUNED.toml (those of a front to TUNED-1.toml and so on);
        the search is kept beside it on the way.
    plot
        Draw peaks before and after to a PNG beside the output.
    resume
        Go on with a search that was stopped.
    """
    import tuning

    weights = dict(_named_number(text) for text in objective)
    limits = dict(_named_number(text) for text in limit)
    shares = dict(_named_number(text) for text in spread)
    refuse(stable is None and bool(reserve or shares), "--reserve and --spread need --stable")
    refuse(plant is None and sampled, "--sampled draws from a posterior: it needs --plant")
    exclusive_options = {
        "--rank": rank,
        "--front": front,
        "--choose": choose,
        "--keep": keep is not None,
    }
    chosen_options = [name for name, given in exclusive_options.items() if given]
    refuse(
        len(chosen_options) > 1,
        f"{' and '.join(chosen_options)} do not go together; give one of them",
    )
    refuse(bool(rank and (weights or limits)), "--rank takes the place of --objective and --limit")
    single_search_options = batch is not None or starts > 1 or resume
    refuse(
        bool(
            chosen_options
            and (chosen_options[0] in ("--rank", "--front") or resume)
            and single_search_options
        ),
        f"--batch, --starts and --resume are for a single search, not for {''.join(chosen_options)}",
    )
    picture = picture_path(output, case.with_suffix(".tuned")) if plot else None
    check_suffix(output, ".toml", "a tuned case")
    front_limits = _pareto_limits(front) if front else None
    files = _output_files(output, len(front_limits[1]) if front_limits else 0)
    check_outputs(overwrite, *files, picture)
    parsed_case = read_case(case, set_)
    loads = tuning.read_load_cases(cases)
    if plant is not None:
        parsed_case, loads = _with_identified_plant(
            parsed_case, loads, plant, plants, sampled, seed
        )
    total_objective = tuning.Objective(weights or {"peak": 1.0}, over, limits=limits)
    problem = parsed_case, dict(bounds_of(text) for text in free), loads
    shared_options = {
        "stable": None if stable is None else tuning.StabilityConstraint(stable, reserve, shares),
        "method": method or ("lbfgs" if front_limits or rank else "adam"),
        "steps": steps, "seed": seed, "least_peaks": bounds, "progress": not json_,
    }  # fmt: skip
    if front_limits:
        tuning_result = tuning.pareto(*problem, total_objective, *front_limits, **shared_options)
        results = tuning_result.tuned
    elif rank:
        results = tuning.lexicographic(
            *problem, rank.split(","), aggregation=over, **shared_options
        )[-1:]
        tuning_result = results[0]
    elif choose:
        integer_choices = dict(_integer_choices(text) for text in choose)
        search_options = {"batch": batch, "starts": starts}
        tuning_result = tuning.tune_integers(
            parsed_case,
            integer_choices,
            *problem[1:],
            total_objective,
            **search_options,
            **shared_options,
        )
        results = (tuning_result.best,)
    elif keep is not None:
        search_options = {"batch": batch, "starts": starts}
        tuning_result = tuning.tune_reduced(
            parsed_case, keep, *problem[1:], total_objective, **search_options, **shared_options
        )
        results = (tuning_result.tuned,)
    else:
        checkpoint = None if output is None else output.with_suffix(".search.npz")
        if checkpoint and checkpoint.exists() and overwrite and not resume:
            checkpoint.unlink()
        search_options = {
            "batch": batch,
            "starts": starts,
            "checkpoint": checkpoint,
            "resume": resume,
        }
        tuning_result = tuning.tune(*problem, total_objective, **search_options, **shared_options)
        results = (tuning_result,)
    _write_and_print(tuning_result, results, files, picture, json_)
    if output:
        output.with_suffix(".search.npz").unlink(missing_ok=True)


def _write_and_print(tuning_result, results, files, picture, json_) -> None:
    """Write the tuned cases and the picture, and print what was found."""
    from jaxbeam.files.case_file import save_case

    for one, file in zip(results, files, strict=False):
        save_case(one.case, file, overwrite=True)  # checked before the work
    if picture:
        drawn = tuning_result if hasattr(tuning_result, "plot") else results[0]
        drawn.plot().savefig(picture)
    if json_:
        summaries = [one.to_dict() for one in results]
        print_json(summaries[0] if len(summaries) == 1 else {"front": summaries})
    else:
        print(tuning_result)
        print_written(*files, picture)


def _with_identified_plant(case, loads, file: Path, count: int, sampled: bool, seed: int):
    """The case on the plant of a fit, and its load cases on plants that the fit leaves possible."""
    import tuning

    fit = tuning.load_fit(file.with_suffix(".npz"))
    source = tuning.sample(fit, seed=seed) if sampled else fit
    plants_drawn = tuning.draw_plants(source, 2 * count, seed)
    return tuning.with_identified_plant(case, fit), loads.across(
        plants_drawn[:count], plants_drawn[count:]
    )


def _output_files(output: Path | None, count: int) -> list[Path]:
    """The files to write tuned cases to: one, or one for each limit of a front."""
    if output is None:
        return []
    if not count:
        return [output]
    return [output.with_stem(f"{output.stem}-{i + 1}") for i in range(count)]


def _pareto_limits(text: str) -> tuple[str, list[float]]:
    """The merit and the limits of MERIT=NUMBER,NUMBER,...; raises ValueError otherwise."""
    merit, _, numbers = text.partition("=")
    try:
        return merit, [float(number) for number in numbers.split(",")]
    except ValueError:
        raise ValueError(
            f"--front takes MERIT=NUMBER,NUMBER,..., such as effort=0.1,0.2,0.4, not {text!r}"
        ) from None


def _integer_choices(text: str) -> tuple[str, list[int]]:
    """The address and the numbers of ADDRESS=NUMBER,...; raises ValueError otherwise."""
    address, _, numbers = text.partition("=")
    try:
        return address, [int(number) for number in numbers.split(",")]
    except ValueError:
        raise ValueError(
            f"--choose takes ADDRESS=NUMBER,NUMBER,..., such as controller.horizon=4,6,8, not"
            f" {text!r}"
        ) from None


def _named_number(text: str) -> tuple[str, float]:
    """The two sides of NAME=NUMBER. Raises ValueError if the number is none."""
    merit, _, weight = text.partition("=")
    try:
        return merit, float(weight)
    except ValueError:
        raise ValueError(f"a name and a number are needed, such as peak=1, not {text!r}") from None
