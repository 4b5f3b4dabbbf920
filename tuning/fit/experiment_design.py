"""Experiment design: positions of sensors, speeds of loads and the like, for small errors of a fit.

ranges = {"sensors.0.position": (0.05, 0.55)}
print(design_experiment(case, free=["beam.damping_ratio"], over=ranges))
"""

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Float

from jaxbeam.case.case import Case, replace, unit_at, value_at
from jaxbeam.case.fields import concrete, refuses_traced
from jaxbeam.case.validation import check_case
from jaxbeam.runtime.arrays import xp
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.integration_plan import IntegrationPlan, integration_plan, sample_times
from jaxbeam.simulation.simulate import simulate_readings
from tuning.fit.dataset import SIMULATION_TOLERANCE
from tuning.parameters import check_continuous

START_COUNT = 5  # of the search, as there may be several local minima


@dataclasses.dataclass(frozen=True, eq=False)
class ExperimentDesign:
    """Designed experiment: values of the chosen numbers, and standard errors of free parameters.

    Both are in SI units, before and after the design; `error_sensitivities` (parameter, choice) are
    derivatives of the logarithm of each error with respect to each choice, before. Errors are
    infinite for parameters that are not identifiable. `case` has the chosen values.
    """

    choices: list[str]
    units: list[str]
    before: Float[np.ndarray, " choice"]
    after: Float[np.ndarray, " choice"]
    addresses: list[str]
    errors_before: Float[np.ndarray, " parameter"]
    errors_after: Float[np.ndarray, " parameter"]
    error_sensitivities: Float[np.ndarray, "parameter choice"]
    case: Case

    def to_dict(self) -> dict:
        """Choices and standard errors, each before and after (SI units), for JSON."""
        choices = zip(self.choices, self.before, self.after, strict=True)
        errors = zip(self.addresses, self.errors_before, self.errors_after, strict=True)
        return {
            "choices": {name: {"before": a, "after": b} for name, a, b in choices},
            "standard_errors": {name: {"before": a, "after": b} for name, a, b in errors},
        }

    def __str__(self) -> str:
        rows = zip(self.choices, self.units, self.before, self.after, strict=True)
        lines = [f"{choice}: {a:.5g} -> {b:.5g} {unit}" for choice, unit, a, b in rows]
        errors = zip(self.addresses, self.errors_before, self.errors_after, strict=True)
        lines += [
            f"standard error of {name}: {a:.3g} -> {b:.3g}"
            if np.isfinite(b)
            else f"{name} is not identifiable: no reading depends on it alone"
            for name, a, b in errors
        ]
        return "\n".join(lines)


@refuses_traced("a design of experiments")
def design_experiment(
    case: Case,
    free: Sequence[str],
    over: Mapping[str, tuple[float, float]],
    *,
    target: str | None = None,
    noise: float = 1e-5,
) -> ExperimentDesign:
    """Choose numbers of an experiment within bounds, for the smallest errors of a fit.

    `free` are the addresses to be fitted, at their likely values in the case; `over` gives the
    bounds of the numbers to choose. Minimised is the standard error of the `target` or, without
    one, the volume of the confidence region of all (D-optimality). Errors are those of the
    linearised fit, from the Fisher information J' J / noise^2 with exact derivatives J of the
    readings; the search has exact gradients, too, and several starts. `noise` is the standard
    deviation (SI) of a sample of sensors without a noise of their own.

    Raises ValueError for unknown addresses, a number that decides when samples are taken, a choice
    that is free as well, and bounds that exclude the value in the case.

    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     sensors=[jb.Sensor(0.3, noise=1e-5)],
    ...     loads=[jb.MovingForce(force=4.0, speed=2.0)],
    ...     run=jb.Run(0.4, sample_rate=50.0),
    ... )
    >>> over = {"loads.0.speed": (1.0, 4.0)}
    >>> found = tuning.design_experiment(case, ["beam.flexural_rigidity"], over)
    >>> print(str(found).splitlines()[0])
    loads.0.speed: 2 -> 4 m/s
    """
    free = list(free)
    check_case(case)
    _check_arguments(case, free, over, target)
    low, high = np.array(list(over.values()), float).T
    nominal = jnp.array([float(concrete(value_at(case, address))) for address in free])
    before = np.array([float(concrete(value_at(case, address))) for address in over])
    noise_levels = jnp.array([noise if s.noise is None else s.noise for s in case.all_sensors])

    def cramer_rao(choice, plan):
        """Cramer-Rao bound: logarithms of standard errors, and half that of the volume."""
        times = sample_times(case)
        chosen = replace(case, dict(zip(over, choice, strict=True)))

        def predict(values):
            return simulate_readings(
                replace(chosen, dict(zip(free, values, strict=True))), times, plan
            )

        jacobian = jax.jacfwd(predict)(nominal) / noise_levels[:, None]
        rows = jacobian.reshape(-1, len(free)) * jnp.where(nominal == 0, 1.0, jnp.abs(nominal))
        information = rows.T @ rows
        inverse = xp.linalg.inv(information + 1e-12 * jnp.trace(information) * jnp.eye(len(free)))
        errors = jnp.log(jnp.diag(inverse)) / 2
        return errors, -xp.linalg.slogdet(information)[1] / 2

    @compiled
    def bound_with_gradient(choice, plan):
        return cramer_rao(choice, plan), jax.jacfwd(cramer_rao)(choice, plan)

    def objective(fraction):
        choice = jnp.asarray(low + (high - low) * fraction)
        (errors, volume), (slopes, volume_slope) = bound_with_gradient(choice, plan)
        if target is None:
            return float(volume), np.asarray(volume_slope) * (high - low)
        index = free.index(target)
        return float(errors[index]), np.asarray(slopes[index]) * (high - low)

    plan = _integration_plan(case)
    (errors, _), (slopes, _) = bound_with_gradient(jnp.asarray(before), plan)
    best = _minimise(objective, (before - low) / (high - low))
    after = low + (high - low) * best
    chosen = replace(case, dict(zip(over, after, strict=True)))
    sizes = np.where(nominal == 0, 1.0, np.abs(nominal))
    (improved, _), _ = bound_with_gradient(jnp.asarray(after), _integration_plan(chosen))
    return ExperimentDesign(
        choices=list(over),
        units=[unit_at(case, address) for address in over],
        before=before,
        after=after,
        addresses=free,
        errors_before=np.exp(np.asarray(errors)) * sizes,
        errors_after=np.exp(np.asarray(improved)) * sizes,
        error_sensitivities=np.asarray(slopes),
        case=chosen,
    )


def _integration_plan(case: Case) -> IntegrationPlan:
    return integration_plan(case, sample_times(case), SIMULATION_TOLERANCE)


def _minimise(objective, start: Float[np.ndarray, " choice"]) -> Float[np.ndarray, " choice"]:
    """Best of several searches between 0 and 1 (the bounds), one of them from `start`."""
    others = np.random.default_rng(0).random((START_COUNT - 1, start.size))
    if start.size == 1:
        others = (np.arange(START_COUNT - 1)[:, None] + 0.5) / (START_COUNT - 1)
    found = [
        scipy.optimize.minimize(objective, begin, jac=True, bounds=[(0, 1)] * start.size)
        for begin in (start, *others)
    ]
    return min(found, key=lambda one: one.fun).x


def _check_arguments(case: Case, free, over, target) -> None:
    if not over:
        raise ValueError("name at least one number to choose")
    if target is not None and target not in free:
        raise ValueError(f"the target {target} is not free; free are {', '.join(free)}")
    for address in (*free, *over):
        if concrete(value_at(case, address)).ndim:
            raise ValueError(f"{address} is a list; name its entries, {address}.0 and so on")
        check_continuous(case, address)
    for address, (low, high) in over.items():
        value = float(concrete(value_at(case, address)))
        if address in free:
            raise ValueError(f"{address} cannot be both fitted and chosen")
        if not low <= value <= high or not low < high:
            raise ValueError(f"{address} is {value:g}, outside its bounds {low:g} to {high:g}")
