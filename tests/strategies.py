"""Random valid cases, for tests of properties that hold for every case."""

import itertools

from hypothesis import strategies as st

import jaxbeam as jb
from jaxbeam.case.actuators.base import Patch, PointForce, Shaker, SpringDamper
from jaxbeam.case.actuators.electrodynamic import (
    AbstractInnerLoop,
    CurrentLoop,
    Electrodynamic,
    ForceLoop,
)
from jaxbeam.case.beam import END_CONDITIONS, Beam, Support
from jaxbeam.case.case import Case, Run
from jaxbeam.case.fields import kind_of, kinds
from jaxbeam.case.loads.base import MovingForce, MovingMass
from jaxbeam.case.sensors import QUANTITIES, Filter, Sensor
from tests.export import cases as controlled


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


# One part of every kind, from whose numbers random ones are made; a test finds missing kinds.

PROFILES = {
    "table": jb.profiles.TableProfile([-20.0, 0.2, 0.4, 20.0], [0.0, 1e-4, -1e-4, 0.0]),
    "sine": jb.profiles.SineProfile(amplitude=1e-4, wavelength=0.3, phase=0.4),
    "ramp": jb.profiles.RampProfile(start=0.1, end=0.3, height=1e-4),
    "step": jb.profiles.StepProfile(start=0.1, end=0.3, height=-1e-4),
    "bump": jb.profiles.BumpProfile(start=0.1, end=0.3, height=2e-4, contact_length=0.05),
    "spectrum": jb.profiles.SpectrumProfile([0.4, 1.35], [4e-5, 2e-5], [0.3, 2.0]),
    "iso8608": jb.profiles.ISO8608Profile("C", seed=4, waves=12, switch_on=[-2.0, 3.0]),
    "rail": jb.profiles.RailProfile("fra-3", seed=2, waves=12, contact_length=0.05),
}

COACH = jb.vehicles.Coach("quarter-truck", count=2, length=8.0)
WAGON = {
    "body_mass": 0.3,
    "body_inertia": 1e-3,
    "bogie_mass": 0.05,
    "bogie_inertia": 1e-5,
    "wheelset_mass": 0.02,
    "primary_stiffness": 900.0,
    "primary_damping": 0.5,
    "secondary_stiffness": 200.0,
    "secondary_damping": 0.5,
    "bogie_distance": 0.2,
    "wheelset_distance": 0.05,
}
LOADS = {
    "mass": jb.MovingMass(mass=0.4, speed=2.4, entry_time=0.02),
    "force": jb.MovingForce(mass=0.4, times=[0.0, 0.1, 0.2], positions=[0.0, 0.4, 0.3]),
    "axles": jb.Axles(offsets=[0.0, 0.2], forces=[3.0, 2.0], count=2, spacing=0.3, speed=2.4),
    "train": jb.vehicles.TrainLoad(coaches=[COACH], speed=2.4, start_position=-1.0),
    "line-load": jb.LineLoad(
        force_per_length=[5.0, 2.0], lengths=[0.2, 0.1], gaps=[0.0, 0.1], points=8, speed=2.4
    ),
    "oscillator": jb.Oscillator(0.4, 900.0, 2.0, wheel_mass=0.05, speed=2.4, deceleration=0.5),
    "quarter-car": jb.QuarterCar(
        body_mass=0.3,
        axle_mass=0.05,
        suspension_stiffness=60.0,
        suspension_damping=0.4,
        tyre_stiffness=900.0,
        speed=-2.4,
    ),
    "half-car": jb.vehicles.HalfCar(
        body_mass=0.4,
        body_inertia=1e-3,
        axle_positions=[0.1, -0.1],
        axle_masses=[0.05, 0.06],
        suspension_stiffness=[60.0, 50.0],
        suspension_damping=[0.4, 0.3],
        tyre_stiffness=[900.0, 800.0],
        tyre_damping=[0.1, 0.1],
        speed=2.4,
    ),
    "wagon": jb.vehicles.Wagon(**WAGON, speed=2.4, start_position=-0.3),
    "vehicle": jb.vehicles.VehicleLoad(
        bodies=[jb.vehicles.VehicleBody("body", mass=0.4, inertia=1e-3, position=0.0)],
        axles=[
            jb.vehicles.VehicleAxle(
                "body", p, mass=0.05, suspension_stiffness=60.0, suspension_damping=0.2
            )
            for p in (0.1, -0.1)
        ],
        speed=2.4,
    ),
    "varying-force": jb.VaryingForce(
        force=2.0, frequencies=[1.3, 3.0], amplitudes=[0.7, 0.2], phases=[0.0, 1.0], speed=2.4
    ),
    "pedestrian": jb.Pedestrian(pace=2.0, weight=5.0, speed=2.4, step_time=0.1),
    "crowd": jb.Crowd(people=3, length=0.5, pace=2.0, weight=5.0, speed=2.4, seed=3),
}

# Cases of controllers with the shapes that these need; kinds of their own are left out.
CONTROLLED = {
    name: case
    for name, case in (controlled.CASES | controlled.DESIGNED_TABLES).items()
    if type(case.controller).__module__.startswith("jaxbeam.")
}
WEIGHTS, PERIOD = controlled.WEIGHTS, controlled.PERIOD
PREDICTIVE = {"horizon": 4, "moves": 2, "move_weight": 1e-9, "period": PERIOD}
ONE_EACH = {"actuators": [jb.PointForce(0.3)], "sensors": [jb.Sensor(0.3)]}
CONTROLLED |= {
    "lqr-step": controlled.rig(jb.LQR(**WEIGHTS, points=60, horizon="frozen")),
    "lqr-augmented": controlled.rig(
        jb.LQR(
            **WEIGHTS,
            points=60,
            estimator=jb.MovingHorizon(0.02, 1e-5, weight_deviation=1.0),
            horizon="crossing",
            augmented="loads",
        )
    ),
    "lqr-position": controlled.rig(
        jb.LQR(**WEIGHTS, masses=[0.3], points=60, horizon="crossing", schedule="positions")
    ),
    "lqr-integral": controlled.rig(
        jb.LQR(
            [1e4, 1e2, 1.0, 0.1, 0.0],
            [1e-4, 1e-3],
            positions=[0.3, 0.4],
            position_weight=[1e5, 2e5],
            integral_weight=[1.0, 2.0],
            reference=[1e-4, 0.0],
            period=PERIOD,
            sampling="exact",
        )
    ),
    "kalman-extended": controlled.rig(
        jb.LQR(
            **WEIGHTS,
            estimator=jb.ExtendedKalman(0.02, 1e-5, mass_deviation=0.1, speed_deviation=0.1),
        )
    ),
    "mpc-scenario": controlled.rig(
        jb.ScenarioMPC(
            **PREDICTIVE, loads="known", stiffness_factors=[0.8, 1.2], mass_factors=[1.0, 1.1]
        )
    ),
    "gpc-adaptive": controlled.rig(
        jb.AdaptiveGPC(**PREDICTIVE, until=0.1, probe=0.5, measurement_noise=1e-7), **ONE_EACH
    ),
}


def kinds_of_jaxbeam(family: type) -> set[str]:
    """Kinds of a family that jaxbeam declares; tests declare others."""
    found = kinds(family).items()
    return {kind for kind, one in found if one.__module__.startswith("jaxbeam.")}


def kinds_of_examples() -> dict[str, set[str]]:
    """Kinds of controllers and estimators that have an example."""
    laws = [case.controller for case in CONTROLLED.values()]
    estimators = [getattr(law, "estimator", None) for law in laws]
    return {
        name: {kind for part in parts if (kind := kind_of(type(part))) is not None}
        for name, parts in (("controller", laws), ("estimator", estimators))
    }
