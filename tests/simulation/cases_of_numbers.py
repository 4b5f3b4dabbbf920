"""Cases in which every declared number of every kind is not zero and changes the run.

A case stands beside the parts whose numbers `test_every_number` differentiates in it.
"""

import dataclasses

import numpy as np

import jaxbeam as jb
from jaxbeam import vehicles
from jaxbeam.control.load_identification import LoadIdentification
from jaxbeam.control.state_controller import DesignModel
from tests.export.cases import LATE, PERIOD
from tests.model.test_layered_track import RIG
from tests.strategies import CONTROLLED, LOADS, PROFILES

RUN = jb.Run(0.3, sample_rate=217.3)  # no sample is at an event
BEAM = jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2)
SENSOR = jb.Sensor(0.25)
MASS = LOADS["mass"]
STANDING = {"speed": None, "entry_time": 0.02}
TABLE = {"speed": None, "times": [0.01, 0.1, 0.27], "positions": [-0.1, 0.3, 0.8]}
START = {"entry_time": 0.01, "start_position": -0.05}


def rig(loads=(MASS,), **changes) -> jb.Case:
    parts = {"beam": BEAM, "sensors": [SENSOR], "loads": loads, "run": RUN}
    return jb.Case(**(parts | changes))


def changed(name: str, **changes):
    """An example of a load with other numbers."""
    return dataclasses.replace(LOADS[name], **changes)


AXLE = {"mass": 0.05, "suspension_stiffness": 60.0, "suspension_damping": 0.2}
TYRE = {"tyre_stiffness": 900.0, "tyre_damping": 0.1}
ARTICULATED = jb.vehicles.VehicleLoad(
    bodies=[
        vehicles.VehicleBody("tractor", mass=0.3, inertia=1e-3, position=0.02),
        vehicles.VehicleBody("frame", mass=0.1, inertia=4e-4, position=-0.02),
        vehicles.VehicleBody("trailer", mass=0.4, inertia=2e-3, position=-0.25),
    ],
    springs=[vehicles.VehicleSpring("tractor", "frame", -0.02, 400.0, 1.0, 3.0, 0.01)],
    hinges=[vehicles.VehicleHinge("frame", "trailer", position=-0.06)],
    axles=[
        vehicles.VehicleAxle("frame", 0.05, **AXLE, **TYRE),
        vehicles.VehicleAxle("frame", -0.05, **AXLE),
        vehicles.VehicleAxle("trailer", -0.3, **AXLE, **TYRE),
    ],
    count=2,
    spacing=0.5,
    speed=2.4,
    **START,
)
SECTION = {"width": 0.04, "height": 0.005}
COIL = {"resistance": 2.0, "inductance": 1e-3, "force_constant": 4.0}


def driving(actuators: int, **changes) -> jb.Prescribed:
    """Commands that go beyond the limits of the actuators here."""
    ones = np.ones((actuators, 1))
    waves = {"amplitudes": 3.0 * ones, "frequencies": [9.0], "phases": 0.4 * ones}
    return jb.Prescribed(0.3 * ones[:, 0], **waves, **changes)


OF_BEAM = {
    "section": rig(
        beam=jb.Beam(
            0.6, **SECTION, youngs_modulus=2.8e10, density=2675.0, rayleigh_damping=[0.8, 2e-4]
        )
    ),
    "everything along the beam": rig(
        beam=jb.Beam(
            0.6,
            11.68,
            0.535,
            0.03,
            shear_stiffness=3e4,
            rotary_inertia=1e-4,
            foundation_stiffness=300.0,
            axial_force=-40.0,
            modes=2,
        )
    ),
    "loss factor": rig(beam=jb.Beam(0.6, 11.68, 0.535, loss_factor=0.02, modes=2)),
    "segments": rig(
        beam=jb.Beam(
            0.6,
            segments=[
                jb.Segment(0.27, [12.0, -2.0], 0.5, None, None, [3e4, 1e3], 1e-4, 300.0, 0.02),
                jb.Segment(None, 9.0, [0.4, 0.1], None, None, 2e4, [1e-4, 1e-5], 200.0, 0.04),
            ],
            hinges=[jb.Hinge(0.2, rotational_stiffness=40.0)],
            modes=2,
        )
    ),
    "segments of sections": rig(
        beam=jb.Beam(
            0.6,
            damping_ratio=[0.03, 0.02],
            youngs_modulus=2.8e10,
            density=2675.0,
            segments=[
                jb.Segment(0.27, width=[0.04, 0.002], height=0.005),
                jb.Segment(width=0.03, height=[0.005, -0.001]),
            ],
            modes=2,
        )
    ),
}
SUPPORTS = rig(
    beam=jb.Beam(0.6, 11.68, 0.535, 0.03, ends="free-clamped", modes=2),
    supports=[
        jb.Support(
            0.1,
            stiffness=6e3,
            damping=5.0,
            rotational_stiffness=1.0,
            mass=0.05,
            settlement=1e-4,
        )
    ],
)
ABSORBERS = rig(
    absorbers=[
        jb.Absorber(0.2, mass=0.02, stiffness=90.0, damping=0.1, inertance=0.01),
        jb.Absorber(
            0.35,
            mass=0.03,
            frequency=9.0,
            damping_ratio=0.1,
            ground_inertance=0.01,
            max_stroke=1.0,
        ),
    ]
)
DERIVED = {
    "d33": 4.6e-10,
    "modulus": 30.3e9,
    "electrode_spacing": 5e-4,
    "beam_height": 5e-3,
    "patch_height": 3e-4,
    "patch_width": 0.03,
}
ACTUATORS = {
    "passive": rig(actuators=[jb.SpringDamper(0.3, stiffness=400.0, damping=2.0)]),
    "coils": rig(
        [LOADS["axles"]],
        actuators=[
            jb.Electrodynamic(
                0.2,
                **COIL,
                back_emf=3.0,
                mass=0.02,
                stiffness=200.0,
                damping=1.0,
                limits=(-1.0, 2.0),
            ),
            jb.Electrodynamic(
                0.35, **COIL, inner_loop=jb.actuators.CurrentLoop(900.0, limits=(-0.2, 0.3))
            ),
        ],
        controller=driving(2, period=0.0113),
    ),
    "limits within loops of the current": rig(
        [LOADS["axles"]],
        actuators=[
            jb.Electrodynamic(
                0.35, **COIL, limits=(-0.2, 0.3), inner_loop=jb.actuators.CurrentLoop(900.0)
            ),
        ],
        controller=driving(1, period=0.0113),
    ),
    "gains of loops of the current": rig(
        [LOADS["axles"]],
        actuators=[
            jb.Electrodynamic(0.4, **COIL, inner_loop=jb.actuators.CurrentLoop(None, 2.0, 900.0))
        ],
        controller=driving(1, period=0.0113),
    ),
    "loops of the force": rig(
        [LOADS["axles"]],
        actuators=[
            jb.Electrodynamic(
                0.45,
                **COIL,
                inner_loop=jb.actuators.ForceLoop(400.0, sensor_bandwidth=3e3, limits=(-0.5, 1.0)),
            ),
            jb.Electrodynamic(0.5, **COIL, inner_loop=jb.actuators.ForceLoop(None, 0.4, 300.0)),
        ],
        controller=driving(2, period=0.0113),
    ),
    "force and volts": rig(
        actuators=[
            jb.PointForce(0.2, limits=(-1.0, 2.0)),
            jb.Shaker(0.4, 200.0, 2.0, bandwidth=900.0, limits=(-1.0, 2.0)),
        ],
        controller=driving(2, period=0.0113),
    ),
    "patches": rig(
        actuators=[
            jb.Patch(
                0.1,
                0.2,
                **DERIVED,
                correction=0.8,
                added_mass=0.05,
                added_rigidity=2.0,
                amplifier_gain=200.0,
                rate_limit=60.0,
            ),
            jb.Patch(0.3, 0.35, 8e-4, limits=(-1.0, 2.0)),
            jb.Patch(0.4, 0.5, 8e-4, amplifier_gain=900.0),  # its voltages are limited
        ],
        controller=driving(3, period=0.0113, delay=0.003),
    ),
    "hysteresis and creep": CONTROLLED["compensation"],
}
SENSORS = rig(
    sensors=[
        jb.Sensor(0.25, offset=1e-4, noise=1e-5, delay=0.0012, filter=jb.Filter(40.0, 3)),
        jb.Sensor(0.4, "strain", 2e-6, fibre_distance=0.0025, sampling_period=0.0153),
        jb.Sensor(0.35, "stress", section_modulus=2e-7, range=(-1e5, 4e5)),
        jb.Sensor(0.2, "acceleration", filter=jb.Filter(60.0, realisation="analogue")),
    ]
)
JUMPS_OF_ALL = rig(
    actuators=[jb.PointForce(0.3)],
    sensors=[jb.Sensor(0.25, resolution=1e-5, dropout=0.1, jitter=1e-3)],
    loads=[LOADS["quarter-car"]],
    vehicle_sensors=[vehicles.VehicleSensor(dropout=0.1, jitter=1e-3)],
    controller=jb.Feedback(
        [2e3], period=0.0052, delay=1e-3, resolution=0.01, dropout=0.1, jitter=1e-3
    ),
)
SPREAD = [jb.MovingForce(force=3.0, speed=2.4)]
OF_TRACKS = {
    "sleepers": rig(SPREAD, track=jb.Track(spread="3 sleepers", sleeper_spacing=0.03)),
    "even": rig(SPREAD, track=jb.Track(spread_length=0.07)),
    "layered": rig(
        [changed("oscillator", entry_time=0.0231)],
        beam=jb.Beam(0.6, 11.68, 0.535, 0.03, modes=10),
        track=jb.Track(**RIG),
    ),
    "uneven": rig(
        SPREAD, track=jb.Track(spread_offsets=[-0.03, 0.01, 0.05], spread_shares=[0.5, 1.0, 0.7])
    ),
}
OF_LOADS = {
    "forces": rig(
        [
            jb.MovingForce(force=3.0, speed=2.4, deceleration=0.5, **START),
            jb.MovingForce(mass=0.2, **TABLE),
            changed("axles", **TABLE),
            jb.LineLoad(
                force_per_length=[5.0, 2.0],
                lengths=[0.2, 0.1],
                gaps=[0.01, 0.1],
                points=8,
                position=0.4,
                **STANDING,
            ),
        ]
    ),
    "forces that vary": rig(
        [
            changed("varying-force", **START),
            jb.VaryingForce(
                force=2.0, force_times=[0.01, 0.1, 0.25], forces=[0.5, 2.0, -1.0], position=0.2
            ),
            changed("pedestrian", **START),
            changed(
                "pedestrian", **STANDING, step_time=None, position=0.4, factors=[0.3], phases=[0.4]
            ),
            changed("crowd", activity="jogging", contact_time=0.3, pace_deviation=0.1),
        ]
    ),
    "masses and vehicles": rig(
        [
            jb.MovingMass(mass=0.3, **TABLE),
            changed("mass", deceleration=0.5, **START),
            jb.Axles(offsets=[0.0, 0.2], masses=[0.1, 0.2], speed=2.4),
            changed("oscillator", entry_time=0.02),
            changed("quarter-car", tyre_damping=0.1, entry_time=0.02),
            changed("half-car", **START),
        ],
        vehicle_sensors=[
            vehicles.VehicleSensor(
                load=5,
                position=0.05,
                offset=1e-3,
                noise=1e-2,
                filter=jb.Filter(20.0),
                sampling_period=0.0153,
                delay=0.0012,
            )
        ],
    ),
    "articulated vehicles": rig([ARTICULATED]),
    "wagons": rig([changed("wagon", count=2, spacing=0.35, entry_time=0.02)]),
    "train": rig(
        [
            changed("train", speed=40.0, **START),
            jb.LineLoad("LM71", tail=10.0, points=8, speed=40.0, **START),
        ],
        beam=jb.Beam(20.0, 1e10, 12e3, 0.02, modes=2),
        sensors=[jb.Sensor(10.0)],
    ),
}
PROFILE_CHANGES = {
    "rail": {"shortest_wavelength": 0.2, "longest_wavelength": 3.0, "switch_on": [-0.5, 0.3]},
    "iso8608": {"switch_on": [-0.5, 0.3]},
    "spectrum": {"switch_on": [-0.5, 0.3]},
}
OF_PROFILES = {
    kind: rig(
        [changed("oscillator", **START)],
        profile=dataclasses.replace(
            profile, contact_length=np.float64(0.05), **PROFILE_CHANGES.get(kind, {})
        ),
    )
    for kind, profile in PROFILES.items()
}

LATER = 0.0031  # s
DESIGN = DesignModel(
    force_per_volt=4.0, stiffness=1500.0, damping=4.0, mass=0.3, speed=2.9, entry_time=0.0231
)


def law(name: str, later: float = 0.0, **changes) -> jb.Case:
    """An example of a controller with other numbers of the law, and readings that do not jump.

    Loads may enter `later` (s), at no time at which something is sampled.
    """
    case = CONTROLLED[name]
    loads = (dataclasses.replace(one, entry_time=one.entry_time + later) for one in case.loads)
    return dataclasses.replace(
        case,
        loads=tuple(loads),
        run=dataclasses.replace(case.run, sample_rate=np.float64(217.3)),
        sensors=tuple(dataclasses.replace(one, resolution=None) for one in case.sensors),
        controller=dataclasses.replace(case.controller, resolution=None, **changes),
    )


def array(*numbers: float) -> np.ndarray:
    return np.array(numbers)


CONTINUOUS = jb.Kalman(
    0.02, loads="estimated", weight_deviation=1.0, measurement_intensity=1e-8, points=60
)
WEIGHTS = {"state_weight": [1e4, 1e2, 1.0, 0.1, 0.0], "command_weight": [1e-2, 1e-1]}
OF_CONTROLLERS = {
    name: law(name)
    for name in (
        "feedback",
        "pd",
        "lead",
        "ppf",
        "ppf-two-modes",
        "internal-model",
        "internal-model-scheduled",
        "feedback-stepped",
        "semi-active",
        "sliding-mode",
        "state",
        "mpc",
        "gpc",
    )
} | {
    "lqr-step": law("lqr-step", LATER),
    # Nothing that moves with a period is at one time with what does not.
    "output-feedback": dataclasses.replace(
        law("output-feedback", LATER, delay=np.float64(0.9 * PERIOD)),
        sensors=[
            dataclasses.replace(sensor, sampling_period=2.137 * PERIOD if i == 1 else None)
            for i, sensor in enumerate(LATE)
        ],
    ),
    "lqr-inversion": law("lqr-inversion", delay=np.float64(1.9 * PERIOD)),
    "lqr-scheduled": law("lqr-scheduled", LATER, speeds=array(2.03, 3.07)),
    "lqr-integral": law("lqr-integral", LATER, state_weight=array(1e4, 1e2, 1.0, 0.1, 0.01)),
    "lqr-augmented": law(
        "lqr-augmented",
        LATER,
        estimator=jb.MovingHorizon(0.02, 1e-5, weight_deviation=1.0, window=2),
    ),
    "lqr-observer": law(
        "lqr-observer",
        design=DesignModel(force_per_volt=4.0, stiffness=1500.0, damping=4.0),
        feedback=array(1.0, 0.9, 0.8, 0.7, 0.6),
    ),
    "poles": law("lqr-observer", estimator=jb.Observer([[-30.0, 200.0], [-60.0, 800.0]])),
    "dlqr-kalman": law(
        "dlqr-kalman",
        LATER,
        positions=array(0.2, 0.45),
        position_weight=array(1e5, 2e5),
        input_rate_weight=array(1e-6, 1e-5),
    ),
    "h-infinity": law(
        "h-infinity",
        LATER,
        positions=array(0.15, 0.3, 0.4),
        corner=np.float64(40.0),
        attenuation=np.float64(190.0),
    ),
    "prescribed": law("prescribed", times=array(0.0513, 0.1037, 0.2871)),
    "feedforward-confirmed": law("feedforward-confirmed", gate_errors=array(0.0113, -0.0097)),
    "feedback-scheduled": law(
        "feedback-scheduled",
        load_identification=LoadIdentification(
            [-0.05, 0.05], until=0.312, gate_errors=[0.0113, -0.0097]
        ),
    ),
    "kalman-extended": dataclasses.replace(
        law(
            "kalman-extended",
            LATER,
            estimator=jb.ExtendedKalman(
                0.02,
                1e-5,
                mass_deviation=0.1,
                speed_deviation=0.2,
                position_deviation=0.01,
                acceleration_noise=0.1,
            ),
        ),
        run=jb.Run(0.0913, sample_rate=217.3),
    ),
    **{
        name: law(
            "moving-horizon",
            later,
            estimator=jb.MovingHorizon(
                0.02,
                1e-5,
                weight_deviation=1.0,
                min_weight=low,
                max_weight=high,
                window=2,
                deflection_limit=3e-4,
            ),
        )
        for name, later, low, high in (
            ("moving-horizon", 0.0, 0.5, 3.6),
            ("moving-horizon of a heavy load", LATER, 4.5, 9.0),
        )
    },
    "design with a patch": law("compensation-kalman", design=DesignModel(correction=0.8)),
    "gpc-adaptive": law(
        "gpc-adaptive",
        LATER,
        until=np.float64(0.1213),
        output_weight=array(2.0),
        reference=array(1e-4),
    ),
    "mpc-soft": law(
        "mpc-soft",
        LATER,
        output_weight=array(1.0, 2.0),
        horizon_weight=array(1.0, 1.1, 1.2, 1.3, 1.4, 1.5),
        positions=array(0.2, 0.4),
    ),
    # So slow that predictions reach the limit, and the end of the horizon leaves the terminal set.
    "mpc-dual-mode": law(
        "mpc-dual-mode", LATER, move_weight=np.float64(1e-8), hard_limit=np.float64(5.7e-5)
    ),
    "mpc-scenario": law(
        "mpc-scenario",
        LATER,
        delays=array(0.0, 2e-3),
        loads="known",
        move_weight=array(1e-7, 1e-7),
    ),
    "lqr-finite": law(
        "lqr-finite",
        LATER,
        design=DESIGN,
        entries="predicted",
        terminal_weight=array(1e3, 1e2, 1.0, 0.1, 0.01),
    ),
    "lqr-position": law("lqr-position", LATER, masses=array(0.3, 0.5), speeds=array(2.03, 3.07)),
    # A filter that knows the loads exactly has nothing to correct.
    "kalman": rig(
        [dataclasses.replace(MASS, entry_time=np.float64(0.0231))],
        actuators=CONTROLLED["kalman-known"].actuators,
        controller=jb.LQR(
            **WEIGHTS, estimator=CONTINUOUS, design=DesignModel(mass=0.3, entry_time=0.0231)
        ),
    ),
}
JUMPING = {
    f"{part} jump": (JUMPS_OF_ALL, f"{part}.")
    for part in ("sensors", "vehicle_sensors", "controller")
}
BOX = dict(torsional_rigidity=4.0, polar_inertia=2e-4)
EDGE = jb.Sensor(0.25, eccentricity=0.03)
TWISTING = [jb.Sensor(0.25, "twist"), jb.Sensor(0.35, "torque"), EDGE]
TORSION = {
    "eccentric loads": rig(
        [
            changed("mass", eccentricity=0.02),
            jb.MovingForce(force=3.0, speed=2.4, eccentricity=-0.01),
            changed("axles", eccentricity=0.015),
        ],
        beam=jb.Beam(0.6, 11.68, 0.535, 0.03, **BOX, modes=4),
        sensors=TWISTING,
    ),
    "an eccentric beam on springs": rig(
        [jb.MovingForce(force=3.0, speed=2.4, eccentricity=-0.01)],
        beam=jb.Beam(0.6, 11.68, 0.535, 0.03, **BOX, mass_eccentricity=5e-3, modes=4),
        supports=[jb.Support(0.31, stiffness=500.0, torsional_stiffness=20.0)],
        sensors=TWISTING,
    ),
}
CASES: dict[str, tuple[jb.Case, str | tuple[str, ...]]] = {
    **{
        name: (case, ("beam.", "supports.", "loads.", "sensors.")) for name, case in TORSION.items()
    },
    **{name: (case, "beam.") for name, case in OF_BEAM.items()},
    "supports": (SUPPORTS, "supports."),
    "absorbers": (ABSORBERS, "absorbers."),
    **{name: (case, "actuators.") for name, case in ACTUATORS.items()},
    "sensors": (SENSORS, "sensors."),
    **{name: (case, ("loads.", "vehicle_sensors.")) for name, case in OF_LOADS.items()},
    **{f"{name} track": (case, "track.") for name, case in OF_TRACKS.items()},
    **{f"{name} profile": (case, "profile.") for name, case in OF_PROFILES.items()},
    "run": (rig(controller=None), "run."),
    **{name: (case, "controller.") for name, case in OF_CONTROLLERS.items()},
    **JUMPING,
}
