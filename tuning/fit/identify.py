"""Identification: parameters of a case from logs of runs with known loads, by least squares."""

import contextlib
import dataclasses
import os
from collections.abc import Iterator, Mapping, Sequence

import jax
import numpy as np
from jaxtyping import Bool

from jaxbeam.case.case import Case, structure_of
from jaxbeam.case.fields import concrete, refuses_traced
from jaxbeam.model.plausibility.check import warn_if_implausible
from jaxbeam.runtime.progress import BAR_DELAY, ProgressBar, following
from tuning.checkpoint import Checkpoint, checkpoint_path, fingerprint
from tuning.fit.dataset import Dataset, make_dataset
from tuning.fit.least_squares import LeastSquares, SearchPoint, check_loss, multi_start
from tuning.fit.result import Fit, fit_result
from tuning.logs.log import Log
from tuning.parameters import LOG_ADDRESS, FreeParameter, Prior, free_parameters


@refuses_traced("a fit")
def identify(
    case: Case,
    logs: Log | Sequence[Log],
    free: Mapping[str, tuple[float, float] | Prior | None] | Sequence[str] | str,
    *,
    loss: str = "squares",
    stages: Sequence[Sequence[str]] = (),
    starts: int = 1,
    seed: int = 0,
    checkpoint: str | os.PathLike | None = None,
    resume: bool = False,
    progress: bool = True,
) -> Fit:
    """Fit parameters of a case to logs of runs with known loads.

    `free` names addresses, each with bounds (low, high), a `Prior` (bounds, scale, distribution) or
    None; a parameter of one log, such as its load's speed, is at `logs.0.loads.0.speed`, one of
    every log at `logs.*.loads.0.speed`. Loads are those of the logs, or else the case's.

    Minimised is the sum of squared residuals over their noise, and of squared prior residuals, by
    bounded Levenberg-Marquardt with exact forward derivatives; noise levels of the
    channels are estimated from the residuals. Standard errors follow from the Jacobian, widened
    where residuals are autocorrelated; directions that are not identifiable are named.

    `loss` "soft-l1" or "huber" reduces the weight of outliers. `stages` are lists of addresses that
    are fitted first, one list after the other, the rest held. With several `starts`, drawn by the
    `seed` but for the first, the lowest minimum is taken. With a `checkpoint` file that search can
    be stopped at any time; with `resume` it goes on, to the same result. Of a fit that takes longer
    than two seconds the trial points and their misfit are shown, unless `progress` is False.

    Raises ValueError for faulty input or a checkpoint of another search, FileExistsError if the
    checkpoint exists and `resume` is not set, RuntimeError if the simulation fails.

    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     sensors=[jb.Sensor(0.3, noise=1e-5)],
    ...     loads=[jb.MovingForce(force=4.0, speed=2.0)],
    ...     run=jb.Run(0.4, sample_rate=50.0),
    ... )
    >>> logs = []
    >>> for speed in (2.0, 2.5):
    ...     record = jb.simulate(jb.replace(case, {"loads.0.speed": speed}))
    ...     columns = ("w",), ("deflection",), ("m",), f"{speed} m/s", (0,)
    ...     logs.append(
    ...         tuning.Log(record.times, record.measured, *columns, loads=record.case.loads)
    ...     )
    >>> start = jb.replace(case, {"beam.flexural_rigidity": 10.0})
    >>> fit = tuning.identify(start, logs, "beam.flexural_rigidity")
    >>> print(fit.verdict.split(";")[0], f"{fit.values[0]:.2f} N m^2")
    the model explains the logs: residuals are white noise 12.02 N m^2
    """
    logs = [logs] if isinstance(logs, Log) else list(logs)
    addresses = [free] if isinstance(free, str) else free
    bounds = dict(addresses) if isinstance(addresses, Mapping) else dict.fromkeys(addresses)
    check_loss(loss)
    if starts < 1:
        raise ValueError(f"starts must be 1 or more, not {starts}")
    warn_if_implausible(structure_of(case))
    path = checkpoint_path(checkpoint, resume)
    dataset = make_dataset(case, logs)
    largest_reading = float(np.max(np.abs(dataset.measured)))
    parameters = free_parameters(dataset.cases, bounds, largest_reading)
    if largest_reading == 0:
        raise ValueError("all readings of the logs are 0: there is nothing to fit")
    stage_masks = [_stage_mask(parameters, stage) for stage in stages]
    least_squares = LeastSquares(dataset, parameters, loss)
    minima, start = (), None
    with _bar(progress):
        if starts > 1:
            kept = Checkpoint(path, _search_digest(dataset, parameters, loss, starts, seed))
            minima = tuple(multi_start(least_squares, dataset.measured, starts, seed, kept))
            start = minima[0].unbounded
        for mask in stage_masks:
            start = least_squares.solve(dataset.measured, start=start, free=mask).unbounded
        solution = least_squares.solve(dataset.measured, start=start)
    return fit_result(case, least_squares, solution, minima)


@contextlib.contextmanager
def _bar(shown: bool) -> Iterator[None]:
    """Progress bar of the points that searches try within this context, if `shown`."""
    with ProgressBar(None, "point", shown=shown, desc="fit", delay=BAR_DELAY) as bar:

        def on_point(point: SearchPoint) -> None:
            bar.set_postfix_str(f"misfit {point.misfit:.4g}", refresh=False)
            bar.update()

        with following(on_point):
            yield


def _stage_mask(
    parameters: list[FreeParameter], stage: Sequence[str]
) -> Bool[np.ndarray, " parameter"]:
    """Mask of the parameters that are free in a stage; `logs.*` in front stands for every log."""
    addresses = [parameter.address for parameter in parameters]
    of_every_log = [LOG_ADDRESS.sub(r"logs.*.\2", address) for address in addresses]
    for address in stage:
        if address not in (*addresses, *of_every_log):
            raise ValueError(f"a stage fits {address}, which is not free; free are {addresses}")
    pairs = zip(addresses, of_every_log, strict=True)
    return np.array([a in stage or b in stage for a, b in pairs])


def _search_digest(
    dataset: Dataset, parameters: list[FreeParameter], loss: str, starts: int, seed: int
) -> str:
    """Fingerprint of a search from several starts."""
    return fingerprint(
        {
            "cases": [jax.tree.map(lambda leaf: concrete(leaf).tolist(), c) for c in dataset.cases],
            "measured": [dataset.measured.tobytes().hex(), dataset.mask.tobytes().hex()],
            "times": dataset.times.tobytes().hex(),
            "parameters": [dataclasses.asdict(parameter) for parameter in parameters],
            "settings": [loss, starts, seed],
        }
    )
