"""Moving-horizon estimation: a Kalman filter whose states in a window are kept within bounds.

The states x of the present sample and the bounded deflections s of the last ones are jointly
Gaussian, given all readings, by a Kalman filter of x and s. The estimate is the most probable point
within the bounds: with mean m and covariance S of the bounded numbers c, and those of (x, s),

    x* = x + cov(x, c) S^-1 (c* - m),   c* = argmin (c - m)' S^-1 (c - m) within the bounds.

It is that of the optimisation over all states and noises of the window, whose arrival cost is the
Kalman filter before the window (Rao, Rawlings and Mayne, IEEE Trans. Automatic Control 48, 2003).
"""

import dataclasses
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.controller import AbstractSampledFilter
from jaxbeam.case.fields import POSITIVE, choice, concrete, count, is_concrete, number
from jaxbeam.control.estimation.crossing_filter import CrossingFilter, corrected
from jaxbeam.control.estimation.kalman import AbstractKalmanEstimator, Kalman
from jaxbeam.control.estimation.observer import sensor_offsets
from jaxbeam.control.estimation.sampled_plant import Transition
from jaxbeam.model.output_rows import modal_row
from jaxbeam.numerics.matrices import symmetric_part
from jaxbeam.numerics.qp import solve_qp
from jaxbeam.runtime.arrays import Array, Number, cholesky, scan, solve_triangular, take, xp

RIDGE = 1e-10  # added to correlations, which the deflections of a window make singular


Joint = Float[Array, "joint joint"]


class WindowState(NamedTuple):
    """Mean of states and earlier deflections after a sample, covariance, and the last command."""

    mean: Float[Array, " joint"]
    covariance: Joint
    command: Float[Array, " actuator"]


class BoundFactor(NamedTuple):
    """Factor of the covariance of the bounded numbers: c = mean + `size` `root` z, z white.

    The states and earlier deflections are mean + `columns` z where they depend on c. Numbers that
    are `certain` have no variance.
    """

    size: Float[Array, " bound"]
    root: Float[Array, "bound bound"]
    columns: Float[Array, "joint bound"]
    certain: Bool[Array, " bound"]


class WindowFilter(AbstractSampledFilter):
    """Most probable states of a `filter` within bounds of deflections and weights.

    `rows` give the bounded deflections (m) from the states; they are bounded by `deflection_limit`
    in the last `window` samples, the present one included. `weight_rows` give the weights (N).
    Missing readings are those of the `filter`. A `table` has gains and factors at all samples, with
    which the covariance of a state stays what it was.
    """

    without_reading: ClassVar[str] = (
        "The estimate is predicted by the model, and not corrected by it."
    )

    filter: CrossingFilter
    rows: Float[Array, "deflection state"]
    deflection_limit: Float[Array, ""]
    weight_rows: Float[Array, "wheel state"]
    min_weight: Float[Array, ""]
    max_weight: Float[Array, ""]
    window: int = eqx.field(static=True)
    table: tuple[Float[Array, "sample joint sensor"], BoundFactor | None] | None = None

    @property
    def earlier(self) -> int:
        """Number of deflections of earlier samples."""
        return (self.window - 1) * self.rows.shape[0]

    def initial_state(self):
        start = self.filter.initial_state()
        grown = ((0, self.earlier), (0, self.earlier))
        return WindowState(
            xp.pad(start.x, (0, self.earlier)), xp.pad(start.covariance, grown), start.command
        )

    def tabulated(self, times):
        filter, noise = self.filter.with_models(times), self.filter.sensor_chain.noise_covariance

        def step(covariance, model):
            matrix, own, rows = self.joint(model[0], model[1])
            covariance = symmetric_part(matrix @ covariance @ matrix.T + own)
            gain, covariance = corrected(covariance, rows, noise)
            factor = self.factor(covariance) if self._bounded else None
            return covariance, (gain, factor)

        start = self.initial_state().covariance
        return dataclasses.replace(self, filter=filter, table=scan(step, start, filter.table)[1])

    @property
    def _bounded(self) -> bool:
        return bool(self.rows.shape[0] or self.weight_rows.shape[0])

    def update(self, state, measurement, t):
        command = measurement.command
        transition, C, D = self.filter.model_at(t)
        matrix, noise, rows = self.joint(transition, C)
        x = transition.predict(state.mean[: C.shape[-1]], state.command, command)
        mean = xp.concatenate([x, matrix[C.shape[-1] :] @ state.mean])
        readings = C @ x + D @ command + sensor_offsets(self.filter.filtered.plant)
        covariance = state.covariance
        if self.table is None:
            own = self.filter.sensor_chain.noise_covariance
            covariance = symmetric_part(matrix @ covariance @ matrix.T + noise)
            gain, covariance = corrected(covariance, rows, own)
            factor = self.factor(covariance) if self._bounded else None
        else:
            sample = self.filter.sensor_chain.timing.sample_at(t)
            gain, factor = jax.tree.map(lambda part: take(part, sample), self.table)
        mean = mean + gain @ measurement.innovation(readings)
        within = self._within_bounds(mean, factor)[: C.shape[-1]]
        return self.filter.estimate(within, t), WindowState(mean, covariance, command)

    def joint(
        self, transition: Transition, C: Float[Array, "sensor state"]
    ) -> tuple[Joint, Joint, Float[Array, "sensor joint"]]:
        """Transition of states and earlier deflections, covariance of its noise, and C."""
        earlier = self.earlier
        # Deflections of the last sample become the first of the earlier ones.
        shift = self._deflections()[:earlier]
        matrix = xp.concatenate([xp.pad(transition.matrix, ((0, 0), (0, earlier))), shift])
        noise = xp.pad(transition.noise_covariance, (0, earlier))
        return matrix, noise, xp.pad(C, ((0, 0), (0, earlier)))

    def _deflections(self) -> Float[Array, "deflection joint"]:
        """Rows of the present and of the earlier deflections."""
        states, earlier = self.rows.shape[1], self.earlier
        present = xp.pad(self.rows, ((0, 0), (0, earlier)))
        return xp.concatenate([present, xp.eye(earlier, states + earlier, k=states)])

    def bounds(
        self,
    ) -> tuple[Float[Array, "bound joint"], Float[Array, " bound"], Float[Array, " bound"]]:
        """Rows of the bounded numbers, and their least and largest values, infinite where free."""
        deflections = self._deflections()
        weights = xp.pad(self.weight_rows, ((0, 0), (0, self.earlier)))
        limits = xp.full(deflections.shape[0], self.deflection_limit)
        count = weights.shape[0]
        lowest = xp.concatenate([-limits, xp.full(count, self.min_weight)])
        highest = xp.concatenate([limits, xp.full(count, self.max_weight)])
        return xp.concatenate([deflections, weights]), lowest, highest

    def factor(self, covariance: Joint) -> BoundFactor:
        """Factor by which bounded numbers follow from independent ones, of their covariance."""
        rows, _, _ = self.bounds()
        count, common = rows.shape[0], rows @ covariance
        variance = xp.diagonal(common @ rows.T)
        certain = variance <= 0
        size = xp.sqrt(xp.where(certain, 1.0, variance))
        correlation = (common @ rows.T) / (size * size[:, None]) + RIDGE * np.eye(count)
        correlation = xp.where(certain[:, None] | certain, np.eye(count), correlation)
        root = cholesky(correlation)
        columns = solve_triangular(
            root, xp.where(certain, 0.0, 1 / size)[:, None] * common, lower=True
        )
        return BoundFactor(size, root, columns.T, certain)

    def _within_bounds(self, mean: Float[Array, " joint"], factor: BoundFactor | None):
        """Most probable point within the bounds; the mean where none is found."""
        rows, lowest, highest = self.bounds()
        count, numbers = rows.shape[0], rows @ mean
        if factor is None:
            return mean
        M = xp.concatenate([factor.root, -factor.root])
        sides = xp.concatenate(
            [(highest - numbers) / factor.size, (numbers - lowest) / factor.size]
        )
        # A number without variance, as at the start, cannot be moved into its bounds.
        free = xp.concatenate([factor.certain, factor.certain]) | ~xp.isfinite(sides)
        M, sides = xp.where(free[:, None], 0.0, M), xp.where(free, 1.0, sides)
        found = solve_qp(np.eye(count), xp.zeros(count), M, sides)
        return mean + factor.columns @ xp.where(found.solved, found.x, 0.0)


class MovingHorizon(AbstractKalmanEstimator):
    """Most probable states over a window of samples, within bounds on weights and deflections.

    Over the last `window` samples the states and the white forces minimise the squares of both and
    of the noise of the readings, over their variances (Rawlings, Mayne and Diehl, Model Predictive
    Control, 2nd edition, 2017, section 4.3); what was before the window counts by the Kalman
    filter, as the arrival cost. Noise, loads and sensors are those of `Kalman`, which finds the
    same states where no bound is met. Bounds are the `min_weight` and the `max_weight` of loads
    whose weights are "estimated" (N, of each wheel), and the `deflection_limit` at the sensors,
    whatever they measure, in all samples of the window.

    A weight stays as it is, so that bounds of weights alone give the same at any window. A missing
    reading corrects nothing; the gains stay those of complete readings.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.LQR(
    ...         state_weight=[1e6, 1.0],
    ...         command_weight=[1e-2],
    ...         period=0.005,
    ...         estimator=jb.MovingHorizon(
    ...             process_noise=0.02, measurement_noise=1e-5, weight_deviation=1.0
    ...         ),
    ...     ),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.914 mm
    """

    kind: ClassVar[str] = "moving-horizon"

    loads: str = choice("loads in the model", "known", "estimated", default="estimated")
    weight_deviation: Float[Number, " *load"] | None = number(
        "N", "standard deviation of the weights of the design", POSITIVE, default=None
    )
    window: int = count("samples, with the present one, over which bounds hold", default=5)
    min_weight: Float[Number, ""] = number("N", "least weight of a wheel", default=0.0)
    max_weight: Float[Number, ""] | None = number("N", "largest weight of a wheel", default=None)
    deflection_limit: Float[Number, ""] | None = number(
        "m", "largest deflection at the sensors, up or down", POSITIVE, default=None
    )

    @property
    def has_vehicles(self):
        return True

    @property
    def varies(self):
        return True

    def kalman(self) -> Kalman:
        """Kalman filter of the same plant, noise and loads, without bounds."""
        return Kalman(
            self.process_noise,
            self.measurement_noise,
            loads=self.loads,
            weight_deviation=self.weight_deviation,
            max_delay_periods=self.max_delay_periods,
        )

    def sampled_filter(self, plant, timing):
        filter = self.kalman().sampled_filter(plant, timing)
        states, rows = filter.initial.shape[0], xp.zeros((0, plant.coordinate_scale.shape[0]))
        if self.deflection_limit is not None:
            positions = plant.case.sensor_positions
            rows = modal_row(plant.modal_model.fields, plant.case, positions, "deflection")
            rows = rows / plant.coordinate_scale
        rows = xp.pad(rows, ((0, 0), (0, states - rows.shape[1])))
        wheels = plant.weights.shape[0] if self.loads == "estimated" else 0
        first = filter.sensor_chain.plant_states - plant.augmented_start.shape[0]
        weight_rows = xp.eye(wheels, states, k=first + plant.vehicle_states)
        none = xp.asarray(xp.inf)
        return WindowFilter(
            filter,
            rows,
            none if self.deflection_limit is None else self.deflection_limit,
            weight_rows,
            self.min_weight,
            none if self.max_weight is None else self.max_weight,
            self.window,
        )

    def validate(self, case, system):
        limits = self.min_weight, self.max_weight
        if all(part is not None and is_concrete(part) for part in limits):
            least, largest = map(concrete, limits)
            if not least < largest:
                return f"max_weight must be above min_weight, {least:g} N, not {largest:g} N"
        return self.kalman().validate(case, system)
