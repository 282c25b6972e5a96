"""A window or notebook in which a person moves the plane: the picture of an episode over four sliders."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.widgets import Button, Slider
from numpy.typing import NDArray

from armscan.anatomy import SUCCESS_THRESHOLD, Tissues, check_tissues
from armscan.envs.actions import COMPONENTS
from armscan.envs.observations import View
from armscan.envs.panels import BACKGROUND, LINE_COLOUR, OPTIMUM_COLOUR, PLANE_COLOUR, TEXT_COLOUR, Colour
from armscan.envs.rendering import HEIGHT, WIDTH, Box, ReferencePlane, RewardHistory, draw_plane, view_of
from armscan.envs.rules import Volumes, named_volumes
from armscan.envs.scene import reachable_optimum
from armscan.envs.window import check_display, picture_figure
from armscan.utils.validation import check_choice
from armscan.volumes import LabelVolume, ManipulatorAction, open_dataset

BOUND_DEG = 180.0
N_REMEMBERED = 60
# In pixels from the window's lower left corner: (left, bottom, width, height).
HEIGHT_BELOW = 148
SLIDERS_AT, SLIDER_GAP = (64, 116, 400, 18), 34
BUTTONS_AT, BUTTON_GAP = (640, 104, 204, 32), 44


class Explorer:
    """A figure with the picture of a plane, a slider for each of its components, and buttons.

    Args:
        volumes: Volumes to explore, by name, one or more.
        name: Name of the first volume to show.
        tissues: Clustering rule of each tissue.

    Attributes:
        figure: Matplotlib figure.
        sliders: Sliders of rz and rx in degrees, tx and ty in mm, by name.
        volume: Volume that is shown.
        optimum: Optimal plane of the volume within the sliders' bounds; None if it is not known.
        plane: The current plane.
        view: Slice at the current plane, with its clusters.
        rewards: Rewards of the planes shown in this volume, the current one last.
    """

    volume: LabelVolume
    optimum: ManipulatorAction | None
    plane: ManipulatorAction
    view: View

    def __init__(self, volumes: dict[str, LabelVolume], name: str, tissues: Tissues) -> None:
        self.volumes = volumes
        self.rewards: list[float] = []
        self._tissues = tissues
        self._is_setting = False
        self.figure, self._image = picture_figure(
            "armscan", np.full((HEIGHT, WIDTH, 3), BACKGROUND, np.uint8), HEIGHT_BELOW
        )
        # Nothing else holds a reference to the widgets, and without one they no longer respond.
        setattr(self.figure, "explorer", self)  # noqa: B010
        self.sliders = {component: self._slider(row, component) for row, component in enumerate(COMPONENTS)}
        self.optimum_button = self._button(0, self.go_to_optimum)
        self.previous_button = self._button(1, partial(self.next_volume, -1), "previous volume")
        self.next_button = self._button(2, self.next_volume, "next volume")
        self.choose(name)

    def choose(self, name: str) -> None:
        """Go to the middle of a volume."""
        self.volume = self.volumes[check_choice("volume", name, list(self.volumes))]
        self.optimum = reachable_optimum(self.volume)
        self.rewards.clear()
        across_mm, along_mm, _ = self.volume.size_mm
        bounds = ((-BOUND_DEG, BOUND_DEG), (-BOUND_DEG, BOUND_DEG), (0.0, across_mm), (0.0, along_mm))
        marks = [None] * 4 if self.optimum is None else self.optimum.to_array().tolist()
        for slider, (low, high), mark in zip(self.sliders.values(), bounds, marks, strict=True):
            slider.valmin, slider.valmax = low, high
            slider.ax.set_xlim(low, high)
            slider.vline.set_visible(mark is not None)
            slider.vline.set_xdata([mark or 0.0] * 2)
        self.optimum_button.label.set_text("to the optimal plane" if self.optimum else "no optimal plane known")
        self.optimum_button.set_active(self.optimum is not None)
        self.go_to(ManipulatorAction((0.0, 0.0), (0.0, along_mm / 2)))

    def next_volume(self, n_further: int = 1) -> None:
        """Go to the volume `n_further` places after the current one, wrapping around."""
        names = list(self.volumes)
        self.choose(names[(names.index(self.volume.name) + n_further) % len(names)])

    def go_to_optimum(self) -> None:
        """Go to the optimal plane, if it is known."""
        if self.optimum is not None:
            self.go_to(self.optimum)

    def go_to(self, plane: ManipulatorAction) -> None:
        """Set the sliders to a plane, or as near as they reach, and show it."""
        self._is_setting = True
        for slider, value in zip(self.sliders.values(), plane.to_array().tolist(), strict=True):
            slider.set_val(value)
        self._is_setting = False
        self._look()

    def picture(self) -> NDArray[np.uint8]:
        """Draw the current view, shape (512, 860, 3)."""
        remembered = self.rewards[-N_REMEMBERED:]
        first = len(self.rewards) - len(remembered) + 1
        return draw_plane(
            self.volume,
            self.plane,
            self.view,
            reference=None if self.optimum is None else ReferencePlane(self.optimum, "optimal plane"),
            history=RewardHistory(
                remembered, range(first, first + N_REMEMBERED), -SUCCESS_THRESHOLD, "reward by plane"
            ),
        )

    def _look(self, _: float = 0.0) -> None:
        if self._is_setting:
            return
        self.plane = ManipulatorAction.from_array(np.array([slider.val for slider in self.sliders.values()]))
        self.view = view_of(self.volume, self.plane, tissues=self._tissues)
        self.rewards.append(self.view.reward)
        self._image.set_data(self.picture())
        self.figure.canvas.draw_idle()

    def _slider(self, row: int, component: str) -> Slider:
        left, bottom, width, height = SLIDERS_AT
        axes = self._axes((left, bottom - row * SLIDER_GAP, width, height))
        slider = Slider(
            axes,
            component,
            -BOUND_DEG,
            BOUND_DEG,
            valinit=0.0,
            valfmt="%.1f°" if component in ("rz", "rx") else "%.1f mm",
            color=_rgb(LINE_COLOUR),
            track_color=_rgb(LINE_COLOUR),
            initcolor=_rgb(OPTIMUM_COLOUR),
            handle_style={"facecolor": _rgb(PLANE_COLOUR), "edgecolor": _rgb(PLANE_COLOUR)},
        )
        for text in (slider.label, slider.valtext):
            text.set_color(_rgb(TEXT_COLOUR))
        # Drawn together with the picture.
        slider.drawon = False
        slider.on_changed(self._look)
        return slider

    def _button(self, row: int, action: Callable[[], None], label: str = "") -> Button:
        left, bottom, width, height = BUTTONS_AT
        axes = self._axes((left, bottom - row * BUTTON_GAP, width, height))
        button = Button(axes, label, color=_rgb(LINE_COLOUR), hovercolor=_rgb((92, 100, 118)))
        button.label.set_color(_rgb(TEXT_COLOUR))
        button.on_clicked(lambda _: action())
        return button

    def _axes(self, box: Box) -> Axes:
        left, bottom, width, height = box
        whole = HEIGHT + HEIGHT_BELOW
        return self.figure.add_axes((left / WIDTH, bottom / whole, width / WIDTH, height / whole))


def explore(
    volumes: LabelVolume | Volumes = None, *, volume: str | None = None, clustering: str | Tissues = "pixels"
) -> Explorer:
    """Open a window, or in a notebook a figure, in which a plane is moved by sliders.

    In a notebook run `%matplotlib widget` first. In a script `matplotlib.pyplot.show()` waits until the window is
    closed.

    Args:
        volumes: A volume, several volumes by name or in a sequence, or a folder with or without a manifest. They
            require no labelled plane. Default: None, four phantoms.
        volume: Name of the first volume to show. Default: None, the first one.
        clustering: Clustering rules: `pixels`, `metric`, or an `armscan.anatomy.Tissues`. Default: `pixels`.

    Returns:
        The explorer; its figure keeps it alive while it is open.

    Raises:
        DisplayError: If no window can be opened.
        InvalidValueError: If an argument is invalid.
        VolumeError: If the folder or a file cannot be used.
        ManifestError: If the folder's manifest is damaged.
    """
    check_display()
    tissues = check_tissues(clustering)
    named = _named(volumes)
    explorer = Explorer(
        named, next(iter(named)) if volume is None else check_choice("volume", volume, [*named]), tissues
    )
    explorer.figure.show()
    return explorer


def _named(volumes: LabelVolume | Volumes) -> dict[str, LabelVolume]:
    if isinstance(volumes, LabelVolume):
        return {volumes.name: volumes}
    if isinstance(volumes, str | Path):
        return {volume.name: volume for volume in open_dataset(volumes, require_manifest=False).volumes.values()}
    return named_volumes(volumes)


def _rgb(colour: Colour) -> tuple[float, float, float]:
    """Return a colour in Matplotlib's form."""
    red, green, blue = (part / 255 for part in colour)
    return red, green, blue
