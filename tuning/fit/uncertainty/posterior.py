"""The posterior of the free numbers, sampled: what intervals look like where errors do not.

No-U-turn sampling (Hoffman and Gelman, 2014) by blackjax, the extra `bayes`.
"""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tuning.checkpoint import fingerprint, load, save
from tuning.fit.identify import Fit
from tuning.optional import import_extra

NOISE_MODELS = ("held", "estimated")
DRAWS_PER_BLOCK = 100  # draws between two states on disk
MAX_R_HAT = 1.05  # R-hat beyond which chains have not mixed
MIN_EFFECTIVE_DRAWS = 100  # effective draws below which intervals are not to be trusted


@dataclasses.dataclass(frozen=True, eq=False)
class Posterior:
    """Draws (chain, draw, free) of the free numbers in SI units, and how well they mixed.

    `r_hat` compares the spread between and within chains (1 is perfect), `effective_draws` is the number
    of independent draws that these are worth; `divergences` counts steps that went astray.
    """

    addresses: list[str]
    draws: Float[np.ndarray, "chain draw free"]
    r_hat: Float[np.ndarray, " free"]
    effective_draws: Float[np.ndarray, " free"]
    divergences: int

    @property
    def means(self) -> Float[np.ndarray, " free"]:
        """Means of the draws."""
        return self.draws.mean(axis=(0, 1))

    @property
    def deviations(self) -> Float[np.ndarray, " free"]:
        """Standard deviations of the draws."""
        return self.draws.std(axis=(0, 1))

    @property
    def intervals(self) -> Float[np.ndarray, "free 2"]:
        """Central 95 % intervals."""
        return np.quantile(self.draws, [0.025, 0.975], axis=(0, 1)).T

    @property
    def verdict(self) -> str:
        """Whether the draws may be trusted."""
        if not np.all(self.r_hat < MAX_R_HAT):
            return f"the chains have not mixed (R-hat up to {self.r_hat.max():.3f}): draw more"
        if not np.all(self.effective_draws > MIN_EFFECTIVE_DRAWS):
            return f"only {self.effective_draws.min():.0f} effective draws: draw more"
        if self.divergences > 0.01 * self.draws[..., 0].size:
            return f"{self.divergences} divergent steps: the corners of the posterior are missed"
        return f"mixed: R-hat up to {self.r_hat.max():.3f}, {self.effective_draws.min():.0f} effective draws"

    def to_dict(self) -> dict:
        """Means, deviations, intervals, R-hat and effective draws by address, and the verdict."""
        rows = zip(
            self.addresses, self.means, self.deviations, self.intervals, self.r_hat, self.effective_draws,
            strict=True,
        )  # fmt: skip
        numbers = {
            address: {
                "mean": float(mean),
                "deviation": float(deviation),
                "interval_95": interval.tolist(),
                "r_hat": float(r_hat),
                "effective_draws": float(effective),
            }
            for address, mean, deviation, interval, r_hat, effective in rows
        }
        return {"numbers": numbers, "verdict": self.verdict}

    def __str__(self) -> str:
        width = max(map(len, self.addresses))
        head = f"{'number':{width}}  {'mean':>11}  {'deviation':>10}  {'95 % interval':^25}"
        lines = [f"{head}  {'R-hat':>6}  {'draws':>6}"]
        rows = zip(self.addresses, self.means, self.deviations, self.intervals, strict=True)
        for i, (address, mean, deviation, (low, high)) in enumerate(rows):
            lines.append(
                f"{address:{width}}  {mean:11.5g}  {deviation:10.3g}  {low:11.5g} to {high:<10.5g}"
                f"  {self.r_hat[i]:6.3f}  {self.effective_draws[i]:6.0f}"
            )
        return "\n".join([*lines, self.verdict])


def sample(
    fit: Fit,
    draws: int = 500,
    chains: int = 4,
    warmup: int = 200,
    seed: int = 0,
    checkpoint: str | os.PathLike | None = None,
    resume: bool = False,
    noise: str = "held",
) -> Posterior:
    """Sample the posterior of a fit's numbers: its likelihood, priors, and bounds.

    The noise is that of the fit, widened where residuals are coloured; if it is "estimated", the
    level of each channel is unknown with the prior 1 / level, and integrated out (Gelman and
    others, section 3.2). A number without a prior is believed to be anywhere within its bounds.
    Chains start around the fit, scattered as widely as its standard errors; for speed the sampler
    moves in the directions and sizes of these.

    With a `checkpoint` file sampling can be stopped at any time and taken up with `resume`: the
    draws are the same.

    Raises ValueError if the data cannot see some direction without a prior, for another word on
    the noise, and for a damaged or foreign checkpoint, FileExistsError if it exists and `resume`
    is not set, ImportError without blackjax.
    """
    if fit.unidentifiable:
        raise ValueError(
            f"the data cannot see {', '.join(fit.unidentifiable[0])}: give a prior, or a value known "
            "otherwise, before sampling"
        )
    if noise not in NOISE_MODELS:
        raise ValueError(f"noise can be {' or '.join(map(repr, NOISE_MODELS))}, not {noise!r}")
    density, from_unbounded, start, whitening = _log_density(fit, noise)
    digest = fingerprint(
        {
            "values": fit.values.tobytes().hex(),
            "measured": fit.dataset.measured.tobytes().hex(),
            "addresses": fit.addresses,
            "settings": [chains, warmup, seed, noise],
        }
    )
    file = None if checkpoint is None else Path(checkpoint)
    found, divergences = draw_by_nuts(
        density, start.size, draws, chains, warmup, seed, file, digest, resume
    )
    values = np.asarray(
        jax.vmap(jax.vmap(from_unbounded))(jnp.asarray(start + found @ whitening.T))
    )
    return with_diagnostics(fit.addresses, values, divergences)


def with_diagnostics(
    addresses: list[str], draws: Float[np.ndarray, "chain draw free"], divergences: int
) -> Posterior:
    """Draws with R-hat and effective number (Gelman and others, Bayesian Data Analysis, 11.4).

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


def _log_density(fit: Fit, noise_model: str = "held"):
    """Log density over whitened search variables, their map to values, centre and directions."""
    least_squares, dataset = fit.least_squares, fit.dataset
    noise = np.where(np.isnan(fit.noise), 1.0, fit.noise * np.sqrt(fit.autocorrelation_factor))
    weights, measured = jnp.asarray(least_squares.weights(noise)), jnp.asarray(dataset.measured)
    predict = dataset.predictor(fit.addresses)
    parameters = fit.parameters
    pairs = zip(parameters, fit.values, strict=True)
    start = np.array([number.to_unbounded(float(value)) for number, value in pairs])
    slopes = np.diag(jax.jacfwd(least_squares.from_unbounded)(jnp.asarray(start)))
    _, jacobian = least_squares.linearised(fit.values)
    rows = (jacobian * np.asarray(weights)[..., None]).reshape(-1, start.size) * slopes
    prior_jacobian = (
        np.asarray(jax.jacfwd(least_squares.prior_residuals)(jnp.asarray(fit.values))) * slopes
    )
    information = rows.T @ rows + prior_jacobian.T @ prior_jacobian
    # A number at a bound has no slope there: its search variable wanders over order one.
    floor = 1 / np.array([number.unbounded_size for number in parameters]) ** 2
    whitening = np.linalg.cholesky(np.linalg.inv(information + np.diag(floor)))

    independent = dataset.mask.sum(axis=1) / fit.autocorrelation_factor

    def misfit(residuals):
        squares = jnp.sum(residuals**2, axis=1)
        if noise_model == "held":
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
    file: Path | None = None,
    digest: str = "",
    resume: bool = False,
) -> tuple[Float[np.ndarray, "chain draw size"], int]:
    """Draws from a log density near a standard normal one, and how many steps diverged.

    Step sizes are adapted first; then draws are made in blocks, each with random numbers of its
    own, and kept in the file. Raises ValueError for a damaged or foreign file, FileExistsError if
    it exists and `resume` is not set, ImportError without blackjax.
    """
    blackjax = import_extra("blackjax", "bayes")
    if file is not None and file.exists() and not resume:
        raise FileExistsError(f"{file} exists: resume that sampling, or delete it")
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

    if file is not None and file.exists():
        state = load(file, digest)
    else:
        # Chain after chain: side by side each would wait for the longest path of all.
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
        if file is not None:
            save(file, digest, state)
    return state["draws"][:, :draws], int(state["divergent"])
