"""Comparison of controllers over many runs: loads, plants, delays, errors of gates and sensors.

The laws are designed for the case as it is; what a run changes of the plant they do not know.
"""

import dataclasses
import warnings
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from jaxbeam.analysis.compare import Comparison, compare
from jaxbeam.analysis.hand_drawn import hand_drawn_law
from jaxbeam.case.case import Case, replace, value_at
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import concrete
from jaxbeam.case.validation import check_case
from jaxbeam.model.modes import mesh_layout
from jaxbeam.simulation.simulate import ContactLossWarning, simulate
from tuning.control.fixed_design import with_fixed_design
from tuning.control.load_cases import PLANT_PREFIXES, AddressValues, run_case
from tuning.control.tuning_result import RunSetResult, beside_no_control

HAND_DRAWN = "drawn by hand"
OF_CONTROLLER = "controller."


def compare_runs(
    case: Case,
    controllers: Mapping[str, AbstractController],
    runs: Sequence[AddressValues],
    period: float | None = None,
) -> list[Comparison]:
    """Controllers on each of some runs, beside a law drawn by hand, no control, and the bound.

    Runs are values by address, as `tuning.latin_hypercube` draws them. Values of the beam, its
    supports, actuators and sensors are unknown to the laws, which are designed for the `case`;
    those of `controller`, as its delay, are those of every controller that has them. The law drawn
    by hand has the shortest period, the delay and the gates of the others. `period` (s) is that of
    the bound.

    Raises ValueError as `compare`, and as `run_case`.
    """
    laws = with_hand_drawn(case, controllers)
    free = dataclasses.replace(case, controller=None)
    return [_compare_run(free, laws, run, period) for run in runs]


def with_hand_drawn(
    case: Case, controllers: Mapping[str, AbstractController]
) -> dict[str, AbstractController]:
    """The controllers and the law drawn by hand, where the case allows one."""
    sampled = [one for one in controllers.values() if one.period is not None]
    periods = [float(concrete(one.period)) for one in sampled]
    delays = [0.0 if one.delay is None else float(concrete(one.delay)) for one in sampled]
    gates = [one.gates for one in sampled if getattr(one, "gates", None) is not None]
    numbers = {"period": min(periods, default=0.01), "delay": max(delays, default=0.0)}
    if gates:
        numbers["gates"] = tuple(concrete(gates[0]))
    return dict(controllers) | {HAND_DRAWN: hand_drawn_law(case, **numbers)}


def hand_drawn_peaks(case: Case, runs: Sequence[AddressValues]) -> Float[np.ndarray, " run"] | None:
    """Largest deflections (m) at the sensors under the law drawn by hand, by run.

    None for a case that allows no such law: without loads, say, or with ones that stand.
    """
    laws = {} if case.controller is None else {"its own": case.controller}
    free = dataclasses.replace(case, controller=None)
    try:
        law = with_hand_drawn(case, laws)[HAND_DRAWN]
        cases = [_changed(free, {HAND_DRAWN: law}, run) for run in runs]
        for one, controllers in cases:
            check_case(dataclasses.replace(one, controller=controllers[HAND_DRAWN]))
    except ValueError:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)
        records = [
            simulate(dataclasses.replace(one, controller=controllers[HAND_DRAWN]))
            for one, controllers in cases
        ]
    return np.array([float(np.max(record.peak_deflection)) for record in records])


def beside_hand_drawn(outcome: RunSetResult, peaks: Float[np.ndarray, " run"]) -> str:
    """Sentence on the peaks (m) under the law drawn by hand in the runs of a tuning."""
    reductions = 1 - peaks / outcome.uncontrolled_peaks
    words = (
        f"drawn by hand, with no number tuned: worst {outcome.name} run: peak"
        f" {beside_no_control(reductions.min())}"
    )
    if np.isfinite(outcome.least_peaks).all():
        shares = outcome.attained_shares(peaks)
        words += f"; of the attainable reduction at least {shares.min():.1%}, {shares.mean():.1%}"
        words += " in the mean"
    return words


def _compare_run(case: Case, laws, run: AddressValues, period) -> Comparison:
    """Comparison on one run."""
    return compare(*_changed(case, laws, run), period)


def _changed(case: Case, laws, run: AddressValues) -> tuple[Case, dict[str, AbstractController]]:
    """Case of a run, and the laws designed for the case as it is, with the settings of the run."""
    settings = {a.removeprefix(OF_CONTROLLER): v for a, v in run.items() if _is_setting(a)}
    others = {address: value for address, value in run.items() if not _is_setting(address)}
    changed = run_case(case, others)
    nominal = {a: value_at(case, a) for a in others if a.startswith(PLANT_PREFIXES)}
    layout = mesh_layout(changed)
    controllers = {}
    for name, law in laws.items():
        one = _with_settings(dataclasses.replace(changed, controller=law), settings)
        controllers[name] = with_fixed_design(one, nominal, layout).controller
    return changed, controllers


def _is_setting(address: str) -> bool:
    return address.startswith(OF_CONTROLLER)


def _with_settings(case: Case, settings: Mapping[str, float]) -> Case:
    """The case with settings of its controller; of those it lacks, delays alone are given to it."""
    law = case.controller
    for key, value in settings.items():
        name = key.split(".")[0]
        if key == "delay":
            case = dataclasses.replace(case, controller=dataclasses.replace(law, delay=value))
        elif getattr(law, name, None) is not None:
            case = replace(case, {f"{OF_CONTROLLER}{key}": np.asarray(value)})
        law = case.controller
    return case
