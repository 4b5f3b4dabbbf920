"""Identification: parameters of a case from logs of runs with known loads, by least squares."""

import contextlib
import dataclasses
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence

import jax
import numpy as np
from jaxtyping import Bool

from jaxbeam.case.case import Case, crossing_times, structure_of
from jaxbeam.case.fields import concrete, refuses_traced
from jaxbeam.case.trajectory import NEVER
from jaxbeam.model.plausibility.check import warn_if_implausible
from jaxbeam.runtime.progress import BAR_DELAY, ProgressBar, following
from tuning.checkpoint import Checkpoint, checkpoint_path, fingerprint
from tuning.fit.dataset import Dataset, coloured, make_dataset
from tuning.fit.least_squares import LeastSquares, SearchPoint, check_loss, multi_start
from tuning.fit.modal_parameters import ModalParameterFit, identify_from_modes
from tuning.fit.result import CONVERGED, Fit, fit_result
from tuning.fit.uncertainty import t_quantile
from tuning.logs.log import Log
from tuning.modal.identify_modes import identify_modes
from tuning.parameters import LOG_ADDRESS, FreeParameter, Prior, free_parameters, to_unbounded


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

    Where residuals are not white, as on a road that nobody measured, and the modes of the vibration
    after the loads contradict numbers of the beam, supports or absorbers, those are taken from the
    modes, with their errors, and the crossings give the loads; `Fit.search` says what the crossings
    alone gave. Without such vibration, a search that ends badly begins again with the loads.

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
        fit = fit_result(case, least_squares, solution, minima)
        if coloured(fit.channel_residuals):
            fit = _with_decays(fit, bounds) or _loads_first(fit)
    return fit


STRUCTURE = "beam.", "supports.", "absorbers."  # addresses of what free vibration depends on
MAX_MISFIT = 3.0  # standard deviations (rms) of modes that a case explains
# Geometric mean over the signals of the residuals of a crossing with the structure of the modes,
# over those of all numbers fitted to it. Planted: 0.5 to 1.7 where a road was missing, 4.5 and 9
# where another number of the structure was wrong, so that the modes gave a wrong one too.
MAX_RISE = 2.5


def _of_structure(fit: Fit) -> Bool[np.ndarray, " parameter"]:
    """Mask of the numbers that free vibration depends on."""
    return np.array([address.startswith(STRUCTURE) for address in fit.addresses])


def _with_decays(fit: Fit, bounds: Mapping) -> Fit | None:
    """Fit whose structure is that of the vibration after the loads, where the two disagree.

    What a crossing misses, as a road that nobody measured, biases damping, stiffness and loads
    together. The modes of the free decay do not depend on it: they give the numbers of the
    structure with their errors, and the crossing, from the starts, the others. None without
    decays, without numbers that modes determine, with commands, and where the crossing contradicts
    the modes, as another number of the structure is wrong.
    """
    dataset, of_structure = fit.dataset, _of_structure(fit)
    driven = any(case.controller is not None for case in dataset.cases)
    named = [address for address, own in zip(fit.addresses, of_structure, strict=True) if own]
    # Neither by the starts nor by the fit is a load on the beam later.
    exits = np.concatenate([crossing_times(case)[:, 1] for case in (*dataset.cases, *fit.cases)])
    if driven or not of_structure.any() or not exits.size or exits.max() >= NEVER:
        return None
    alone = fit.values[of_structure]
    found = _structure_of_decays(dataset, {a: bounds.get(a) for a in named}, float(exits.max()))
    if found is None:
        return None
    low, high = found.intervals.T
    if np.all((low <= alone) & (alone <= high)):
        return None
    problem = fit.least_squares
    start = np.array(problem.start_point)
    start[of_structure] = to_unbounded(found.parameters, found.values)
    try:
        solution = problem.solve(dataset.measured, start=start, free=~of_structure)
    except RuntimeError:  # the loads cannot be found from their starts
        return None
    again = fit_result(dataset.nominal_case, problem, solution, fit.minima)
    measured = np.isfinite(fit.noise)
    if np.mean(np.log(again.noise[measured] / fit.noise[measured])) > np.log(MAX_RISE):
        return None
    errors, correlation = again.errors.copy(), again.correlation.copy()
    errors[of_structure] = found.errors * found.quantile / t_quantile(again.degrees_of_freedom)
    correlation[of_structure] = correlation[:, of_structure] = 0.0
    correlation[np.ix_(of_structure, of_structure)] = found.correlation
    listed = ", ".join(f"{a} ({v:.4g})" for a, v in zip(named, alone, strict=True))
    return dataclasses.replace(
        again,
        errors=errors,
        correlation=correlation,
        search=f"{again.search}; modes of the vibration after the load give the structure, in"
        f" brackets what the crossing alone gave: {listed}",
    )


def _structure_of_decays(dataset: Dataset, free: Mapping, left: float) -> ModalParameterFit | None:
    """Numbers of a structure by modes of the vibration after the loads have `left` (s).

    The free decays found in the logs are taken, or else all that is after the loads. None without
    modes that the case explains and that determine the numbers.
    """
    end = min(float(log.times[-1]) for log in dataset.logs)
    for window in (None, (left, end)):
        with warnings.catch_warnings(), contextlib.suppress(ValueError):
            warnings.simplefilter("ignore")  # of the attempt alone
            decays = identify_modes(dataset.logs, window=window, kind="free decay")
            if min(begin for begin, _ in decays.windows) >= left:
                found = identify_from_modes(dataset.nominal_case, decays, free)
                if np.all(np.isfinite(found.errors)) and found.misfit < MAX_MISFIT:
                    return found
    return None


def _loads_first(fit: Fit) -> Fit:
    """Fit begun again with the structure held until the loads are found, if that ends well.

    A fit that ended elsewhere than at a plausible minimum may have begun too far from it.
    """
    held = _of_structure(fit)
    if fit.search == CONVERGED or held.all() or not held.any():
        return fit
    problem, measured = fit.least_squares, fit.dataset.measured
    try:
        start = problem.solve(measured, free=~held).unbounded
        solution = problem.solve(measured, start=start)
    except RuntimeError:
        return fit
    again = fit_result(fit.dataset.nominal_case, problem, solution, fit.minima)
    return again if again.search == CONVERGED else fit


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
