"""The command that tunes controllers."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from jaxbeam.arguments import (
    bounds_of,
    check_outputs,
    check_suffix,
    picture_path,
    read_case,
    refuse,
)
from jaxbeam.cli.app import Json, Output, Overwrite, Settings, app
from jaxbeam.printing import print_json, print_written


@app.command
def tune(
    case: Path,
    /,
    *,
    free: tuple[str, ...] = (),
    cases: Path,
    objective: tuple[str, ...] = (),
    over: str = "worst",
    stable: float | None = None,
    reserve: float = 0.0,
    spread: tuple[str, ...] = (),
    steps: int = 80,
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
        MERIT=WEIGHT: peak, rms, after_exit, effort or contact; the peak alone if left out.
    over
        How runs are taken together: worst, mean, or cvar (the mean of the worst quarter).
    stable
        Largest real part (1/s) that a pole may have with loads frozen along the crossings.
    reserve
        With --stable: delay (s) more than the controller's that must not bring it down.
    spread
        With --stable: ADDRESS=SHARE by which a number may be off, such as
        beam.flexural_rigidity=0.1; repeat it for more.
    steps
        Steps of the search.
    starts
        How many points to search from at once; the first is the case as it is.
    seed
        Which random points the others are.
    bounds
        Whether to compute the least peak possible for every run.
    output
        Write the tuned case to this file, TUNED.toml; the search is kept beside it on the way.
    plot
        Draw peaks before and after to a PNG beside the output.
    resume
        Go on with a search that was stopped.
    """
    import tuning
    from jaxbeam.casefile import save_case

    weights = dict(_weight(text) for text in objective)
    shares = dict(_weight(text) for text in spread)
    refuse(stable is None and bool(reserve or shares), "--reserve and --spread need --stable")
    limits = None if stable is None else tuning.Stable(stable, reserve, shares)
    picture = picture_path(output, case.with_suffix(".tuned")) if plot else None
    check_suffix(output, ".toml", "a tuned case")
    check_outputs(overwrite, output, picture)
    checkpoint = None if output is None else output.with_suffix(".search.npz")
    if checkpoint and checkpoint.exists() and overwrite and not resume:
        checkpoint.unlink()
    found = tuning.tune(
        read_case(case, set_),
        dict(bounds_of(text) for text in free),
        tuning.read_load_cases(cases),
        tuning.Objective(weights or {"peak": 1.0}, over),
        stable=limits,
        steps=steps,
        starts=starts,
        seed=seed,
        bounds=bounds,
        checkpoint=checkpoint,
        resume=resume,
        progress=not json_,
    )
    if output:
        save_case(found.case, output, overwrite=True)  # checked before the work
    if checkpoint:
        checkpoint.unlink()
    if picture:
        found.plot().savefig(picture)
    if json_:
        print_json(found.to_dict())
    else:
        print(found)
        print_written(output, picture)


def _weight(text: str) -> tuple[str, float]:
    """The two sides of NAME=NUMBER. Raises ValueError if the number is none."""
    merit, _, weight = text.partition("=")
    try:
        return merit, float(weight)
    except ValueError:
        raise ValueError(f"a name and a number are needed, such as peak=1, not {text!r}") from None
