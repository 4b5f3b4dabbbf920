"""Mode shapes from known poles: least-squares frequency-domain method (LSFD)."""

import numpy as np
from jaxtyping import Complex, Float

from tuning.modal.spectral.impulse_responses import FrequencyResponses


def residue_shapes(
    values: Complex[np.ndarray, "line output input"],
    z: Complex[np.ndarray, " line"],
    roots: Complex[np.ndarray, " mode"],
    participations: Complex[np.ndarray, "mode input"],
) -> Complex[np.ndarray, "mode output"]:
    """Shapes psi_r of H = sum_r psi_r l_r^T / (z - z_r) + conjugates + real c_-1 / z + c_0 + c_1 z.

    The last terms, for each output and input, stand for modes outside of the band.
    """
    inputs = values.shape[2]
    one = participations / (z[:, None, None] - roots[:, None])  # line, mode, input
    other = participations.conj() / (z[:, None, None] - roots.conj()[:, None])
    terms = np.concatenate([one + other, 1j * (one - other)], axis=1)
    rest = np.kron(z[:, None, None] ** np.array([-1, 0, 1])[:, None], np.eye(inputs))
    columns = np.concatenate([terms, rest.reshape(len(z), -1, inputs)], axis=1)
    matrix = columns.transpose(0, 2, 1).reshape(len(z) * inputs, -1)
    right = values.transpose(0, 2, 1).reshape(len(z) * inputs, -1)
    found = np.linalg.lstsq(
        np.concatenate([matrix.real, matrix.imag]), np.concatenate([right.real, right.imag]),
        rcond=None,
    )[0]  # fmt: skip
    count = roots.size
    return found[:count] + 1j * found[count : 2 * count]


def shapes_with_covariance(
    responses: FrequencyResponses,
    roots: Complex[np.ndarray, " mode"],
    root_changes: Complex[np.ndarray, "block mode"],
    participations: Complex[np.ndarray, "mode input"],
) -> tuple[Complex[np.ndarray, "mode output"], Float[np.ndarray, "mode part part"]]:
    """Shapes by residues, and the covariance of their real, then imaginary parts.

    Shapes of it have a largest component of one. Deviations of the responses and of the roots in
    each block are carried through the least squares.
    """
    z = responses.z
    shapes = residue_shapes(responses.values, z, roots, participations)
    largest = np.argmax(np.abs(shapes), axis=1)
    rows = np.arange(roots.size)
    unit = shapes / shapes[rows, largest][:, None]
    parts = []
    for change, moved in zip(responses.changes, root_changes, strict=True):
        own = residue_shapes(responses.values + change, z, roots + moved, participations)
        difference = own / own[rows, largest][:, None] - unit
        parts.append(np.concatenate([difference.real, difference.imag], axis=1))
    stacked = np.stack(parts)
    return shapes, np.einsum("bmp,bmq->mpq", stacked, stacked)
