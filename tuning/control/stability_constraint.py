"""A constraint on tuning: the loop is to stay stable while loads cross, with room to spare."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.analysis.linearised_loop import linearise, loop_dynamics, loop_timing
from jaxbeam.case.case import Case, known_case, replace, value_at
from jaxbeam.case.loads import motion
from jaxbeam.model.modes import lay_out
from tuning.control.fixed_design import with_fixed_design
from tuning.control.load_cases import AddressValues, run_case
from tuning.control.run_set import RunSet

STABILITY_PENALTY_SLOPE = 1.0  # of the objective, for each 1/s of too large a real part


@dataclasses.dataclass(frozen=True)
class StabilityConstraint:
    """Frozen poles of all training runs are to have real parts of at most `max_real_part` (1/s).

    They are looked at without loads and at `instants` instants along each crossing; also with each
    of the numbers in `parameter_tolerance` changed by its share up and down, and, for a controller that
    samples, with a `extra_delay` (s) on top of its own. Poles cost more than runs: `crossings`, numbers
    by address like those of load cases, may take the place of all training runs.
    """

    max_real_part: float = 0.0
    extra_delay: float = 0.0
    parameter_tolerance: dict[str, float] = dataclasses.field(default_factory=dict)
    instants: int = 7
    crossings: tuple[AddressValues, ...] = ()

    def __post_init__(self):
        if (
            self.extra_delay < 0
            or self.instants < 1
            or any(not 0 < s < 1 for s in self.parameter_tolerance.values())
        ):
            raise ValueError(
                "stable takes a delay that is not negative, at least one place, and spreads"
                " between 0 and 1"
            )

    def violation_of_runs(self, case: Case, run_set: RunSet):
        """`violation` for a case under tuning, along the crossings or all runs of its bench."""
        if self.crossings:
            return self.violation_function([run_case(case, run) for run in self.crossings])
        return self.violation_function(run_set.cases, run_set.nominal)

    def violation_function(self, cases: list[Case], nominal: Mapping[str, Any] | None = None):
        """Function of values by address: by how much (1/s) the worst pole is too far right.

        Laws are designed for the cases, not for what the spread makes of them, and for the
        `nominal` numbers, by address, where the cases differ from these. Raises ValueError as
        `linearised_loop` does, and for a delay without a sampling period.
        """
        sampling = loop_timing(cases[0])
        if sampling is None and self.extra_delay:
            raise ValueError("stable.delay needs a controller that samples: give it a period")
        samplings = [sampling]
        if self.extra_delay:
            samplings.append(sampling._replace(delay=sampling.delay + self.extra_delay))
        layout = lay_out(known_case(cases[0]))
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cases)
        instants = jnp.asarray(np.array([self._evaluation_times(case) for case in cases]))
        # One row as it is, and two for each number in the spread.
        shares = np.diag(list(self.parameter_tolerance.values()))
        factors = 1 + np.concatenate([np.zeros((1, len(shares))), shares, -shares])

        def growth_rates(values, case, factor, times):
            """Of each clock at each time (clock, time)."""
            case = replace(case, values)
            design_values = {a: value_at(case, a) for a in self.parameter_tolerance} | dict(
                nominal or {}
            )
            pairs = zip(self.parameter_tolerance, factor, strict=True)
            changed = replace(case, {a: f * value_at(case, a) for a, f in pairs})
            loop = loop_dynamics(with_fixed_design(changed, design_values, layout), layout)

            def at(own):
                return jax.vmap(lambda t: linearise(loop, own, t).growth_rate())(times)

            return jnp.stack([at(own) for own in samplings])

        def violation(values: Mapping[str, Any]) -> Float[Array, ""]:
            # Slopes of poles cost more than poles do, and only those of the worst are wanted.
            fixed = jax.lax.stop_gradient(dict(values))
            rows = jnp.asarray(factors)
            found = jax.lax.map(
                lambda run: jax.lax.map(
                    lambda factor: growth_rates(fixed, run[0], factor, run[1]), rows
                ),
                (stacked, instants),
            )
            run, row, own, place = jnp.unravel_index(jnp.argmax(found), found.shape)
            case = jax.tree.map(lambda leaf: leaf[run], stacked)
            worst = growth_rates(values, case, rows[row], instants[run, place][None])[own, 0]
            return jnp.maximum(worst - self.max_real_part, 0.0)

        return violation

    def _evaluation_times(self, case: Case) -> Float[np.ndarray, " time"]:
        """Before the first load, and evenly along the crossing of the first."""
        entry, leave = (float(t) for t in motion(case.loads[0], case.beam.length).window())
        leave = min(leave, float(case.run.duration))
        shares = (np.arange(self.instants) + 0.5) / self.instants
        return np.append(entry - 1.0, entry + (leave - entry) * shares)
