"""A Matplotlib backend with invisible windows, whose contents can be read and which react to clicks."""

from matplotlib.backend_bases import FigureManagerBase
from matplotlib.backends.backend_agg import FigureCanvasAgg


class FigureManager(FigureManagerBase):
    title = ""
    n_shown = 0

    def show(self):
        self.n_shown += 1

    def set_window_title(self, title):
        self.title = title


class FigureCanvas(FigureCanvasAgg):
    manager_class = FigureManager
