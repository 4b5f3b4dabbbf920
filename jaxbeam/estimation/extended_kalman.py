"""Extended Kalman filter that follows masses and speeds of the loads: settings and design."""

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from jaxbeam.case.fields import NOT_NEGATIVE, concrete, is_concrete, number
from jaxbeam.case.trajectory import NEVER
from jaxbeam.estimation.crossing_filter import NUMBERS, LoadFollowingFilter
from jaxbeam.estimation.kalman import (
    AbstractKalmanEstimator,
    modal_noise_intensity,
    reading_variance,
)
from jaxbeam.estimation.observability import detectability_error, mode_count
from jaxbeam.estimation.sampled_plant import filtered_plant, sensor_chain
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.stages import balance
from jaxbeam.runtime.arrays import Array, Number, set_at, xp

# Of length, speed and mass of the design; over these derivatives are differences.
DIFFERENCE_STEP = LoadFollowingFilter.difference_step


class ExtendedKalman(AbstractKalmanEstimator):
    """Kalman filter that follows masses, positions and speeds of the loads as they cross.

    The beam is linear, given the loads; the filter is linearised about their estimate at each
    sample (e.g. Simon, Optimal State Estimation, 2006, section 13.2). Masses, speeds and positions
    start from those of the design (`controller.design` may give it others than the case has), with
    standard deviations `mass_deviation`, `speed_deviation` and `position_deviation`; the speed
    changes by a white acceleration of intensity `acceleration_noise`. Exact numbers have deviation
    zero. Laws whose gains are scheduled by the positions of the loads, as `lqr` with schedule
    "positions", take those of the estimate; laws that feed forward weights take the estimated ones.

    With an uncertain entry and nearly exact readings the filter is too sure of its linearisation,
    and may stay at a wrong mass. State more `measurement_noise` than the sensors have there.

    White forces of intensity `process_noise` act on the (mass-normalised) modes; each reading has
    white noise of standard deviation `measurement_noise`. Filters and delays of the sensors are
    modelled as by `Kalman`. A missing reading corrects neither estimate nor covariance. Loads are
    masses or forces of one wheel, without a profile.

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
    ...         estimator=jb.ExtendedKalman(
    ...             process_noise=0.02,
    ...             measurement_noise=1e-5,
    ...             mass_deviation=0.1,
    ...             speed_deviation=0.2,
    ...         ),
    ...     ),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.914 mm
    """

    kind: ClassVar[str] = "kalman-extended"

    mass_deviation: Float[Number, " *load"] = number(
        "kg", "standard deviation of the masses of the design", NOT_NEGATIVE, kw_only=True
    )
    speed_deviation: Float[Number, " *load"] = number(
        "m/s", "standard deviation of the speeds of the design", NOT_NEGATIVE, kw_only=True
    )
    position_deviation: Float[Number, " *load"] = number(
        "m", "standard deviation of the position of a load as it enters", NOT_NEGATIVE, default=0.0
    )
    acceleration_noise: Float[Number, " *load"] = number(
        "m^2/s^3", "intensity of the white acceleration of the loads", NOT_NEGATIVE, default=0.0
    )

    @property
    def varies(self):
        return True

    def sampled_filter(self, plant, timing):
        filtered, loads = filtered_plant(plant), plant.weights.shape[0]
        intensity = modal_noise_intensity(filtered.plant, self.process_noise)
        states, gravity = intensity.shape[0], plant.case.run.gravity
        end = states + NUMBERS * loads
        variance = reading_variance(plant, self.measurement_noise)
        sensors = sensor_chain(plant, variance, timing, end, self.max_delay_periods)
        start = -timing.period  # s, one period before the first sample
        position, speed, _ = plant.loads.kinematics(start)
        masses = plant.weights / gravity
        numbers = xp.concatenate([position, speed, masses])
        no_state, of_numbers = xp.zeros(sensors.state_count), np.s_[states:end]
        covariance = xp.zeros((sensors.state_count, sensors.state_count))
        covariance = set_at(covariance, (of_numbers, of_numbers), self._covariance(plant, start))
        speeds = np.s_[states + loads : states + 2 * loads]
        noise = set_at(xp.zeros(end), speeds, xp.broadcast_to(self.acceleration_noise, (loads,)))
        length = xp.broadcast_to(plant.case.beam.length, (loads,))
        return LoadFollowingFilter(
            filtered,
            filtered.plant.output_rows,
            sensors,
            xp.append(balance(filtered.plant.unloaded.A), xp.ones(NUMBERS * loads)),
            xp.pad(intensity, (0, NUMBERS * loads)) + xp.diag(noise),
            set_at(no_state, of_numbers, numbers),
            covariance,
            DIFFERENCE_STEP * xp.concatenate([length, xp.abs(speed) + length, masses]),
            plant.loads.inertia[:, 0] / masses,
            plant.modal_model.state_count,
        )

    def _covariance(self, plant: Plant, start) -> Float[Array, "number number"]:
        """Covariance of positions, speeds and masses at the start (s).

        The position is known as the load enters, so that a faster one is further away before.
        """
        loads = plant.weights.shape[0]
        deviations = self.position_deviation, self.speed_deviation, self.mass_deviation
        variances = [xp.broadcast_to(part, (loads,)) ** 2 for part in deviations]
        entry = plant.loads.entry_exit_times()[:, 0]
        since_entry = xp.where(entry < NEVER, start - entry, 0.0)
        motion = xp.eye(NUMBERS * loads)
        motion = set_at(motion, (np.arange(loads), loads + np.arange(loads)), since_entry)
        return motion @ xp.diag(xp.concatenate(variances)) @ motion.T

    def validate(self, case, system):
        if not case.sensors:
            return "kind needs sensors; add one"
        if not case.loads:
            return "kind needs loads to follow; add one, or take kind 'kalman'"
        if case.profile is not None:
            return "kind is for beams without a profile; take kind 'kalman'"
        if case.absorbers:
            return "kind is for beams without absorbers; take kind 'kalman'"
        for i, load in enumerate(case.loads):
            vehicle = load.vehicle(case.run.gravity)
            if vehicle.names or vehicle.offsets.shape[0] * load.spacings().shape[0] != 1:
                return f"kind needs loads of one wheel; loads.{i} has more: take kind 'kalman'"
            if load.force_histories():
                return f"kind needs constant loads; loads.{i} varies: take kind 'kalman'"
            weight = vehicle.static_loads[0]
            if is_concrete(weight) and concrete(weight) <= 0:
                return f"kind needs loads with a weight; loads.{i} has none"
        error = self.sampled_noise_error(case)
        if error is not None:
            return error
        loads = len(case.loads)
        names = "mass_deviation", "speed_deviation", "position_deviation", "acceleration_noise"
        sizes = dict.fromkeys(names, loads) | {"measurement_noise": len(case.sensors)}
        if system is not None:
            sizes["process_noise"] = mode_count(system)
        error = self.size_error(sizes)
        return error if error is not None or system is None else detectability_error(system)
