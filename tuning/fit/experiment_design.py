"""Design of experiments: where to put a sensor, or how fast to cross, to know a number better.

found = sharpen(case, free=["beam.damping_ratio"], over={"sensors.0.position": (0.05, 0.55)})
print(found)
"""

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Float

from jaxbeam.case.case import Case, replace, value_at
from jaxbeam.case.fields import known
from jaxbeam.case.validation import check
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.integration_plan import IntegrationPlan, integration_plan, sample_times
from jaxbeam.simulation.simulate import simulate_readings
from tuning.parameters.free import unit_at

SIMULATION_TOLERANCE = 1e-5  # of the simulation, relative to the largest deflection
START_COUNT = 5  # of the search, spread between the bounds: there may be several best places


@dataclasses.dataclass(frozen=True, eq=False)
class ExperimentDesign:
    """A better experiment: what to choose, and the standard errors before and after (SI units).

    `error_sensitivities` (free, choice) say by which share an error changes per unit of each choice, before;
    an infinite error is of a number that the experiment cannot tell.
    """

    choices: list[str]
    units: list[str]
    before: Float[np.ndarray, " choice"]
    after: Float[np.ndarray, " choice"]
    addresses: list[str]
    errors_before: Float[np.ndarray, " free"]
    errors_after: Float[np.ndarray, " free"]
    error_sensitivities: Float[np.ndarray, "free choice"]
    case: Case

    def to_dict(self) -> dict:
        """Choices and standard errors, each before and after (SI units), as plain data."""
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
        lines += [f"standard error of {name}: {a:.3g} -> {b:.3g}" for name, a, b in errors]
        return "\n".join(lines)


def design_experiment(
    case: Case,
    free: Sequence[str],
    over: Mapping[str, tuple[float, float]],
    *,
    target: str | None = None,
    noise: float = 1e-5,
) -> ExperimentDesign:
    """Choose numbers of an experiment, within bounds, such that a fit tells the most.

    `free` are the addresses that will be fitted; the case has their likely values. The standard
    error of `target` is made as small as can be or, without one, the volume of the confidence
    region of all (D-optimality). Errors are those of the linearised fit, from the Fisher
    information J' J / noise^2 with exact derivatives J of the readings; its derivatives with
    respect to the choices are exact, too, and followed from several starts. `noise` is the standard
    deviation of a sample (SI) of sensors that do not say theirs.

    Raises ValueError for unknown addresses, a choice that is free as well, and bounds that do not
    hold what the case has.
    """
    free = list(free)
    check(case)
    _check_arguments(case, free, over, target)
    low, high = np.array(list(over.values()), float).T
    nominal = jnp.array([float(known(value_at(case, address))) for address in free])
    before = np.array([float(known(value_at(case, address))) for address in over])
    noise_levels = jnp.array([noise if s.noise is None else s.noise for s in case.sensors])

    def cramer_rao(choice, plan):
        """Log standard errors, and half the log of the volume."""
        times = sample_times(case)
        chosen = replace(case, dict(zip(over, choice, strict=True)))

        def predict(values):
            return simulate_readings(
                replace(chosen, dict(zip(free, values, strict=True))), times, plan
            )

        jacobian = jax.jacfwd(predict)(nominal) / noise_levels[:, None]
        rows = jacobian.reshape(-1, len(free)) * jnp.where(nominal == 0, 1.0, jnp.abs(nominal))
        information = rows.T @ rows
        inverse = jnp.linalg.inv(information + 1e-12 * jnp.trace(information) * jnp.eye(len(free)))
        errors = jnp.log(jnp.diag(inverse)) / 2
        return errors, -jnp.linalg.slogdet(information)[1] / 2

    @compiled
    def look(choice, plan):
        return cramer_rao(choice, plan), jax.jacfwd(cramer_rao)(choice, plan)

    def least(share, plan):
        (errors, volume), (slopes, volume_slope) = look(
            jnp.asarray(low + (high - low) * share), plan
        )
        if target is None:
            return float(volume), np.asarray(volume_slope) * (high - low)
        index = free.index(target)
        return float(errors[index]), np.asarray(slopes[index]) * (high - low)

    plan = _integration_plan(case)
    (errors, _), (slopes, _) = look(jnp.asarray(before), plan)
    best = _minimise(lambda share: least(share, plan), (before - low) / (high - low))
    after = low + (high - low) * best
    chosen = replace(case, dict(zip(over, after, strict=True)))
    sizes = np.where(nominal == 0, 1.0, np.abs(nominal))
    (improved, _), _ = look(jnp.asarray(after), _integration_plan(chosen))
    return ExperimentDesign(
        list(over),
        [unit_at(case, address) for address in over],
        before,
        after,
        free,
        np.exp(np.asarray(errors)) * sizes,
        np.exp(np.asarray(improved)) * sizes,
        np.asarray(slopes),
        chosen,
    )


def _integration_plan(case: Case) -> IntegrationPlan:
    return integration_plan(case, sample_times(case), SIMULATION_TOLERANCE)


def _minimise(objective, start: Float[np.ndarray, " choice"]) -> Float[np.ndarray, " choice"]:
    """The best of some searches, of which one begins at the start (shares of the bounds)."""
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
        raise ValueError("name at least one number that may be chosen")
    if target is not None and target not in free:
        raise ValueError(f"{target} is to be sharpened but is not free; free are {', '.join(free)}")
    for address in (*free, *over):
        if known(value_at(case, address)).ndim:
            raise ValueError(f"{address} is a list; name its entries, {address}.0 and so on")
    for address, (low, high) in over.items():
        value = float(known(value_at(case, address)))
        if address in free:
            raise ValueError(f"{address} cannot be both fitted and chosen")
        if not low <= value <= high or not low < high:
            raise ValueError(f"{address} is {value:g}, outside of its bounds {low:g} to {high:g}")
