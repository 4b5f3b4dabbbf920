"""Assembly of planar vehicles: bodies on vertical springs and dampers, hinges between them, wheels.

A body at x (m, forwards) with height u and pitch t, positive nose up, has the height
u + (s - x) t above the point s. The extensions R q of springs and the heights N q above wheels
follow from the heights H q and pitches T q of the bodies, linear in the degrees of freedom q:

    M = H^T m H + T^T I T,   K = R^T k R + Q^T kappa Q,   C likewise,

with masses m, moments of inertia I, and rotational springs kappa between the pitches, Q q. A hinge
between two bodies removes one height (an exact constraint). On a level surface at rest

    (K + N^T k_w N) q = -g H^T m,   P = -k_w N q + g m_w

give the static loads P of wheels with springs k_w and unsprung masses m_w: sum P is the weight.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.case.loads.base import VehicleModel
from jaxbeam.runtime.arrays import Array, solve, xp

Pairs = tuple[tuple[int, int], ...]


class Bodies(NamedTuple):
    """Bodies: names, masses (kg), positions of their centres of mass (m), inertias (kg m^2).

    A body without inertia (None), such as the lumped mass of an axle, has a height only.
    """

    names: tuple[str, ...]
    masses: Float[Array, " body"]
    positions: Float[Array, " body"]
    inertias: tuple[Float[Array, ""] | None, ...]


class Links(NamedTuple):
    """Springs (N/m, N m/rad) and dampers (N s/m, N m s/rad) between pairs of bodies."""

    pairs: Pairs
    positions: Float[Array, " link"]
    stiffness: Float[Array, " link"]
    damping: Float[Array, " link"]
    rotational_stiffness: Float[Array, " link"] | None = None
    rotational_damping: Float[Array, " link"] | None = None


class Hinges(NamedTuple):
    """Points (m) at which pairs of bodies have the same height."""

    pairs: Pairs
    positions: Float[Array, " hinge"]


class Wheels(NamedTuple):
    """Wheels under bodies, front first: springs (N/m), dampers (N s/m) and unsprung masses (kg)."""

    bodies: tuple[int, ...]
    positions: Float[Array, " wheel"]
    masses: Float[Array, " wheel"]
    stiffness: Float[Array, " wheel"]
    damping: Float[Array, " wheel"]


NO_HINGES = Hinges((), np.zeros(0))


def assemble(
    bodies: Bodies,
    links: Links,
    wheels: Wheels,
    gravity: Float[Array, ""],
    hinges: Hinges = NO_HINGES,
) -> VehicleModel:
    """Matrices and static wheel loads of a planar vehicle; see the module. Gravity in m/s^2.

    Static loads are not finite if the springs hold the vehicle in no equilibrium.
    """
    heights, pitches, names = _coordinates(bodies, hinges)
    inertias = xp.array([0.0 if one is None else one for one in bodies.inertias])
    ends = _incidence(links.pairs, len(bodies.names))
    under = np.eye(len(bodies.names))[list(wheels.bodies)]

    def heights_at(selection, positions):
        levers = selection * (positions[:, None] - bodies.positions[None, :])
        return selection @ heights + levers @ pitches

    extensions = heights_at(ends, links.positions)
    wheel_map = heights_at(under, wheels.positions)
    mass = heights.T @ (bodies.masses[:, None] * heights) + pitches.T @ (
        inertias[:, None] * pitches
    )
    stiffness = extensions.T @ (links.stiffness[:, None] * extensions)
    damping = extensions.T @ (links.damping[:, None] * extensions)
    rotations = ends @ pitches
    if links.rotational_stiffness is not None:
        stiffness = stiffness + rotations.T @ (links.rotational_stiffness[:, None] * rotations)
    if links.rotational_damping is not None:
        damping = damping + rotations.T @ (links.rotational_damping[:, None] * rotations)
    total = stiffness + wheel_map.T @ (wheels.stiffness[:, None] * wheel_map)
    sag = solve(total, heights.T @ bodies.masses)  # under unit gravity, downwards
    static_loads = gravity * (wheels.stiffness * (wheel_map @ sag) + wheels.masses)
    return VehicleModel(
        wheels.positions[0] - wheels.positions,
        static_loads,
        wheels.masses,
        wheels.stiffness,
        wheels.damping,
        mass,
        damping,
        stiffness,
        wheel_map,
        names,
    )


def _incidence(pairs: Pairs, body_count: int) -> Float[np.ndarray, "pair body"]:
    """1 and -1 at the two bodies of each pair."""
    one = np.eye(body_count)
    return np.array([one[first] - one[second] for first, second in pairs]).reshape(-1, body_count)


def _coordinates(bodies: Bodies, hinges: Hinges):
    """Heights and pitches of the bodies by the degrees of freedom, (body, dof), and their names."""
    names, height_columns, pitches = [], [], []
    for name, inertia in zip(bodies.names, bodies.inertias, strict=True):
        height_columns.append(len(names))
        names.append(name)
        if inertia is not None:
            names.append(f"{name} pitch")
    one = np.eye(len(names))
    for column, inertia in zip(height_columns, bodies.inertias, strict=True):
        pitches.append(np.zeros(len(names)) if inertia is None else one[column + 1])
    rows = [one[column] for column in height_columns]
    # Hinged bodies are groups with one free height, that of their first body.
    group, eliminated = list(range(len(rows))), []
    for i, (first, second) in enumerate(hinges.pairs):
        if group[first] > group[second]:
            first, second = second, first
        keep, leave = group[first], group[second]
        point = hinges.positions[i]
        difference = (
            rows[first]
            + (point - bodies.positions[first]) * pitches[first]
            - rows[second]
            - (point - bodies.positions[second]) * pitches[second]
        )
        members = [j for j, one_group in enumerate(group) if one_group == leave]
        for j in members:
            rows[j] = rows[j] + difference
            group[j] = keep
        eliminated.append(height_columns[leave])
    kept = np.array([j for j in range(len(names)) if j not in eliminated], int)
    heights = xp.stack(rows)[:, kept]
    return heights, np.array(pitches)[:, kept], tuple(names[j] for j in kept)
