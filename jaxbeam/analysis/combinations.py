"""Combinations of actions: factors times the extremes of each, and their envelope.

An action has a lowest and a highest value of each effect: a permanent one the same, one that may be
absent at most zero and at least zero. Each enters a combination with the worst of its factors and
extremes (EN 1990, 6.4.3, sums effects so, the model being linear),

    highest = sum over actions of max(f v),  f in its factors, v in (lowest, highest),

and the envelope has the extremes of all combinations. All factors are given by the user.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from jaxbeam.analysis.load_models import (
    check_quantity,
    crossing_envelope,
    influence_at,
    load_model_envelope,
)
from jaxbeam.analysis.sections import envelope
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete, is_real, refuses_traced, suggestion
from jaxbeam.case.toml_file import number_in_si
from jaxbeam.model.along_beam import sections
from jaxbeam.model.statics import REACTION
from jaxbeam.runtime.printer import TableViews

Extremes = tuple[Float[np.ndarray, " position"], Float[np.ndarray, " position"]]
Factors = float | Sequence[float] | Sequence[int]
SOURCES = "uniform", "model", "loads"  # an action has one of these
SELF_WEIGHT, OWN = "self-weight", "case"
OPTIONS = {  # of each source, with the units of those that are numbers
    "uniform": {},
    "model": {"speed": "m/s", "lane": "N/m", "impact": "1"},
    "loads": {},
}


@dataclasses.dataclass(frozen=True, repr=False)  # a table
class Combined(TableViews):
    """Lowest and highest effects (combination, position) of named combinations at positions (m)."""

    quantity: str
    positions: Float[np.ndarray, " position"]
    names: tuple[str, ...]
    lowest: Float[np.ndarray, "combination position"]
    highest: Float[np.ndarray, "combination position"]

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """Extremes of all combinations at each position, and which governs, by head."""
        names = np.array(self.names)
        return {
            "position (m)": self.positions,
            f"lowest {self.quantity}": self.lowest.min(axis=0),
            "lowest by": names[self.lowest.argmin(axis=0)],
            f"highest {self.quantity}": self.highest.max(axis=0),
            "highest by": names[self.highest.argmax(axis=0)],
        }


def combined(
    extremes: Mapping[str, Extremes], combinations: Mapping[str, Mapping[str, Factors]]
) -> tuple[Float[np.ndarray, "combination position"], Float[np.ndarray, "combination position"]]:
    """Lowest and highest sums of factored actions, for each combination; see the module.

    `extremes` has lowest and highest values (position,) by action, `combinations` a factor by
    action, or two, as `[1.35, 1.0]` of an unfavourable and a favourable one; actions that are left
    out do not act. Raises ValueError for an action without extremes, without combinations, and for
    factors that are not finite.

    >>> from jaxbeam.analysis.combinations import combined
    >>> import numpy as np
    >>> dead, traffic = np.array([100.0]), np.array([60.0])
    >>> effects = {"dead": (dead, dead), "traffic": (-20.0 * np.ones(1), traffic)}
    >>> print(*combined(effects, {"ultimate": {"dead": [1.35, 1.0], "traffic": 1.5}}))
    [[70.]] [[225.]]
    """
    if not combinations:
        raise ValueError("there is nothing to combine: give a table of factors for a combination")
    lowest, highest = [], []
    for name, factors in combinations.items():
        low = high = 0.0
        for action, given in factors.items():
            where = f"combinations.{name}.{action}"
            if action not in extremes:
                raise ValueError(
                    f"{where}: there is no such action; {suggestion(action, extremes)}"
                )
            values = np.atleast_1d(np.asarray(given if is_real(given) else np.nan, float))
            if values.ndim != 1 or values.size not in (1, 2) or not np.isfinite(values).all():
                raise ValueError(f"{where} is a factor, or two, as [1.35, 1.0], not {given!r}")
            products = values[:, None, None] * np.stack(extremes[action])
            low, high = low + products.min(axis=(0, 1)), high + products.max(axis=(0, 1))
        shape = np.zeros_like(next(iter(extremes.values()))[0])
        lowest.append(shape + low)
        highest.append(shape + high)
    return np.stack(lowest), np.stack(highest)


def action_extremes(
    case: Case, action: Mapping, x: Float[np.ndarray, " position"], quantity: str, where: str = ""
) -> Extremes:
    """Lowest and highest effect of an action at positions x (m); see `combine`.

    Raises ValueError as that does, for the action at the address `where`.
    """
    source = next((one for one in SOURCES if one in action), None)
    allowed = () if source is None else (source, *OPTIONS[source])
    wrong = [key for key in action if key not in allowed]
    if source is None or wrong:
        raise ValueError(
            f"{where or 'an action'} has one of {', '.join(SOURCES)}, and with a model speed,"
            f" lane or impact; not {', '.join(map(str, action)) or 'nothing'}"
        )
    if source == "uniform":
        return _uniform(case, action["uniform"], x, quantity, f"{where}.uniform")
    if source == "loads":
        if action["loads"] != OWN or quantity == REACTION:
            raise ValueError(
                f"{where}.loads is {OWN!r}, the loads of the case as they move, without reactions"
            )
        found = envelope(case, x, quantity=quantity)
        return np.asarray(found.lowest), np.asarray(found.highest)
    given = {
        key: number_in_si(action[key], unit, f"{where}.{key}")
        for key, unit in OPTIONS["model"].items()
        if key in action
    }
    if "speed" not in given:
        lane, impact = given.get("lane"), given.get("impact")
        static = load_model_envelope(
            case, action["model"], x, quantity=quantity, lane=lane, allowance=impact
        )
        return static.lowest, static.highest
    if len(given) > 1 or quantity == REACTION:
        raise ValueError(
            f"{where}: a model at a speed has neither lane nor impact, and no reactions; leave out"
            " speed for the static effects"
        )
    moving = crossing_envelope(case, action["model"], given["speed"], x, quantity=quantity)
    return np.asarray(moving.lowest), np.asarray(moving.highest)


@refuses_traced("a combination of actions")
def combine(
    case: Case,
    actions: Mapping[str, Mapping],
    combinations: Mapping[str, Mapping[str, Factors]],
    x,
    *,
    quantity: str = "moment",
) -> Combined:
    """Combinations of actions on a beam at positions x (m), with a factor for each action.

    An action has one of

    - `uniform`: a load (N/m, or "12 kN/m") on the whole beam, for good; "self-weight" is that of
      the beam by its mass per length,
    - `model`: a load model or train of `load_model_envelope`, where it is worst or absent, with its
      `lane` load and `impact`; with a `speed` the dynamic effects of its axles,
    - `loads = "case"`: the loads of the case, as they move.

    Factors are those of `combined`. What jumps at a position counts with the worse side of each
    action. Raises ValueError as `combined`, `load_model_envelope` and `jaxbeam.envelope`, and for
    an action that is none of these.

    >>> import jaxbeam as jb
    >>> from jaxbeam.analysis.combinations import combine
    >>> case = jb.Case(jb.Beam(length=20.0, flexural_rigidity=6e9, mass_per_length=9e3))
    >>> actions = {"deck": {"uniform": "20 kN/m"}, "traffic": {"model": "LM1"}}
    >>> found = combine(case, actions, {"ultimate": {"deck": 1.35, "traffic": 1.35}}, x=[10.0])
    >>> print(f"{found.highest[0, 0]:.4g} N m")  # 1.35 (20 kN/m L^2 / 8 + 4.17 MN m)
    6.98e+06 N m
    """
    check_quantity(quantity)
    x = np.atleast_1d(np.asarray(concrete(x, "x"), float))
    extremes = {
        name: action_extremes(case, action, x, quantity, f"actions.{name}")
        for name, action in actions.items()
    }
    return Combined(quantity, x, tuple(combinations), *combined(extremes, combinations))


def _uniform(case: Case, given, x, quantity: str, where: str) -> Extremes:
    """Effect of a load (N/m) on the whole beam, the integral of the influence line times it."""
    if given == SELF_WEIGHT:
        if case.beam.segments:
            raise ValueError(f"{where}: give the weight of a beam of several sections in N/m")
        load = float(concrete(case.beam.mass_per_length * case.run.gravity))
    else:
        load = number_in_si(given, "N/m", where)
    points, left_of = x, np.zeros(0, int)
    if quantity != REACTION:
        points, left_of = map(np.asarray, sections(case, x, quantity))
    lines = [influence_at(case, float(point), quantity) for point in points]
    values = load * np.array([np.trapezoid(line.values, line.positions) for line in lines])
    low, high = values[: x.size].copy(), values[: x.size].copy()
    np.minimum.at(low, left_of, values[x.size :])
    np.maximum.at(high, left_of, values[x.size :])
    return low, high
