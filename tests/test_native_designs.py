"""Optimal gains by hand-written C: the same as without, and as scipy's, with the same slopes."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam import native_library
from jaxbeam.control import FiniteLQR
from jaxbeam.control.lqr import optimal
from jaxbeam.modes import lay_out
from jaxbeam.native_designs import LIBRARY

pytestmark = pytest.mark.skipif(native_library.compiler() is None, reason="no C compiler here")

BEAM = jb.Beam(0.6, 11.68, 0.535, 0.03, modes=3)
FORCE = jb.PointForce(0.25)
SHAKER = jb.Shaker(0.22, 2000.0, 5.0, force_per_volt=4.6, bandwidth=500.0)
MASS = jb.MovingMass(mass=0.4, speed=4.0)
LATER = jb.MovingMass(mass=0.2, speed=3.0, entry_time=0.05)
WEIGHTS = [4e5, 1e5, 1e5, 10.0, 1.0, 1.0]


def rig(actuators, loads, law=FiniteLQR, **settings):
    return jb.Case(
        BEAM,
        actuators=actuators,
        loads=loads,
        controller=law(WEIGHTS, [1e-3] * len(actuators), points=120, **settings),
    )


# What the states are, and how many commands, forces, and stretches between events there are.
CASES = {
    "one force": rig([FORCE], [MASS]),
    "two commands": rig([FORCE, jb.PointForce(0.4)], [MASS]),
    "two loads known ahead": rig([FORCE], [MASS, LATER], jb.AugmentedLQR),
    "lagging": dataclasses.replace(
        rig([SHAKER], [MASS]), controller=FiniteLQR([*WEIGHTS, 0.0], [1e-3], points=120)
    ),
}
# What differs from design to design, and so what they share.
VARIED = {
    "nothing shared": ("loads.0.mass", "loads.0.speed", "controller.command_weight.0"),
    "flows shared": ("controller.command_weight.0",),
    "answers shared": ("loads.0.mass",),
    "weights of states": ("controller.state_weight.0",),
}


@pytest.fixture(scope="module", autouse=True)
def folder(tmp_path_factory):
    """The C, compiled into a cache folder of these tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        assert not LIBRARY.ready()
        assert LIBRARY.build() == LIBRARY.binary()
        assert LIBRARY.ready()
        yield


def designed(case, addresses, in_time):
    """Polynomials of gains, and P, by relative numbers at some addresses."""
    case = dataclasses.replace(
        case, controller=dataclasses.replace(case.controller, in_time=in_time)
    )
    layout, known = lay_out(case), jb.addresses(case)
    start = np.array([float(known[address]) for address in addresses])

    def of(shares):
        changed = jb.replace(case, dict(zip(addresses, start * shares, strict=True)))
        table, costs = optimal(changed.controller, jb.state_space(changed, layout=layout))
        return table.pieces, costs

    return of


def assert_alike(found, expected, rounding):
    """Compared with the largest in a stretch."""
    size = np.max(np.abs(expected), axis=tuple(range(2, expected.ndim)), keepdims=True)
    assert np.max(np.abs(found - expected) / size) < rounding


@pytest.mark.parametrize("lanes", [1, 3, 19])
@pytest.mark.parametrize("varied", VARIED)
@pytest.mark.parametrize("name", ["one force", "two commands"])
def test_gains_are_those_without_it(name, varied, lanes):
    shares = np.random.default_rng(0).uniform(0.8, 1.2, (lanes, len(VARIED[varied])))
    (found, costs), (plain, plain_costs) = (
        jax.jit(jax.vmap(designed(CASES[name], VARIED[varied], way)))(shares)
        for way in ("native", "sequential")
    )
    assert_alike(costs, plain_costs, 1e-12)
    # By the start of a stretch alone; what bends it is a small difference of large numbers.
    assert_alike(found[:, :, 0], plain[:, :, 0], 1e-11)
    assert_alike(found, plain, 1e-9)
