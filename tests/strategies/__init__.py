"""Random valid cases, for tests of properties that hold for every case."""

import itertools

from hypothesis import strategies as st

from jaxbeam.case.actuators.base import Patch, PointForce, Shaker, SpringDamper
from jaxbeam.case.actuators.electrodynamic import (
    AbstractInnerLoop,
    CurrentLoop,
    Electrodynamic,
    ForceLoop,
)
from jaxbeam.case.beam import END_CONDITIONS, Beam, Support
from jaxbeam.case.case import Case, Run
from jaxbeam.case.loads.base import MovingForce, MovingMass
from jaxbeam.case.sensors import QUANTITIES, Filter, Sensor


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    """Finite numbers between two bounds, of either sign of zero but never subnormal."""
    return st.floats(low, high, allow_subnormal=False)


def maybe(strategy: st.SearchStrategy) -> st.SearchStrategy:
    """A value, or None where a number may be left out."""
    return st.none() | strategy


@st.composite
def beams(draw) -> Beam:
    """Beams of any end conditions, by stiffness or by section, with modal or Rayleigh damping."""
    modes = draw(st.integers(1, 6))
    if draw(st.booleans()):
        section = {
            "flexural_rigidity": draw(numbers(1.0, 1e6)),
            "mass_per_length": draw(numbers(0.1, 1e3)),
        }
    else:
        section = {
            "width": draw(numbers(0.01, 1.0)),
            "height": draw(numbers(0.001, 1.0)),
            "youngs_modulus": draw(numbers(1e9, 3e11)),
            "density": draw(numbers(500.0, 1e4)),
        }
    ratio = numbers(0.0, 0.2)
    if draw(st.booleans()):
        damping = {"damping_ratio": draw(ratio | st.lists(ratio, min_size=modes, max_size=modes))}
    else:
        damping = {"rayleigh_damping": [draw(numbers(0.0, 1.0)), draw(numbers(0.0, 1e-3))]}
    end = st.sampled_from(list(END_CONDITIONS))
    ends = f"{draw(end)}-{draw(end)}"
    return Beam(length=draw(numbers(0.1, 50.0)), ends=ends, modes=modes, **section, **damping)


@st.composite
def supports(draw, length: float) -> tuple[Support, ...]:
    """Up to three supports, rigid or elastic, at different positions."""
    shares = draw(st.lists(st.integers(0, 20), max_size=3, unique=True))
    stiffnesses = [draw(maybe(numbers(0.0, 1e8))) for _ in shares]
    return tuple(
        Support(
            position=length * share / 20,
            stiffness=stiffness,
            damping=None if stiffness is None else draw(maybe(numbers(0.0, 100.0))),
            rotational_stiffness=draw(numbers(0.0, 1e4)),
        )
        for share, stiffness in zip(shares, stiffnesses, strict=True)
    )


@st.composite
def inner_loops(draw) -> AbstractInnerLoop:
    """An inner loop of a shaker of either kind."""
    limits = draw(maybe(st.just([-1.0, 2.0])))
    if draw(st.booleans()):
        return CurrentLoop(bandwidth=draw(numbers(1.0, 1e4)), limits=limits)
    lag = draw(maybe(numbers(1.0, 1e4)))
    return ForceLoop(None, draw(numbers(0.1, 9.0)), draw(maybe(numbers(1.0, 9.0))), lag, limits)


ACTUATORS = ("point", "shaker", "electrodynamic", "patch", "spring")


@st.composite
def actuators(draw, length: float):
    """An actuator of any kind."""
    position = numbers(0.0, length)
    limits = maybe(st.tuples(numbers(-10.0, -1.0), numbers(0.0, 10.0)).map(list))
    kind = draw(st.sampled_from(ACTUATORS))
    if kind == "point":
        return PointForce(position=draw(position), limits=draw(limits))
    if kind == "shaker":
        return Shaker(draw(position), stiffness=draw(numbers(0.0, 1e4)), limits=draw(limits))
    if kind == "spring":
        return SpringDamper(draw(position), draw(numbers(0.0, 1e5)), draw(numbers(0.0, 100.0)))
    if kind == "electrodynamic":
        loop = draw(maybe(inner_loops()))
        return Electrodynamic(
            position=draw(position),
            resistance=draw(numbers(0.1, 10.0)),
            inductance=draw(numbers(1e-5, 1e-3)),
            force_constant=draw(numbers(-20.0, 20.0)),
            back_emf=draw(maybe(numbers(-20.0, 20.0))),
            mass=draw(numbers(0.0, 0.1)),
            limits=draw(limits) if loop is None else None,
            inner_loop=loop,
        )
    return Patch(
        start=draw(numbers(0.0, 0.45 * length)),
        end=draw(numbers(0.5 * length, length)),
        moment_per_volt=draw(numbers(-1e-3, 1e-3)),
        limits=draw(limits),
        added_mass=draw(maybe(numbers(0.0, 0.1))),
        added_rigidity=draw(maybe(numbers(0.0, 10.0))),
    )


@st.composite
def filters(draw) -> Filter:
    """A filter with a cutoff below half of every sampling frequency in use."""
    realisation = draw(st.sampled_from(["digital", "analogue"]))
    return Filter(draw(numbers(0.01, 0.4)), draw(st.integers(1, 10)), realisation=realisation)


@st.composite
def sensors(draw, length: float) -> Sensor:
    """A sensor of any quantity of a beam that does not twist."""
    bending = [name for name, quantity in QUANTITIES.items() if not quantity.of_twist]
    quantity = draw(st.sampled_from(bending))
    fibre = draw(numbers(-0.1, 0.1)) if QUANTITIES[quantity].at_fibre else None
    modulus = draw(numbers(1e-6, 0.1)) if QUANTITIES[quantity].over_modulus else None
    offset = draw(numbers(-1.0, 1.0))
    return Sensor(
        draw(numbers(0.0, length)),
        quantity,
        offset,
        fibre,
        noise=draw(maybe(numbers(0.0, 1.0))),
        range=draw(maybe(st.tuples(numbers(-2.0, -1.0), numbers(1.0, 2.0)).map(list))),
        resolution=draw(maybe(numbers(1e-6, 0.1))),
        filter=draw(maybe(filters())),
        sampling_period=draw(maybe(numbers(1e-4, 0.01))),
        delay=draw(maybe(numbers(0.0, 0.1))),
        section_modulus=modulus,
    )


@st.composite
def loads(draw, length: float):
    """A mass or force that crosses in either direction, brakes, or follows a table."""
    if draw(st.booleans()):
        trajectory = {
            "speed": draw(numbers(0.05, 20.0)) * draw(st.sampled_from([1, -1])),
            "entry_time": draw(numbers(0.0, 2.0)),
            "deceleration": draw(numbers(-0.1, 0.1)),
        }
    else:
        steps = draw(st.lists(numbers(0.01, 1.0), min_size=2, max_size=6))
        position = numbers(0.0, length)
        trajectory = {
            "times": list(itertools.accumulate(steps)),
            "positions": draw(st.lists(position, min_size=len(steps), max_size=len(steps))),
        }
    if draw(st.booleans()):
        return MovingMass(mass=draw(numbers(0.0, 100.0)), **trajectory)
    weight = draw(st.sampled_from(["mass", "force"]))
    return MovingForce(**{weight: draw(numbers(0.0, 1e3))}, **trajectory)


@st.composite
def cases(draw) -> Case:
    """Cases that pass `check_case`, with up to two parts of each list."""
    beam = draw(beams())
    length = float(beam.length)
    return Case(
        beam,
        supports=draw(supports(length)),
        actuators=draw(st.lists(actuators(length), max_size=2)),
        sensors=draw(st.lists(sensors(length), max_size=2)),
        loads=draw(st.lists(loads(length), max_size=2)),
        run=Run(draw(numbers(0.01, 100.0)), draw(numbers(1.0, 1e5)), draw(numbers(0.0, 20.0))),
        title=draw(st.text(max_size=30)),
    )
