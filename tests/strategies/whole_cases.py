"""Random whole cases: all loads, vehicles, profiles, actuators, controllers and estimators."""

import dataclasses

import equinox as eqx
import jax
import numpy as np
from hypothesis import strategies as st

from jaxbeam.case.case import Case
from jaxbeam.case.loads.vehicle_parts import VehicleSensor
from jaxbeam.case.validation import check_case
from tests.strategies import actuators, sensors
from tests.strategies.examples import CONTROLLED, LOADS, PROFILES

LENGTH = 0.6  # of the beam of the examples, m


@st.composite
def varied(draw, part):
    """A part whose numbers are multiplied by random factors, one for each field."""
    factors = st.sampled_from([0.0, 0.3, 0.9, 1.0, 1.0, 1.0, 1.1, 3.0])

    def scaled(leaf):
        is_number = isinstance(leaf, float) or (
            isinstance(leaf, np.ndarray | jax.Array) and np.asarray(leaf).dtype.kind == "f"
        )
        return leaf * draw(factors) if is_number else leaf

    return jax.tree.map(scaled, part)


@st.composite
def whole_cases(draw) -> Case:
    """Cases, most of them valid, with a controller of any kind, or actuators without one."""
    kind = draw(st.sampled_from([None, *CONTROLLED]))
    case = CONTROLLED[kind or "feedback"]
    if kind is None:
        case = dataclasses.replace(
            case,
            controller=None,
            actuators=tuple(draw(st.lists(actuators(LENGTH), max_size=2))),
            sensors=tuple(draw(st.lists(sensors(LENGTH), max_size=2))),
        )
    elif draw(st.booleans()):
        law = draw(varied(case.controller))
        case = eqx.tree_at(lambda c: c.controller, case, law)
    if kind is None or draw(st.booleans()):
        names = draw(st.lists(st.sampled_from(list(LOADS)), min_size=1, max_size=3))
        case = dataclasses.replace(case, loads=tuple(draw(varied(LOADS[name])) for name in names))
        if case.controller is None and "quarter-car" in names:
            sensor = VehicleSensor(load=names.index("quarter-car"))
            case = dataclasses.replace(case, vehicle_sensors=(sensor,))
    if draw(st.booleans()):
        profile = draw(varied(PROFILES[draw(st.sampled_from(list(PROFILES)))]))
        case = dataclasses.replace(case, profile=profile)
    return case


def is_valid(case: Case) -> bool:
    """Whether a case passes `check_case`, whose refusals are one sentence."""
    try:
        check_case(case)
    except ValueError as refusal:
        assert "\n" not in str(refusal) and len(str(refusal)) < 700, refusal
        return False
    return True
