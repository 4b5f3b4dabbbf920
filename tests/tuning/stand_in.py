"""A campaign whose readings are a formula: what surrounds a fit is tested without simulating."""

import dataclasses

import jax.numpy as jnp
import numpy as np

import jaxbeam as jb
from tuning import Log
from tuning.fit.dataset import Dataset
from tuning.fit.identify import fit_result
from tuning.fit.least_squares import LeastSquares
from tuning.parameters.free import free_parameters

TRUTH = {"beam.flexural_rigidity": 20.0, "beam.damping_ratio": 0.03, "sensors.0.offset": 0.2}
PULLS = (1.0, 1.6, 0.7)  # how hard the beam of each log was pulled before it was let go
TIMES = np.arange(120) / 50.0
NOISE = 0.02
CASE = jb.Case(
    beam=jb.Beam(length=1.0, flexural_rigidity=19.0, mass_per_length=2.0, damping_ratio=0.02),
    sensors=[jb.Sensor(position=0.5)],
    loads=[jb.MovingMass(mass=0.5, speed=1.0)],
)


def formula(rigidity, damping, offset, pull):
    """A decaying oscillation: pull e^(-z w t) cos(w t) + offset, with w = 2 sqrt(rigidity)."""
    w = 2 * rigidity**0.5
    return pull * jnp.exp(-damping * w * TIMES) * jnp.cos(w * TIMES) + offset


@dataclasses.dataclass(frozen=True)
class StandIn(Dataset):
    """Logs of one channel, each with a pull of its own; its numbers are those of `TRUTH`."""

    def predictor(self, addresses):
        def predict(values):
            given = dict(zip(TRUTH, TRUTH.values(), strict=True))
            given |= dict(zip(addresses, values, strict=True))
            numbers = [given[address] for address in TRUTH]
            logs = [formula(*numbers, pull) for pull in PULLS[: len(self.logs)]]
            return jnp.stack(logs)[..., None]

        return predict

    def doubt(self, values):
        return ""


def clean(logs=3):
    """The readings without noise (log, time, channel)."""
    return np.array([formula(*TRUTH.values(), pull) for pull in PULLS[:logs]])[..., None]


def campaign(measured=None, real=None, logs=3, seed=0) -> StandIn:
    """A campaign of clean readings with white noise, unless others are given."""
    if measured is None:
        noise = np.random.default_rng(seed).normal(size=(logs, TIMES.size, 1))
        measured = clean(logs) + NOISE * noise
    real = np.ones(measured.shape) if real is None else real
    made = [
        Log(TIMES, part, ("w",), ("deflection",), ("m",), f"run {i}", valid=has > 0)
        for i, (part, has) in enumerate(zip(measured, real, strict=True))
    ]
    times = np.tile(TIMES, (len(made), 1))
    return StandIn(CASE, [CASE] * len(made), made, None, times, measured, real)


def search(free=None, loss="squares", **about) -> LeastSquares:
    """A search for the numbers of `TRUTH`, or some of them."""
    made = campaign(**about)
    free = dict.fromkeys(TRUTH) if free is None else free
    return LeastSquares(made, free_parameters(made.cases, free, 1.0), loss)


def fit(found: LeastSquares | None = None):
    """The fit of a search."""
    found = search() if found is None else found
    return fit_result(CASE, found, found.solve(found.data.measured))
