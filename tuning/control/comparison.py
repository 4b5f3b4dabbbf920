"""Comparison of controllers over many runs: loads, plants, delays, errors of gates and sensors.

The laws are designed for the case as it is; what a run changes of the plant they do not know.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from jaxbeam.analysis.compare import Comparison, compare
from jaxbeam.analysis.hand_drawn import hand_drawn_law
from jaxbeam.case.case import Case, replace, value_at
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import concrete
from jaxbeam.model.modes import mesh_layout
from tuning.control.fixed_design import with_fixed_design
from tuning.control.load_cases import PLANT_PREFIXES, AddressValues, run_case

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


def _compare_run(case: Case, laws, run: AddressValues, period) -> Comparison:
    """Comparison on one run."""
    settings = {a.removeprefix(OF_CONTROLLER): v for a, v in run.items() if _is_setting(a)}
    others = {address: value for address, value in run.items() if not _is_setting(address)}
    changed = run_case(case, others)
    nominal = {a: value_at(case, a) for a in others if a.startswith(PLANT_PREFIXES)}
    layout = mesh_layout(changed)
    controllers = {}
    for name, law in laws.items():
        one = _with_settings(dataclasses.replace(changed, controller=law), settings)
        controllers[name] = with_fixed_design(one, nominal, layout).controller
    return compare(changed, controllers, period)


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
