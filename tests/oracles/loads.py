"""Trajectory of a load along a beam at constant deceleration, shared by the oracles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

GRAVITY = 9.81  # m/s^2


@dataclass(frozen=True)
class Load:
    """A load that enters at the left end, or at the right end if its speed is negative."""

    mass: float  # kg
    speed: float  # m/s at entry
    entry_time: float = 0.0  # s
    deceleration: float = 0.0  # m/s^2, against the travel; a load that stops stays
    kind: str = "mass"  # or "force", which is the weight of `mass` alone

    def time_at(self, distance: float) -> float:
        """Time (s) at which the load has travelled `distance` (m); infinite if it never does."""
        v, a = abs(self.speed), self.deceleration
        root = v**2 - 2.0 * a * distance
        return self.entry_time + 2.0 * distance / (v + root**0.5) if root >= 0.0 else np.inf

    @property
    def stop_time(self) -> float:
        a = self.deceleration
        return self.entry_time + abs(self.speed) / a if a > 0.0 else np.inf

    def motion(self, t: float, length: float, stopped: bool) -> tuple[float, float, float]:
        """Position, velocity and acceleration along the beam at time t.

        The caller says whether it has `stopped`: at the stop itself the acceleration jumps.
        """
        s = min(t, self.stop_time) - self.entry_time if stopped else t - self.entry_time
        v, a = abs(self.speed), self.deceleration
        x, dx, ddx = v * s - 0.5 * a * s**2, v - a * s, -a
        if stopped:
            dx, ddx = 0.0, 0.0
        return (x, dx, ddx) if self.speed > 0.0 else (length - x, -dx, -ddx)
