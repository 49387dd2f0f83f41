"""Gymnasium's classes around the task of balancing; importing this registers the library.

``undertow/NAME-v0`` and ``undertow/NAME_realistic-v0`` are the ids, see :func:`register_all`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from undertow.base import InvalidInputError, MissingExtraError, at_least, one_of, require
from undertow.closed_loop import Event
from undertow.display.animation import Picture
from undertow.export.balancing import NEEDS, BalancingTask, BenchPlant, IdealPlant, Lanes
from undertow.mechanisms import LIBRARY
from undertow.models import FloatArray

try:
    import gymnasium
    from gymnasium.spaces import Box
    from gymnasium.utils import seeding
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise MissingExtraError(NEEDS, remedy="pip install 'undertow[gym]'") from error

#: Frames in a second of a rendered episode, at most.
FRAMES = 50


def _spaces(task: BalancingTask) -> tuple[Any, Any]:
    """Return the spaces of observations, (2n,), and of actions, (m,)."""
    low, high = task.box
    one = np.ones(task.mechanism.m)
    return Box(low, high, dtype=np.float64), Box(-one, one, dtype=np.float64)


def _begin(
    task: BalancingTask, rng: np.random.Generator, options: dict[str, Any] | None
) -> FloatArray:
    """Return where an episode begins, (2n,): ``options`` may name states, else it is drawn."""
    if not options:
        return task.start(rng)
    if not isinstance(options, Mapping):
        raise InvalidInputError(
            "options of reset()",
            value=repr(options),
            limit="states by name",
            remedy='Write options={"phi": 0.3}, SI units; None draws the start',
        )
    x = task.mechanism.state(**options)
    task.problem.check_start(task.mechanism, x)
    return x


class Environment(gymnasium.Env[FloatArray, NDArray[Any]]):
    """One mechanism to be balanced.

    An episode begins where the hand lets go: the usual start times r, ½ ≤ |r| ≤ 1, of either
    sign, drawn from the seed; or where ``reset(options={"phi": 0.3})`` says.  The reward of a
    step is −∫Φ(x, u) dt.  At the end of a step an episode is *terminated* where the state is in the
    terminal set, where a constraint is broken (travel is one) or where ‖x‖ passes ``escape``:
    ``info["event"]`` is then REACHED, CONSTRAINT or DIVERGED, and the last two pay the penalty.
    It is *truncated*, HORIZON, when the objective's horizon is over.

    Parameters
    ----------
    task
        What is asked.
    render_mode
        ``"rgb_array"``, or ``None``.

    Attributes
    ----------
    task
        What is asked.
    """

    def __init__(self, task: BalancingTask, render_mode: str | None = None) -> None:
        rate = 1.0 / task.period
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": round(rate / max(1, round(rate / FRAMES))),
        }
        if render_mode is not None:
            one_of("render_mode", render_mode, self.metadata["render_modes"])
        self.task, self.render_mode = task, render_mode
        self.observation_space, self.action_space = _spaces(task)
        self._plant = IdealPlant(task) if task.bench is None else BenchPlant(task, task.bench)
        self._left = 0
        self._picture: Picture | None = None

    @property
    def x(self) -> FloatArray:
        """The true state, (2n,)."""
        return self._plant.x

    def _observation(self) -> FloatArray:
        return np.clip(self._plant.observation, *self.task.box)

    def _info(self) -> dict[str, Any]:
        return {} if self.task.bench is None else {"x": self._plant.x}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Begin an episode.

        Parameters
        ----------
        seed
            Of all that is drawn from now on.
        options
            States by name, SI units: where to begin; the others are 0.

        Returns
        -------
        observation, info
            (2n,), SI units; of a realistic environment ``info["x"]`` is the true state.
        """
        super().reset(seed=seed)
        self._plant.reset(_begin(self.task, self.np_random, options), self.np_random)
        self._left = self.task.steps
        return self._observation(), self._info()

    def step(self, action: NDArray[Any]) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Hold an action, inputs over their limits, (m,), for a period.

        Returns
        -------
        observation, reward, terminated, truncated, info
            See :class:`Environment`.

        Raises
        ------
        InvalidInputError
            For an action that is not (m,) finite numbers, and after the end of an episode.
        """
        inputs = self.task.inputs(action)
        if not self._left:
            raise InvalidInputError(
                "step of an environment",
                value="no episode, or one that has ended",
                limit="an episode that goes on",
                remedy="Call reset() first",
            )
        cost, margin = self._plant.step(inputs)
        event = self.task.events(self._plant.x[None], np.array([margin]))
        reward = float(self.task.rewards(np.array([cost]), event)[0])
        self._left -= 1
        terminated = bool(event[0] != Event.HORIZON)
        truncated = not terminated and self._left == 0
        info = self._info()
        if terminated or truncated:
            self._left, info["event"] = 0, Event(int(event[0])).name
        return self._observation(), reward, terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return the mechanism as it stands, (height, width, 3); ``None`` without a mode."""
        if self.render_mode is None:
            return None
        if self._picture is None:
            self._picture = Picture(self.task.mechanism)
        return self._picture.pixels(self._plant.x[: self.task.mechanism.n])


class VectorEnvironment(VectorEnv[NDArray[Any], NDArray[Any], NDArray[Any]]):
    """Many ideal environments, moved by one compiled call; each is as :class:`Environment`.

    One that has ended begins anew with the next step, whose action it does not use (Gymnasium's
    ``AutoresetMode.NEXT_STEP``).  Seeded with k, environment i draws what a single one seeded with
    k + i draws.

    Parameters
    ----------
    task
        What is asked, without a bench.
    num_envs
        How many, N.
    """

    def __init__(self, task: BalancingTask, num_envs: int) -> None:
        at_least("num_envs of a vector environment", num_envs, 1, "1024 fill the processor")
        if task.bench is not None:
            raise InvalidInputError(
                "bench of a vector environment",
                value="a realistic one",
                limit="the model as the plant",
                remedy="Vectorise realistic ones with gymnasium.vector.SyncVectorEnv",
            )
        self.metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}
        self.task, self.num_envs = task, num_envs
        self.single_observation_space, self.single_action_space = _spaces(task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._lanes = Lanes(task, num_envs)
        self._rngs = [seeding.np_random(None)[0] for _ in range(num_envs)]
        self._left = np.full(num_envs, -1)  # before reset()

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        """Begin N episodes.

        Parameters
        ----------
        seed
            Of the first environment, the others count on from it; or one for each.
        options
            States by name, SI units: where all of them begin.

        Returns
        -------
        observations, infos
            (N, 2n), SI units.
        """
        if seed is not None:
            given = np.asarray(seed)
            if given.dtype.kind not in "iu" or given.shape not in ((), (self.num_envs,)):
                raise InvalidInputError(
                    "seeds of a vector environment",
                    value=repr(seed) if given.size == 1 else f"shape {given.shape}",
                    limit=f"a whole number, or {self.num_envs}",
                    remedy="Give the first one alone: the others count on from it",
                )
            seeds = given if given.ndim else given + np.arange(self.num_envs)
            self._rngs = [seeding.np_random(int(one))[0] for one in seeds]
        self._begin(range(self.num_envs), options)
        return self._observations(self._lanes.x), {}

    def _begin(self, which: Any, options: dict[str, Any] | None = None) -> None:
        for i in which:
            self._lanes.place(i, _begin(self.task, self._rngs[i], options))
            self._left[i] = self.task.steps

    def _observations(self, x: FloatArray) -> FloatArray:
        return np.clip(x, *self.task.box, out=x)

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[
        NDArray[Any], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]
    ]:
        """Hold actions, (N, m), for a period.

        Returns
        -------
        observations, rewards, terminations, truncations, infos
            (N, 2n), and (N,) each.  Where an episode ends, ``infos["event"]`` says how, and
            ``infos["_event"]`` is true.

        Raises
        ------
        InvalidInputError
            For actions that are not (N, m) finite numbers, and before :meth:`reset`.
        """
        require(
            (self._left >= 0).all(),
            "step of a vector environment",
            "no episodes yet",
            "episodes that reset() has begun",
            "Call reset() first",
        )
        over = self._left == 0
        self._lanes.u[:] = self.task.inputs(actions, self.num_envs).T
        cost, margin = self._lanes.step()
        x = self._lanes.x
        event = self.task.events(x, margin)
        rewards = self.task.rewards(cost, event)
        self._left -= 1
        terminated = event != Event.HORIZON
        truncated = ~terminated & (self._left == 0)
        if over.any():
            which = np.flatnonzero(over)
            self._begin(which)
            x[which] = self._lanes.x[which]
            rewards[which], terminated[which], truncated[which] = 0.0, False, False
        ended = terminated | truncated
        infos: dict[str, Any] = {}
        if ended.any():
            self._left[ended] = 0
            names = np.full(self.num_envs, None, dtype=object)
            names[ended] = [Event(int(code)).name for code in event[ended]]
            infos = {"event": names, "_event": ended}
        return self._observations(x), rewards, terminated, truncated, infos


def register_all() -> None:
    """Register ``undertow/NAME-v0`` and ``undertow/NAME_realistic-v0`` of every mechanism.

    Nothing is compiled before one of them is made.  ``gymnasium.make`` takes what
    :func:`undertow.environment` does; ``gymnasium.make_vec`` makes :class:`VectorEnvironment`.
    """
    home = "undertow.export.balancing"
    for name in LIBRARY:
        given = {"mechanism": name}
        gymnasium.register(
            f"undertow/{name}-v0",
            f"{home}:environment",
            vector_entry_point=f"{home}:vector_environment",
            kwargs=given,
        )
        gymnasium.register(
            f"undertow/{name}_realistic-v0",
            f"{home}:environment",
            kwargs={**given, "realistic": True},
        )


register_all()
