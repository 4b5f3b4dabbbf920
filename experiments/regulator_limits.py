"""What section 5 says of optimal control beyond its tables: sampled gains, and stability.

Frozen poles are no criterion for a loop that changes with time, but they are what was published.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

import jaxbeam as jb
from experiments import published
from experiments.verdicts import Finding, finding
from jaxbeam.riccati import dlqr, stein
from jaxbeam.stability import frozen_poles

EFFORT = 9e-8  # R of the example in 5.1
ACTIVE = 3500.0  # N/m
UNLIKE = "a shaker of 3.25 N/V that lags by 1 ms (alpha = beta = 1000)"
DEAR = 1.001  # times the least cost: a gain that costs more is not the optimal one
SPEEDS = (0.55, 2.0, 4.0, 5.6)  # m/s
MASSES = (0.509, 0.7, 1.0)  # kg
PLACES = 21  # of the load, for which poles are found


def active(rig: jb.Case) -> jb.Case:
    """The rig with its shaker as it is when it is driven."""
    return jb.replace(rig, {"actuators.0.stiffness": ACTIVE})


def unlike(rig: jb.Case) -> jb.Case:
    """The rig with the shaker that the printed gains of the sampled regulator belong to.

    Its two numbers were fitted to the twelve of the gains for 5 ms and for 10 ms.
    """
    return jb.replace(rig, {"actuators.0.force_per_volt": 3.25, "actuators.0.bandwidth": 1000.0})


def sampled(rig: jb.Case, weights) -> list[Finding]:
    """Limits of sampling, and gains of the sampled regulator, of the rig with its shaker."""
    rig = active(rig)
    moved = jb.replace(rig, {"actuators.0.position": 0.25})
    moved = dataclasses.replace(moved, beam=dataclasses.replace(moved.beam, modes=2))
    two = [weights[i] for i in (0, 1, 3, 4, 6)]
    gains = (
        (published.SAMPLED_GAIN, rig, 5e-3, weights),
        (published.MOVED_GAIN, moved, 1e-2, two),
        (published.FAST_GAIN, rig, 2e-4, weights),
    )
    limits = finding(published.SAMPLING_LIMITS, jb.sampling_limit(rig))
    return [limits, *(_gain(printed, *problem) for printed, *problem in gains)]


def optimal_gain(case, period: float, weights, effort: float = EFFORT):
    """The gain that costs least in discrete time, and that cost; states as in the thesis."""
    plant = jb.state_space(case, "sine").unloaded.discretize(period)
    return dlqr(plant.A, plant.B, jnp.diag(jnp.array(weights)), effort * jnp.eye(1))


def _gain(printed, case, period, weights) -> Finding:
    """A printed gain beside the optimal one; what is wrong with it, if it costs much more."""
    plant = jb.state_space(case, "sine").unloaded.discretize(period)
    Q, R = jnp.diag(jnp.array(weights)), EFFORT * jnp.eye(1)
    best, least = optimal_gain(case, period, weights)
    theirs = jnp.array(printed.numbers)[None]
    closed = plant.A - plant.B @ theirs
    radius = np.abs(np.linalg.eigvals(np.asarray(closed))).max()
    obstacle = ""
    if radius >= 1:
        obstacle = (
            f"with the printed gain the loop it is for is unstable: {radius:.2g} times as much"
            " after each period"
        )
    else:
        cost = np.trace(np.asarray(stein(closed, Q + theirs.T @ R @ theirs)))
        dearer = cost / np.trace(np.asarray(least))
        if dearer > DEAR:
            obstacle = (
                "with the printed gain the regulator of the stated rig costs"
                f" {100 * (dearer - 1):.2g} % more than the least, which one gain alone attains"
            )
    other = np.asarray(optimal_gain(unlike(case), period, weights)[0])[0]
    return finding(printed, np.asarray(best)[0], {UNLIKE: other}, obstacle)


def frozen(readings) -> list[Finding]:
    """Stability by frozen poles; `readings` has loops by name, with few states and with all."""
    slow, fast = SPEEDS[0], SPEEDS[-1]
    shown, limits = {}, {}
    for name, (few, every) in readings.items():
        speeds = [_largest(few, {"loads.0.speed": v, "loads.0.mass": MASSES[0]}) for v in SPEEDS]
        masses = [_largest(few, {"loads.0.speed": slow, "loads.0.mass": m}) for m in MASSES]
        whole = _largest(every, {"loads.0.speed": fast, "loads.0.mass": MASSES[0]})
        shown[name] = np.array([speeds[0] > 0, speeds[-1] > 0, whole > 0], float)
        limits[name] = np.array([_first(SPEEDS, speeds), _first(MASSES, masses)])
    highest = np.max(list(limits.values()), axis=0)
    below = np.all(highest < published.UNSTABLE_BEYOND.numbers * (1 - 0.05))
    printed, *others = readings
    return [
        finding(published.UNSTABLE, shown[printed], {name: shown[name] for name in others}),
        finding(
            published.UNSTABLE_BEYOND,
            limits[printed],
            {name: limits[name] for name in others},
            obstacle=f"by every reading frozen poles are to the right from {highest[0]:.2g} m/s"
            f" and from {highest[1]:.2g} kg at the latest"
            if below
            else "",
        ),
    ]


def _largest(case: jb.Case, load) -> float:
    """The largest real part (1/s) of the frozen poles while a load crosses."""
    case = jb.replace(case, load)
    crossing = float(case.beam.length / case.loads[0].speed)
    return float(frozen_poles(case, np.linspace(0, crossing, PLACES)[1:-1]).largest.max())


def _first(values, sizes) -> float:
    """Where sizes first rise above zero, between two of the values; the first if at once."""
    above = np.flatnonzero(np.array(sizes) > 0)
    if above.size == 0:
        return np.inf
    i = above[0]
    return float(np.interp(0.0, sizes[i - 1 : i + 1], values[i - 1 : i + 1]) if i else values[0])
