"""Command `tune`: parameters of controllers and absorbers by gradient descent over runs."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from jaxbeam.cli.arguments import (
    bounds_in_si,
    check_exists,
    check_suffix,
    named_number,
    named_numbers,
    parse_bounds,
    refuse_option,
)
from jaxbeam.cli.options import CaseOptions, Free, Output, PictureOptions, Resume, Seed, Starts


def tune(
    case: Path,
    /,
    *,
    free: Free = (),
    cases: Path,
    objective: tuple[str, ...] = (),
    aggregate: str = "worst",
    limit: tuple[str, ...] = (),
    lexicographic: str = "",
    pareto: str = "",
    integers: tuple[str, ...] = (),
    states: int | None = None,
    fit: Path | None = None,
    plants: int = 4,
    posterior: bool = False,
    max_real_part: float | None = None,
    extra_delay: float = 0.0,
    parameter_tolerance: tuple[str, ...] = (),
    method: str | None = None,
    steps: int = 80,
    batch: int | None = None,
    starts: Starts = 1,
    seed: Seed = 0,
    least_peaks: Annotated[bool, Parameter(negative="--no-least-peaks")] = True,
    output: Output = None,
    pictures: PictureOptions = PictureOptions(),
    resume: Resume = False,
    options: CaseOptions = CaseOptions(),
) -> None:
    """Tune controllers and absorbers by gradient descent; report performance on held-out runs.

    Metrics are peak, shortfall, rms, after_exit, effort and contact.

    `--plot` draws peaks before and after to a PNG beside the output.

    Parameters
    ----------
    case
        Case file with a controller or absorbers, TOML.
    cases
        Load cases, TOML: tables [training] and [held_out] with lists of values by address.
    objective
        METRIC=WEIGHT: a term of the objective; repeat it for more. The peak if left out.
    aggregate
        Aggregation over runs: worst, mean or cvar (mean of the worst quarter).
    limit
        METRIC=NUMBER: upper limit of a metric; repeat it for more.
    lexicographic
        METRIC,METRIC,...: metrics in order of priority, in place of an objective: each is
        minimised subject to those before it.
    pareto
        METRIC=NUMBER,NUMBER,...: tune under each of these limits and print the Pareto front.
    integers
        ADDRESS=NUMBER,NUMBER,...: integers to try, such as controller.horizon=4,6,8; all
        combinations are tried if it is repeated for more.
    states
        Number of states fed back by a regulator, such as kind lqr; the states are selected too.
    fit
        FIT.npz, or the FIT.toml beside it, of `jaxbeam identify`: tune for the identified plant.
    plants
        With --fit: number of plants drawn from the covariance of the fit for training, and as
        many for held-out runs.
    posterior
        With --fit: draw plants from the posterior (extra bayes) instead of the covariance.
    max_real_part
        Largest real part (1/s) allowed for poles with loads frozen along the crossings.
    extra_delay
        With --max-real-part: delay (s), beyond that of the controller, with which it holds too.
    parameter_tolerance
        With --max-real-part: ADDRESS=ERROR, relative error of a parameter with which it holds too,
        such as beam.flexural_rigidity=0.1; repeat it for more.
    method
        adam, lbfgs (optax) or bfgs (optimistix). If left out, lbfgs with --pareto and
        --lexicographic, else adam.
    steps
        Number of steps of the optimiser.
    batch
        Number of training runs drawn at random for each step of adam; all if left out.
    least_peaks
        Compute the least achievable peak of every run.
    output
        Write the tuned case to this file, TUNED.toml (those of a Pareto front to TUNED-1.toml,
        TUNED-2.toml, ...), and checkpoints beside it.
    """
    weights = dict(named_number("--objective", text, "peak=1") for text in objective)
    limits = dict(named_number("--limit", text, "effort=0.3") for text in limit)
    tolerances = dict(
        named_number("--parameter-tolerance", text, "beam.flexural_rigidity=0.1")
        for text in parameter_tolerance
    )
    _check_combination(
        {
            "--lexicographic": bool(lexicographic),
            "--pareto": bool(pareto),
            "--integers": bool(integers),
            "--states": states is not None,
        },
        searches=batch is not None or starts > 1,
        resume=resume,
    )
    refuse_option(
        max_real_part is None and bool(extra_delay or tolerances),
        "--extra-delay and --parameter-tolerance need --max-real-part",
    )
    refuse_option(fit is None and posterior, "--posterior draws plants from a fit: it needs --fit")
    refuse_option(
        bool(lexicographic and (weights or limits)),
        "--lexicographic takes the place of --objective and --limit",
    )
    picture = pictures.path(output, case.with_suffix(".tuned"))
    check_suffix(output, ".toml", "a tuned case")
    pareto_limits = _pareto_limits(pareto) if pareto else None
    integer_choices = dict(_integer_choices(text) for text in integers)
    bounds = dict(parse_bounds(text) for text in free)
    files = _output_files(output, len(pareto_limits[1]) if pareto_limits else 0)
    options.check_outputs(*files, picture)
    check_exists("file of load cases", cases)
    if fit is not None:
        check_exists("fit", fit.with_suffix(".npz"))
    options.check_case(case)

    import tuning  # sets XLA's threads, therefore before the case is read
    from tuning.checkpoint import kept_in

    parsed_case = options.read(case)
    bounds = bounds_in_si(parsed_case, bounds)
    loads = tuning.read_load_cases(cases, parsed_case)
    if fit is not None:
        parsed_case, loads = _with_identified_plant(
            parsed_case, loads, fit, plants, posterior, seed
        )
    total_objective = tuning.Objective(weights or {"peak": 1.0}, aggregate, limits=limits)
    search_options = {
        "stable": None
        if max_real_part is None
        else tuning.StabilityConstraint(max_real_part, extra_delay, tolerances),
        "method": method or ("lbfgs" if pareto or lexicographic else "adam"),
        "steps": steps,
        "seed": seed,
        "least_peaks": least_peaks,
        "progress": not options.json_,
    }
    start_options = {"batch": batch, "starts": starts}
    if pareto_limits:
        result = tuning.pareto(
            parsed_case, bounds, loads, total_objective, *pareto_limits, **search_options
        )
        tuned = result.tuned
    elif lexicographic:
        metrics = lexicographic.split(",")
        results = tuning.control.lexicographic(
            parsed_case, bounds, loads, metrics, aggregation=aggregate, **search_options
        )
        result = results[-1]
        tuned = (result,)
    elif integers:
        result = tuning.control.tune_integers(
            parsed_case, integer_choices, bounds, loads, total_objective,
            **start_options, **search_options,
        )  # fmt: skip
        tuned = (result.best,)
    elif states is not None:
        result = tuning.control.tune_reduced(
            parsed_case, states, bounds, loads, total_objective, **start_options, **search_options
        )
        tuned = (result.tuned,)
    else:
        checkpoint = None if output is None else output.with_suffix(".search.npz")
        if checkpoint and options.overwrite and not resume:
            checkpoint.unlink(missing_ok=True)
        with kept_in(checkpoint):
            result = tuning.tune(
                parsed_case, bounds, loads, total_objective, checkpoint=checkpoint, resume=resume,
                **start_options, **search_options,
            )  # fmt: skip
        tuned = (result,)
    _write_and_print(result, tuned, files, picture, pictures, options)
    if output:
        output.with_suffix(".search.npz").unlink(missing_ok=True)


def _check_combination(kinds: dict[str, bool], searches: bool, resume: bool) -> None:
    """Raise ValueError for kinds of searches that exclude each other or the options of one.

    `kinds` tells by option whether it is given; `searches`, whether --batch or --starts are.
    """
    given = [option for option, is_given in kinds.items() if is_given]
    refuse_option(len(given) > 1, f"{' and '.join(given)} are mutually exclusive; give one of them")
    several = bool(given) and given[0] in ("--lexicographic", "--pareto")
    refuse_option(
        (several and searches) or (bool(given) and resume),
        f"--batch, --starts and --resume are for a single search, not for {''.join(given)}",
    )


def _write_and_print(result, tuned, files, picture, pictures, options: CaseOptions) -> None:
    """Write the tuned cases and the picture, and print the result."""
    from jaxbeam.files.case_file import save_case

    for one, file in zip(tuned, files, strict=False):
        save_case(one.case, file, overwrite=True)  # checked before the work
    if picture:
        drawn = result if hasattr(result, "plot") else tuned[0]
        pictures.save(pictures.titled(drawn.plot()), picture)
    from jaxbeam.analysis.stability import stability_margin
    from tuning.control.tuning_result import hand_drawn_sentence

    summaries, closed = [one.to_dict() for one in tuned], []
    for one, summary in zip(tuned, summaries, strict=True):
        if one.case.controller is None:  # absorbers alone
            continue
        loop = stability_margin(one.case)
        summary["stability"] = loop.verdict
        if not one.case.controller.open_loop:
            closed.append(f"the tuned loop is {loop}")
    by_hand = []
    drawn_by_hand = _hand_drawn(tuned)
    if drawn_by_hand is not None:
        index, outcome, peaks = drawn_by_hand
        by_hand = [hand_drawn_sentence(outcome, peaks)]
        summaries[index]["runs"][outcome.name]["peak_drawn_by_hand"] = peaks.tolist()
    options.report(
        summaries[0] if len(summaries) == 1 else {"front": summaries},
        [str(result), *by_hand, *closed],
        *files,
        picture,
    )


def _hand_drawn(tuned):
    """Index of the first tuning, its last set of runs, and the peaks (m) of the law drawn by hand.

    None if the case allows no such law.
    """
    from tuning import TuningResult
    from tuning.control.tuning_result import hand_drawn_peaks

    for index, one in enumerate(tuned):
        if isinstance(one, TuningResult):
            outcome = one.run_sets[-1]
            peaks = hand_drawn_peaks(one.case, outcome.runs)
            return None if peaks is None else (index, outcome, peaks)
    return None


def _with_identified_plant(case, loads, file: Path, count: int, posterior: bool, seed: int):
    """Case with the identified plant, and load cases on plants drawn from the fit."""
    import tuning

    fit = tuning.load_fit(file.with_suffix(".npz"))
    source = tuning.fit.sample(fit, seed=seed) if posterior else fit
    drawn = tuning.control.draw_plants(source, 2 * count, seed)
    return tuning.control.with_identified_plant(case, fit), loads.across(
        drawn[:count], drawn[count:]
    )


def _output_files(output: Path | None, count: int) -> list[Path]:
    """Files of the tuned cases: one, or one for each limit of a Pareto front."""
    if output is None:
        return []
    if not count:
        return [output]
    return [output.with_stem(f"{output.stem}-{i + 1}") for i in range(count)]


def _pareto_limits(text: str) -> tuple[str, list[float]]:
    return named_numbers("--pareto", text, "METRIC=NUMBER,NUMBER,...", "effort=0.1,0.2,0.4")


def _integer_choices(text: str) -> tuple[str, list[int]]:
    form, example = "ADDRESS=NUMBER,NUMBER,...", "controller.horizon=4,6,8"
    return named_numbers("--integers", text, form, example, int)
