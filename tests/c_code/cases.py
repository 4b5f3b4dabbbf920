"""Small cases, one for each kind of controller and estimator, whose C code is tested."""

import numpy as np

import jaxbeam as jb
from jaxbeam.case.case import Run
from jaxbeam.control.feedback import Feedback, OutputFeedback, ScheduledFeedback
from jaxbeam.control.feedforward import Prescribed
from jaxbeam.control.load_identification import LoadIdentification
from jaxbeam.control.optimal.lqr import LQR
from tests.c_code.given_laws import PERIOD, FollowedPositions, GivenTables, VaryingMPC


def rig(controller, **changes):
    """Beam with two shakers, three sensors and a mass that crosses in 0.25 s."""
    parts = {
        "beam": jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
        "actuators": [jb.Shaker(0.2, 2000.0, 5.0, limits=(-4.0, 4.0)), jb.PointForce(0.45)],
        "sensors": [jb.Sensor(0.2), jb.Sensor(0.4), jb.Sensor(0.3, "velocity")],
        "loads": [jb.MovingMass(mass=0.4, speed=2.4, entry_time=0.02)],
        "run": Run(duration=0.3),
    }
    return jb.Case(controller=controller, **(parts | changes))


FILTERED = [jb.Sensor(0.2, filter=jb.Filter(40.0, 3), offset=1e-4), jb.Sensor(0.4, resolution=1e-5)]
LATE = [
    jb.Sensor(0.2, filter=jb.Filter(40.0), delay=7e-3, noise=1e-6),
    jb.Sensor(0.4, filter=jb.Filter(20.0), sampling_period=2 * PERIOD),
    jb.Sensor(0.3, "velocity", filter=jb.Filter(30.0, realisation="analogue")),
]
WEIGHTS = {
    "state_weight": [1e4, 1e2, 1.0, 0.1, 0.0],
    "command_weight": [1e-4, 1e-3],
    "period": PERIOD,
}
WEAK = WEIGHTS | {"command_weight": [1e-2, 1e-1]}
OPERATORS = {
    "hysteresis": jb.actuators.Hysteresis([0.0, 0.2, 0.5], [0.7, 0.2, 0.2]),
    "compensation": jb.actuators.Hysteresis([0.0, 0.3], [0.75, 0.3]),
    "creep": jb.actuators.Creep([9.0], [0.1]),
    "creep_compensation": jb.actuators.Creep([10.0, 1.0], [0.06, 0.05]),
}
KALMAN = jb.Kalman(0.02, 1e-5)
TWO_LOADS = [
    jb.MovingMass(mass=0.4, speed=2.4, entry_time=0.02),
    jb.MovingMass(mass=0.2, speed=3.0, entry_time=0.1),
]
ESTIMATED = jb.Kalman(0.02, 1e-5, loads="estimated", weight_deviation=1.0)
SHORT = {"loads": [jb.MovingMass(mass=0.4, speed=15.0)], "run": Run(duration=0.06)}
LEAD_LAG = 1 / (2 * np.pi * np.array([20.0, 30.0]))  # s, of poles at 20 and 30 Hz
CASES = {
    "feedback": rig(Feedback([2e3, 1e3], higher_gains=[[1e8, 2e8]], period=PERIOD)),
    "spring": rig(
        Feedback([2e3], period=PERIOD),
        actuators=[jb.SpringDamper(0.3, stiffness=100.0), jb.PointForce(0.45, limits=(-1.0, 1.0))],
    ),
    "spring-lqr": rig(
        jb.LQR([1e4, 1e2, 1.0, 0.1], [1e-4], period=PERIOD),
        actuators=[jb.SpringDamper(0.3, stiffness=100.0), jb.PointForce(0.45, limits=(-1.0, 1.0))],
    ),
    "feedback-cubic": rig(Feedback([5e8, 1e8], power=3, period=PERIOD), sensors=FILTERED),
    "output-feedback": rig(
        OutputFeedback([[2e3, 0.0, 5.0], [0.0, -1e3, 1.0]], period=PERIOD, delay=PERIOD),
        sensors=LATE,
    ),
    "pd": rig(jb.PD([2e3, 1e3], rate_gains=[10.0, 5.0], lag=1e-2, period=PERIOD)),
    "lead": rig(
        jb.PD(
            [2e3, 1e3],
            rate_gains=np.array([2e3, 1e3]) * (1 / (10 * np.pi) - LEAD_LAG),
            lag=LEAD_LAG,
            period=PERIOD,
        )
    ),
    "ppf": rig(
        jb.PositivePositionFeedback([1e3, 1e3], 8.0, damping_ratio=0.3, period=PERIOD, delay=1e-3)
    ),
    "prescribed": rig(
        Prescribed(
            [0.1, 0.2],
            amplitudes=[[1.0, 2.0], [0.5, 0.0]],
            frequencies=[3.0, 11.0],
            phases=[[0.0, 1.0], [2.0, 0.0]],
            times=[0.05, 0.1, 0.3],
            values=[[0.0, 1.0, -1.0], [2.0, 0.0, 1.0]],
            period=PERIOD,
        )
    ),
    "feedforward": rig(
        jb.Feedforward(
            [-0.05, 0.05],
            shares=[0.0, 0.3, 1.0],
            values=[[0.0, 5.0, 0.0], [1.0, 2.0, 3.0]],
            lead=2e-3,
            period=PERIOD,
            resolution=1e-2,
        ),
        loads=TWO_LOADS,
    ),
    "feedforward-confirmed": rig(
        jb.Feedforward(
            [-0.05, 0.05],
            shares=[0.0, 0.3, 1.0],
            values=[[0.0, 5.0, 0.0], [1.0, 2.0, 3.0]],
            lead=2e-3,
            confirmation=5e-5,
            period=PERIOD,
        ),
        loads=TWO_LOADS,
    ),
    "internal-model": rig(
        jb.InternalModel(
            [-1e-3, 0.0, 1e-3],
            values=[[4.0, 0.0, -4.0], [3.0, 0.0, -3.0]],
            notches=[30.0, 60.0],
            period=PERIOD,
        ),
        sensors=FILTERED,
    ),
    "internal-model-scheduled": rig(
        jb.ScheduledInternalModel(period=PERIOD, delay=1.5 * PERIOD),
        actuators=[jb.Patch(0.1, 0.3, 0.15, limits=[-0.5, 4.0]), jb.PointForce(0.45, [-4.0, 1.0])],
        sensors=[
            jb.Sensor(0.2, filter=jb.Filter(20.0, 5), delay=7e-3),
            jb.Sensor(0.4, offset=1e-4),
        ],
    ),
    "feedback-scheduled": rig(
        ScheduledFeedback(
            [0.2, 0.5],
            [[1e3, 2e3], [1e3, 3e3]],
            load_identification=LoadIdentification(gates=[-0.05, 0.05]),
            period=PERIOD,
        )
    ),
    "feedback-stepped": rig(
        ScheduledFeedback(
            [0.2, 0.3, 0.5],
            [[1e8, 2e8, 3e8], [1e8, 3e8, 3e8]],
            power=3,
            between="stepped",
            load_identification=LoadIdentification(threshold=2e-5),
            period=PERIOD,
        )
    ),
    "semi-active": rig(
        jb.SemiActive(
            [0.5, 0.8], 20.0, OutputFeedback([[-6.0, -5.0], [-7.0, -4.0]]), period=PERIOD
        ),
        sensors=[jb.Sensor(0.2, "velocity"), jb.Sensor(0.45, "velocity")],
    ),
    "sliding-mode": rig(
        jb.SlidingMode(
            [30.0, 20.0], 10.0, [0.1, 0.2], positions=[0.25, 0.45], estimator=KALMAN, period=PERIOD
        )
    ),
    "state": rig(jb.StateFeedback(np.full((2, 5), 2.0), period=PERIOD)),
    "lqr-observer": rig(jb.LQR(**WEIGHTS, estimator=jb.Observer(speed=3.0))),
    "dlqr-kalman": rig(
        LQR(**WEIGHTS, delay=2e-3, estimator=KALMAN, sampling="exact"), sensors=FILTERED
    ),
    "lqr-inversion": rig(jb.LQR(**WEIGHTS, estimator=jb.Inversion(1e-2), delay=2 * PERIOD)),
    "mpc": rig(jb.MPC(8, 3, [1e-10, 1e-10], estimator=KALMAN, period=PERIOD, delay=1e-3)),
    "gpc": rig(
        jb.GPC(
            6, 2, 1e-8, output_weight=[1.0, 1.0, 1e-5], reference=[1e-4, 0.0, 0.0], period=PERIOD
        )
    ),
    "compensation": rig(
        Feedback([2000.0, 2000.0], period=PERIOD, delay=1.5 * PERIOD),
        actuators=[
            jb.Patch(0.2, 0.3, 0.15, limits=[-0.5, 1.0], **OPERATORS),
            jb.PointForce(0.45),
        ],
    ),
    "compensation-kalman": rig(
        LQR(
            [1e4, 1e2, 1.0, 0.1],
            [1e-2, 1e-2],
            period=PERIOD,
            delay=2e-3,
            estimator=KALMAN,
            sampling="exact",
        ),
        actuators=[
            jb.Patch(0.2, 0.3, 0.15, compensation=jb.actuators.Hysteresis([0.0, 0.1], [0.8, 0.3])),
            jb.PointForce(0.45),
        ],
    ),
    "h-infinity": rig(jb.HInfinity(2e-4, 2.0, 1.0, [1e-5, 1e-5, 1e-3], period=PERIOD)),
    "gpc-adaptive": rig(
        jb.AdaptiveGPC(
            6,
            2,
            1e-8,
            probe=[0.5, 0.3],
            until=0.12,
            more_delay=1,
            measurement_noise=1e-4,
            period=PERIOD,
        ),
        beam=jb.Beam(0.6, 12.0, 0.5, 0.1, modes=2),
        actuators=[jb.PointForce(0.25, limits=(-4.0, 4.0)), jb.PointForce(0.45)],
        sensors=[jb.Sensor(0.2), jb.Sensor(0.4)],
        loads=[jb.MovingForce(mass=0.3, speed=4.0, entry_time=0.13)],
    ),
    "mpc-soft": rig(
        jb.MPC(
            6,
            2,
            1e-9,
            soft_limit=1e-4,
            terminal="none",
            laguerre_pole=0.4,
            estimator=jb.Inversion(),
            period=PERIOD,
        )
    ),
    "mpc-dual-mode": rig(
        jb.MPC(
            3,
            3,
            1e-9,
            hard_limit=3e-3,
            terminal="dual-mode",
            terminal_periods=6,
            terminal_weight=1.0,
            period=PERIOD,
        )
    ),
    "kalman-known": rig(
        jb.LQR(**WEAK, estimator=jb.Kalman(0.02, 1e-5, loads="known"), delay=2e-3), **SHORT
    ),
    "mpc-scenario-worst": rig(
        jb.ScenarioMPC(
            3,
            2,
            1e-7,
            stiffness_factors=[0.8, 1.2],
            delays=[0.0, 2e-3],
            merit="worst",
            estimator=KALMAN,
            period=PERIOD,
            delay=1e-3,
        )
    ),
    "mpc-scenario-mean": rig(
        jb.ScenarioMPC(
            3,
            2,
            1e-9,
            stiffness_factors=[0.8, 1.2],
            delays=[0.0, 2e-3],
            merit="mean",
            soft_limit=1e-4,
            estimator=KALMAN,
            period=PERIOD,
            delay=1e-3,
        )
    ),
    "kalman-extended": rig(
        jb.LQR(
            **WEAK,
            estimator=jb.ExtendedKalman(
                0.02, 1e-5, mass_deviation=0.1, speed_deviation=0.2, acceleration_noise=0.1
            ),
            delay=2e-3,
        ),
        **SHORT
        | {
            "sensors": [
                jb.Sensor(0.2, offset=1e-4),
                jb.Sensor(0.4, "acceleration", noise=0.05),
                jb.Sensor(0.3, filter=jb.Filter(60.0, realisation="analogue")),
            ],
            "loads": [
                jb.MovingMass(mass=0.4, speed=15.0),
                jb.MovingForce(mass=0.2, speed=12.0, entry_time=0.01),
            ],
        },
    ),
    "moving-horizon": rig(
        jb.LQR(
            **WEAK,
            estimator=jb.MovingHorizon(
                0.02,
                1e-5,
                weight_deviation=1.0,
                max_weight=3.6,
                window=2,
                deflection_limit=3e-4,
            ),
            delay=2e-3,
        ),
        **SHORT,
    ),
    "mpc-unconstrained": rig(jb.MPC(6, 2, 1e-10, solver="unconstrained", period=PERIOD)),
}


GATES = LoadIdentification(gates=[-0.05, 0.05])
CASES["table"] = rig(GivenTables(period=PERIOD))
CASES["family"] = rig(GivenTables(family=True, identification=GATES, period=3 * PERIOD))
BETWEEN_SAMPLES = [  # loads that enter and leave between samples, where rounding decides nothing
    jb.MovingMass(mass=0.4, speed=2.4, entry_time=0.021),
    jb.MovingMass(mass=0.2, speed=2.9, entry_time=0.1),
]
CASES["position"] = rig(GivenTables(family=True, period=3 * PERIOD), loads=BETWEEN_SAMPLES)
CASES["position-followed"] = rig(FollowedPositions(period=3 * PERIOD), loads=BETWEEN_SAMPLES)
CASES["nearest"] = rig(
    GivenTables(family=True, nearest=True, identification=GATES, period=3 * PERIOD)
)
CASES["mpc-varying"] = rig(
    VaryingMPC(
        settings=jb.MPC(3, 2, 1e-10, solver="hildreth", period=PERIOD), period=PERIOD, delay=1e-3
    ),
    run=Run(duration=0.06),
)
CASES["mpc-estimated"] = rig(
    VaryingMPC(settings=jb.MPC(3, 1, 1e-10, estimator=ESTIMATED, period=PERIOD), period=PERIOD),
    **SHORT | {"loads": [jb.MovingMass(mass=0.4, speed=14.5)]},  # leaves between samples
)

# Their designs compile for seconds.
DESIGNED_TABLES = {
    "mpc-vehicle": rig(
        jb.MPC(3, 1, 1e-10, loads="known", estimator=KALMAN, period=PERIOD),
        **SHORT | {"loads": [jb.Oscillator(0.3, 900.0, 2.0, speed=15.0)]},
    ),
    "lqr-finite": rig(
        LQR(**WEAK, points=60, after="fade", fade_time=0.02, estimator=KALMAN, horizon="crossing")
    ),
    "lqr-scheduled": rig(
        LQR(
            **WEIGHTS,
            masses=[0.2, 0.5],
            speeds=[2.0, 3.0],
            points=60,
            augmented="loads",
            load_identification=LoadIdentification(gates=[-0.05, 0.05]),
            estimator=jb.Observer(speed=3.0),
            horizon="crossing",
            schedule="load",
        )
    ),
}
