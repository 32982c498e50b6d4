"""The batched environment as Stable-Baselines3 takes it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from dlo_gym.envs.vector_env import Observations, ShapeControlVectorEnv
from dlo_gym.exceptions import MissingExtra

try:
    from stable_baselines3.common.vec_env import VecEnv
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn
except ImportError as error:
    raise MissingExtra("stable-baselines3", "train") from error


class ShapeVecEnv(VecEnv):
    """A ``ShapeControlVectorEnv`` that starts over in the same step, as SB3's ``VecEnv``.

    The observation that an episode ended with is in its info's ``terminal_observation``, and
    ``TimeLimit.truncated`` says whether only time had run out.

    Raises:
        ValueError: if ``envs`` starts over in another way.
    """

    def __init__(self, envs: ShapeControlVectorEnv) -> None:
        if envs.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise ValueError(f"envs: expected autoreset_mode SameStep, got {envs.autoreset_mode}")
        self.envs = envs
        self.render_mode = envs.render_mode
        self._actions = np.zeros(envs.action_space.shape or (), dtype=np.float32)
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Observations:
        """Seeds and options of ``seed`` and ``set_options`` are used once."""
        everyone = np.ones(self.num_envs, dtype=bool)
        observations, infos = self.envs.reset_each(self._seeds, self._options, everyone)
        self.reset_infos = [_info_of(infos, i) for i in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: NDArray[np.floating]) -> None:
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, terminations, truncations, batch = self.envs.step(self._actions)
        over = terminations | truncations
        infos = []
        for i in range(self.num_envs):
            info = _info_of(batch, i)
            if over[i]:
                self.reset_infos[i] = info
                info = _info_of(batch["final_info"], i)
                info["terminal_observation"] = batch["final_obs"][i]
            info["TimeLimit.truncated"] = bool(truncations[i] and not terminations[i])
            infos.append(info)
        return observations, rewards.astype(np.float32), over, infos

    def close(self) -> None:
        self.envs.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        return self.envs.render()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.envs.envs[i], attr_name) for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        for i in self._get_indices(indices):
            setattr(self.envs.envs[i], attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        return [
            getattr(self.envs.envs[i], method_name)(*method_args, **method_kwargs)
            for i in self._get_indices(indices)
        ]

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]


def _info_of(infos: dict[str, Any], index: int) -> dict[str, Any]:
    """The info of one environment out of a batch's."""
    info = {}
    for key, values in infos.items():
        if key.startswith("_") or key.startswith("final_") or not infos[f"_{key}"][index]:
            continue
        if isinstance(values, dict):
            info[key] = _info_of(values, index)
        else:
            value = values[index]
            info[key] = value.item() if isinstance(value, np.generic) else value
    return info
