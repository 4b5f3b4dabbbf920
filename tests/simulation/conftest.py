"""Fixture of the tests of runs."""

import equinox as eqx
import jax.numpy as jnp
import pytest

import jaxbeam as jb
from tests.differences import load_of, plan_of
from tests.oracles.crossing import Load
from tests.simulation.pinned_span import SPAN, TIMES, case_of


@pytest.fixture(scope="module")
def one_mass():
    """Function that simulates one mass on the span; all runs share one plan."""
    case = case_of(SPAN, [Load(0.3, 1.0)])
    plan = plan_of(case)

    def run(load: Load, times=TIMES, plan=plan, **numbers):
        changed = eqx.tree_at(lambda c: c.loads, case, (load_of(load),))
        return jb.simulate(jb.replace(changed, numbers), jnp.asarray(times), plan)

    return run
