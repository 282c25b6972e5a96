"""The Gymnasium environment: find the carpal tunnel's plane in a labelmap of an arm."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from armscan.envs.episode import Episode, begin, check_actions, info_of, wanted_volume
from armscan.envs.rules import Observed, Rules, Volumes
from armscan.envs.scene import Scene
from armscan.errors import ResetNeededError
from armscan.utils.arrays import FloatArray
from armscan.utils.validation import check_choice, check_int
from armscan.volumes import LabelVolume
from armscan.volumes.plane import ManipulatorAction

if TYPE_CHECKING:
    from armscan.envs.window import Window


class ArmscanEnv(gym.Env[Observed, FloatArray]):
    """Moves a slicing plane through a labelmap of an arm until the slice shows the carpal tunnel.

    ## Description
    An episode uses one volume, drawn at random and moved by a random `transform`. Each action places the plane
    (absolute, not relative to the last one). The environment samples the slice and clusters its landmarks. The optimal
    plane is the labelled plane of the volume, moved with the volume.

    ## Action space
    `Box(-1, 1, (n_action,))`: the free components of (rz, rx, tx, ty), normalised. Rotations are a * bound degrees,
    translations (a + 1) / 2 * bound mm. Components that are not free stay at the optimal plane's values. With
    `ends="on_stop"`, a last component `stop` follows: above 0, this plane is the agent's answer. Values outside [-1, 1]
    are clipped; NaN, infinity or another shape raises `InvalidValueError`.

    ## Observation space
    The parts of the chosen observation, then `action`, the last action, shape (n_action,), and `reward`, the current
    slice's, shape (1,). If all of them are vectors, they form one flat `Box` of 32-bit floats; otherwise a
    `MultiBoxSpace`, a `Dict` of boxes. `flat` overrides this.

    | observation | part before action and reward | shape |
    | --- | --- | --- |
    | `action_reward` | none | |
    | `cluster` | `clusters`: number, pixels, mean centre of bones, tendons, artery, normalised | (12,) |
    | `slice` | `slice`: the labels, 0 to 4, uint8 | (across, depth) |
    | `slice_channels` | `channels`: masks of bones, tendons, artery, 0 or 1, uint8 | (3, across, depth) |
    | `slice_metric` | `shares`: shares of bones, tendons, artery in a pixel, up to 255, uint8 | (3, across, depth) |
    | a list of them | all of them | |

    ## Rewards
    `LandmarkReward` of the slice, in [-1, 0]: 0 where every count is on target, no tissue is missing, and the tendons
    lie between bones and artery; or another `reward`.

    ## Starting state
    Fixed components are at the optimum, free ones at normalised 0 (`start="middle"`) or drawn (`start="random"`).
    `reset(options={"volume": name})` chooses the volume. An episode may start on a plane that already scores above
    -success_threshold: it still takes its first step, and `info["starts_solved"]` says so.

    ## Episode end
    | `ends` | terminated |
    | --- | --- |
    | `on_reward` | on the first plane whose reward is above -success_threshold |
    | `on_budget` | never: the agent may explore; only its last plane is judged |
    | `on_stop` | on the plane at which the agent says `stop`, rewarded or not |

    Every episode is truncated after `max_steps` steps. `is_success` is true for a plane whose reward is above
    -success_threshold; on the last plane, it is the success of the episode.

    ## Info
    `volume` (name), `rotation_deg` (rz, rx), `translation_mm` (tx, ty), `counts` (clusters of bones, tendons, artery),
    `is_success`, `starts_solved`, `action` (the last one, normalised), `reward`, and the distance to the optimal
    plane: `distance_mm` (of the slice's centre, along the optimal normal) and `distance_deg` (between the normals).

    Args:
        volumes: Volumes by name or in a sequence, or the folder of a dataset. Default: None, four phantoms.
        render_mode: `rgb_array`: `render()` returns a picture; `human`: a window shows every reset and step. Default:
            None.
        observation: Observation of the agent: a name of the table above, a list of names, or an object with the methods
            of `Observation`. Default: `cluster`.
        flat: Whether the observation is one vector. Default: None, one vector if every part is a vector.
        projection: Free components: `x`, `y`, `xy`, `zy`, `full`, or a list of `rz`, `rx`, `tx`, `ty`. Default: `y`.
        reward: Object with the methods of `armscan.anatomy.Reward`; one that needs fitting is fitted to the labelled
            planes of these volumes. Default: None, the published reward.
        targets: Target counts of the published reward: clusters of bones, tendons and artery, each from 1 to 1000; not
            with another `reward`. Default: (4, 3, 1).
        clustering: Clustering rules: `pixels`, as published; `metric`, in mm, for pixels of up to 0.6 mm;
            or an `armscan.anatomy.Tissues`. Default: `pixels`.
        success_threshold: Threshold of success, in (0, 1]: a plane whose reward is above -success_threshold succeeds.
            Default: 0.05.
        ends: Event that ends an episode before `max_steps`: `on_reward`, the first success; `on_budget`, none;
            `on_stop`, the agent's `stop`, a further component of its action. The last plane is judged.
            Default: `on_reward`.
        max_steps: Number of steps after which an episode is truncated, 1 or more. Default: 50.
        start: Plane at the start, `middle` or `random`. Default: `middle`.
        rotation_bounds_deg: Bounds of rz and rx in degrees, each in [0, 180]. Default: (180, 180).
        translation_bounds_mm: Bounds of tx and ty in mm, each in [0, 1e6]. Default: None, the size of the current
            volume.
        transform: Random motion of the volume at each reset. Default: `RandomTransform()`; None: no motion.

    Raises:
        InvalidValueError: If an argument is invalid.
        OptimalPlaneError: If a volume's labelled plane is missing, outside the bounds, or not above -success_threshold.
        VolumeError: If the folder or a file cannot be used.
        ManifestError: If the folder's manifest is missing or damaged.
        DisplayError: If `render_mode` is `human` and no window can be opened.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - as Gymnasium declares it
        "render_modes": ["human", "rgb_array"],
        "render_fps": 4,
    }

    def __init__(self, volumes: Volumes = None, *, render_mode: str | None = None, **rules: Any) -> None:
        self.render_mode = check_choice("render_mode", render_mode, (None, *self.metadata["render_modes"]))
        self.rules = Rules(volumes, **rules)
        self.observation_space = self.rules.observation_space  # type: ignore[assignment]
        self.action_space: spaces.Box = self.rules.action_space  # type: ignore[assignment]
        self._episode: Episode | None = None
        self._window: Window | None = None
        if self.render_mode == "human":
            # Deferred, as drawing is below: steps need neither.
            from armscan.envs.window import Window

            self._window = Window("armscan", self.metadata["render_fps"])

    @property
    def volumes(self) -> dict[str, LabelVolume]:
        """The volumes by name."""
        return self.rules.volumes

    @property
    def action_names(self) -> tuple[str, ...]:
        """The components of an action, in its order, such as `("rz", "ty")`, or `("rz", "ty", "stop")`."""
        return self.rules.action_names

    @property
    def episode(self) -> Episode:
        """The current episode.

        Raises:
            ResetNeededError: Before the first reset.
        """
        if self._episode is None:
            raise ResetNeededError("the environment has no episode yet: call reset() first")
        return self._episode

    @property
    def scene(self) -> Scene:
        """The volume of the current episode and where its optimal plane lies."""
        return self.episode.scene

    @property
    def plane(self) -> ManipulatorAction:
        """The current plane, in the moved volume's frame."""
        return self.episode.plane

    @property
    def slice_xz(self) -> NDArray[np.uint8]:
        """The current slice, indexed [across, depth]."""
        slice_xz = self.episode.view.slice_xz.view()
        slice_xz.flags.writeable = False
        return slice_xz

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observed, dict[str, Any]]:
        """Start an episode; `options={"volume": name}` chooses its volume."""
        volume_name = wanted_volume(self.rules, options)
        super().reset(seed=None if seed is None else check_int("seed", seed, at_least=0))
        (self._episode,) = begin(self.rules, [self.np_random], [volume_name])
        return self._seen()

    def step(self, action: FloatArray) -> tuple[Observed, float, bool, bool, dict[str, Any]]:
        """Place the plane; the class describes the return values."""
        episode = self._episode
        if episode is None or not episode.is_running:
            raise ResetNeededError("the episode has ended or not begun: call reset() before step()")
        episode.aim(check_actions(action, (len(self.rules.action_names),)))
        observation, info = self._seen()
        return observation, episode.view.reward, episode.is_terminated, episode.is_truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """Return a picture of the current step, shape (512, 860, 3); None in `human`, whose window has it already."""
        if self.render_mode is None:
            gym.logger.warn("render() was called without a render_mode; make the environment with 'rgb_array'.")
            return None
        episode = self.episode
        return _drawn(episode) if self._window is None else None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()

    def _seen(self) -> tuple[Observed, dict[str, Any]]:
        episode = self.episode
        episode.see(self.rules.look_at(episode.scene, episode.plane))
        if self._window is not None:
            self._window.show(_drawn(episode))
        return self.rules.observe(episode.view), info_of(episode)


def _drawn(episode: Episode) -> NDArray[np.uint8]:
    from armscan.envs.rendering import draw_frame

    return draw_frame(episode)
