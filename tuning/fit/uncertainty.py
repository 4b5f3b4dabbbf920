"""Uncertainty of fitted parameters where linearised fits do not hold: profiles, and samples.

Samples of the posterior are those of no-U-turn sampling (Hoffman and Gelman, 2014) by blackjax, the
extra `bayes`. Profiles are of the misfit over a parameter.
"""

import dataclasses
import os
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from jaxbeam.case.fields import refuses_traced
from jaxbeam.files.report import ReportTable
from jaxbeam.plot.style import COLOURS, FAINT, INK, use_style
from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.packages import import_extra
from jaxbeam.runtime.printer import TableViews, text_table
from tuning.checkpoint import NO_CHECKPOINT, Checkpoint, checkpoint_path, fingerprint
from tuning.fit.least_squares import t_quantile
from tuning.fit.result import Fit

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX

NOISE_MODELS = ("fixed", "estimated")
DRAWS_PER_BLOCK = 100  # draws between two checkpoints
MAX_R_HAT = 1.05  # beyond it chains have not mixed
MIN_EFFECTIVE_DRAWS = 100  # below it intervals are not reliable


@dataclasses.dataclass(frozen=True, eq=False)
class Posterior(TableViews):
    """Posterior draws (chain, draw, parameter) of the free parameters (SI units), with diagnostics.

    `r_hat` is the ratio of the spread between chains to that within (1 for chains that have mixed),
    `effective_draws` the number of independent draws; `divergences` counts divergent steps.
    """

    addresses: list[str]
    draws: Float[np.ndarray, "chain draw parameter"]
    r_hat: Float[np.ndarray, " parameter"]
    effective_draws: Float[np.ndarray, " parameter"]
    divergences: int

    @property
    def means(self) -> Float[np.ndarray, " parameter"]:
        """Means of the draws."""
        return self.draws.mean(axis=(0, 1))

    @property
    def deviations(self) -> Float[np.ndarray, " parameter"]:
        """Standard deviations of the draws."""
        return self.draws.std(axis=(0, 1))

    @property
    def intervals(self) -> Float[np.ndarray, "parameter 2"]:
        """Central 95 % intervals."""
        return np.quantile(self.draws, [0.025, 0.975], axis=(0, 1)).T

    @property
    def verdict(self) -> str:
        """Whether the draws are reliable, in a sentence."""
        if not np.all(self.r_hat < MAX_R_HAT):
            return f"the chains have not mixed (R-hat up to {self.r_hat.max():.3f}): draw more"
        if not np.all(self.effective_draws > MIN_EFFECTIVE_DRAWS):
            return f"only {self.effective_draws.min():.0f} effective draws: draw more"
        if self.divergences > 0.01 * self.draws[..., 0].size:
            return f"{self.divergences} divergent steps: parts of the posterior are not sampled"
        draws = f"{self.effective_draws.min():.0f} effective draws"
        return f"mixed: R-hat up to {self.r_hat.max():.3f}, {draws}"

    def _rows(self) -> Iterator[tuple]:
        """Address, mean, deviation, interval, R-hat and effective draws of each parameter."""
        moments = self.means, self.deviations, self.intervals
        return zip(self.addresses, *moments, self.r_hat, self.effective_draws, strict=True)

    def to_dict(self) -> dict:
        """Means, deviations, intervals and diagnostics by address, and the verdict, for JSON."""
        numbers = {
            address: {
                "mean": float(mean),
                "deviation": float(deviation),
                "interval_95": interval.tolist(),
                "r_hat": float(r_hat),
                "effective_draws": float(effective),
            }
            for address, mean, deviation, interval, r_hat, effective in self._rows()
        }
        return {"numbers": numbers, "verdict": self.verdict}

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """Address, mean, deviation, 95 % interval and diagnostics of each parameter, by head."""
        return {
            "parameter": np.array(self.addresses),
            "mean": self.means,
            "deviation": self.deviations,
            "95 % from": self.intervals[:, 0],
            "95 % to": self.intervals[:, 1],
            "R-hat": np.asarray(self.r_hat),
            "effective draws": np.asarray(self.effective_draws),
        }

    def to_inference_data(self) -> "xarray.DataTree":
        """Draws as ArviZ reads them: group "posterior", a variable (chain, draw) per address.

        ArviZ 1.0 and later take a DataTree of xarray for inference data, as `arviz.summary(tree)`.
        """
        import xarray

        chains, draws, _ = self.draws.shape
        variables = {
            address: (("chain", "draw"), self.draws[..., i])
            for i, address in enumerate(self.addresses)
        }
        coordinates = {"chain": np.arange(chains), "draw": np.arange(draws)}
        group = xarray.Dataset(variables, coordinates, {"inference_library": "jaxbeam"})
        return xarray.DataTree.from_dict({"posterior": group})

    @property
    def table(self) -> ReportTable:
        """Table of means, deviations, intervals and diagnostics of the parameters."""
        rows = [
            (name, f"{mean:.6g}", f"{sd:.2g}", f"{low:.5g} to {high:.5g}", f"{r:.3f}", f"{n:.0f}")
            for name, mean, sd, (low, high), r, n in self._rows()
        ]
        header = ("parameter", "mean", "deviation", "95 % interval", "R-hat", "effective draws")
        return ReportTable(header, rows)

    def __str__(self) -> str:
        lines = text_table(self.table.header, self.table.rows, "<>><>>")
        return "\n".join([*lines, self.verdict])


@refuses_traced("a posterior")
def sample(
    fit: Fit,
    draws: int = 500,
    chains: int = 4,
    warmup: int = 200,
    seed: int = 0,
    checkpoint: str | os.PathLike | None = None,
    resume: bool = False,
    noise: str = "fixed",
) -> Posterior:
    """Sample the posterior of the parameters of a fit, from likelihood, priors and bounds.

    With the noise "fixed" it is that of the fit, widened for autocorrelation; with "estimated" the
    level of each channel is unknown with the prior 1 / level, and integrated out (Gelman and
    others, section 3.2). A parameter without a prior is uniform within its bounds. Chains start
    around the fit, scattered by its standard errors, and the sampler works in variables whitened
    by its covariance.

    With a `checkpoint` file sampling can be stopped at any time; with `resume` it goes on, to the
    same draws.

    Raises ValueError for a direction that is not identifiable and has no prior, an unknown word
    for the noise, and a checkpoint that is damaged or of another sampling; FileExistsError if the
    checkpoint exists and `resume` is not set; ImportError without blackjax.

    The No-U-Turn sampler runs `chains` at once, and adapts in `warmup` steps that are dropped.

    >>> import tuning
    >>> fit = tuning.load_fit("fit.npz")
    >>> posterior = tuning.fit.sample(fit, draws=20, chains=2, warmup=20)
    >>> print(posterior.addresses, f"{posterior.means[0]:.1f}")
    ['beam.flexural_rigidity'] 12.0
    """
    if fit.unidentifiable:
        raise ValueError(
            f"not identifiable from the data: {', '.join(fit.unidentifiable[0])}; give a prior, or "
            "a value known otherwise, before sampling"
        )
    if noise not in NOISE_MODELS:
        raise ValueError(f"noise can be {' or '.join(map(repr, NOISE_MODELS))}, not {noise!r}")
    path = checkpoint_path(checkpoint, resume)
    density, from_unbounded, start, whitening = _log_density(fit, noise)
    digest = fingerprint(
        {
            "values": fit.values.tobytes().hex(),
            "measured": fit.dataset.measured.tobytes().hex(),
            "addresses": fit.addresses,
            "settings": [chains, warmup, seed, noise],
        }
    )
    kept = Checkpoint(path, digest)
    found, divergences = draw_by_nuts(density, start.size, draws, chains, warmup, seed, kept)
    values = np.asarray(
        jax.vmap(jax.vmap(from_unbounded))(jnp.asarray(start + found @ whitening.T))
    )
    return with_diagnostics(fit.addresses, values, divergences)


def with_diagnostics(
    addresses: list[str], draws: Float[np.ndarray, "chain draw parameter"], divergences: int
) -> Posterior:
    """Posterior of draws: R-hat, effective draws (Gelman and others, Bayesian Data Analysis, 11.4).

    Raises ImportError without blackjax.
    """
    diagnostics = import_extra("blackjax.diagnostics", "bayes")
    columns = jnp.asarray(draws)
    return Posterior(
        addresses,
        draws,
        np.atleast_1d(np.asarray(diagnostics.potential_scale_reduction(columns))),
        np.atleast_1d(np.asarray(diagnostics.effective_sample_size(columns))),
        divergences,
    )


def _log_density(fit: Fit, noise_model: str = "fixed"):
    """Log density of whitened search variables, map to values, centre, whitening matrix."""
    least_squares, dataset = fit.least_squares, fit.dataset
    weights = jnp.asarray(least_squares.weights(fit.widened_noise))
    measured = jnp.asarray(dataset.measured)
    predict = dataset.prediction(fit.addresses).predict
    start = fit.unbounded
    slopes = np.diag(jax.jacfwd(least_squares.from_unbounded)(jnp.asarray(start)))
    _, jacobian = least_squares.linearised(fit.values)
    rows = (jacobian * np.asarray(weights)[..., None]).reshape(-1, start.size) * slopes
    prior_jacobian = (
        np.asarray(jax.jacfwd(least_squares.prior_residuals)(jnp.asarray(fit.values))) * slopes
    )
    information = rows.T @ rows + prior_jacobian.T @ prior_jacobian
    # At a bound the value has no slope; its search variable varies by its own typical size.
    floor = 1 / np.array([p.unbounded_size for p in fit.parameters]) ** 2
    whitening = np.linalg.cholesky(np.linalg.inv(information + np.diag(floor)))

    independent = dataset.mask.sum(axis=1) / fit.autocorrelation_factor

    def misfit(residuals):
        squares = jnp.sum(residuals**2, axis=1)
        if noise_model == "fixed":
            return jnp.sum(squares)
        # The integral of level^-(n + 1) exp(-squares / (2 level^2)) is squares^(-n / 2).
        return jnp.sum(independent * jnp.log(jnp.where(independent > 0, squares, 1.0)))

    def density(z):
        y = start + whitening @ z
        values, stretch = jax.jvp(least_squares.from_unbounded, (y,), (jnp.ones_like(y),))
        residuals = (measured - predict(values)) * weights
        total = misfit(residuals) + jnp.sum(least_squares.prior_residuals(values) ** 2)
        return -total / 2 + jnp.sum(jnp.log(jnp.abs(stretch) + 1e-300))

    return density, least_squares.from_unbounded, start, whitening


def draw_by_nuts(
    density: Callable[[Float[Array, " size"]], Float[Array, ""]],
    size: int,
    draws: int,
    chains: int,
    warmup: int,
    seed: int,
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> tuple[Float[np.ndarray, "chain draw size"], int]:
    """Draws from a log density close to the standard normal one, and the number of divergences.

    The step size is adapted first; then draws are made in blocks with random numbers of their own,
    after each of which the checkpoint is written.

    Raises ValueError for a checkpoint that is damaged or of another sampling, ImportError without
    blackjax.
    """
    blackjax = import_extra("blackjax", "bayes")
    keys = jax.random.split(jax.random.key(seed), chains)

    def adapt(key):
        begin, own = jax.random.split(key)
        adaptation = blackjax.window_adaptation(blackjax.nuts, density)
        (state, tuned), _ = adaptation.run(own, jax.random.normal(begin, (size,)), warmup)
        return state.position, tuned["step_size"], tuned["inverse_mass_matrix"]

    def block(key, position, step, mass):
        kernel = blackjax.nuts(density, step, mass)

        def one(state, key):
            state, info = kernel.step(key, state)
            return state, (state.position, info.is_divergent)

        _, (positions, divergent) = jax.lax.scan(
            one, kernel.init(position), jax.random.split(key, DRAWS_PER_BLOCK)
        )
        return positions, divergent

    state = checkpoint.load()
    if state is None:
        # Chain after chain: in a batch each would wait for the longest trajectory of all.
        position, step, mass = map(np.asarray, jax.jit(lambda k: jax.lax.map(adapt, k))(keys))
        state = {
            "position": position, "step": step, "mass": mass,
            "draws": np.empty((chains, 0, size)), "divergent": np.array(0),
        }  # fmt: skip
    run = jax.jit(lambda *given: jax.lax.map(lambda each: block(*each), given))
    while state["draws"].shape[1] < draws:
        number = state["draws"].shape[1] // DRAWS_PER_BLOCK
        own = jnp.stack([jax.random.fold_in(key, number + 1) for key in keys])
        positions, divergent = map(
            np.asarray, run(own, state["position"], state["step"], state["mass"])
        )
        state = state | {
            "position": positions[:, -1],
            "draws": np.concatenate([state["draws"], positions], axis=1),
            "divergent": state["divergent"] + divergent.sum(),
        }
        checkpoint.save(state)
    return state["draws"][:, :draws], int(state["divergent"])


LINEAR_AGREEMENT = 0.25  # relative difference of half widths below which intervals agree
MAX_STEPS_PER_SIDE = 12  # steps to each side, each at most twice as long as the one before


@dataclasses.dataclass(frozen=True, eq=False)
class Profile:
    """Profile of a parameter: `values` (SI), and `deviance`, -2 ln L above its minimum, there.

    `interval` is where the deviance stays below `critical_deviance` (95 % confidence); infinite on
    a side on which it does not reach it. `linear_interval` is that of the linearised fit.
    """

    address: str
    unit: str
    values: Float[np.ndarray, " point"]
    deviance: Float[np.ndarray, " point"]
    critical_deviance: float
    interval: tuple[float, float]
    linear_interval: tuple[float, float]

    @property
    def verdict(self) -> str:
        """The interval, and how it compares with the linear one, in a sentence."""
        low, high = self.interval
        unit = "" if self.unit in ("", "1") else f" {self.unit}"
        if np.isinf(low) and np.isinf(high):
            return f"{self.address} is not identifiable from the data: every value fits as well"
        if np.isinf(high):
            return f"the data only say that {self.address} is above {low:.5g}{unit}"
        if np.isinf(low):
            return f"the data only say that {self.address} is below {high:.5g}{unit}"
        statement = f"{self.address} is between {low:.5g} and {high:.5g}{unit}"
        ends = np.abs(np.array(self.interval) - self.linear_interval)
        if not np.all(np.isfinite(self.linear_interval)):
            return f"{statement}, though not identifiable by the linearised fit"
        if np.all(ends < LINEAR_AGREEMENT * (high - low) / 2):
            return f"{statement}, as the linearised fit says"
        return f"{statement}; the linearised interval is misleading, use this one"


@refuses_traced("a profile")
def profile(fit: Fit, address: str, points: int = 4) -> Profile:
    """Profile likelihood of a parameter, on both sides of its fitted value.

    The noise is that of the fit, widened for autocorrelation. About `points` steps lie on either
    side within the interval; steps lengthen where the deviance hardly rises. Nothing is compiled
    anew.

    Raises ValueError if the parameter is not free.

    The `address` is one of those that were free in the fit.

    >>> import tuning
    >>> fit = tuning.load_fit("fit.npz")
    >>> found = tuning.fit.profile(fit, "beam.flexural_rigidity", points=1)
    >>> print(f"{found.interval[0]:.1f} to {found.interval[1]:.1f} {found.unit}")
    12.0 to 12.1 N m^2
    """
    if address not in fit.addresses:
        raise ValueError(f"{address} is not free in this fit; free are {', '.join(fit.addresses)}")
    index = fit.addresses.index(address)
    critical_deviance = t_quantile(fit.degrees_of_freedom) ** 2
    noise = fit.widened_noise
    # With weights widened channel by channel the minimum is not quite that of the fit.
    centre = _refit(fit, fit.unbounded, noise)
    least = fit.least_squares.values_at(centre)
    parameter, value = fit.parameters[index], float(least[index])
    best = fit.least_squares.cost(least, noise, fit.dataset.measured)
    error = fit.errors[index]
    size = parameter.typical_size_at(value)
    step = min(error, size / 2) * np.sqrt(critical_deviance) / points
    values, deviance = [value], [0.0]
    for side in (-1.0, 1.0):
        moved_value, stride, rise, point = value, side * step, 0.0, centre
        for _ in range(MAX_STEPS_PER_SIDE):
            if not parameter.low < moved_value + stride < parameter.high:
                break
            moved_value += stride
            point, before = np.array(point), rise
            point[index] = parameter.to_unbounded(moved_value)
            point = _refit(fit, point, noise, index)
            cost = fit.least_squares.cost(
                fit.least_squares.values_at(point), noise, fit.dataset.measured
            )
            rise = 2 * (cost - best)
            values.append(moved_value)
            deviance.append(rise)
            if rise > 1.3 * critical_deviance or not np.isfinite(rise):
                break
            if rise - before < critical_deviance / points**2:
                stride *= 2
    order = np.argsort(values)
    values, deviance = np.array(values)[order], np.array(deviance)[order]
    interval = tuple(
        _interval_end(values, deviance, value, critical_deviance, side) for side in (-1, 1)
    )
    linear = tuple(map(float, fit.intervals[index]))
    return Profile(address, parameter.unit, values, deviance, critical_deviance, interval, linear)


def _refit(fit: Fit, point, noise, held: int | None = None) -> Float[np.ndarray, " parameter"]:
    """Search variables with one parameter held and the others fitted, from a point on."""
    free = np.arange(point.size) != (-1 if held is None else held)
    if not free.any():
        return point
    search = fit.least_squares
    scale = search.step_scale(point, noise)
    found, _ = search.minimise(point, scale, search.weights(noise), fit.dataset.measured, free)
    return found


def _interval_end(values, deviance, best: float, critical_deviance: float, side: int) -> float:
    """Value at which the root of the deviance, nearly a straight line, reaches the critical one."""
    on_side = side * (values - best) >= 0
    side_values = values[on_side][::side]
    roots = np.maximum.accumulate(np.sqrt(np.maximum(deviance[on_side][::side], 0.0)))
    finite = np.isfinite(roots)
    if not np.any(roots[finite] > np.sqrt(critical_deviance)):
        return side * np.inf
    return float(np.interp(np.sqrt(critical_deviance), roots[finite], side_values[finite]))


PANELS_PER_ROW = 3


@use_style
def plot_profiles(profiles: Sequence[Profile]) -> Figure:
    """Figure of the deviance of each parameter, with its critical value and the interval."""
    figure, panels = _panels(len(profiles))
    for axes, found in zip(panels, profiles, strict=False):
        axes.plot(found.values, found.deviance, "o-", color=INK, markersize=3, linewidth=1)
        axes.axhline(found.critical_deviance, color=COLOURS[1], linewidth=1)
        for end in found.interval:
            if np.isfinite(end):
                axes.axvline(end, color=COLOURS[1], linewidth=0.8, linestyle=":")
        if np.all(np.isfinite(found.linear_interval)):
            axes.axvspan(*found.linear_interval, color=FAINT, alpha=0.6, linewidth=0)
        axes.set(
            title=found.address,
            ylabel="rise of $-2\\,\\ln L$",
            ylim=(0, 2 * found.critical_deviance),
        )
        axes.set_xlabel("" if found.unit == "1" else found.unit)
    return figure


@use_style
def plot_posterior(posterior: Posterior) -> Figure:
    """Figure of histograms of the draws of each parameter, a line for each chain, and intervals."""
    figure, panels = _panels(len(posterior.addresses))
    for i, axes in enumerate(panels):
        draws = posterior.draws[..., i]
        bin_edges = np.linspace(draws.min(), draws.max(), 31)
        for j, chain in enumerate(draws):
            axes.hist(
                chain, bin_edges, histtype="step", density=True, color=COLOURS[j % len(COLOURS)]
            )
        axes.axvspan(*posterior.intervals[i], color=FAINT, alpha=0.6, linewidth=0)
        axes.set(title=posterior.addresses[i], yticks=[])
    return figure


def _panels(count: int):
    """A figure with so many panels, and its axes."""
    rows = -(-count // PANELS_PER_ROW)
    figure = Figure(figsize=(3.2 * min(count, PANELS_PER_ROW), 2.4 * rows))
    grid = figure.subplots(rows, min(count, PANELS_PER_ROW), squeeze=False).ravel()
    for axes in grid[count:]:
        axes.axis("off")
    return figure, grid[:count]
