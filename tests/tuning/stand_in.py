"""A dataset whose readings are a formula, for tests of fits without simulation."""

import dataclasses

import jax.numpy as jnp
import numpy as np

import jaxbeam as jb
from tuning import Log
from tuning.fit.dataset import Dataset
from tuning.fit.least_squares import LeastSquares
from tuning.fit.result import fit_result
from tuning.parameters import FunctionPrediction, free_parameters

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
