"""A small rig with a patch, and a dataset whose readings are a formula, for quick tests."""

import dataclasses

import jax.numpy as jnp
import numpy as np

import jaxbeam as jb
from tuning import Log
from tuning.fit.dataset import Dataset
from tuning.fit.least_squares import LeastSquares
from tuning.fit.result import fit_result
from tuning.parameters import FunctionPrediction, free_parameters

GAIN = "controller.gains.0"
RIGIDITY = "beam.flexural_rigidity"
BEAM = jb.Beam(
    length=0.6, flexural_rigidity=13.211, mass_per_length=0.812, damping_ratio=0.03, modes=1
)


def rig(controller=None) -> jb.Case:
    """One mode, a patch, a sensor, a load that crosses in 0.4 s; linear feedback if left out."""
    return jb.Case(
        BEAM,
        actuators=[
            jb.Patch(
                0.2575, 0.3425, 8.292e-4, correction=0.32, amplifier_gain=200.0, limits=[-2.5, 7.5]
            )
        ],
        sensors=[jb.Sensor(0.25)],
        loads=[jb.MovingMass(mass=0.5, speed=1.5)],
        controller=jb.Feedback([2000.0], period=0.01) if controller is None else controller,
        run=jb.Run(duration=0.5, sample_rate=100.0),
    )


# A dataset whose readings are a formula, for tests of fits without simulation.

TRUTH = {"beam.flexural_rigidity": 20.0, "beam.damping_ratio": 0.03, "sensors.0.offset": 0.2}
AMPLITUDES = (1.0, 1.6, 0.7)  # initial deflection (m) in each log
TIMES = np.arange(120) / 50.0
NOISE = 0.02
CASE = jb.Case(
    beam=jb.Beam(length=1.0, flexural_rigidity=19.0, mass_per_length=2.0, damping_ratio=0.02),
    sensors=[jb.Sensor(position=0.5)],
    loads=[jb.MovingMass(mass=0.5, speed=1.0)],
)


def formula(rigidity, damping, offset, amplitude):
    """A decaying oscillation: a e^(-z w t) cos(w t) + offset, with w = 2 sqrt(rigidity)."""
    w = 2 * rigidity**0.5
    return amplitude * jnp.exp(-damping * w * TIMES) * jnp.cos(w * TIMES) + offset


@dataclasses.dataclass(frozen=True)
class StandIn(Dataset):
    """Logs of one channel that differ in amplitude; its free parameters are those of `TRUTH`."""

    def prediction(self, addresses):
        def predict(values):
            by_address = TRUTH | dict(zip(addresses, values, strict=True))
            parameters = [by_address[address] for address in TRUTH]
            logs = [formula(*parameters, a) for a in AMPLITUDES[: len(self.logs)]]
            return jnp.stack(logs)[..., None]

        return FunctionPrediction(predict)

    def validity_warning(self, values):
        return ""


def clean(logs=3):
    """Readings without noise (log, time, channel)."""
    return np.array([formula(*TRUTH.values(), a) for a in AMPLITUDES[:logs]])[..., None]


def dataset(measured=None, mask=None, logs=3, seed=0) -> StandIn:
    """Dataset of the given readings; by default clean ones with white noise."""
    if measured is None:
        noise = np.random.default_rng(seed).normal(size=(logs, TIMES.size, 1))
        measured = clean(logs) + NOISE * noise
    mask = np.ones(measured.shape) if mask is None else mask
    made = [
        Log(TIMES, part, ("w",), ("deflection",), ("m",), f"run {i}", valid=has > 0)
        for i, (part, has) in enumerate(zip(measured, mask, strict=True))
    ]
    times = np.tile(TIMES, (len(made), 1))
    return StandIn(CASE, [CASE] * len(made), made, None, times, measured, mask)


def least_squares(free=None, loss="squares", **options) -> LeastSquares:
    """Least-squares problem in the parameters of `TRUTH`, or some of them."""
    data = dataset(**options)
    free = dict.fromkeys(TRUTH) if free is None else free
    return LeastSquares(data, free_parameters(data.cases, free, 1.0), loss)


def fit(problem: LeastSquares | None = None):
    """Fit of a least-squares problem."""
    problem = least_squares() if problem is None else problem
    return fit_result(CASE, problem, problem.solve(problem.data.measured))
