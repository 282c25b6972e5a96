"""Random motions of volumes at reset, and their optimal planes."""

import numpy as np
import pytest

from armscan.anatomy import TissueClusters, landmark_reward
from armscan.envs import EnvFactory, ManipulatorAction, RandomTransform
from armscan.envs.rules import Rules
from armscan.envs.scene import SceneSampler, shows_labelled
from armscan.errors import InvalidValueError, OptimalPlaneError
from armscan.volumes import LabelVolume
from tests.conftest import make_tiny_volume


def make_rules(volume, **changes):
    return Rules([volume], **({"rotation_bounds_deg": (90.0, 45.0)} | changes))


def draw(volume, rng, n_scenes=1, **changes):
    """Draw scenes of a volume, one after another."""
    made = make_rules(volume, **changes)
    return [made.draw_scenes([volume.name], [rng])[0][0] for _ in range(n_scenes)]


def test_scene_optimum_is_rewarded_and_within_the_bounds(dataset, phantom):
    rng = np.random.default_rng(0)
    for volume in (*dataset.values(), phantom):
        for scene in draw(volume, rng, 25):
            clusters = TissueClusters.from_slice(volume.slice(scene.optimum, transform=scene.transform))
            assert landmark_reward(clusters) > -0.05
            assert (np.abs(scene.optimum_normalised) <= 1).all()
            assert scene.distance(scene.optimum) == pytest.approx((0.0, 0.0), abs=1e-4)


def test_scene_optimum_shows_the_labelled_plane(phantom):
    """The moved optimum is the labelled plane: in the volume it is parallel to it, and it shows as much bone."""
    labelled = phantom.slice(phantom.optimal_action)
    (scene,) = draw(phantom, np.random.default_rng(1))
    matrix, _offset_mm = scene.transform.plane_map(scene.optimum)
    assert abs(matrix[:, 1] @ phantom.optimal_action.normal) == pytest.approx(1.0)
    seen = TissueClusters.from_slice(phantom.slice(scene.optimum, transform=scene.transform))
    assert seen.bones.n_pixels == pytest.approx(TissueClusters.from_slice(labelled).bones.n_pixels, rel=0.03)


DEFORMED = {"scale": 0.1, "stretch": 0.1, "shear": 0.1, "mirror": True}


@pytest.mark.parametrize("motion", [{}, {"rx_deg": 8.0}, DEFORMED], ids=["as by default", "about X", "deformed"])
def test_slice_of_an_optimal_plane_is_as_it_would_be_looked_up(dataset, phantom, motion):
    shown = set()
    for volume in (*dataset.values(), phantom):
        rules, rng = make_rules(volume, transform=RandomTransform(**motion)), np.random.default_rng(3)
        for scene, slice_xz in rules.draw_scenes([volume.name] * 20, [rng] * 20):
            np.testing.assert_array_equal(slice_xz, volume.slice(scene.optimum, transform=scene.transform))
            shown.add(shows_labelled(scene))
    # Only the default motion leaves some slices exactly as labelled, and shifts others.
    assert shown == ({False} if motion else {True, False})


def test_no_picture_counts_as_the_labelled_one_where_rounding_may_change_a_voxel(phantom):
    between = ManipulatorAction((0.0, 0.0), (0.0, 100.5 * phantom.spacing[1]))
    volume = LabelVolume(phantom.labels, phantom.spacing, "between", between)
    assert phantom.labelled_clearance > 0.0
    assert volume.labelled_clearance == 0.0
    sampler = SceneSampler(rotation_bounds_deg=(180.0, 180.0), translation_bounds_mm=None, transform=None)
    assert shows_labelled(sampler.unmoved(phantom))
    assert not shows_labelled(sampler.unmoved(volume))


def test_scene_optimum_stays_within_tight_rotation_bounds(phantom):
    rz, rx = phantom.optimal_action.rotation
    tight = draw(
        phantom,
        np.random.default_rng(0),
        200,
        rotation_bounds_deg=(abs(rz) + 10.0, abs(rx) + 20.0),
        transform=RandomTransform(rz_deg=10.0, rx_deg=20.0, tx_mm=0.0, ty_mm=0.0),
        success_threshold=1.0,
    )
    assert max(np.abs(scene.optimum_normalised).max() for scene in tight) <= 1


def test_scene_without_transform_is_the_volume_as_it_is(phantom):
    (scene,) = draw(phantom, np.random.default_rng(0), transform=None)
    assert scene.transform is None
    assert scene.optimum == phantom.optimal_action


def test_bounds_do_not_depend_on_the_draw(phantom):
    assert len({scene.bounds for scene in draw(phantom, np.random.default_rng(0), 20)}) == 1


def test_random_transform_stays_within_its_limits(phantom):
    rng = np.random.default_rng(0)
    drawn = [RandomTransform(rz_deg=3, rx_deg=1, tx_mm=0, ty_mm=7).draw(phantom, rng) for _ in range(200)]
    values = np.array([[*transform.rotation, *transform.translation] for transform in drawn])
    assert (np.abs(values).max(axis=0) <= [3, 1, 0, 7]).all()
    assert (values.std(axis=0) > [1, 0.3, -1, 2]).all()
    assert drawn[0].centre_mm == phantom.centre_mm


DEFORMED_LESS = {"scale": 0.08, "stretch": 0.05, "shear": 0.09, "mirror": True}


def test_deformations_keep_the_labelled_plane(phantom):
    """Every point of the moved optimum shows a point of the labelled plane, and a plane beside it none."""
    points = np.random.default_rng(0).uniform(0.0, 90.0, (20, 3)) * [1, 0, 1]
    normal, origin = phantom.optimal_action.normal, phantom.optimal_action.offset_mm
    for scene in draw(phantom, np.random.default_rng(0), 10, transform=RandomTransform(rx_deg=5.0, **DEFORMED_LESS)):
        matrix, offset_mm = scene.plane_map(scene.optimum)
        np.testing.assert_allclose((points @ matrix.T + offset_mm - origin) @ normal, 0.0, atol=1e-6)
        (rz, rx), (tx, ty) = scene.optimum.rotation, scene.optimum.translation
        matrix, offset_mm = scene.plane_map(ManipulatorAction((rz, rx), (tx, ty + 1.0)))
        assert np.abs((points @ matrix.T + offset_mm - origin) @ normal).min() > 0.8


def test_deformations_leave_the_motions_as_they_are(phantom):
    """The same seed moves a volume as without deformations; another seed draws other deformations."""
    moved = draw(phantom, np.random.default_rng(5), transform=RandomTransform())[0]
    deformed = [
        draw(phantom, np.random.default_rng(seed), transform=RandomTransform(**DEFORMED_LESS))[0] for seed in (5, 6)
    ]
    assert deformed[0].optimum == moved.optimum
    assert not np.allclose(deformed[0].transform.deformation, deformed[1].transform.deformation)


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("scale", lambda f: np.allclose(f, f[0, 0] * np.eye(3))),
        ("stretch", lambda f: np.allclose(f, np.diag(f.diagonal())) and len(set(f.diagonal())) == 3),
        ("shear", lambda f: (f.diagonal() == 1.0).all() and (f[[0, 0, 2, 2], [1, 2, 0, 1]] != 0.0).all()),
        ("mirror", lambda f: (np.abs(f) == np.eye(3)).all()),
    ],
)
def test_each_deformation_does_one_thing(phantom, name, shape):
    transform = RandomTransform(**{name: DEFORMED_LESS[name]})
    rng = np.random.default_rng(1)
    drawn = np.array([transform.draw(phantom, rng).deformation for _ in range(60)])
    assert all(shape(deformation) for deformation in drawn)
    spread = np.abs(np.abs(drawn) - np.eye(3)).max()
    changes = drawn - np.eye(3)
    # In both directions equally often; a mirrored axis goes one way.
    assert abs(np.mean(drawn[:, 0, 0] < 0.0) - (0.5 if name == "mirror" else 0.0)) < 0.15
    assert name == "mirror" or -0.8 * changes.min() < changes.max() < -1.25 * changes.min()
    assert spread == 0.0 if name == "mirror" else 0.8 * DEFORMED_LESS[name] < spread <= DEFORMED_LESS[name]
    assert {np.sign(deformation[0, 0]) for deformation in drawn} == ({-1.0, 1.0} if name == "mirror" else {1.0})


def test_agents_are_judged_on_volumes_as_they_are(phantom):
    factory = EnvFactory(transform=RandomTransform(rz_deg=3.0, **DEFORMED_LESS))
    assert factory.undeformed().rules["transform"] == RandomTransform(rz_deg=3.0)
    assert factory.rules["transform"].scale == 0.08
    bare = EnvFactory(transform=None)
    assert bare.undeformed().rules == bare.rules


def test_a_mirrored_volume_shows_the_labelled_slice_mirrored(phantom):
    transform = RandomTransform(rz_deg=0.0, tx_mm=0.0, ty_mm=0.0, mirror=True)
    rng = np.random.default_rng(0)
    labelled = phantom.slice(phantom.optimal_action)
    shown = [phantom.slice(phantom.optimal_action, transform=transform.draw(phantom, rng)) for _ in range(20)]
    is_mirrored = [not np.array_equal(each, labelled) for each in shown]
    assert 0 < sum(is_mirrored) < 20
    for each, mirrored in zip(shown, is_mirrored, strict=True):
        # A point halfway between two voxels may fall to either.
        assert (each == (labelled[::-1] if mirrored else labelled)).mean() > 0.99


def test_a_scaled_volume_shows_its_tissues_scaled(phantom):
    transform = RandomTransform(rz_deg=0.0, tx_mm=0.0, ty_mm=0.0, scale=0.2)
    rng = np.random.default_rng(0)
    labelled = (phantom.slice(phantom.optimal_action) > 0).sum()
    for _ in range(5):
        moved = transform.draw(phantom, rng)
        shown = (phantom.slice(phantom.optimal_action, transform=moved) > 0).sum()
        assert shown / labelled == pytest.approx(moved.deformation[0, 0] ** 2, rel=0.02)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"scale": 0.5}, "transform scale is 0.5, but it must be .* 0.3"),
        ({"stretch": -0.1}, "transform stretch is -0.1"),
        ({"shear": "a"}, "transform shear is 'a'"),
        ({"mirror": 1}, "transform mirror is 1"),
        ({"rz_deg": -1}, "transform rz_deg is -1"),
        ({"rx_deg": "a"}, "transform rx_deg is 'a'"),
        ({"tx_mm": float("nan")}, "transform tx_mm is nan"),
        ({"centre": "corner"}, "transform centre is 'corner'"),
    ],
)
def test_impossible_motions_and_deformations_are_refused(arguments, message):
    with pytest.raises(InvalidValueError, match=message):
        RandomTransform(**arguments)


def test_random_transform_about_the_first_voxel_as_published(phantom):
    drawn = RandomTransform(centre="first_voxel").draw(phantom, np.random.default_rng(0))
    np.testing.assert_array_equal(drawn.offset_mm, [*drawn.translation, 0.0])


def test_task_refuses_a_volume_without_a_labelled_plane():
    with pytest.raises(OptimalPlaneError, match="tiny: has no labelled plane"):
        make_rules(make_tiny_volume())


def test_task_refuses_a_plane_that_does_not_score():
    volume = make_tiny_volume(optimal_action=ManipulatorAction((0, 0), (0, 5)))
    with pytest.raises(OptimalPlaneError, match=r"tiny: the labelled plane scores -0\.\d+"):
        make_rules(volume)


@pytest.mark.parametrize("rz", [7.1234567, -7.1234567])
def test_task_refuses_bounds_that_do_not_hold_the_turned_plane(phantom, rz):
    plane = ManipulatorAction((rz, 0.0), phantom.optimal_action.translation)
    phantom = LabelVolume(phantom.labels, phantom.spacing, "phantom-0", plane)
    expected = r"phantom-0: the optimal plane has rz = .* it must be at least (\S+)$"
    with pytest.raises(OptimalPlaneError, match=expected) as refused:
        make_rules(phantom, rotation_bounds_deg=(abs(rz) + 9.0, 45.0), success_threshold=0.2)
    make_rules(phantom, rotation_bounds_deg=(float(str(refused.value).split()[-1]), 45.0), success_threshold=0.2)


def test_plane_that_lies_on_the_rotation_bound_is_reached(phantom):
    rotation = (7.1234567, 3.3)
    plane = ManipulatorAction(rotation, phantom.optimal_action.translation)
    sampler = SceneSampler(
        rotation_bounds_deg=rotation,
        translation_bounds_mm=None,
        transform=RandomTransform(rz_deg=0.0, rx_deg=0.0, tx_mm=5.0, ty_mm=5.0),
    )
    scene = sampler.propose(LabelVolume(phantom.labels, phantom.spacing, "tilted", plane), np.random.default_rng(0))
    assert scene is not None
    assert np.abs(scene.optimum_normalised).max() <= 1


def test_task_refuses_a_plane_outside_the_volume(phantom):
    moved = LabelVolume(phantom.labels, phantom.spacing, "moved", ManipulatorAction((0, 0), (0, 5000)))
    with pytest.raises(OptimalPlaneError, match=r"moved: the optimal plane, .* misses the volume"):
        make_rules(moved)


def test_task_gives_up_where_no_transform_keeps_the_plane_in_view(phantom):
    with pytest.raises(OptimalPlaneError, match="phantom-0: no transform of 1000"):
        draw(
            phantom,
            _OutOfView(),
            translation_bounds_mm=(97.0, phantom.optimal_action.translation[1] + 0.01),
            success_threshold=1e-9,
        )


class _OutOfView:
    """A random generator that always moves the hand out of the picture."""

    def random(self, _size):
        """Return draws as shares of the way from the lowest to the highest."""
        return np.array([0.5, 0.5, 20.5, -19.5])
