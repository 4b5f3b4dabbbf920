"""Kalman filters of the state, with loads that are ignored, known, estimated or followed."""

import math
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.controller import AbstractEstimator
from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, choice, concrete, count, is_concrete, number
from jaxbeam.case.trajectory import NEVER
from jaxbeam.control.estimation.crossing_filter import NUMBERS, CrossingFilter, LoadFollowingFilter
from jaxbeam.control.estimation.observability import detectability_error, mode_count
from jaxbeam.control.estimation.observer import (
    ConstantGainFilter,
    ContinuousCrossingFilter,
    TimeInvariantFilter,
    kalman_gain,
    sampled_kalman_gain,
    sensor_offsets,
)
from jaxbeam.control.estimation.sampled_plant import PERIOD_ROUNDING, filtered_plant, sensor_chain
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.finite_horizon import GainTable, finite_horizon
from jaxbeam.numerics.stages import balance
from jaxbeam.runtime.arrays import Array, Number, set_at, to_numpy, xp
from jaxbeam.runtime.compiling import compiled


class AbstractKalmanEstimator(AbstractEstimator):
    """Settings common to Kalman filters: noise of plant and readings, and delays of sensors."""

    process_noise: Float[Number, " *mode"] = number(
        "N^2 s/kg", "intensity of the white force on each mode", POSITIVE
    )
    measurement_noise: Float[Number, " *sensor"] | None = number(
        "unit of quantity",
        "standard deviation of readings; that of the sensors if left out",
        POSITIVE,
        default=None,
    )
    max_delay_periods: int = count(
        "largest delay of a sensor, in periods, rounded up", default=1, kw_only=True
    )

    def sampled_noise_error(self, case: Case) -> str | None:
        """Error of noise and delays of readings at samples, or None."""
        missing = missing_noise_error(case) if self.measurement_noise is None else None
        return missing or delay_error(case, self.max_delay_periods)

    def size_error(self, sizes: dict[str, int]) -> str | None:
        """Error of a setting that has neither one entry nor as many as its size, or None."""
        for name, size in sizes.items():
            value = getattr(self, name)
            if value is not None and value.shape not in ((), (size,)):
                return f"{name} must be one number or {size}, not {value.shape[0]}"
        return None


def modal_noise_intensity(
    plant: Plant, process_noise: Float[Array, " *mode"]
) -> Float[Array, "state state"]:
    """Intensity of the white noise in the rates of the states, (unit of each)^2 s.

    Forces of intensity `process_noise` (N^2 s/kg) act on the mass-normalised modes.
    """
    modes = plant.coordinate_scale.shape[0]
    force = process_noise * plant.coordinate_scale**2
    actuator_intensity = xp.zeros(plant.modal_model.state_count - 2 * modes)
    return xp.diag(xp.concatenate([xp.zeros(modes), force, actuator_intensity]))


def reading_variance(
    plant: Plant, measurement_noise: Float[Array, " *sensor"] | None
) -> Float[Array, " sensor"]:
    """Variance of the noise of each reading, in its unit squared; that of the sensors if None."""
    sensors = plant.case.sensors
    if measurement_noise is None:
        return xp.stack([sensor.noise_variance for sensor in sensors])
    return xp.broadcast_to(measurement_noise**2, (len(sensors),))


def missing_noise_error(case: Case) -> str | None:
    """Error of a filter whose readings have the noise of the sensors, if one has none, or None."""
    for i, sensor in enumerate(case.sensors):
        if sensor.noise is None or (is_concrete(sensor.noise) and concrete(sensor.noise) == 0):
            return f"measurement_noise must be given, as sensors.{i} has no noise"
    return None


def delay_error(case: Case, max_delay_periods: int) -> str | None:
    """Error if a sensor is delayed by more periods of the controller, or None."""
    period = case.controller.period
    for i, sensor in enumerate(case.sensors):
        if sensor.delay is None or not (is_concrete(sensor.delay) and is_concrete(period)):
            continue
        delay_periods = math.ceil(concrete(sensor.delay) / concrete(period) - PERIOD_ROUNDING)
        if delay_periods > max_delay_periods:
            return (
                f"max_delay_periods must be at least {delay_periods}, the periods of"
                f" sensors.{i}.delay"
            )
    return None


MAX_PHASE_PER_INTERVAL = 3.0  # rad, phase advance of the fastest mode in an interval of the table

Square = Float[Array, "state state"]


class Kalman(AbstractKalmanEstimator):
    """Kalman filter: the estimate of least variance if noise and plant are as stated.

    White forces of intensity `process_noise` act on the (mass-normalised) modes; each reading has
    white noise of standard deviation `measurement_noise`. The `loads` are "ignored", and the
    filter is time-invariant; or "known": plant and gain vary as they cross; or their weights are
    "estimated" too, starting from those of the design with the standard deviation
    `weight_deviation`. Times, speeds, inertia, vehicles and profile of the crossing are given; the
    states of vehicles are estimated, and each of their wheels has a weight of its own.

    Filters of the sensors and their delays of up to `max_delay_periods` periods are part of the
    plant, so that innovations are white. Noise is that of the samples: behind a digital filter it
    is coloured. The beam is at rest one period before the first sample. Not modelled are sampling
    periods of the sensors' own, nor the direct effect of the white forces on accelerometers. Modes
    that no sensor observes need damping: their estimate is that of the model. A missing reading
    corrects nothing; the gains stay those of complete readings.

    Without a period the filter acts in continuous time (Kalman-Bucy): the noise of readings is
    white with the `measurement_intensity`, that of samples with variance intensity / period; the
    beam is at rest at t = 0. Along the crossing the gain is tabulated, in `points` intervals
    between consecutive entries and exits, with errors of 1e-8.

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
    ...         estimator=jb.Kalman(process_noise=0.02, measurement_noise=1e-5),
    ...     ),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    1.168 mm
    """

    kind: ClassVar[str] = "kalman"
    continuous_time: ClassVar[bool] = True

    loads: str = choice(
        "loads in the model of the filter", "ignored", "known", "estimated", default="ignored"
    )
    weight_deviation: Float[Number, " *load"] | None = number(
        "N", "standard deviation of the weights of the design", POSITIVE, default=None
    )
    measurement_intensity: Float[Number, " *sensor"] | None = number(
        "unit of quantity^2 s", "intensity of the noise of readings", POSITIVE, default=None
    )
    points: int = count("intervals of the gain from event to event", default=400)

    @property
    def has_vehicles(self):
        return self.loads != "ignored"

    @property
    def varies(self):
        return self.loads != "ignored"

    def sampled_filter(self, plant, timing):
        filtered = filtered_plant(plant)
        filtered_model = filtered.plant
        intensity = modal_noise_intensity(filtered_model, self.process_noise)
        states, start = intensity.shape[0], plant.augmented_start
        loads = start.shape[0]  # states of vehicles, weights, and one for profile and histories
        variance = reading_variance(plant, self.measurement_noise)
        scale = balance(filtered_model.unloaded.A)
        plant_states = plant.modal_model.state_count
        if self.loads == "ignored":
            system = filtered.with_filtered_outputs(filtered_model.unloaded)
            sensors = sensor_chain(plant, variance, timing, states, self.max_delay_periods)
            transition = sensors.transition(lambda t: system, intensity, scale)
            C, D = sensors.output_matrices(system.C, system.D)
            gain, _ = sampled_kalman_gain(
                transition.matrix, C, transition.noise_covariance, sensors.noise_covariance
            )
            return ConstantGainFilter(transition, C, D, sensor_offsets(plant), gain, plant_states)
        timing = timing.varying(filtered_model)
        sensors = sensor_chain(plant, variance, timing, states + loads, self.max_delay_periods)
        no_state, load_states = xp.zeros(sensors.state_count), np.s_[states : states + loads]
        return CrossingFilter(
            filtered,
            sensors,
            xp.append(scale, xp.ones(loads)),
            xp.pad(intensity, (0, loads)),
            set_at(no_state, load_states, start),
            xp.diag(set_at(no_state, load_states, self.load_variance(plant))),
            plant_states,
            self.loads == "estimated",
        )

    def continuous_filter(self, plant):
        filtered, count = filtered_plant(plant), len(plant.case.sensors)
        filtered_model = filtered.plant
        intensity = modal_noise_intensity(filtered_model, self.process_noise)
        noise = xp.diag(xp.broadcast_to(self.measurement_intensity, (count,)))
        states, start = intensity.shape[0], plant.augmented_start
        offset, plant_states = sensor_offsets(plant), plant.modal_model.state_count
        zero_state = xp.zeros(states)
        if self.loads == "ignored":
            system = filtered.with_filtered_outputs(filtered_model.unloaded)
            gain, _ = kalman_gain(system.A, system.C, intensity, noise)
            return TimeInvariantFilter(offset, zero_state, plant_states, system, gain)
        end = plant.case.run.duration

        initial_covariance = xp.diag(xp.append(zero_state, self.load_variance(plant)))
        Q = xp.pad(intensity, (0, start.shape[0]))
        table = to_numpy(_dual_gains(filtered, end, self.points, Q, noise, initial_covariance))
        return ContinuousCrossingFilter(
            offset,
            xp.append(zero_state, start),
            plant_states,
            filtered,
            table,
            end,
            self.loads == "estimated",
        )

    def load_variance(self, plant: Plant) -> Float[Array, " added"]:
        """Variance of the states that `Plant.augmented` adds, at the start: that of the weights.

        In N^2; zero where weights are certain, as of absorbers, and for states of vehicles. The
        deviation of a load is that of each of its wheels.
        """
        variance, count = xp.zeros_like(plant.augmented_start), plant.weights.shape[0]
        if self.weight_deviation is None:
            return variance
        deviation = self.weight_deviation
        rolling = count - plant.loads.absorbers
        if deviation.ndim:
            deviation = deviation[np.array(plant.loads.load_of_wheel[:rolling], int)]
        weights = np.s_[plant.vehicle_states : plant.vehicle_states + rolling]
        return set_at(variance, weights, xp.broadcast_to(deviation**2, (rolling,)))

    def validate(self, case, system):
        if not case.sensors:
            return "kind needs sensors; add one"
        period = case.controller.period
        if (period is None) != (self.measurement_intensity is not None):
            return "measurement_intensity must be given without a controller.period, and only then"
        if period is None and self.measurement_noise is not None:
            return "measurement_noise is that of samples; without a period leave it out"
        if period is not None:
            error = self.sampled_noise_error(case)
            if error is not None:
                return error
        if self.loads != "ignored" and not case.loads:
            return "loads must be 'ignored': there are none"
        if (self.loads == "estimated") != (self.weight_deviation is not None):
            return "weight_deviation and loads = 'estimated' belong together; give both or neither"
        sizes = {"measurement_noise": len(case.sensors), "weight_deviation": len(case.loads)}
        sizes["measurement_intensity"] = len(case.sensors)
        if system is not None:
            sizes["process_noise"] = mode_count(system)
        error = self.size_error(sizes)
        if error is not None or system is None:
            return error
        return detectability_error(system) or self._interval_error(case, system)

    def _interval_error(self, case, system) -> str | None:
        """Error if an interval of the gain table is too long for the fastest mode, or None."""
        if case.controller.period is not None or self.loads == "ignored":
            return None
        modes = mode_count(system)
        fastest_frequency = np.max(
            np.abs(np.linalg.eigvals(concrete(system.A)[: 2 * modes, : 2 * modes]))
        )
        min_points = math.ceil(
            fastest_frequency * concrete(case.run.duration) / MAX_PHASE_PER_INTERVAL
        )
        if self.points >= min_points:
            return None
        return f"points must be at least {min_points} for {modes} modes and a run that long"


@compiled
def _dual_gains(filtered, end, points: int, Q, noise, initial_covariance) -> GainTable:
    """Gains of a filtered plant over the time to the end (s), those of the dual regulator.

    Always compiled: in NumPy its loop takes longer than compilation.
    """

    def dual_system(time_to_end):
        """Transposed plant at a time (s) before the end: its regulator has the same gain."""
        plant = filtered.with_filtered_outputs(filtered.plant.augmented(end - time_to_end))
        return plant.A.T, plant.C.T

    crossing_times = filtered.plant.loads.entry_exit_times().reshape(-1)
    events = xp.concatenate([xp.zeros(1), xp.clip(crossing_times, 0.0, end), end[None]])
    problem = xp.sort(end - events), points, Q, noise, initial_covariance
    return finite_horizon(dual_system, *problem)[0]


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
        variance, timing = reading_variance(plant, self.measurement_noise), timing.varying(plant)
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
