"""A problem as an environment of gymnasium, which is installed by `pip install 'jaxbeam[gym]'`."""

from typing import Any, ClassVar

import jax
import numpy as np

from jaxbeam.benchmark.environment import Environment
from jaxbeam.benchmark.problem import BenchmarkProblem, load
from jaxbeam.case.arguments import checks_classes

try:
    import gymnasium
except ImportError as error:
    raise ImportError(
        "environments of gymnasium need it: pip install 'jaxbeam[gym]', or take"
        " jaxbeam.benchmark.Environment, which needs nothing more"
    ) from error


class GymnasiumEnvironment(gymnasium.Env):
    """Environment of gymnasium with the observations and rewards of an `Environment`.

    Actions are from -1, the lowest command of an actuator, over 0, none, to 1, the highest one.
    `reset(seed=...)` is a run of that seed, with its test load; `options={"load": numbers}` is one
    of another load. The `info` of a step has the `peak` (m) so far, the `uncontrolled` one (m) of
    the whole run without commands, and the numbers of the `load`.

    >>> import jaxbeam as jb
    >>> environment = jb.benchmark.GymnasiumEnvironment("patch")
    >>> observation, _ = environment.reset(seed=1)
    >>> print(observation.shape, environment.action_space.high)
    (5,) [1.]
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    @checks_classes
    def __init__(self, problem: str | BenchmarkProblem):
        self.problem = load(problem) if isinstance(problem, str) else problem
        self.environment = Environment(self.problem)
        self._reset, self._step = jax.jit(self.environment.reset), jax.jit(self.environment.step)
        actuators = self.problem.case.driven
        self.limits = np.array([np.asarray(one.command_limits(), float) for one in actuators]).T
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (len(actuators),), np.float64)
        told = len(self.problem.vary) if self.problem.told else 0
        size = len(self.problem.case.sensors) + 1 + told
        largest = np.full(size, np.finfo(np.float64).max)
        self.observation_space = gymnasium.spaces.Box(-largest, largest, dtype=np.float64)
        self.state = None

    @checks_classes
    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Observation at the start of a run, and its info."""
        super().reset(seed=seed)
        seed = int(self.np_random.integers(2**31)) if seed is None else seed
        numbers = (options or {}).get("load", self.problem.test_load(seed))
        self.state, observation = self._reset(seed, np.asarray(numbers, float))
        return np.asarray(observation), self._info()

    def step(self, action):
        """Observation, reward, whether the run has ended, False, and the info of a period.

        Raises ValueError before the first reset.
        """
        if self.state is None:
            raise ValueError("call reset before step")
        low, high = self.limits
        action = np.clip(np.asarray(action, float), -1.0, 1.0)
        command = np.where(action < 0, -action * low, action * high)
        self.state, observation, reward, done = self._step(self.state, command)
        return np.asarray(observation), float(reward), bool(done), False, self._info()

    def _info(self) -> dict[str, Any]:
        return {
            "peak": float(self.state.peak),
            "uncontrolled": float(self.state.uncontrolled),
            "load": np.asarray(self.state.load),
        }
