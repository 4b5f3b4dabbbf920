"""Linearised loops with stationary loads, which rest at their positions."""

import dataclasses

import equinox as eqx
import numpy as np

from jaxbeam.analysis.frozen_loop import FrozenTrajectory, LoopDynamics, frozen_loads, loop_dynamics
from jaxbeam.analysis.linearised_loop import LinearisedLoop, linearise, loop_timing
from jaxbeam.analysis.loops.settled_filter import settled_law
from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.fields import concrete
from jaxbeam.case.loads.mass import MovingMass
from jaxbeam.case.trajectory import NEVER
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modes import mesh_layout
from jaxbeam.runtime.arrays import xp

ROUNDING = 1e-14  # of the entries of a constant state in a matrix of a loop


def stationary_loops(case: Case, times) -> list[LinearisedLoop]:
    """Loops of a case with its loads stationary at their positions of some times (s).

    They are linearised about the equilibrium under the loads. Raises ValueError as
    `linearised_loop`.
    """
    timing = loop_timing(case)
    loop = loop_dynamics(case, mesh_layout(concrete_case(case)))
    return [
        without_constant_states(linearise(_with_stationary_loads(loop, t), timing, xp.asarray(t)))
        for t in times
    ]


def loop_with_mass_at(case: Case, position: float, mass: float) -> LinearisedLoop:
    """Loop of a case with one stationary mass (kg) at a position (m), and without its loads.

    The law is that of the case, at the time at which the first load of the case is there: a
    schedule has the gains of that time. It is linearised about the equilibrium under the mass.
    Raises ValueError for a position off the beam, a negative mass, and as `linearised_loop`.
    """
    loads = standing_mass(case, position, mass)
    timing = loop_timing(case)
    loop = loop_dynamics(case, mesh_layout(concrete_case(case)))
    loop = eqx.tree_at(lambda loop: loop.augmented_plant.loads, loop, loads)
    t = xp.asarray(_passage_time(case, position))
    return without_constant_states(linearise(loop, timing, t))


def standing_mass(case: Case, position: float, mass: float) -> LoadSet:
    """A stationary mass (kg) at a position (m) in place of the loads of a case.

    Raises ValueError for a position off the beam, and a mass that is negative or not finite.
    """
    length = float(concrete(case.beam.length))
    if not 0 <= position <= length:
        raise ValueError(f"the mass at {position:g} m is off the beam, 0 to {length:g} m")
    if not 0 <= mass < np.inf:
        raise ValueError(f"the mass at {position:g} m must be positive, in kg; it is {mass:g}")
    alone = dataclasses.replace(case, loads=(MovingMass(mass=mass, speed=1.0),), profile=None)
    zero, one = xp.zeros(()), xp.ones(())
    path = FrozenTrajectory(
        xp.asarray(position), zero, zero, one, xp.ones(1, bool), case.beam.length
    )
    loads = load_set(alone)
    paths = path, *loads.trajectories[1:]  # of absorbers
    return dataclasses.replace(loads, trajectories=paths, profile=None)


def without_constant_states(loop: LinearisedLoop) -> LinearisedLoop:
    """Sampled loop without constant states, such as those of a completed load identification."""
    if loop.period is None:
        return loop
    size = loop.A.shape[0]
    unchanged = np.abs(np.asarray(loop.A) - np.eye(size)) <= ROUNDING
    constant = np.all(unchanged, axis=1) & ~np.any(loop.B, axis=1)
    kept = ~constant
    return LinearisedLoop(
        loop.A[kept][:, kept], loop.B[kept], loop.K[:, kept], loop.period, loop.modal_states
    )


def _with_stationary_loads(loop: LoopDynamics, t: float) -> LoopDynamics:
    """Loop with stationary loads at their positions of t (s), and a filter settled under them.

    Raises ValueError for a filter that does not settle.
    """
    length, zero = loop.plant.case.beam.length, xp.zeros(())

    def stationary(loads: LoadSet) -> LoadSet:
        frozen = frozen_loads(loads, length, xp.asarray(t))
        paths = tuple(
            dataclasses.replace(path, speed=zero, acceleration=zero) for path in frozen.trajectories
        )
        return eqx.tree_at(lambda loads: loads.trajectories, frozen, paths)

    law = settled_law(loop.law, np.float64(t), stationary)
    loads = stationary(loop.augmented_plant.loads)
    return eqx.tree_at(lambda loop: (loop.law, loop.augmented_plant.loads), loop, (law, loads))


def _passage_time(case: Case, position: float) -> float:
    """Time (s) at which the first wheel of the first load is at a position (m); 0 if never."""
    trajectories = load_set(case).trajectories
    if not trajectories:
        return 0.0
    times = concrete(trajectories[0].passage_times(xp.asarray([position])))
    times = times[np.abs(times) < NEVER]
    return float(times[0]) if times.size else 0.0
