"""From the beam to the readings: samples under way and digital filters, as states at the ticks.

The states just before a tick are z = (x, h, m, v): those x of the plant with the sensors' analogue
filters; for a sensor with a delay what it saw when it last looked, when it looked before, and so
on; the memories m of digital filters; and the noise v of the samples that these take at the tick.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.filters import filter_step
from jaxbeam.estimation.sampled_plant import ROUNDING, Ticks, Transition
from jaxbeam.model.sensor_filters import sensed
from jaxbeam.model.sensor_signals import Sections, design
from jaxbeam.model.state_space import LoadedBeam, StateSpace

# Of the noise of its samples, what a digital filter is taken to add to its output. Without it the
# filter would be undone exactly, and what it all but stops be taken for known.
FLOOR = 1e-3

# The plant at a time (s), its outputs what the sensors see.
Seen = Callable[[Float[Array, ""]], StateSpace]


class Sight(eqx.Module):
    """A loaded beam with its sensors' analogue filters: `seen` is what they make of its states."""

    model: LoadedBeam
    seen: Float[Array, "sensor state"]

    def behind(self, system: StateSpace) -> StateSpace:
        """A system of the model, its outputs behind the analogue filters."""
        filters = [sensor.filter for sensor in self.model.case.sensors]
        smooth = np.array([f is not None and f.realisation == "analogue" for f in filters])
        if not smooth.any():
            return system
        seen = self.seen @ self.model.to_rig(jnp.eye(self.seen.shape[1]))
        seen = jnp.pad(seen, ((0, 0), (0, system.C.shape[1] - seen.shape[1])))
        C = jnp.where(smooth[:, None], seen, system.C)
        D = jnp.where(smooth[:, None], 0.0, system.D)
        return eqx.tree_at(lambda s: (s.C, s.D), system, (C, D))


def sight(model: LoadedBeam) -> Sight:
    """A model with the analogue filters of its sensors."""
    wide, seen = sensed(model)
    return Sight(eqx.tree_at(lambda m: m.rig, model, wide), seen)


class Chain(eqx.Module):
    """Which states the sensors add to `plant` of the plant, and how they go on.

    `sections` are those of digital filters, `lags` (s) the delays of the sensors, None where there
    is none; `variance` is that of the noise of their samples. A delay may reach back over `reach`
    periods.
    """

    sections: tuple[Sections, ...]
    lags: tuple[Float[Array, ""] | None, ...]
    variance: Float[Array, " sensor"]
    clock: Ticks
    plant: int = eqx.field(static=True)
    reach: int = eqx.field(static=True)

    @property
    def size(self) -> int:
        """The number of all states."""
        return self._layout()[-1]

    @property
    def noise(self) -> Float[Array, "sensor sensor"]:
        """Covariance of the noise that readings have beside that among the states."""
        digital = np.array([part is not None for part in self.sections])
        return jnp.diag(jnp.where(digital, FLOOR**2, 1.0) * self.variance)

    def rows(self, C, D) -> tuple[Float[Array, "sensor all"], Float[Array, "sensor actuator"]]:
        """What takes the states just before a tick, and the commands, to the readings."""
        return self._slopes(C, D, 0)

    def onward(self, plant: Seen, intensity, scale, t=0.0) -> Transition:
        """The states from just before the tick a period before t (s) to just before that at t.

        White noise of this intensity acts on the rates of the plant; see `Ticks.transition`.
        """
        extra = self.size - self.plant

        def rates(time):
            system = plant(time)
            return system.A, system.B

        start = t - self.clock.period
        before = plant(start)
        drift, direct = self._slopes(before.C, before.D, 1)
        whole = Transition(drift, direct, jnp.zeros_like(direct), jnp.zeros_like(drift))
        looks = {i: self._late(lag)[1] for i, lag in enumerate(self.lags) if lag is not None}
        parts, ends, early = self.clock.parts(rates, intensity, scale, t, list(looks.values()))
        for k, part in enumerate(parts):
            still = jax.scipy.linalg.block_diag(part.drift, np.eye(extra))
            before, after = (jnp.pad(x, ((0, extra), (0, 0))) for x in (part.before, part.after))
            noise = jnp.pad(part.noise, ((0, extra), (0, extra)))
            whole = whole.then(Transition(still, before, after, noise))
            for i, look in looks.items():
                system, now = plant(start + ends[k]), ends[k] == look
                whole = whole.then(self._looked(i, system.C[i], system.D[i], now, early[k]))
        fresh = jnp.zeros(self.size)
        for place, variance in zip(self._layout()[2], self.variance, strict=True):
            fresh = fresh if place is None else fresh.at[place].set(variance)
        return eqx.tree_at(lambda w: w.noise, whole, whole.noise + jnp.diag(fresh))

    def _looked(self, sensor, row, direct, now, early) -> Transition:
        """What a look of a sensor adds, if it is now: its signal becomes the latest sample."""
        place = self._layout()[0][sensor]
        keep = jnp.eye(self.size)
        seen = jnp.pad(row, (0, self.size - self.plant))
        drift = keep.at[place].set(jnp.where(now, seen, keep[place]))
        push = jnp.zeros((self.size, direct.shape[0]))
        before, after = (
            push.at[place].set(jnp.where(now & acts, direct, 0.0)) for acts in (early, ~early)
        )
        return Transition(drift, before, after, jnp.zeros_like(keep))

    def _slopes(self, C, D, which: int):
        """What takes states and commands to the readings (0), or to the states after a tick (1)."""

        def tick(state, command):
            return self._tick(state, C @ state[: self.plant] + D @ command)[which]

        return jax.jacfwd(tick, (0, 1))(jnp.zeros(self.size), jnp.zeros(D.shape[1]))

    def _tick(self, state, signals):
        """Readings of the states just before a tick, and the states just after it."""
        looks, memories, noises, _ = self._layout()
        readings, after = [], state
        for i, sections in enumerate(self.sections):
            sample, lag = signals[i], self.lags[i]
            if lag is not None:
                seen = state[looks[i] : looks[i] + self.reach + 1]
                sample = seen @ jax.nn.one_hot(self._late(lag)[0], self.reach + 1, dtype=float)
                after = after.at[looks[i] + 1 : looks[i] + self.reach + 1].set(seen[:-1])
            if sections is not None:
                place = slice(memories[i], memories[i] + 2 * sections.shape[0])
                memory = state[place].reshape(-1, 2)
                sample, memory = filter_step(sections, memory, sample + state[noises[i]])
                after = after.at[place].set(memory.reshape(-1)).at[noises[i]].set(0.0)
            readings.append(sample)
        return jnp.stack(readings), after

    def _late(self, lag) -> tuple[Array, Array]:
        """Whole periods in a delay, and how far into each period (s) the sensor looks."""
        whole = jax.lax.stop_gradient(jnp.floor(lag / self.clock.period + ROUNDING))
        left = jnp.maximum(lag - whole * self.clock.period, 0.0)
        return whole.astype(int), self.clock.period - left

    def _layout(self) -> tuple[list, list, list, int]:
        """Where samples, memories and noises of each sensor begin, None for none; and the end."""
        end = self.plant
        starts = [], [], []
        for sections, lag in zip(self.sections, self.lags, strict=True):
            lengths = (
                0 if lag is None else self.reach + 1,
                0 if sections is None else 2 * sections.shape[0],
                0 if sections is None else 1,
            )
            for places, length in zip(starts, lengths, strict=True):
                places.append(end if length else None)
                end += length
        return *starts, end


def chain(
    model: LoadedBeam, variance: Float[Array, " sensor"], clock: Ticks, plant: int, reach: int
) -> Chain:
    """The chain of a case's sensors behind so many states of a plant."""
    sensors = model.case.sensors
    sections = tuple(design(sensor, clock.period) for sensor in sensors)
    lags = tuple(sensor.delay for sensor in sensors)
    return Chain(sections, lags, variance, clock, plant, reach)
