"""Pictures of an episode, and of a plane outside of one."""

import numpy as np
import pytest
from gymnasium.wrappers import RecordEpisodeStatistics

from armscan.envs import ArmscanEnv, ManipulatorAction
from armscan.envs.panels import (
    OPTIMUM_COLOUR,
    OUTLINE_COLOUR,
    PLANE_COLOUR,
    REWARD_COLOUR,
    SHADES,
    TISSUE_COLOURS,
    UNCLUSTERED,
    side_panels,
    slice_panel,
)
from armscan.envs.rendering import (
    FRONTAL_BOX,
    HEIGHT,
    REWARD_BOX,
    SAGITTAL_BOX,
    WIDTH,
    ReferencePlane,
    draw_plane,
    view_of,
)
from armscan.errors import ResetNeededError
from armscan.volumes import LabelVolume
from armscan.volumes.rigid_transform import RigidTransform


def n_shown(picture, colour):
    return int((picture == np.array(colour, dtype=np.uint8)).all(axis=-1).sum())


def within(picture, box):
    left, top, right, bottom = box
    return picture[top:bottom, left:right]


def shaded(label, shade):
    return (TISSUE_COLOURS[label] * shade).astype(np.uint8)


@pytest.fixture
def env(phantom):
    env = ArmscanEnv([phantom], projection="zy", render_mode="rgb_array")
    env.reset(seed=0)
    return env


def test_render_shows_slice_planes_and_changes_with_the_step(env):
    first = env.render()
    assert first.shape == (HEIGHT, WIDTH, 3)
    assert first.dtype == np.uint8
    for colour in (PLANE_COLOUR, OPTIMUM_COLOUR, *TISSUE_COLOURS):
        assert n_shown(first, colour) > 0
    for box in (FRONTAL_BOX, SAGITTAL_BOX):
        assert n_shown(within(first, box), PLANE_COLOUR) > 100
        assert n_shown(within(first, box), OPTIMUM_COLOUR) > 20
    env.step(np.array([0.2, 0.5]))
    assert (env.render() != first).any()


def test_render_draws_the_reward_of_every_step(env):
    lasts = []
    for _ in range(4):
        columns = (within(env.render(), REWARD_BOX) == REWARD_COLOUR).all(axis=-1).any(axis=0)
        lasts.append(int(np.flatnonzero(columns).max()))
        if env.episode.is_running:
            env.step(np.array([0.9, -0.9]))
    assert len(lasts) == 4
    assert lasts == sorted(set(lasts))


def test_render_shows_each_cluster_of_the_optimal_plane_apart(phantom):
    view = view_of(phantom, phantom.optimal_action)
    picture = np.asarray(slice_panel(view, (516, 236)))
    assert view.clusters.counts == (4, 3, 1)
    for label, n_clusters in ((1, 4), (2, 3), (3, 1)):
        for shade in SHADES[:n_clusters]:
            assert n_shown(picture, shaded(label, shade)) > 50
    assert n_shown(picture, OUTLINE_COLOUR) > 300


def test_render_outlines_clusters_alone():
    labels = np.zeros((60, 3, 30), dtype=np.uint8)
    labels[2:12, :, 2:14], labels[30:40, :, 2:14] = 1, 1
    labels[50:56, :, 20:26] = 2
    labels[20:21, :, 20:21] = 3
    view = view_of(LabelVolume(labels, (1.0, 1.0, 1.0), "blocks"), ManipulatorAction((0.0, 0.0), (0.0, 1.0)))
    assert view.clusters.counts == (2, 1, 0)
    picture = np.asarray(slice_panel(view, (600, 300)))
    assert picture.shape == (300, 600, 3)
    # Ten pixels per voxel, depth upward.
    voxels = picture[::-1].reshape(30, 10, 60, 10, 3)
    for (across, depth), colour in (
        ((6, 6), shaded(1, SHADES[0])),
        ((34, 6), shaded(1, SHADES[1])),
        ((20, 20), shaded(3, UNCLUSTERED)),
        ((40, 20), TISSUE_COLOURS[0]),
    ):
        assert (voxels[depth, :, across] == colour).all()
    is_clustered = sum(tissue.image > 0 for tissue in view.clusters.each()) > 0
    has_outline = (voxels == OUTLINE_COLOUR).all(axis=-1).any(axis=(1, 3)).T
    assert has_outline.sum() > 80
    assert not has_outline[~is_clustered].any()


@pytest.mark.parametrize("is_right_handed", [True, False])
def test_render_shows_a_volume_as_it_is_seen_from_the_palm_and_from_the_side(is_right_handed):
    labels = np.zeros((30, 40, 20), dtype=np.uint8)
    labels[2:6, 4:36, 2:8], labels[24:28, 4:36, 2:8] = 1, 2
    # Nearest to the palm, with the second tissue.
    labels[24:28, 10:20, 15:18] = 3
    direction = np.diag([1.0 if is_right_handed else -1.0, 1.0, 1.0])
    volume = LabelVolume(labels, (1.0, 1.0, 1.0), "blocks", direction=direction)
    plane = ManipulatorAction((20.0, 0.0), (0.0, 10.0))
    frontal, sagittal = map(np.asarray, side_panels(volume, None, [(plane, PLANE_COLOUR, 1)], ((300, 400), (200, 400))))
    # Seen from high z with the fingers, at low y, up: X runs to the left in a right-handed frame.
    at_left, at_right = (frontal[300, column] for column in (40, 260))
    assert [*map(tuple, (at_left, at_right))] == [
        tuple(TISSUE_COLOURS[label]) for label in ((2, 1) if is_right_handed else (1, 2))
    ]
    artery = 40 if is_right_handed else 260
    assert tuple(frontal[150, artery]) == tuple(TISSUE_COLOURS[3])
    rows, columns = np.nonzero((frontal == PLANE_COLOUR).all(axis=-1))
    assert (np.corrcoef(rows, columns)[0, 1] < 0) == is_right_handed
    # From the side, z runs to the right: the nearer tissue is at high x, or at low x in a left-handed frame.
    assert tuple(sagittal[300, 50]) == tuple(TISSUE_COLOURS[2 if is_right_handed else 1])


def test_draw_plane_without_an_episode_names_no_step_and_no_optimal_plane(phantom, monkeypatch):
    from PIL import ImageDraw

    written = []
    monkeypatch.setattr(ImageDraw.ImageDraw, "text", lambda _, __, text, **___: written.append(text))
    plane = ManipulatorAction((3.0, 0.0), (0.0, 100.0))
    view = view_of(phantom, plane)
    draw_plane(phantom, plane, view)
    assert f"reward {view.reward:.3f}" in written
    assert not [text for text in written if "step" in text or "optimal" in text or "from the p" in text[:10]]
    written.clear()
    draw_plane(phantom, plane, view, reference=ReferencePlane(plane, "former plane"))
    assert {"former plane", "0.0 mm and 0.0°", "from the former plane", "rz 3.0°, rx 0.0°"} <= set(written)
    written.clear()
    draw_plane(phantom, plane, view, transform=RigidTransform((5.0, 0.0)))
    assert "in the moved volume: rz 3.0°, rx 0.0°" in written


@pytest.mark.parametrize(
    ("rz_deg", "transform", "seen_from"),
    [
        (10.0, None, "fingers"),
        (170.0, None, "elbow"),
        (80.0, RigidTransform((20.0, 0.0)), "elbow"),
        (100.0, RigidTransform((-20.0, 0.0)), "fingers"),
    ],
)
@pytest.mark.parametrize("is_right_handed", [True, False])
def test_title_says_from_where_the_slice_is_seen(phantom, monkeypatch, is_right_handed, rz_deg, transform, seen_from):
    from PIL import ImageDraw

    written = []
    monkeypatch.setattr(ImageDraw.ImageDraw, "text", lambda _, __, text, **___: written.append(text))
    direction = np.diag([1.0 if is_right_handed else -1.0, 1.0, 1.0])
    volume = LabelVolume(phantom.labels, phantom.spacing, "wrist", phantom.optimal_action, direction=direction)
    plane = ManipulatorAction((rz_deg, 0.0), (30.0, 40.0))
    draw_plane(volume, plane, view_of(volume, plane), transform=transform)
    other = {"fingers": "elbow", "elbow": "fingers"}
    assert f"slice, palm up, from the {seen_from if is_right_handed else other[seen_from]}" in written


def test_titles_say_where_the_palm_is_not_at_high_z(phantom, monkeypatch):
    from PIL import ImageDraw

    written = []
    monkeypatch.setattr(ImageDraw.ImageDraw, "text", lambda _, __, text, **___: written.append(text))
    plane = ManipulatorAction((10.0, 0.0), (30.0, 40.0))
    volume = LabelVolume(np.ascontiguousarray(phantom.labels[:, :, ::-1]), phantom.spacing, "turned over")
    draw_plane(volume, plane, view_of(volume, plane))
    assert {"slice, back of the hand up, from the fingers", "frontal, from the back of the hand"} <= set(written)


def test_draw_plane_shortens_a_long_name(phantom, monkeypatch):
    from PIL import ImageDraw

    written = []
    monkeypatch.setattr(ImageDraw.ImageDraw, "text", lambda _, __, text, **___: written.append(text))
    plane = phantom.optimal_action
    volume = LabelVolume(phantom.labels, phantom.spacing, "subject-" * 20 + "left.nii.gz")
    draw_plane(volume, plane, view_of(volume, plane))
    (name,) = [text for text in written if "…" in text]
    assert name.startswith("subject-")
    assert name.endswith("left.nii.gz")


def test_render_draws_a_volume_one_voxel_thick(phantom):
    labels = phantom.labels[:, :1].copy()
    labels[:3, 0, 0] = 1, 2, 3
    volume = LabelVolume(labels, phantom.spacing, "thin")
    plane = ManipulatorAction((0.0, 0.0), (0.0, 0.0))
    assert draw_plane(volume, plane, view_of(volume, plane)).shape == (HEIGHT, WIDTH, 3)


def test_render_needs_an_episode(phantom):
    with pytest.raises(ResetNeededError):
        ArmscanEnv([phantom], render_mode="rgb_array").render()


def test_render_goes_through_wrappers(env):
    assert RecordEpisodeStatistics(env).render().shape == (HEIGHT, WIDTH, 3)


def test_render_without_a_mode_warns(phantom):
    env = ArmscanEnv([phantom])
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="without a render_mode"):
        assert env.render() is None
