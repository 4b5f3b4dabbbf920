"""Laws with random tables, and of plants that vary, whose designs take no compilation."""

import dataclasses

import equinox as eqx
import jax
import numpy as np

import jaxbeam as jb
from jaxbeam.case.controller import AbstractController
from jaxbeam.control.load_identification import LoadIdentification
from jaxbeam.control.optimal.crossing_gains import GainSchedule, PositionGainLaw, ScheduledGainLaw
from jaxbeam.control.predictive.prediction import Preview, SampledPlant
from jaxbeam.control.state_controller import SampledStateLaw, TrueState
from jaxbeam.estimation.sampled_plant import sample_timing
from jaxbeam.numerics.gain_table import GainTable

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
