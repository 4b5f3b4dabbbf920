"""Moving-horizon estimation: settings, and the design at samples."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.fields import POSITIVE, choice, concrete, count, is_concrete, number
from jaxbeam.estimation.kalman import Kalman
from jaxbeam.estimation.kalman_noise import AbstractKalmanEstimator
from jaxbeam.estimation.moving_horizon.window_filter import WindowFilter
from jaxbeam.model.sensing.output_rows import modal_row
from jaxbeam.runtime.arrays import Array, xp


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
    weight_deviation: Float[Array, " *load"] | None = number(
        "N", "standard deviation of the weights of the design", POSITIVE, default=None
    )
    window: int = count("samples, with the present one, over which bounds hold", default=5)
    min_weight: Float[Array, ""] = number("N", "least weight of a wheel", default=0.0)
    max_weight: Float[Array, ""] | None = number("N", "largest weight of a wheel", default=None)
    deflection_limit: Float[Array, ""] | None = number(
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
