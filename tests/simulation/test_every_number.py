"""The derivative by every declared number of every kind equals differences, or is refused.

The classes of a case and of its parts are walked: each number that they declare is one of a case
here, where it is not zero and changes the run. A number without such a case fails a test, so that
a new kind, or a new number of one, needs a case.
"""

import dataclasses
import inspect

import jax
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam import planar
from jaxbeam.case.case import leaves_by_address
from jaxbeam.case.kinds import PACKAGES, import_modules
from jaxbeam.case.loads.planar.vehicle import PlanarVehicle
from jaxbeam.control.design_model import DesignModel
from jaxbeam.control.load_identification import LoadIdentification
from jaxbeam.runtime.arrays import xp
from jaxbeam.runtime.module import Module
from tests.strategies.examples import CONTROLLED, LOADS, PROFILES

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # of lost contact, of sizes

# Numbers with which a run jumps, by name, and the sentence that refuses their derivatives.
DECIDES = "decides at samples, so that commands jump with it and it has no derivative"
JUMPS = {
    "resolution": "jumps with it, so that it has no derivative",
    "dropout": "is drawn by a seed and jumps with the dropout",
    "jitter": "is drawn by a seed and jumps with the jitter",
    "until": DECIDES,
    "threshold": DECIDES,
    "confirmation": DECIDES,
    "stepped masses": DECIDES,
}
STEP, TOLERANCE = 4e-6, 1e-4  # of numbers; of the largest derivative of an output
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
ARTICULATED = jb.VehicleLoad(
    bodies=[
        planar.VehicleBody("tractor", mass=0.3, inertia=1e-3, position=0.02),
        planar.VehicleBody("frame", mass=0.1, inertia=4e-4, position=-0.02),
        planar.VehicleBody("trailer", mass=0.4, inertia=2e-3, position=-0.25),
    ],
    springs=[planar.VehicleSpring("tractor", "frame", -0.02, 400.0, 1.0, 3.0, 0.01)],
    hinges=[planar.VehicleHinge("frame", "trailer", position=-0.06)],
    axles=[
        planar.VehicleAxle("frame", 0.05, **AXLE, **TYRE),
        planar.VehicleAxle("frame", -0.05, **AXLE),
        planar.VehicleAxle("trailer", -0.3, **AXLE, **TYRE),
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
            jb.Electrodynamic(0.35, **COIL, inner_loop=jb.CurrentLoop(900.0, limits=(-0.2, 0.3))),
        ],
        controller=driving(2, period=0.0113),
    ),
    "gains of loops of the current": rig(
        [LOADS["axles"]],
        actuators=[jb.Electrodynamic(0.4, **COIL, inner_loop=jb.CurrentLoop(None, 2.0, 900.0))],
        controller=driving(1, period=0.0113),
    ),
    "loops of the force": rig(
        [LOADS["axles"]],
        actuators=[
            jb.Electrodynamic(
                0.45,
                **COIL,
                inner_loop=jb.ForceLoop(400.0, sensor_bandwidth=3e3, limits=(-0.5, 1.0)),
            ),
            jb.Electrodynamic(0.5, **COIL, inner_loop=jb.ForceLoop(None, 0.4, 300.0)),
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
    vehicle_sensors=[planar.VehicleSensor(dropout=0.1, jitter=1e-3)],
    controller=jb.Feedback(
        [2e3], period=0.0052, delay=1e-3, resolution=0.01, dropout=0.1, jitter=1e-3
    ),
)
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
            planar.VehicleSensor(
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
    "planar vehicles": rig([ARTICULATED, changed("wagon", count=2, spacing=0.6, entry_time=0.02)]),
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

DESIGN = DesignModel(
    force_per_volt=4.0, stiffness=1500.0, damping=4.0, mass=0.3, speed=2.0, entry_time=0.03
)


def law(name: str, **changes) -> jb.Case:
    """An example of a controller with other numbers of the law, and readings that do not jump."""
    case = CONTROLLED[name]
    return dataclasses.replace(
        case,
        run=dataclasses.replace(case.run, sample_rate=np.float64(217.3)),
        sensors=tuple(dataclasses.replace(one, resolution=None) for one in case.sensors),
        controller=dataclasses.replace(case.controller, resolution=None, **changes),
    )


def array(*numbers: float) -> np.ndarray:
    return np.array(numbers)


CONTINUOUS = jb.Kalman(
    0.02, loads="estimated", weight_deviation=1.0, measurement_intensity=1e-12, points=60
)
WEIGHTS = {"state_weight": [1e4, 1e2, 1.0, 0.1, 0.0], "command_weight": [1e-2, 1e-1]}
OF_CONTROLLERS = {
    name: law(name)
    for name in (
        "feedback",
        "output-feedback",
        "pd",
        "lead",
        "ppf",
        "internal-model",
        "internal-model-scheduled",
        "feedback-stepped",
        "sliding-mode",
        "state",
        "lqr-inversion",
        "mpc",
        "gpc",
        "mpc-dual-mode",
        "lqr-scheduled",
        "lqr-step",
        "lqr-augmented",
        "lqr-integral",
    )
} | {
    "lqr-observer": law("lqr-observer", design=DESIGN, feedback=array(1.0, 0.9, 0.8, 0.7, 0.6)),
    "poles": law("lqr-observer", estimator=jb.Observer([[-30.0, 200.0], [-60.0, 800.0]])),
    "dlqr-kalman": law(
        "dlqr-kalman",
        positions=array(0.2, 0.45),
        position_weight=array(1e5, 2e5),
        input_rate_weight=array(1e-6, 1e-5),
    ),
    "h-infinity": law(
        "h-infinity",
        positions=array(0.15, 0.3, 0.4),
        corner=np.float64(40.0),
        attenuation=np.float64(9.0),
    ),
    "prescribed": law("prescribed", times=array(0.0513, 0.1037, 0.2871)),
    "feedforward-confirmed": law("feedforward-confirmed", gate_errors=array(0.0113, -0.0097)),
    "feedback-scheduled": law(
        "feedback-scheduled",
        load_identification=LoadIdentification(
            [-0.05, 0.05], until=0.312, gate_errors=[0.0113, -0.0097]
        ),
    ),
    "kalman-extended": law(
        "kalman-extended",
        estimator=jb.ExtendedKalman(
            0.02,
            1e-5,
            mass_deviation=0.1,
            speed_deviation=0.2,
            position_deviation=0.01,
            acceleration_noise=0.1,
        ),
    ),
    "moving-horizon": law(
        "moving-horizon",
        estimator=jb.MovingHorizon(
            0.02,
            1e-5,
            weight_deviation=1.0,
            min_weight=0.5,
            max_weight=3.6,
            window=2,
            deflection_limit=3e-4,
        ),
    ),
    "design with a patch": law("compensation-kalman", design=DesignModel(correction=0.8)),
    "gpc-adaptive": law(
        "gpc-adaptive", until=np.float64(0.1213), output_weight=array(2.0), reference=array(1e-4)
    ),
    "mpc-soft": law(
        "mpc-soft",
        output_weight=array(1.0, 2.0),
        horizon_weight=array(1.0, 1.1, 1.2, 1.3, 1.4, 1.5),
        positions=array(0.2, 0.4),
    ),
    "mpc-scenario": law("mpc-scenario", delays=array(0.0, 2e-3)),
    "lqr-finite": law("lqr-finite", terminal_weight=array(1e3, 1e2, 1.0, 0.1, 0.0)),
    "lqr-position": law("lqr-position", masses=array(0.3, 0.5), speeds=array(2.0, 3.0)),
    "kalman": rig(
        [MASS],
        actuators=CONTROLLED["kalman-known"].actuators,
        controller=jb.LQR(**WEIGHTS, estimator=CONTINUOUS),
    ),
}
JUMPING = {
    f"{part} jump": (JUMPS_OF_ALL, f"{part}.")
    for part in ("sensors", "vehicle_sensors", "controller")
}
CASES: dict[str, tuple[jb.Case, str | tuple[str, ...]]] = {
    **{name: (case, "beam.") for name, case in OF_BEAM.items()},
    "supports": (SUPPORTS, "supports."),
    "absorbers": (ABSORBERS, "absorbers."),
    **{name: (case, "actuators.") for name, case in ACTUATORS.items()},
    "sensors": (SENSORS, "sensors."),
    **{name: (case, ("loads.", "vehicle_sensors.")) for name, case in OF_LOADS.items()},
    **{f"{name} profile": (case, "profile.") for name, case in OF_PROFILES.items()},
    "run": (rig(controller=None), "run."),
    **{name: (case, "controller.") for name, case in OF_CONTROLLERS.items()},
    **JUMPING,
}
# Numbers that do not matter in these cases, or never.
WITHOUT_EFFECT = {
    "absorbers": {"absorbers.1.max_stroke"},
    "forces": {"loads.3.tail"},
    "hysteresis and creep": {"actuators.0.depolarisation"},
    "run": {"run.duration"},
}
NEVER_OF_EFFECT = {
    ("SpringDamper", "limits"),  # it takes no commands
    ("Absorber", "max_stroke"),  # a run beyond it is warned of
    ("Run", "duration"),  # on peaks before the end; see `test_moving_events`
}
# Cases whose derivatives are still to be compared.
OPEN = {
    "coils",
    "gains of loops of the current",
    "loops of the force",
    "patches",
    "masses and vehicles",
    "planar vehicles",
    "train",
    *(f"{kind} profile" for kind in OF_PROFILES if kind not in ("rail", "sine")),
    *(OF_CONTROLLERS.keys() - {"internal-model", "feedback-scheduled", "lead", "ppf", "feedback"}),
}


def outputs(case: jb.Case):
    """Peaks, deflections, readings and commands of a run."""
    record = jb.simulate(case, tolerance=1e-9)
    end = record.times.size - 1
    parts = [record.peak_deflection]
    for share in (0.3, 0.62, 0.9):
        i = int(share * end)
        parts += [record.deflection[i], record.sensor_values[i], record.measured[i]]
        parts += [] if record.command is None else [record.command[i]]
    parts += [record.vehicle_readings[int(0.62 * end)]] if case.vehicle_sensors else []
    return xp.concatenate([xp.reshape(part, -1) for part in parts])


def numbers(case: jb.Case, of) -> list[str]:
    """Addresses of numbers that are not zero, each list as one, of parts of a case."""
    found = leaves_by_address(case).items()
    return [address for address, value in found if address.startswith(of) and np.any(value)]


def jumps(case: jb.Case, address: str) -> str:
    """The sentence that refuses the derivative by a number; "" if there is none."""
    stepped = getattr(case.controller, "between", "") == "stepped"
    part, name = address.partition(".")[0], address.rpartition(".")[2]
    if part == "vehicle_sensors" and name == "jitter":
        return ""  # no law waits for these readings, which are taken from a smooth history
    return JUMPS.get(f"stepped {name}" if stepped and name == "masses" else name, "")


def moved(case: jb.Case, addresses, shares) -> jb.Case:
    """The case with numbers increased by shares of themselves, other ones for each entry."""
    leaves, structure = jax.tree.flatten(case)
    index = {address: i for i, address in enumerate(leaves_by_address(case))}
    for address, share in zip(addresses, shares, strict=True):
        value = leaves[index[address]]
        entries = 1 + 0.3 * np.cos(1.0 + np.arange(np.size(value)))
        leaves[index[address]] = value * (1 + share * entries.reshape(np.shape(value)))
    return jax.tree.unflatten(structure, leaves)


COMPARED = [name for name in CASES if name not in OPEN | JUMPING.keys()]


@pytest.mark.parametrize("name", [*COMPARED, "vehicle_sensors jump"])
def test_derivatives_equal_differences(name):
    case, of = CASES[name]
    smooth = [address for address in numbers(case, of) if not jumps(case, address)]

    def function(shares):
        return outputs(moved(case, smooth, shares))

    found = np.asarray(jax.jacfwd(function)(np.zeros(len(smooth))))
    rows = STEP * np.eye(len(smooth))
    expected = np.stack([(function(row) - function(-row)) / (2 * STEP) for row in rows], -1)
    sizes = np.maximum(np.abs(function(np.zeros(len(smooth)))), 1e-12)
    without_effect = set()
    for i, address in enumerate(smooth):
        ours, differences = found[:, i] / sizes, expected[:, i] / sizes
        largest = np.abs(differences).max()
        # The absolute part is the tolerance of the run over the step.
        bound = TOLERANCE * np.abs(differences) + 1e-6 * (1 + largest)
        assert np.all(np.abs(ours - differences) <= bound), address
        if largest < 1e-7:
            without_effect.add(address)
    assert without_effect == WITHOUT_EFFECT.get(name, set())


JUMPING_NUMBERS = [
    (name, address)
    for name, (case, of) in CASES.items()
    for address in numbers(case, of)
    if jumps(case, address)
]


@pytest.mark.parametrize(("name", "address"), JUMPING_NUMBERS)
def test_derivatives_of_jumps_are_refused(name, address):
    case, _ = CASES[name]
    with pytest.raises(ValueError, match=jumps(case, address)):
        jax.jvp(lambda share: outputs(moved(case, [address], [share])), (0.0,), (1.0,))


def subclasses(part_class: type) -> set[type]:
    direct = part_class.__subclasses__()
    return set(direct).union(*map(subclasses, direct))


def declaring(part_class: type, name: str) -> tuple[str, str]:
    """The first class that declares a number, and its name: what is inherited needs one case."""
    owners = [
        one
        for one in part_class.__mro__
        if "unit" in getattr(vars(one).get("__dataclass_fields__", {}).get(name), "metadata", {})
    ]
    return owners[-1].__name__, name


def declared_numbers() -> set[tuple[str, str]]:
    """All numbers that classes of jaxbeam declare, but those that vehicle files alone have."""
    for package in PACKAGES:
        import_modules(package)
    return {
        declaring(part_class, field.name)
        for part_class in subclasses(Module) - {PlanarVehicle}
        if part_class.__module__.startswith("jaxbeam.")
        and not inspect.isabstract(part_class)
        and dataclasses.is_dataclass(part_class)
        for field in dataclasses.fields(part_class)
        if "unit" in field.metadata
    }


def owner(case: jb.Case, address: str):
    """The part of a case that has the number at an address."""
    part = case
    for key in address.split(".")[:-1]:
        part = part[int(key)] if isinstance(part, tuple) else getattr(part, key)
    return part


def test_every_declared_number_has_a_case():
    covered = {
        declaring(type(owner(case, address)), address.rpartition(".")[2])
        for name, (case, of) in CASES.items()
        for address in numbers(case, of)
        if address not in WITHOUT_EFFECT.get(name, ())
    }
    assert declared_numbers() - covered == NEVER_OF_EFFECT
