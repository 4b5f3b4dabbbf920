"""Optimal gains by hand-written C: those without it, and slopes; see test_finite_time, too."""

import dataclasses
import platform
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.control import FiniteLQR
from jaxbeam.control.optimal.lqr import optimal
from jaxbeam.model.modes import lay_out
from jaxbeam.numerics.native_designs import LIBRARY, lacking
from jaxbeam.runtime import native_library
from tests.differences import central
from tests.modules import ROOT

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


@pytest.mark.parametrize(
    ("name", "varied", "lanes"),
    [
        *(("one force", varied, 11) for varied in VARIED),
        ("one force", "nothing shared", 1),
        ("two commands", "nothing shared", 3),
        ("two commands", "flows shared", 19),
    ],
)
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


@pytest.mark.parametrize("name", ["two loads known ahead", "lagging"])
def test_other_plants_have_the_same_gains(name):
    """Constant states and two forces at once; and flows that are not those of coupled plants."""
    shares = np.array([[0.9, 1.1], [1.0, 1.0], [1.1, 0.9]])
    addresses = "loads.0.mass", "controller.command_weight.0"
    (found, costs), (plain, plain_costs) = (
        jax.jit(jax.vmap(designed(CASES[name], addresses, way)))(shares)
        for way in ("native", "sequential")
    )
    assert_alike(costs, plain_costs, 1e-12)
    assert_alike(found[:, :, 0], plain[:, :, 0], 1e-11)
    assert_alike(found, plain, 1e-9)


@pytest.mark.parametrize("varied", ["loads.0.mass", "controller.command_weight.0"])
def test_slopes_in_reverse_and_forward(varied):
    """One at a time and many at once, against differences."""

    of = designed(CASES["one force"], (varied,), "native")

    def size(share):
        return jnp.sum(of(share)[0][:, 0] ** 2)

    shares, plain = np.array([[0.8], [1.0], [1.3]]), jax.jit(size)
    expected = [central(plain, share, step=1e-3) for share in shares]
    slopes = [jax.jit(slope(size)) for slope in (jax.grad, jax.jacfwd)]
    many = jax.jit(jax.vmap(jax.grad(size)))(shares)
    assert_allclose(many, expected, rtol=1e-6)
    for slope in slopes:
        assert_allclose(slope(shares[0]), expected[0], rtol=1e-6)


NARROW = """
import sys
import jax, numpy as np
from jaxbeam.numerics.native_designs import LIBRARY, lacking
from tests.differences import central
from tests.modules import ROOT
from tests.numerics.test_native_designs import CASES, VARIED, designed
LIBRARY.build()
varied = VARIED["nothing shared"]
of = jax.jit(jax.vmap(designed(CASES["two commands"], varied, "native")))
np.savez(sys.argv[1], *of(np.linspace(0.8, 1.2, 5)[:, None] * np.ones(len(varied))))
"""


@pytest.mark.skipif(platform.machine() != "x86_64", reason="options of other compilers")
@pytest.mark.parametrize("without", ["avx512f", "avx"])
def test_narrower_machines_compute_the_same(without, tmp_path, monkeypatch):
    """In another process: one takes what is in C from only one compiled library."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("CC", f"{native_library.compiler()} -mno-{without}")
    path = tmp_path / "found.npz"
    subprocess.run([sys.executable, "-c", NARROW, str(path)], check=True, cwd=ROOT)
    varied = VARIED["nothing shared"]
    shares = np.linspace(0.8, 1.2, 5)[:, None] * np.ones(len(varied))
    pieces, costs = jax.jit(jax.vmap(designed(CASES["two commands"], varied, "sequential")))(shares)
    with np.load(path) as found:
        assert_alike(found["arr_0"], pieces, 1e-9)
        assert_alike(found["arr_1"], costs, 1e-12)


def test_who_asks_for_what_was_not_compiled_is_told(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(ValueError, match="in_time = 'native' takes what `jaxbeam native` compiles"):
        designed(CASES["one force"], (), "native")(np.zeros(0))
    case = rig([FORCE], [MASS], in_time="native")
    with pytest.raises(ValueError, match="controller.in_time = 'native' takes"):
        jb.simulate(case)


def test_single_precision_is_refused():
    with jax.enable_x64(False):
        assert "double precision only" in (lacking() or "")
