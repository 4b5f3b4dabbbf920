"""One part of every kind, from whose numbers random ones are made; a test finds missing kinds."""

import jaxbeam as jb
from jaxbeam.case.fields import kind_of, kinds
from tests.c_code import cases as controlled

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
