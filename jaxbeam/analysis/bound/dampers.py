"""Peak that semi-active dampers attain with rates known in advance, beside the bound of forces.

A damper of variable rate gives in hold k the force u_k = -c_k v_k, with v_k the velocity of the
beam there as the hold begins (m/s) and c_min <= c_k <= c_max. Velocities are affine in the forces
before, so that for given signs s_k of the velocities the least peak is the linear program of the
bound with

    s_k v_k >= 0,     c_min s_k v_k <= -s_k u_k <= c_max s_k v_k.

The search begins with the signs of some runs. Where the optimum has v_k = 0 it satisfies the
constraints of the other sign, too, so that the least peak with that sign is no larger; the search
ends where this lowers it no more. The peak is attained, but not proved the least of all signs: the
bound of forces within the limits of the actuators is below it.
"""

import math
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxbeam.analysis.bound.bound import (
    DEFAULT_PERIOD,
    InputInfluence,
    attaining_commands,
    checked_influence,
    held_command_limits,
)
from jaxbeam.case.case import Case
from jaxbeam.case.controller import commanded
from jaxbeam.case.fields import concrete, refuses_traced
from jaxbeam.control.semi_active import SemiActive
from jaxbeam.simulation.simulate import simulate

MAX_HOLDS = 200  # of a search, with forces held for longer: programs of 700 take a minute each
LEAST_GAIN = 1e-3  # by which other signs must lower the peak for the search to go on
AT_ZERO = 1e-6  # of the largest velocity
MAX_ROUNDS = 8


class DamperPeak(NamedTuple):
    """Peak (m) that dampers attain, `uncontrolled` that without, and their forces (N).

    The `forces` of all actuators begin at `times` (s) and are held over `period` (s).
    """

    peak: float
    uncontrolled: float
    times: Float[np.ndarray, " hold"]
    forces: Float[np.ndarray, "hold actuator"]
    period: float

    @property
    def verdict(self) -> str:
        """Peaks without control and with the best rates found, in one sentence."""
        return (
            f"rates known in advance, forces held for {self.period:g} s, attain a peak of"
            f" {self.peak:.6g} m, {1 - self.peak / self.uncontrolled:.1%} less than without control"
        )


class _Dampers(NamedTuple):
    """Numbers of dampers among the actuators, positions (m), limits of their rates (N s/m)."""

    actuators: np.ndarray
    places: Float[np.ndarray, " damper"]
    low: Float[np.ndarray, " damper"]
    high: Float[np.ndarray, " damper"]


@refuses_traced("a bound")
def damper_peak(case: Case, positions: ArrayLike | None = None) -> DamperPeak:
    """Least peak deflection found for the dampers of a case with a `jb.SemiActive` controller.

    The peak is that at the sensors, or at given `positions` (m from the left end). Forces follow
    the velocity of the beam as their hold begins, by rates within the limits of the controller, and
    within the limits of the actuators; they are held over the period of the controller, or 0.01 s,
    or longer where a run has more than MAX_HOLDS of them.

    Raises ValueError for another controller, if no forces are found, as where limits of actuators
    are below the forces of the smallest rates, and as `bound`.

    >>> import jaxbeam as jb
    >>> from jaxbeam.analysis.bound.dampers import damper_peak
    >>> case = jb.Case(
    ...     jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3, "velocity")],
    ...     loads=[jb.MovingMass(mass=0.5, speed=2.0)],
    ...     controller=jb.SemiActive(
    ...         min_damping=1.0, max_damping=6.0, desired=jb.Feedback([50.0]), period=0.01
    ...     ),
    ... )
    >>> print(f"{1e3 * damper_peak(case).peak:.2f} mm")
    1.88 mm
    """
    law = case.controller
    if not isinstance(law, SemiActive):
        raise ValueError("controller must be of kind semi-active: it has the limits of the dampers")
    dampers = _dampers(case, law)
    period = float(DEFAULT_PERIOD if law.period is None else concrete(law.period))
    period *= math.ceil(float(concrete(case.run.duration)) / period / MAX_HOLDS * (1 - 1e-12))
    influence, positions, period, _ = checked_influence(
        case, positions, period, None, dampers.places
    )
    low, high, change = held_command_limits(case, period)
    starts = [
        _at_rates(influence, dampers, rates, (low, high)) for rates in (dampers.low, dampers.high)
    ]
    velocities = [_velocities(influence, forces) for forces in starts]
    record = simulate(case)
    velocities.append(
        np.array(
            [
                np.interp(influence.hold_times, record.times, one)
                for one in np.asarray(record.at(dampers.places, "velocity")).T
            ]
        ).T
    )
    found = [
        _descended(influence, dampers, (low, high, change), np.where(one < 0, -1.0, 1.0))
        for one in velocities
    ]
    peak, forces = min(filter(None, found), key=lambda one: one[0], default=(None, None))
    if peak is None:
        raise ValueError(
            "no forces of the dampers were found within the limits of the actuators: raise the"
            " limits, or lower min_damping"
        )
    without = float(np.abs(influence.deflection(np.zeros_like(forces))).max())
    return DamperPeak(peak, without, influence.hold_times, forces, period)


def _dampers(case: Case, law: SemiActive) -> _Dampers:
    actuators = np.array(commanded(case.actuators)[: len(case.driven) - law.active], int)
    places = [float(concrete(case.actuators[i].displacement_map()[0][0])) for i in actuators]
    low, high = (
        np.broadcast_to(concrete(part), actuators.shape)
        for part in (law.min_damping, law.max_damping)
    )
    return _Dampers(actuators, np.array(places), low, high)


def _descended(influence: InputInfluence, dampers: _Dampers, limits, sign):
    """Least peak (m) and forces from the signs (hold, damper) of velocities; None without any."""
    best, (low, high, change) = None, limits
    for _ in range(MAX_ROUNDS):
        try:
            forces = attaining_commands(
                influence, low, high, change, _constraints(influence, dampers, sign)
            )
        except (ValueError, RuntimeError):  # no forces have these signs, or hardly any
            return best
        peak = float(np.abs(influence.deflection(forces)).max())
        if best is not None and peak > (1 - LEAST_GAIN) * best[0]:
            return min(best, (peak, forces), key=lambda one: one[0])
        best = peak, forces
        velocity = np.abs(_velocities(influence, forces))
        sign = np.where(velocity <= AT_ZERO * velocity.max(), -sign, sign)
    return best


def _constraints(influence: InputInfluence, dampers: _Dampers, sign):
    """Matrix and right side of the constraints of dampers for signs (hold, damper)."""
    holds, actuators = influence.response.shape[2:]
    sign, count = sign.ravel(), sign.size
    velocity = influence.velocity.ravel() * sign
    by_forces = influence.velocity_response.reshape(count, -1) * sign[:, None]
    own = (np.arange(holds)[:, None] * actuators + dampers.actuators).ravel()
    force = np.zeros((count, holds * actuators))
    force[np.arange(count), own] = sign
    low, high = (np.tile(part, holds) for part in (dampers.low, dampers.high))
    matrix = np.concatenate(
        [-by_forces, low[:, None] * by_forces + force, -force - high[:, None] * by_forces]
    )
    right = np.concatenate([velocity, -low * velocity, high * velocity])
    scale = np.abs(matrix).max(axis=1)
    scale = np.where(scale > 0, scale, 1.0)
    return scipy.sparse.csr_array(matrix / scale[:, None]), right / scale


def _velocities(influence: InputInfluence, forces) -> Float[np.ndarray, "hold damper"]:
    return influence.velocity + np.tensordot(influence.velocity_response, forces, axes=2)


def _at_rates(influence: InputInfluence, dampers: _Dampers, rates, limits):
    """Forces (hold, actuator) of dampers of constant rates (N s/m), within limits."""
    forces = np.zeros(influence.response.shape[2:])
    low, high = (limit[dampers.actuators] for limit in limits)
    for k in range(len(forces)):
        by_forces = np.tensordot(influence.velocity_response[k, :, :k], forces[:k], axes=2)
        velocity = influence.velocity[k] + by_forces
        forces[k, dampers.actuators] = np.clip(-rates * velocity, low, high)
    return forces
