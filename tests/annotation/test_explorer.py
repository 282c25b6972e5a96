"""The window in which the user moves the plane."""

import gc

import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.backend_bases import MouseButton, MouseEvent

import armscan.annotation.explorer
from armscan.annotation.explorer import explore
from armscan.cli.main import main
from armscan.envs.rendering import HEIGHT, WIDTH, ReferencePlane, draw_plane, view_of
from armscan.errors import DisplayError, InvalidValueError
from armscan.volumes import LabelVolume, ManipulatorAction

MIDDLE = (0.5, 0.5)


def drag(explorer, axes, *places):
    """Press the mouse at the first place in the axes, move it over the others, and let go at the last one."""
    canvas = explorer.figure.canvas
    kinds = ["button_press_event", *["motion_notify_event"] * (len(places) - 1), "button_release_event"]
    for kind, place in zip(kinds, (*places, places[-1]), strict=True):
        x, y = axes.transAxes.transform(place)
        canvas.callbacks.process(kind, MouseEvent(kind, canvas, x, y, button=MouseButton.LEFT))


def click(explorer, button):
    drag(explorer, button.ax, MIDDLE)


def on_screen(explorer):
    """Return the picture as the window shows it, above the sliders."""
    explorer.figure.canvas.draw()
    return np.asarray(explorer.figure.canvas.buffer_rgba())[:HEIGHT, :, :3]


def renamed(volume, name, optimal_action):
    return LabelVolume(volume.labels, volume.spacing, name, optimal_action=optimal_action)


@pytest.fixture
def explorer(phantom, unseen_windows):
    return explore(phantom)


def test_explore_shows_the_picture_above_four_sliders(explorer, phantom):
    assert tuple(explorer.sliders) == ("rz", "rx", "tx", "ty")
    assert [(slider.valmin, slider.valmax) for slider in explorer.sliders.values()] == [
        (-180.0, 180.0),
        (-180.0, 180.0),
        (0.0, phantom.size_mm[0]),
        (0.0, phantom.size_mm[1]),
    ]
    shown = on_screen(explorer)
    assert shown.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_array_equal(shown, explorer.picture())
    assert explorer.figure.canvas.manager.n_shown == 1


@pytest.mark.parametrize("component", range(4))
def test_explore_looks_at_the_plane_that_a_slider_is_dragged_to(explorer, phantom, component):
    before, picture = explorer.plane.to_array(), on_screen(explorer).copy()
    slider = list(explorer.sliders.values())[component]
    drag(explorer, slider.ax, (0.3, 0.5), (0.4, 0.5))
    after = explorer.plane.to_array()
    assert after[component] == pytest.approx(0.6 * slider.valmin + 0.4 * slider.valmax)
    np.testing.assert_array_equal(np.delete(after, component), np.delete(before, component))
    view = view_of(phantom, explorer.plane)
    np.testing.assert_array_equal(explorer.view.slice_xz, view.slice_xz)
    assert len(explorer.rewards) == 3
    assert explorer.rewards[-1] == view.reward
    assert (on_screen(explorer) != picture).any()


def test_explore_jumps_to_the_optimal_plane_and_shows_it_beside(explorer, phantom):
    beside = ReferencePlane(explorer.optimum, "optimal plane")
    assert (explorer.picture() != draw_plane(phantom, explorer.plane, explorer.view)).any()
    click(explorer, explorer.optimum_button)
    assert explorer.plane == beside.action
    assert explorer.rewards[-1] == 0.0
    assert explorer.view.clusters.counts == (4, 3, 1)


def test_explore_goes_from_volume_to_volume(phantom, unseen_windows):
    wide = LabelVolume(phantom.labels, (1.0, 2.0, 1.0), "wide")
    explorer = explore([phantom, wide], volume="wide")
    assert explorer.volume is wide
    assert explorer.sliders["ty"].valmax == wide.size_mm[1]
    click(explorer, explorer.next_button)
    assert explorer.volume is phantom
    assert explorer.sliders["ty"].valmax == phantom.size_mm[1]
    assert len(explorer.rewards) == 1
    click(explorer, explorer.previous_button)
    assert explorer.volume is wide
    np.testing.assert_array_equal(on_screen(explorer), explorer.picture())


@pytest.mark.parametrize("optimum", [None, ManipulatorAction((0.0, 0.0), (0.0, 5000.0))])
def test_explore_needs_no_optimal_plane_that_can_be_reached(phantom, unseen_windows, optimum):
    explorer = explore([renamed(phantom, "bare", optimum), phantom], volume="bare")
    assert explorer.optimum is None
    assert explorer.optimum_button.label.get_text() == "no optimal plane known"
    before = explorer.plane
    click(explorer, explorer.optimum_button)
    assert explorer.plane == before
    drag(explorer, explorer.sliders["ty"].ax, MIDDLE, (0.6, 0.5))
    assert explorer.plane != before
    click(explorer, explorer.next_button)
    click(explorer, explorer.optimum_button)
    assert explorer.rewards[-1] == 0.0


def test_explore_shows_the_last_rewards_in_its_picture(explorer, monkeypatch):
    monkeypatch.setattr(armscan.annotation.explorer, "N_REMEMBERED", 3)
    drawn = []
    monkeypatch.setattr(
        armscan.annotation.explorer, "RewardHistory", lambda rewards, places, *_: drawn.append((rewards, places))
    )
    for along_mm in (20.0, 60.0, 100.0, 140.0):
        explorer.sliders["ty"].set_val(along_mm)
    assert len(explorer.rewards) == 5
    assert drawn[0] == (explorer.rewards[:2], range(1, 4))
    assert drawn[-1] == (explorer.rewards[2:], range(3, 6))


def test_explore_goes_on_while_nobody_holds_the_explorer(phantom, unseen_windows):
    explore(phantom)
    gc.collect()
    explorer = pyplot.gcf().explorer
    drag(explorer, explorer.sliders["ty"].ax, MIDDLE, (0.6, 0.5))
    assert len(explorer.rewards) > 1


def test_explore_reads_a_folder_without_a_manifest(unseen_windows, write_labelmap, phantom):
    folder = write_labelmap("a.nii.gz", phantom.labels, (*phantom.spacing, 1.0)).parent
    assert main(["data", "explore", str(folder), "--volume=a.nii.gz", "--clustering=metric"]) == 0
    assert pyplot.gcf().explorer.volume.name == "a.nii.gz"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a", "b"], "Got unexpected extra argument (b)"),
        (["--folder=x"], "No such option '--folder'"),
        (["--volume="], "volume is '', but it must be phantom-0, "),
        (["/no/such/folder"], "/no/such/folder: the folder of volumes does not exist"),
        (["--clustering=x"], "Invalid value for '--clustering': 'x' is not one of 'pixels', 'metric'."),
        (["--volume=x"], "volume is 'x', but it must be phantom-0, phantom-1, phantom-2 or phantom-3"),
    ],
)
def test_explore_answers_a_mistake_in_one_line(words, message, unseen_windows, capsys):
    assert main(["data", "explore", *words]) == 2
    captured = capsys.readouterr().err
    assert captured.startswith(f"error: {message}")
    assert captured.count("\n") == 1
    assert pyplot.get_fignums() == []


def test_explore_refuses_what_is_no_volume(unseen_windows):
    with pytest.raises(InvalidValueError, match="volumes is 3, but"):
        explore(3)


def test_explore_explains_itself_without_a_display(capsys):
    assert main(["data", "explore", "--help"]) == 0
    assert "Usage: armscan data explore [OPTIONS] [FOLDER]" in capsys.readouterr().out


def test_explore_without_a_display_is_refused_in_one_line(phantom, capsys):
    before = pyplot.get_backend()
    pyplot.switch_backend("agg")
    try:
        with pytest.raises(DisplayError):
            explore(phantom)
        assert main(["data", "explore"]) == 2
    finally:
        pyplot.switch_backend(before)
    assert capsys.readouterr().err.startswith("error: no window can be opened (Matplotlib's backend is 'agg'")
