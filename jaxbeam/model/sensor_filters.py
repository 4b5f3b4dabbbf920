"""The rig with the filters that act on what its sensors see before samples are taken of it."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Float

from jaxbeam.case.filters import analogue
from jaxbeam.model.modal_model import Rig
from jaxbeam.model.state_space import LoadedBeam


def sensed(model: LoadedBeam) -> tuple[Rig, Float[Array, "sensor state"]]:
    """The rig with the states of its sensors' analogue filters, and what the sensors see of it.

    Rows of acceleration sensors are zero: they see forces too. States of filters that a controller
    brings along follow, and rows of their outputs.
    """
    case, rig = model.case, model.rig
    states, modal = rig.states, 2 * model.scale.shape[0]
    parts, feeds, rows = [rig.state_matrix[0]], [], []
    for sensor in case.sensors:
        derivative = {"slope": 1, "strain": 2}.get(sensor.quantity, 0)
        shape = rig.shapes(sensor.position, (derivative,))[0]
        if sensor.quantity == "strain":
            shape = -sensor.fibre_distance * shape
        if sensor.quantity == "acceleration":
            shape = jnp.zeros_like(shape)
        first = 1 if sensor.quantity == "velocity" else 0
        row = jnp.zeros(states).at[first:modal:2].set(shape)
        if sensor.filter is None or sensor.filter.realisation != "analogue":
            rows.append({0: row})
            continue
        matrix, column, output, _ = analogue(sensor.filter)
        feeds.append((len(parts), column, {0: row}))
        rows.append({len(parts): output})
        parts.append(matrix)
    for own in () if case.controller is None else case.controller.own_filters():
        seen = rows[own.sensor]
        feeds.append((len(parts), own.B, seen))
        rows.append({place: own.D * row for place, row in seen.items()} | {len(parts): own.C})
        parts.append(own.A)
    starts = np.cumsum([0, *(part.shape[0] for part in parts)])
    total = int(starts[-1])

    def spread(row):
        """A row over some of the parts as one over all states."""
        pieces = [row.get(i, jnp.zeros(part.shape[0])) for i, part in enumerate(parts)]
        return jnp.concatenate(pieces)

    whole = block_diag(*parts)
    for i, column, row in feeds:
        whole = whole.at[starts[i] : starts[i + 1]].add(jnp.outer(column, spread(row)))
    seen = jnp.stack([spread(row) for row in rows]) if rows else jnp.zeros((0, total))
    command = jnp.zeros((total, rig.command_matrix.shape[1])).at[:states].set(rig.command_matrix)
    wide = eqx.tree_at(lambda r: (r.state_matrix, r.command_matrix), rig, (whole[None], command))
    return wide, seen
