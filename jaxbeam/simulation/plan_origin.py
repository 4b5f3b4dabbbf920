"""Origin of an integration plan: the case, times and step limit that it was made for.

A plan fixes the number of loads on the beam, the steps between samples and the events of control.
Followed by another case it gives wrong numbers, so that what is known of both is compared first.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.integrator.events import EventSchedule
from jaxbeam.integrator.static_shapes import StaticShapes, model_limits, static_shapes
from jaxbeam.integrator.step_size import CONVERGENCE_ORDER

# Errors of a plan, relative to the largest deflection, beyond which it is not followed by a case of
# other numbers. They grow with the ninth power, at least, of steps over the stability limit.
LARGEST_ERROR = 1e-3
INSTEAD = "leave the plan out, or make it of this case and these times by integration_plan"


@dataclasses.dataclass(frozen=True, eq=False)
class PlanOrigin:
    """Case of a plan, with NaN for numbers that differ among several, its samples, its limit (s).

    `times` (s) are None where several cases differ in them.
    """

    case: Case
    times: Float[np.ndarray, " time"] | None
    max_stable_step: float


def common_origin(origins: Sequence[PlanOrigin | None]) -> PlanOrigin | None:
    """Origin of a plan for several cases, which differ in numbers or times; None without one."""
    first, *others = origins
    if first is None:
        return None
    case, times, limit = first.case, first.times, first.max_stable_step
    for other in others:
        if other is None or jax.tree.structure(other.case) != jax.tree.structure(case):
            return None
        case = jax.tree.map(_common_number, case, other.case)
        if times is None or other.times is None or not _same(times, other.times):
            times = None
        limit = min(limit, other.max_stable_step)
    return PlanOrigin(case, times, limit)


def check_origin(
    origin: PlanOrigin | None,
    shapes: StaticShapes,
    case: Case,
    times,
    steps_per_limit: float,
    error: float,
) -> bool:
    """Whether a plan for cases like its `origin` is one of exactly this case, as far as is known.

    `steps_per_limit` is the longest step of the plan over the stability limit of its origin,
    `error` that of the plan.
    Raises ValueError for a case that the plan does not hold for: other parts, supports or loads in
    another order, more loads on the beam at once, much faster motion, or other times. Traced
    numbers cannot be compared.
    """
    if origin is None:
        return True
    for key in (field.name for field in dataclasses.fields(case)):
        own, planned = getattr(case, key), getattr(origin.case, key)
        if key == "controller" and (own is None) == (planned is None):
            continue  # its events are compared, and another law has other errors only
        alike = jax.tree.structure(own) == jax.tree.structure(planned) and all(
            np.shape(a) == np.shape(b)
            for a, b in zip(jax.tree.leaves(own), jax.tree.leaves(planned), strict=True)
        )
        if not alike:
            raise ValueError(
                f"the plan was made for a case with other {key} (their number, kinds, names or"
                f" lists differ): {INSTEAD}"
            )
    if origin.times is not None and (
        np.shape(times) != origin.times.shape
        or (is_concrete(times) and not _same(concrete(times), origin.times))
    ):
        ours = concrete(times) if is_concrete(times) else np.zeros(0)
        raise ValueError(
            f"the plan was made for {_words(origin.times)}, and the run has"
            f" {_words(ours) if ours.size else 'others'}: {INSTEAD}"
        )
    leaves = jax.tree.leaves(case)
    if not all(map(is_concrete, leaves)):
        return True
    case = concrete_case(case)
    if jax.tree.structure(case) == jax.tree.structure(origin.case) and all(
        map(_same_or_nan, jax.tree.leaves(case), jax.tree.leaves(origin.case))
    ):
        return True
    own = static_shapes(case)
    if own.layout != shapes.layout or own.coupled > shapes.coupled:
        raise ValueError(
            "the plan was made for a case with supports, actuators or sections in another order"
            f" along the beam, or without dampers between modes: {INSTEAD}"
        )
    if own.max_loads > shapes.max_loads:
        raise ValueError(
            f"the plan was made for at most {shapes.max_loads} loads on the beam at once, and there"
            f" are {own.max_loads}: {INSTEAD}"
        )
    ratio = origin.max_stable_step / float(model_limits(case, own.layout)[0])
    unstable = ratio * steps_per_limit > max(1.0, steps_per_limit) * (1 + 1e-9)
    if unstable or error * ratio**CONVERGENCE_ORDER > LARGEST_ERROR:
        raise ValueError(
            f"the steps of the plan are too long for this case, in which frequencies or speeds are"
            f" {ratio:.3g} times as high: {INSTEAD}"
        )
    return False


def check_same_events(planned: EventSchedule, own: EventSchedule) -> None:
    """Raises ValueError unless a controlled run has the events of control that a plan has."""
    pairs = zip(jax.tree.leaves(planned), jax.tree.leaves(own), strict=False)
    if jax.tree.structure(planned) != jax.tree.structure(own) or not all(
        np.shape(a) == np.shape(b) and np.allclose(a, b, rtol=1e-12, atol=1e-12) for a, b in pairs
    ):
        raise ValueError(
            "the plan was made for control, readings or commands at other times (period, delays,"
            f" sampling periods): {INSTEAD}"
        )


def _common_number(a: Any, b: Any) -> Any:
    if np.shape(a) != np.shape(b):
        return np.full(np.shape(a), np.nan)
    return np.where(np.asarray(a) == np.asarray(b), a, np.nan)


def _same_or_nan(own: Any, planned: Any) -> bool:
    if np.shape(own) != np.shape(planned):
        return False
    return bool(np.all((np.asarray(own) == np.asarray(planned)) | np.isnan(planned)))


def _same(a: Float[np.ndarray, " time"], b: Float[np.ndarray, " time"]) -> bool:
    return a.shape == b.shape and bool(np.all(np.abs(a - b) <= 1e-9 * np.abs(b).max(initial=0.0)))


def _words(times: Float[np.ndarray, " time"]) -> str:
    return f"{times.size} samples from {times[0]:.4g} to {times[-1]:.4g} s"
