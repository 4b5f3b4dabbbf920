"""Force over time, as a sum of waves and a table."""

import numpy as np
from jaxtyping import Float

from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.module import Module


class ForceHistory(Module):
    """Force (N, positive downwards) over time, in addition to a constant one.

    The sum of A sin(2 pi f t + phase) and of a table of forces at times, with straight lines
    between them, constant before and after; t in s. Runs of a batch differ along a last axis.
    """

    frequencies: Float[Array, "wave *batch"]
    amplitudes: Float[Array, "wave *batch"]
    phases: Float[Array, "wave *batch"]
    times: Float[Array, "entry *batch"]
    forces: Float[Array, "entry *batch"]

    def at(self, times: Float[Array, "*time"]) -> Float[Array, "*time_and_batch"]:
        """Force (N) at times (s), the batch axis last."""
        batch = (1,) * (self.amplitudes.ndim - 1)
        t = xp.asarray(times).reshape(*xp.shape(times), 1, *batch)
        axis = -1 - len(batch)
        angles = 2 * np.pi * self.frequencies * t + self.phases
        force = xp.sum(self.amplitudes * xp.sin(angles), axis=axis)
        if self.times.shape[0] == 0:
            return force
        slopes = xp.diff(self.forces, axis=0) / xp.diff(self.times, axis=0)
        elapsed = xp.clip(t - self.times[:-1], 0.0, xp.diff(self.times, axis=0))
        return force + self.forces[0] + xp.sum(slopes * elapsed, axis=axis)
