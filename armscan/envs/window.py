"""A window of Matplotlib that shows pictures as they come; `armscan data explore` adds sliders to one."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from armscan.errors import DisplayError, reason_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

DPI = 100
# Backends that draw into files or static notebook output, without animation or mouse events.
STILL_BACKENDS = ("agg", "cairo", "inline", "pdf", "pgf", "ps", "svg", "template")


class Window:
    """Shows pictures, each until the next one comes; the first one opens the window.

    A window that a person closes stays closed until `close` has been called and another picture comes.

    Args:
        title: Title of the window.
        frames_per_s: Most pictures a second, above 0.

    Raises:
        DisplayError: If no window can be shown here.
    """

    def __init__(self, title: str, frames_per_s: float) -> None:
        check_display()
        self.title = title
        self._interval_s = 1.0 / frames_per_s
        self._figure: Figure | None = None
        self._image: AxesImage | None = None
        self._is_open = False
        self._shown_s = 0.0

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Show a picture, shape (height, width, 3), once the last one has been shown for long enough."""
        if self._figure is None or self._image is None:
            self._figure, self._image = picture_figure(self.title, picture)
            self._figure.canvas.mpl_connect("close_event", self._was_closed)
            self._figure.show()
            self._is_open = True
        elif self._is_open:
            wait_s = self._shown_s + self._interval_s - time.monotonic()
            if wait_s > 0:
                self._figure.canvas.start_event_loop(wait_s)
            self._image.set_data(picture)
        if self._is_open:
            self._figure.canvas.draw()
            self._figure.canvas.flush_events()
            self._shown_s = time.monotonic()

    def close(self) -> None:
        """Close the window if it is open."""
        if self._figure is not None:
            from matplotlib import pyplot

            pyplot.close(self._figure)
        self._figure = self._image = None
        self._is_open = False

    def _was_closed(self, _: Any) -> None:
        self._is_open = False


def picture_figure(title: str, picture: NDArray[np.uint8], height_below: int = 0) -> tuple[Figure, AxesImage]:
    """Make a figure, not shown yet, that shows a picture pixel for pixel.

    Args:
        title: Title of the window.
        picture: Picture, shape (height, width, 3).
        height_below: Height left free below the picture, in pixels. Default: 0.
    """
    from matplotlib import pyplot

    height, width, _ = picture.shape
    size = width / DPI, (height + height_below) / DPI
    try:
        # Not in interactive mode, in which a notebook would show it already: `Figure.show` does, once.
        with pyplot.ioff():
            figure = pyplot.figure(figsize=size, dpi=DPI, facecolor=picture[0, 0] / 255)
    # Without a display each backend raises its own exception: Tk's TclError derives from Exception alone.
    except Exception as error:
        raise _no_display(reason_of(error)) from error
    if figure.canvas.manager is not None:
        figure.canvas.manager.set_window_title(title)
    axes = figure.add_axes((0.0, height_below / (height + height_below), 1.0, height / (height + height_below)))
    axes.set_axis_off()
    return figure, axes.imshow(picture, aspect="equal")


def check_display() -> None:
    """Raise `DisplayError` unless Matplotlib can show a window here."""
    try:
        from matplotlib import pyplot

        # Default: the first backend that works here.
        backend = str(pyplot.get_backend())
        pyplot.switch_backend(backend)
    except (ImportError, ValueError) as error:
        raise _no_display(reason_of(error)) from error
    if any(still in backend.lower().split(".")[-1].split("_") for still in STILL_BACKENDS):
        raise _no_display(f"Matplotlib's backend is {backend!r}, which shows none")


def _no_display(reason: str) -> DisplayError:
    return DisplayError(
        f"no window can be opened ({reason}): this needs a display, and Tk (python3-tk on Debian) or another of "
        "Matplotlib's interactive backends; in a notebook: armscan's extra [notebook], and then %matplotlib widget"
    )
