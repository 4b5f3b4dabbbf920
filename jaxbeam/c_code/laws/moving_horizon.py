"""C code of moving-horizon estimation: all but the readings is known over the crossing."""

import numpy as np

from jaxbeam.c_code.laws.estimators import FilterModel, transition_matrices, write_filter_step
from jaxbeam.c_code.quadratic_programs import write_solution
from jaxbeam.c_code.source import CSource
from jaxbeam.c_code.tables import at_samples
from jaxbeam.c_code.writers import EstimateCode, write_filter
from jaxbeam.estimation.constant_gain import sensor_offsets
from jaxbeam.estimation.crossing_filter import corrected
from jaxbeam.estimation.moving_horizon.window_filter import BoundFactor, WindowFilter
from jaxbeam.runtime.arrays import xp


@write_filter.register
def _(filter: WindowFilter, code: CSource) -> EstimateCode:
    plant, states = filter.filter.filtered.plant, filter.rows.shape[1]

    def model(t):
        transition, C, D = filter.filter.model_at(t)
        _, *inputs = transition_matrices(transition)
        on_beam = xp.where(plant.loads.on_beam(t), 1.0, 0.0)
        return *filter.joint(transition, C), *inputs, D, on_beam

    A, noise, C, *inputs, D, on_beam = at_samples(model, code)
    previous, present = (np.pad(part, ((0, 0), (0, filter.earlier), (0, 0))) for part in inputs)
    gains, factors = [], []
    start, of_readings = filter.initial_state(), filter.filter.sensor_chain.noise_covariance
    covariance = np.asarray(start.covariance)
    for k in range(len(A)):
        covariance = A[k] @ covariance @ A[k].T + noise[k]
        gain, covariance = (np.asarray(part) for part in corrected(covariance, C[k], of_readings))
        gains.append(gain)
        factors.append(filter.factor(covariance))
    x = code.state("estimate", start.mean, "states of beam, loads and sensors; deflections before")
    model_at_samples = FilterModel(A, previous, present, C, D, np.stack(gains))
    write_filter_step(code, model_at_samples, sensor_offsets(plant), x)
    if filter.bounds()[0].shape[0]:
        x = _write_bounds(filter, factors, code, x)
    added, vehicles = plant.modal_model.state_count, plant.vehicle_states
    weights, wheels = None, filter.weight_rows.shape[0]
    if wheels:
        weights = code.work("weights", wheels, "estimated weights, zero off the beam (N)")
        mask = code.per_sample("on_beam", on_beam.reshape(len(A), -1))
        first = int(np.argmax(np.asarray(filter.weight_rows)[0]))
        code.add(
            f"for (i = 0; i < {wheels}; i++) {weights}[i] = {mask}[i] * {x}[{first} + i];", wheels
        )
    assert added + vehicles <= states
    return EstimateCode(
        x, filter.filter.plant_states, weights, wheels, f"{x} + {added}" if vehicles else None
    )


def _write_bounds(filter: WindowFilter, factors: list[BoundFactor], code: CSource, x: str) -> str:
    """Most probable states within the bounds; their C expression."""
    rows, lowest, highest = (np.asarray(part) for part in filter.bounds())
    states, (count, joint) = filter.rows.shape[1], rows.shape
    size, root, columns, certain = (
        np.stack([np.asarray(part) for part in parts]) for parts in zip(*factors, strict=True)
    )
    limits = np.concatenate([highest, -lowest])
    finite = np.isfinite(limits)
    limits, both = limits[finite], np.concatenate([rows, -rows])[finite]

    def of_both(part):
        return np.concatenate([part, part], axis=1)[:, finite]

    free, size = of_both(certain)[..., None], of_both(size)[..., None]
    G = np.where(free, 0.0, np.concatenate([root, -root], axis=1)[:, finite])
    norms = np.sqrt(np.sum(G**2, axis=2, keepdims=True))
    norms = np.where(norms > 0, norms, 1.0)
    sides = np.where(free, 1.0, limits[:, None] / size / norms)
    sides_by_states = np.where(free, 0.0, both / size / norms)
    h = code.work("bounds", len(limits), "right-hand sides of the bounds")
    z = code.work("correction", count, "independent numbers of the correction")
    within = code.work("within", states, "most probable states within the bounds")
    code.add("/* Most probable states within the bounds: minimise |z| subject to G z <= h */")
    code.add(
        f"copy({h}, {code.per_sample('bound', sides)}, {len(limits)});\n"
        f"for (i = 0; i < {count}; i++) {z}[i] = 0;"
    )
    matrix = code.per_sample("bound_rows", sides_by_states)
    code.multiply_add(h, matrix, x, len(limits), joint, -1)
    G = code.per_sample("bound_matrix", G / norms)
    counter = "bound_failures", "samples at which no states within the bounds were found"
    write_solution(code, "interior", h, G, z, len(limits), count, counter)
    columns = code.per_sample("correction_columns", columns[:, :states])
    code.add(f"copy({within}, {x}, {states});")
    code.add(
        f"if (solved) multiply_add({within}, 1, {columns}, {z}, {states}, {count});",
        2 * states * (count + 1),
    )
    return within
