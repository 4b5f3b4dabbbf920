"""Static equilibrium of a beam whose supports have settled, and the surface it gives to wheels.

A run starts at rest in this equilibrium w_s(x). Equations of motion are linear, so that everything
that moves is measured from it; a wheel at x rolls over the settled surface, the profile r + w_s.
"""

import dataclasses

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.declared_checks import check_on_beam
from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.case.profiles.shapes import AbstractProfile
from jaxbeam.case.validation import check_case
from jaxbeam.model.layout import Layout, find_layout, kink_nodes
from jaxbeam.model.theory.elements import nodal_unknowns
from jaxbeam.model.theory.statics import LEAST_STIFFNESS, Transfer, nodal_system
from jaxbeam.numerics.polynomials import piecewise_chebyshev, slope_jumps
from jaxbeam.runtime.arrays import Array, set_at, solve, xp
from jaxbeam.runtime.module import Module


class SettledBeam(Module):
    """Static fields of a beam on settled supports, between the nodes of its `transfer` matrices.

    `left_states` are the states (w, phi, M, S) at the left of each part, in beam units.
    """

    transfer: Transfer
    left_states: Float[Array, "part 4"]
    length: Float[Array, ""]

    def field(self, x, order: int = 0) -> Float[Array, "*position"]:
        """Field of an order (see `Modes.fields`) at positions x (m): 0 is the deflection w_s."""
        y = xp.asarray(x, float) / self.length
        states = piecewise_chebyshev(self.transfer.nodes, self._series(), y, (0,))[0]
        field = xp.sum(self.transfer.section(y).rows(order) * states, axis=-1)
        return field * self.length ** (1 - abs(order))  # SLOPE, of order -1, is w'

    def surface(
        self, below: AbstractProfile | None, kinks: tuple[int, ...] = ()
    ) -> "SettledSurface":
        """Surface of the beam with the profile of the road or track on it, and its `kinks`."""
        nodes = self.transfer.nodes * self.length
        return SettledSurface(below, nodes, self._series()[..., :1] * self.length, kinks)

    def _series(self) -> Float[Array, "part degree 4"]:
        parts, terms, _ = self.transfer.series.shape
        entries = self.transfer.series.reshape(parts, terms, 4, 4)
        return xp.einsum("pdij,pj->pdi", entries, self.left_states)


class SettledSurface(Module):
    """Height r + w_s of the surface of a settled beam; level with its ends before and behind it.

    Embankments settle with the ends. A slope w_s' at an end is that of a joint: wheels with mass
    enter without impact, as they do where the beam vibrates. `kink_nodes` are the inner nodes at
    which w_s' may jump.
    """

    below: AbstractProfile | None
    nodes: Float[Array, " node"] | None
    series: Float[Array, "part degree 1"] | None
    kink_nodes: tuple[int, ...] = eqx.field(static=True, default=())

    def heights(self, x):
        """Height (m), slope and curvature (1/m), as those of a profile.

        Raises RuntimeError where the load set was made without the layout of a traced case.
        """
        if self.nodes is None:
            raise RuntimeError("the surface of a settled beam needs the layout: load_set(case, it)")
        x = xp.asarray(x, float)
        start, end = self.nodes[0], self.nodes[-1]
        parts = piecewise_chebyshev(self.nodes, self.series, xp.clip(x, start, end), (0, 1, 2))
        height, slope, curvature = parts[..., 0]
        inside = (x >= start) & (x <= end)
        own = height, xp.where(inside, slope, 0.0), xp.where(inside, curvature, 0.0)
        if self.below is None:
            return own
        return tuple(a + b for a, b in zip(own, self.below.heights(x), strict=True))

    def kinks(self) -> Float[Array, " kink"]:
        """Positions (m) at which the slope or curvature of the profile jumps; nodes come anyway."""
        return xp.zeros(0) if self.below is None else self.below.kinks()

    def slope_kinks(self) -> tuple[Float[Array, " kink"], Float[Array, " kink"]]:
        """Positions (m) at which the slope jumps, and by how much, as those of a profile."""
        own = xp.zeros(0), xp.zeros(0)
        if self.kink_nodes and self.nodes is not None:
            index = np.array(self.kink_nodes)
            own = self.nodes[index], slope_jumps(self.nodes, self.series)[index - 1, 0]
        if self.below is None:
            return own
        parts = zip(own, self.below.slope_kinks(), strict=True)
        positions, jumps = (xp.concatenate(pair) for pair in parts)
        return positions, jumps


def has_settlement(case: Case) -> bool:
    """Whether a support of a case has a settlement."""
    return any(support.settlement is not None for support in case.supports)


def surface(case: Case, layout: Layout | None = None) -> Module | None:
    """Surface under the wheels of a case: its profile, and the settled beam; None if level."""
    if not has_settlement(case):
        return case.profile
    numbers = case.beam.length, *(support.position for support in case.supports)
    if layout is None and not all(map(is_concrete, numbers)):
        return SettledSurface(case.profile, None, None)
    layout = find_layout(case) if layout is None else layout
    parts = layout.parts or (1,) * len(layout.degrees)
    kinks = tuple(sum(parts[:node]) for node in kink_nodes(case, layout))
    return settled_beam(case, layout).surface(case.profile, kinks)


def settled_beam(case: Case, layout: Layout | None = None, settlements=None) -> SettledBeam:
    """Static equilibrium of a beam from settlements (support,) in m, by default those of the case.

    The foot of an elastic support settles, and its spring pulls. Patches settle with the beam;
    suspensions of actuators are without force afterwards. Displacements of the nodes that rigid
    supports prescribe move the others by K_ff d_f = -K_fh d_h + k s. `layout` (from `mesh_layout`)
    is needed where numbers of the case are traced.

    Raises ValueError for a beam of concrete numbers that is not held in place.
    """
    layout = find_layout(case) if layout is None else layout
    if settlements is None:
        settlements = [0.0 if s.settlement is None else s.settlement for s in case.supports]
    if not layout.parts:  # of a uniform beam, which needs no parts for its own statics
        elements = len(layout.degrees)
        layout = dataclasses.replace(layout, segments=(0,) * elements, parts=(1,) * elements)
    released = dataclasses.replace(
        layout, constrained=tuple((False, clamped) for _, clamped in layout.constrained)
    )
    system = nodal_system(case, released, suspended=False)
    unknowns, length = nodal_unknowns(case, released)[0], case.beam.length
    unit = length**3 / case.beam.bending_stiffness
    size = system.stiffness.shape[0]
    displacement, force, held = xp.zeros(size), xp.zeros(size), []
    for i, (node, (is_held, _)) in enumerate(zip(layout.nodes, layout.constrained, strict=True)):
        w = unknowns[i][0]
        here = [index - 2 for index in node if 2 <= index < 2 + len(case.supports)]
        for n in here:
            foot, stiffness = -settlements[n] / length, case.supports[n].stiffness
            if stiffness is None:
                displacement = set_at(displacement, w, foot)
            elif not is_held:
                force = set_at(force, w, force[w] + stiffness * unit * foot)
        if is_held:
            held.append(w)
    free = np.setdiff1d(np.arange(size), held)
    stiffness = system.stiffness[np.ix_(free, free)]
    checked = free.size > 0 and is_concrete(stiffness)
    if checked and np.linalg.eigvalsh(concrete(stiffness))[0] <= LEAST_STIFFNESS:
        raise ValueError(
            "supports settle, but do not hold the beam in place: clamp an end, or add supports"
        )
    right = force[free] - system.stiffness[np.ix_(free, held)] @ displacement[np.array(held, int)]
    displacement = set_at(displacement, free, solve(stiffness, right))
    padded = xp.concatenate([displacement, xp.zeros(1)])  # -1: no displacement
    at_ends = padded[system.unknowns]
    left, over = at_ends[:, :2, None], at_ends[:, 2:, None]
    across = system.transfer.across()
    forces = system.force_of_deflection @ (over - across[:, :2, :2] @ left)
    states = xp.concatenate([left, forces], axis=1)[..., 0]
    return SettledBeam(system.transfer, states, length)


def settlement_response(
    case: Case, settlements, x, derivative: int = 0
) -> Float[Array, "*position"]:
    """Static deflection (m, positive upwards) at x (m) from settlements of the supports.

    `settlements` (support,) in m, positive downwards, are those of the `supports` of the case,
    rigid or elastic, in place of their own; an end settles as a rigid support at its position.
    `derivative` is that of `influence_line`: with 2, times the bending stiffness, it is a bending
    moment. Differentiable in settlements and stiffnesses; positions of supports must be concrete.

    Raises ValueError as `influence_line` does, and for a number of settlements other than that of
    the supports.

    >>> import jaxbeam as jb
    >>> two_spans = jb.Case(
    ...     jb.Beam(length=4.0, flexural_rigidity=6.0, mass_per_length=1.0), [jb.Support(2.0)]
    ... )
    >>> curvature = jb.statics.settlement_response(two_spans, [0.1], x=2.0, derivative=2)
    >>> print(f"{6.0 * curvature:.3f} N m")  # 3 E I s / l^2
    0.450 N m
    """
    check_case(case)
    x, settlements = xp.asarray(x, float), xp.asarray(settlements, float)
    check_on_beam("x", x, case.beam.length)
    if settlements.shape != (len(case.supports),):
        raise ValueError(
            f"settlements must be one for each of the {len(case.supports)} supports; their shape"
            f" is {settlements.shape}"
        )
    return settled_beam(case, settlements=settlements).field(x, derivative)
