"""Small cases, one for each kind of controller and estimator, whose C code is tested."""

import dataclasses

import equinox as eqx
import jax
import numpy as np

import jaxbeam as jb
from jaxbeam.case.case import Run
from jaxbeam.case.controller import AbstractController
from jaxbeam.control.crossing_gains import GainSchedule, PositionGainLaw, ScheduledGainLaw
from jaxbeam.control.estimation.sampled_plant import sample_timing
from jaxbeam.control.feedback import Feedback, OutputFeedback, ScheduledFeedback
from jaxbeam.control.feedforward import Prescribed
from jaxbeam.control.load_identification import LoadIdentification
from jaxbeam.control.lqr import LQR
from jaxbeam.control.prediction import Preview, SampledPlant
from jaxbeam.control.state_controller import SampledStateLaw, TrueState
from jaxbeam.numerics.finite_horizon import GainTable

# Laws with random tables, and of plants that vary, whose designs take no compilation.

PERIOD = 5e-3
RANDOM = np.random.default_rng(0)


class GivenTables(AbstractController):
    """Random tables of gains over the crossing, for the true state of the beam."""

    family: bool = eqx.field(static=True, default=False)
    nearest: bool = eqx.field(static=True, default=False)
    identification: LoadIdentification | None = None

    def design_law(self, plant):
        if not self.family:
            return SampledStateLaw(self.random_schedule(), TrueState(np.eye(5)))
        schedules = [self.random_schedule() for _ in range(6)]
        grid = jax.tree.map(lambda *x: np.reshape(np.stack(x), (2, 3, *x[0].shape)), *schedules)
        grids = np.array([0.3, 0.5]), np.array([1.0, 2.0, 3.0])
        if self.identification is None:
            weights = plant.weights
            law = PositionGainLaw(grid, *grids, weights / 9.81, weights, plant.loads)
            return SampledStateLaw(law, TrueState(np.eye(5)))
        numbers = plant.case.beam.length, np.array(2.4)
        source = self.identification.identifier(plant, plant)
        law = ScheduledGainLaw(grid, *grids, *numbers, source, self.nearest, 1)
        return SampledStateLaw(law, TrueState(np.eye(5)))

    def random_schedule(self) -> GainSchedule:
        """Table of five cubics from 0.02 to 0.2 s, then a gain that fades."""
        weights = np.array([2.9, 1.0] if self.family else [])
        columns, inner = 5 + weights.size, np.sort(RANDOM.uniform(size=4))
        coefficients = 20.0 * RANDOM.normal(size=(5, 4, 2, columns))
        table = GainTable(np.concatenate([[0.0], inner, [1.0]]), coefficients)
        final = 20.0 * RANDOM.normal(size=(2, columns))
        times = np.array(0.02), np.array(0.2), np.array(0.03)
        return GainSchedule(table, final, weights, *times, self.family)


class FollowedPositions(GivenTables):
    """Random tables that are read at the positions which an extended Kalman filter follows."""

    def design_law(self, plant):
        # Known numbers: those that are estimated are differences, which multiply rounding.
        estimator = jb.ExtendedKalman(0.02, 1e-4, mass_deviation=0.0, speed_deviation=0.0)
        filter = estimator.sampled_filter(plant, sample_timing(self))
        law = GivenTables(family=True, period=self.period).design_law(plant).law
        gains = lambda x: (x.schedules.table.coefficients, x.schedules.final_gain)  # noqa: E731
        return SampledStateLaw(eqx.tree_at(gains, law, replace_fn=lambda x: 0.02 * x), filter)


class VaryingPlants(Preview):
    """Stands for the preview of a crossing, which takes a compilation: plants that vary in time."""

    sampled: SampledPlant | None = None

    def sampled_plants(self, t, first, count):
        periods = np.floor(t / PERIOD + 0.5) + first + np.arange(count)
        share = np.where(periods < 9, 0.2 * np.sin(0.5 * periods), 0.1)[:, None, None]
        assert self.sampled is not None
        A, B, _ = self.sampled
        E = 1e-4 * np.ones((count, A.shape[0], self.plant.augmented_start.shape[0]))
        return SampledPlant(A * (1 + 0.1 * share), B * (1 - share), E * (1 + share))


class VaryingMPC(AbstractController):
    """MPC with tables over time: of its settings, for plants that vary, with known weights."""

    settings: jb.MPC | None = None

    def design_law(self, plant):
        settings = dataclasses.replace(self.settings, period=self.period, delay=self.delay)
        law = settings.law(plant)
        none = np.zeros(1), (), np.zeros(0, int), np.zeros((0, 1, 1))
        plants = VaryingPlants(plant, self.period, self.delay, *none, law.law.sampled_plant)
        law = eqx.tree_at(lambda s: s.law.preview, law, plants, is_leaf=lambda x: x is None)
        return dataclasses.replace(law, law=dataclasses.replace(law.law, known_weights=True))


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
    "ppf-two-modes": rig(
        jb.PositivePositionFeedback(
            [1e3, 1e3],
            8.0,
            damping_ratio=0.3,
            further_gains=[[-4e2, 2e2]],
            further_frequencies=[[30.0, 20.0]],
            further_damping_ratios=[[0.2, 0.5]],
            period=PERIOD,
        )
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
    # The mass is identified at 0.38 s, which is a sample, also in single precision.
    "feedback-scheduled-at-a-sample": rig(
        ScheduledFeedback(
            [0.2, 0.6],
            [[1e3, 2e3], [1e3, 3e3]],
            load_identification=LoadIdentification(gates=[-0.2, -0.1]),
            period=1e-2,
        ),
        loads=[jb.MovingMass(mass=0.5, speed=1.0, entry_time=0.2)],
        run=Run(duration=0.5),
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
    "semi-active beside active": rig(
        jb.SemiActive(
            0.5, 20.0, OutputFeedback([[-6.0, -5.0], [-7.0, -4.0]]), active=1, period=PERIOD
        ),
        sensors=[jb.Sensor(0.2, "velocity"), jb.Sensor(0.45, "velocity")],
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
