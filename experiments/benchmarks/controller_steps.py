"""Computing time per step of every kind of controller: typical, worst, and in a batch of 256.

    python -m experiments.benchmarks.controller_steps [--only TEXT]

One span with a patch and five modes, crossed by 0.509 kg at 1 m/s, five sensors read every 10 ms. A
step is the computation from a measurement to a command, estimator and load identification included,
design excluded. The steps are those of the crossing, on one core, compiled (see `time_steps`):
the median and the worst of them, and the time for each of 256 at once.
"""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

import jaxbeam as jb
from experiments.benchmarks import use_one_core
from experiments.benchmarks.common import parser, print_row, print_table, seconds_of
from jaxbeam.case.controller import AbstractController, AbstractSampledLaw, ControlStep, Measurement
from jaxbeam.case.fields import concrete, kinds
from jaxbeam.control.sampled_lqr import SamplingWarning
from jaxbeam.control.state_controller import DesignModel
from jaxbeam.model.state_space import state_space
from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.record import Record
from jaxbeam.simulation.simulate import ContactLossWarning

TIMED_STEPS = 60  # timed steps of a run, evenly spread
MAX_STEPS = 1000  # steps of a run that are repeated
MIN_TIMED_DURATION = 1e-3  # s, of the repetitions of a step: the clock resolves it
MAX_REPETITIONS = 20000
ATTEMPTS = 3  # measurements of one time; the shortest is disturbed least by other processes
BATCH_SIZE = 256


class ComputingTimes(NamedTuple):
    """Computing times (s) of the compiled steps of a law.

    `median` and `worst` are those of the steps of a run, each the shortest of several measurements,
    without what the operating system adds. `batched` is the time per step of 256 steps at once, the
    median of several measurements, `batched_worst` the longest of these.
    """

    median: float
    worst: float
    batched: float
    batched_worst: float


def computing_times(record: Record) -> ComputingTimes:
    """Computing times of the steps of a run, repeated with its measurements.

    Raises ValueError for a run without a sampled controller.
    """
    controller = record.case.controller
    if controller is None or controller.period is None:
        raise ValueError("computing times are those of a controller with a period; give it one")
    modal_states = jnp.concatenate([record.coordinates, record.rates], axis=1)
    plant = state_space(record.case)
    states = jnp.zeros((modal_states.shape[0], plant.modal_model.state_count))
    states = states.at[:, : modal_states.shape[1]].set(modal_states)
    samples = sample_indices(np.asarray(record.times), float(concrete(controller.period)))
    histories = record.controller_readings, states, record.command
    measurements = tuple(jnp.nan_to_num(part)[samples] for part in histories)
    return time_steps(controller.law(plant), measurements, record.times[samples])


def time_steps(
    law: AbstractSampledLaw, measurements: tuple[Array, ...], times: Float[Array, " sample"]
) -> ComputingTimes:
    """Computing times of the steps of a law from its initial state.

    `measurements` are the readings, states and commands (sample, ...) at `times` (s).
    """
    timed_steps = set(np.linspace(0, times.shape[0] - 1, TIMED_STEPS).astype(int).tolist())
    state, step_times, zero = law.initial_state(), [], jnp.zeros(())
    for k in range(times.shape[0]):
        measurement = tuple(part[k] for part in measurements)

        def repeat(count, state=state, measurement=measurement, t=times[k]):
            return _repeat_step(law, state, measurement, t, zero, jnp.asarray(count))

        next_state = repeat(1).state
        if k in timed_steps:
            step_times.append(_time_per_step(repeat))
        state = next_state
    batch_indices = np.resize(np.arange(times.shape[0]), BATCH_SIZE)
    batch = tuple(part[batch_indices] for part in measurements)

    def all_at_once():
        return _step_batch(law, state, batch, times[batch_indices])

    all_at_once()  # compiles
    batched = [seconds_of(all_at_once) / BATCH_SIZE for _ in range(2 * ATTEMPTS + 1)]
    return ComputingTimes(
        *(
            float(x)
            for x in (np.median(step_times), max(step_times), np.median(batched), max(batched))
        )
    )


def sample_indices(times: Float[np.ndarray, " time"], period: float) -> Int[np.ndarray, " sample"]:
    """Indices of the times (s) next to multiples of a period (s), at most MAX_STEPS."""
    samples = np.arange(0.0, times[-1] * (1 + 1e-9), period)[:MAX_STEPS]
    return np.clip(np.searchsorted(times, samples - 1e-9), 0, times.size - 1)


@compiled
def _repeat_step(law: AbstractSampledLaw, state, measurement, t, zero, count) -> ControlStep:
    """Result of one step, computed `count` times."""

    def once(_, before):
        # Each repetition depends on the one before through a term that only the caller knows to be
        # zero; otherwise the compiler would keep one.
        link = zero * jnp.sum(before[0])
        linked = Measurement(*(part + link for part in measurement))
        step = law.step(state, linked, t + link)
        return step.command, step.state

    command, after = jax.lax.fori_loop(0, count, once, (jnp.zeros_like(measurement[2]), state))
    return ControlStep(command, after)


@compiled
def _step_batch(law: AbstractSampledLaw, state, measurements, times) -> ControlStep:
    """Results of steps from one state, each with its own measurement."""
    return jax.vmap(lambda parts, t: law.step(state, Measurement(*parts), t))(measurements, times)


def _time_per_step(repeat: Callable[[int], Any]) -> float:
    """Time (s) of one repetition, without that of the call."""
    once = min(seconds_of(lambda: repeat(1)) for _ in range(ATTEMPTS))
    few = min(seconds_of(lambda: repeat(9)) for _ in range(ATTEMPTS))
    one = max((few - once) / 8, 1e-8)
    count = int(np.clip(MIN_TIMED_DURATION / one, 8, MAX_REPETITIONS))
    many = min(seconds_of(lambda: repeat(1 + count)) for _ in range(ATTEMPTS))
    return max(many - once, 0.0) / count


if __name__ == "__main__":
    use_one_core()  # before JAX starts its threads


PERIOD, MODES = 0.01, 5
WEIGHTS = {"state_weight": [1e6] * (2 * MODES), "command_weight": [1.0], "period": PERIOD}
FINITE_HORIZON = {**WEIGHTS, "points": 600}
PREDICTIVE = {"move_weight": 1e-11, "period": PERIOD}
MPC_4 = {"horizon": 6, "moves": 4, **PREDICTIVE}
GPC = {
    "horizon": 8,
    "moves": 3,
    "move_weight": 1e-9,
    "period": PERIOD,
    "design": DesignModel(modes=2),
}
NOISE = {"process_noise": 0.02, "measurement_noise": 1e-5}
GATE_IDENTIFICATION = jb.LoadIdentification(gates=[-0.2, -0.1], until=0.3)
SCHEDULE_GRID = {"masses": [0.2, 0.4, 0.6], "speeds": [1.0, 1.5]}
CONTROLLERS = {
    "prescribed": jb.Prescribed(offsets=[1.0], period=PERIOD),
    "feedforward": jb.Feedforward(
        gates=[-0.2, -0.1], shares=[0.0, 0.5, 1.0], values=[[1.0, 6.0, 1.0]], period=PERIOD
    ),
    "internal-model": jb.InternalModel(
        readings=[-1e-3, 0.0], values=[[7.0, 0.0]], notches=[18.0], period=PERIOD
    ),
    "feedback, linear": jb.Feedback(gains=[2e3], period=PERIOD),
    "feedback, cubic": jb.Feedback(gains=[2e9], power=3, period=PERIOD),
    "feedback-scheduled, load identified": jb.ScheduledFeedback(
        masses=[0.2, 0.6],
        gains=[[2e3, 4e3]],
        load_identification=GATE_IDENTIFICATION,
        period=PERIOD,
    ),
    "output-feedback": jb.OutputFeedback(gains=[[2e3] * 5], period=PERIOD),
    "sliding-mode": jb.SlidingMode(rate=30.0, reaching_rate=10.0, layer=0.1, period=PERIOD),
    "pd": jb.PD(gains=[2e3], rate_gains=20.0, lag=0.02, period=PERIOD),
    "ppf": jb.PositivePositionFeedback(
        gains=[800.0], frequency=17.0, damping_ratio=0.3, period=PERIOD
    ),
    "state": jb.StateFeedback(gain=[[1e3] * (2 * MODES)], period=PERIOD),
    "lqr": jb.LQR(**WEIGHTS),
    "lqr, mode shapes inverted": jb.LQR(**WEIGHTS, estimator=jb.Inversion()),
    "lqr, observer": jb.LQR(**WEIGHTS, estimator=jb.Observer(speed=2.0)),
    "lqr, Kalman filter": jb.LQR(**WEIGHTS, estimator=jb.Kalman(**NOISE)),
    "lqr, Kalman filter, loads known": jb.LQR(
        **WEIGHTS, estimator=jb.Kalman(**NOISE, loads="known")
    ),
    "lqr, Kalman filter, loads estimated": jb.LQR(
        **WEIGHTS, estimator=jb.Kalman(**NOISE, loads="estimated", weight_deviation=2.0)
    ),
    "lqr, exact sampling": jb.LQR(**WEIGHTS, sampling="exact"),
    "lqr, integral action": jb.LQR(
        **WEIGHTS, integral_weight=[1e9], reference=[0.0], sampling="exact"
    ),
    "lqr, frozen plant": jb.LQR(**FINITE_HORIZON, horizon="frozen"),
    "lqr over the crossing": jb.LQR(**FINITE_HORIZON, horizon="crossing"),
    "lqr over the crossing, augmented": jb.LQR(
        **FINITE_HORIZON, horizon="crossing", augmented="loads"
    ),
    "lqr, scheduled by the identified load": jb.LQR(
        **FINITE_HORIZON,
        **SCHEDULE_GRID,
        load_identification=GATE_IDENTIFICATION,
        horizon="crossing",
        schedule="load",
    ),
    "lqr by positions, Kalman filter, loads known": jb.LQR(
        **FINITE_HORIZON,
        **SCHEDULE_GRID,
        estimator=jb.Kalman(**NOISE, loads="known"),
        horizon="crossing",
        schedule="positions",
    ),
    "lqr by positions, extended Kalman filter": jb.LQR(
        **FINITE_HORIZON,
        **SCHEDULE_GRID,
        estimator=jb.ExtendedKalman(**NOISE, mass_deviation=0.1, speed_deviation=0.1),
        horizon="crossing",
        schedule="positions",
    ),
    "gpc": jb.GPC(**GPC),
    "gpc-adaptive": jb.AdaptiveGPC(**GPC, until=0.1, measurement_noise=1e-6),
    "mpc, unconstrained": jb.MPC(**MPC_4, solver="unconstrained"),
    "mpc, 4 variables": jb.MPC(**MPC_4),
    "mpc, 6 variables": jb.MPC(horizon=8, moves=6, **PREDICTIVE),
    "mpc, 8 variables": jb.MPC(horizon=10, moves=8, **PREDICTIVE),
    "mpc, 4 variables, Hildreth": jb.MPC(**MPC_4, solver="hildreth"),
    "mpc, 8 variables, Hildreth": jb.MPC(horizon=10, moves=8, solver="hildreth", **PREDICTIVE),
    "mpc, 4 variables, Kalman filter": jb.MPC(**MPC_4, estimator=jb.Kalman(**NOISE)),
    "mpc, 4 variables, soft limit": jb.MPC(**MPC_4, soft_limit=1e-3),
    "mpc, 4 variables, loads known": jb.MPC(**MPC_4, loads="known"),
    "mpc, 4 variables, time-varying": jb.MPC(**MPC_4, prediction="time-varying"),
}


def patch_case(controller: AbstractController) -> jb.Case:
    """One span with a patch under a controller; the load passes gates before it."""
    return jb.Case(
        jb.Beam(0.6, 13.211, 0.812, 0.03, modes=MODES),
        actuators=[
            jb.Patch(
                start=0.2575,
                end=0.3425,
                moment_per_volt=8.292e-4,
                correction=0.32,
                amplifier_gain=200.0,
                limits=[-2.5, 7.5],
            )
        ],
        sensors=[jb.Sensor(x) for x in (0.3, 0.1, 0.2, 0.42, 0.52)],
        loads=[jb.MovingMass(mass=0.509, speed=1.0, entry_time=0.2)],
        controller=controller,
        run=jb.Run(1.0, sample_rate=1 / PERIOD),
    )


def measure(controller: AbstractController) -> ComputingTimes:
    """Times (s) of the steps of a controller in the crossing."""
    with warnings.catch_warnings():
        for kind in (ContactLossWarning, SamplingWarning):
            warnings.simplefilter("ignore", kind)
        return computing_times(jb.simulate(patch_case(controller), tolerance=1e-4))


def main() -> None:
    """Print the table, and the kinds of controllers that it lacks."""
    options = parser(__doc__)
    options.add_argument("--only", default="", help="time the controllers whose names contain this")
    only = options.parse_args().only
    classes = {type(controller) for controller in CONTROLLERS.values()}
    lacking = [kind for kind, each in kinds(AbstractController).items() if each not in classes]
    if lacking:
        print(f"not timed, as no example is listed here: {', '.join(lacking)}\n")
    print_table(("microseconds per step", "median", "worst", "256 at once", "worst"))
    for name, controller in CONTROLLERS.items():
        if only in name:
            print_row((name, *(f"{1e6 * seconds:.2f}" for seconds in measure(controller))))


if __name__ == "__main__":
    main()
