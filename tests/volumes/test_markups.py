"""Planes written for 3D Slicer and read back."""

import json
from dataclasses import replace

import jsonschema
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from armscan.errors import InvalidValueError, MarkupError
from armscan.volumes import ManipulatorAction, RigidTransform, plane_distance, read_markup, read_volume, write_markup
from tests.conftest import make_tiny_volume

TINY = make_tiny_volume()
ACTION = ManipulatorAction((12.0, -7.0), (1.0, 6.0))

angles = st.floats(-80, 80)
anywhere, inside = st.floats(0, 1), st.floats(0.01, 0.99)
turns = st.tuples(st.floats(-180, 180), st.floats(-180, 180), st.floats(-180, 180))
places = st.tuples(*[st.floats(-500, 500)] * 3)


def numbers(n):
    return {"type": "array", "items": {"type": "number"}, "minItems": n, "maxItems": n}


def strict(**properties):
    return {"type": "object", "properties": properties, "additionalProperties": False}


TEXT, FLAG = {"type": "string"}, {"type": "boolean"}
# What 3D Slicer's markups-schema-v1.0.3.json allows for the keys that armscan writes, and no other keys.
PLANE = strict(
    type={"enum": ["Plane"]},
    name=TEXT,
    coordinateSystem={"enum": ["LPS", "RAS"]},
    coordinateUnits={"enum": ["mm", "um"]},
    locked=FLAG,
    planeType=TEXT,
    sizeMode=TEXT,
    center=numbers(3),
    normal=numbers(3),
    size=numbers(3),
    planeBounds=numbers(4),
    baseToNode=numbers(16),
    orientation=numbers(9),
    controlPoints={
        "type": "array",
        "items": strict(
            id=TEXT,
            label=TEXT,
            position=numbers(3),
            positionStatus={"enum": ["undefined", "preview", "defined"]},
        ),
    },
    display=strict(visibility=FLAG, opacity={"type": "number"}, handlesInteractive=FLAG),
)
DOCUMENT = strict(**{"@schema": TEXT}, markups={"type": "array", "items": PLANE | {"required": ["type"]}})
DOCUMENT["required"] = ["@schema", "markups"]
keep_folder = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@st.composite
def volumes(draw):
    """Return the tiny volume anywhere in the world, its axes oblique, left- or right-handed."""
    about_z, about_x, about_z_again = draw(turns)
    turn = RigidTransform((about_z, about_x)).matrix @ RigidTransform((about_z_again, 0.0)).matrix
    return replace(TINY, origin=draw(places), direction=turn * draw(st.sampled_from([(1, 1, 1), (1, -1, 1)])))


@st.composite
def actions(draw, within=anywhere):
    """Return a plane whose origin lies in the tiny volume."""
    place = np.array(draw(st.tuples(within, within))) * TINY.size_mm[:2]
    return ManipulatorAction(draw(st.tuples(angles, angles)), tuple(place.tolist()))


def written(folder, volume=TINY, action=ACTION):
    path = folder / "plane.mrk.json"
    write_markup(path, volume, action)
    return path, json.loads(path.read_text())


def rewritten(folder, change, volume=TINY, action=ACTION):
    """Return the file as another program or person may have left it: `change` edits its markup."""
    path, document = written(folder, volume, action)
    change(document["markups"][0])
    path.write_text(json.dumps(document))
    return path


def assert_same_plane(action, other):
    assert plane_distance(action, other, (4.0, 3.0)) == pytest.approx((0.0, 0.0), abs=1e-3)
    assert plane_distance(other, action, (-40.0, 30.0)) == pytest.approx((0.0, 0.0), abs=1e-3)


def in_ras(markup):
    """Return a markup as Slicer writes it in RAS: the first two coordinates change their sign."""
    flip = np.array([-1, -1, 1])
    markup["coordinateSystem"] = "RAS"
    for key in ("center", "normal"):
        markup[key] = (flip * markup[key]).tolist()
    markup["baseToNode"] = (
        (np.array([-1, -1, 1, 1])[:, None] * np.reshape(markup["baseToNode"], (4, 4))).ravel().tolist()
    )
    for point in markup["controlPoints"]:
        point["position"] = (flip * point["position"]).tolist()


def with_points(*offsets):
    """Return a change that replaces centre and normal by control points at these (x, y) in the rectangle's frame."""

    def change(markup):
        base = np.reshape(markup["baseToNode"], (4, 4))
        points = [base @ [x, y, 0.0, 1.0] for x, y in offsets]
        markup["controlPoints"] = [{"position": point[:3].tolist()} for point in points]
        for key in ("center", "normal", "baseToNode", "orientation", "size", "planeBounds", "planeType"):
            del markup[key]

    return change


def as_three_points(markup):
    with_points((3.0, 1.0), (6.0, 1.0), (3.0, -2.0))(markup)
    markup["planeType"] = "threePoints"


def as_plane_fit(markup):
    with_points((3.0, 1.0), (6.0, 1.0), (3.0, -2.0), (-1.0, -4.0))(markup)
    markup["planeType"] = "planeFit"


def as_normal_between_points(markup):
    start, normal = np.array(markup["center"]), np.array(markup["normal"])
    as_three_points(markup)
    markup["planeType"] = "pointNormal"
    markup["controlPoints"] = [{"position": p.tolist()} for p in (start, start + 5 * normal)]


def as_centre_and_normal(markup):
    markup["normal"] = [-5 * component for component in markup["normal"]]
    del markup["controlPoints"], markup["baseToNode"]


def as_slicer_saves_it(markup):
    markup["objectToBase"] = np.diag([-1.0, -1.0, 1.0, 1.0]).ravel().tolist()
    markup["coordinateUnits"] = ["mm", "UCUM", "millimeter"]
    markup["controlPoints"].append({"position": [0.0, 0.0, 0.0], "positionStatus": "undefined"})


@given(volumes(), actions())
@keep_folder
def test_markup_is_read_back_as_the_plane_it_was_written_from(tmp_path, volume, action):
    path, _ = written(tmp_path, volume, action)
    np.testing.assert_allclose(read_markup(path, volume).to_array(), action.to_array(), atol=1e-6)


@pytest.mark.parametrize(
    "change",
    [
        in_ras,
        as_three_points,
        with_points((3.0, 1.0), (6.0, 1.0), (3.0, -2.0)),
        as_plane_fit,
        as_normal_between_points,
        as_centre_and_normal,
        as_slicer_saves_it,
    ],
)
# Inside, because a plane that only touches a corner of the volume may miss it by a rounding error.
@given(volume=volumes(), action=actions(within=inside))
@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_markup_is_read_in_every_notation_of_the_plane(tmp_path, change, volume, action):
    path = rewritten(tmp_path, change, volume, action)
    assert_same_plane(read_markup(path, volume), action)


def test_markup_drawn_by_a_person_is_a_slice_about_the_middle(tmp_path):
    at = 30.0
    volume = replace(TINY, labels=np.pad(TINY.labels, ((0, 0), (0, 80), (0, 0))))
    straight = ManipulatorAction((0.0, 0.0), (0.0, at))
    path = rewritten(tmp_path, as_three_points, volume, straight)
    np.testing.assert_allclose(read_markup(path, volume).to_array(), straight.to_array(), atol=1e-9)


def test_markup_shows_the_rectangle_that_the_slice_fills(write_labelmap):
    import SimpleITK

    path = write_labelmap("oblique.nrrd", np.transpose(TINY.labels, (2, 0, 1)))
    image = SimpleITK.ReadImage(str(path))
    image.SetOrigin((-30.0, 12.5, 140.0))
    direction = RigidTransform((25.0, 40.0)).matrix * (1, 1, -1)
    image.SetDirection(direction.ravel().tolist())
    SimpleITK.WriteImage(image, str(path))
    volume = read_volume(path, axes="zxy")
    _, document = written(path.parent, volume, ACTION)
    markup = document["markups"][0]
    base = np.reshape(markup["baseToNode"], (4, 4))
    slice_xz = volume.slice(ACTION)
    left, right, low, high = markup["planeBounds"]
    for i, k in np.ndindex(slice_xz.shape):
        # The middle of pixel (i, k) in the rectangle, in the world, and the voxel that ITK has there.
        x = left + (i + 0.5) / slice_xz.shape[0] * (right - left)
        y = low + (k + 0.5) / slice_xz.shape[1] * (high - low)
        index = image.TransformPhysicalPointToIndex((base @ [x, y, 0.0, 1.0])[:3].tolist())
        inside = all(0 <= n < size for n, size in zip(index, image.GetSize(), strict=True))
        assert slice_xz[i, k] == (image[index] if inside else 0), (i, k)
    assert slice_xz.any()


@given(volumes(), actions())
@keep_folder
def test_markup_says_its_plane_in_each_key_alike_and_right_handed(tmp_path, volume, action):
    _, document = written(tmp_path, volume, action)
    (markup,) = document["markups"]
    orientation = np.reshape(markup["orientation"], (3, 3))
    base_to_node = np.reshape(markup["baseToNode"], (4, 4))
    assert np.linalg.det(orientation) == pytest.approx(1.0)
    assert base_to_node[:3, :3].tolist() == orientation.tolist()
    assert base_to_node[:3, 3].tolist() == markup["center"] == markup["controlPoints"][0]["position"]
    assert orientation[:, 2].tolist() == markup["normal"]
    np.testing.assert_allclose(abs(volume.direction @ action.normal @ markup["normal"]), 1.0)
    assert (markup["coordinateSystem"], markup["coordinateUnits"]) == ("LPS", "mm")


def test_markup_is_what_slicers_schema_allows(tmp_path):
    validator = jsonschema.Draft202012Validator(DOCUMENT)
    _, document = written(tmp_path)
    validator.validate(document)
    (markup,) = document["markups"]
    for key, value in {"center": [0.0, 0.0], "planeBounds": [0.0] * 3, "coordinateUnits": "cm", "foo": 1}.items():
        assert not validator.is_valid(document | {"markups": [markup | {key: value}]}), key


def set_key(key, value):
    return lambda markup: markup.update({key: value})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_key("type", "ROI"), r"the type of the markups is \['ROI'\], but it must be 'Plane'"),
        (set_key("coordinateSystem", "IJK"), "coordinateSystem is 'IJK', but it must be LPS or RAS"),
        (set_key("coordinateSystem", ["LPS"]), "coordinateSystem is"),
        (set_key("coordinateUnits", "um"), "coordinateUnits is 'um', but it must be mm"),
        (set_key("coordinateUnits", ["cm", "UCUM", "centimeter"]), "coordinateUnits is"),
        (set_key("planeType", "bent"), "planeType is 'bent', but it must be planeFit, pointNormal or threePoints"),
        (set_key("center", [0.0, float("nan"), 0.0]), r"center is \[0.0, nan, 0.0\], but it must be 3 finite numbers"),
        (set_key("center", [0.0, 1e9, 0.0]), r"center is .* within \+-1e\+06"),
        (set_key("normal", [0, 0, 0]), r"normal is \[0.0, 0.0, 0.0\], but it must be a direction other than zero"),
        (set_key("normal", [0, 0, 1]), "center and normal are .* degrees off the plane"),
        (set_key("baseToNode", [0] * 16), r"baseToNode is \[0.0, 0.0, 0.0\], but it must be a direction"),
        (set_key("baseToNode", [1, 2]), "baseToNode is .* 16 finite numbers"),
        (set_key("size", "large"), "size is 'large'"),
        (set_key("controlPoints", 3), "controlPoints is 3, but it must be a list of objects"),
        (set_key("controlPoints", [{}]), "position is None"),
    ],
)
def test_markup_that_is_wrong_is_refused_by_its_key(tmp_path, change, message):
    path = rewritten(tmp_path, change)
    with pytest.raises(MarkupError, match=message) as caught:
        read_markup(path, TINY)
    assert str(caught.value).startswith(f"{path}: ")


def test_markup_without_anything_that_says_where_the_plane_lies_is_refused(tmp_path):
    def change(markup):
        for key in ("center", "controlPoints"):
            del markup[key]

    with pytest.raises(MarkupError, match="too few controlPoints"):
        read_markup(rewritten(tmp_path, change), TINY)


def test_markup_with_points_on_one_line_is_refused(tmp_path):
    with pytest.raises(MarkupError, match=r"controlPoints is .* do not lie on one line"):
        read_markup(rewritten(tmp_path, with_points((0.0, 0.0), (1.0, 1.0), (3.0, 3.0))), TINY)


def test_markups_with_two_planes_are_refused_and_with_other_markups_are_read(tmp_path):
    path, document = written(tmp_path)
    document["markups"].insert(0, {"type": "Fiducial"})
    path.write_text(json.dumps(document))
    assert_same_plane(read_markup(path, TINY), ACTION)
    document["markups"].append(document["markups"][1])
    path.write_text(json.dumps(document))
    with pytest.raises(MarkupError, match=r"\['Fiducial', 'Plane', 'Plane'\], but it must be 'Plane' for exactly one"):
        read_markup(path, TINY)


@pytest.mark.parametrize(
    ("normal", "message"),
    [
        ([0, 0, 1], "along the palm"),
        ([1, 0, 0], r"origin \(tx, ty\) must lie"),
        ([0, 1, 0], r"origin \(tx, ty\) must lie"),
    ],
)
def test_markup_of_a_plane_that_is_no_action_is_refused(tmp_path, normal, message):
    def change(markup):
        as_centre_and_normal(markup)
        markup.update(center=[200.0, 200.0, 5.0], normal=normal)

    with pytest.raises(MarkupError, match=message):
        read_markup(rewritten(tmp_path, change), TINY)


junk = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda children: st.lists(children, max_size=4) | st.dictionaries(st.text(max_size=5), children, max_size=3),
    max_leaves=6,
)


@given(st.data())
@keep_folder
def test_markup_that_is_damaged_is_read_or_refused_in_one_line(tmp_path, data):
    path, document = written(tmp_path)
    holder = document["markups"][0]
    for _ in range(data.draw(st.integers(1, 3))):
        if data.draw(st.booleans()) and holder.get("controlPoints"):
            holder = data.draw(st.sampled_from([document["markups"][0], document]))
        key = data.draw(st.sampled_from(sorted(holder)))
        if data.draw(st.booleans()):
            del holder[key]
        else:
            holder[key] = data.draw(junk)
        if "markups" not in document or document["markups"] != [holder]:
            break
    path.write_text(json.dumps(document))
    assert_read_or_refused(path)


@given(st.integers(0, 2000), st.binary(max_size=20))
@keep_folder
def test_markup_that_is_cut_and_overwritten_is_read_or_refused_in_one_line(tmp_path, place, noise):
    path, _ = written(tmp_path)
    contents = path.read_bytes()
    path.write_bytes(contents[:place] + noise)
    assert_read_or_refused(path)


def assert_read_or_refused(path):
    try:
        read = read_markup(path, TINY)
    except MarkupError as error:
        message = str(error)
    else:
        assert_same_plane(read, ACTION)
        return
    assert message.startswith(f"{path}: ")
    assert "\n" not in message


def test_markup_that_is_not_there_or_a_folder_or_nested_too_deeply_is_refused(tmp_path):
    deep = tmp_path / "deep.mrk.json"
    deep.write_text("[" * 100_000)
    for path in (tmp_path / "none.mrk.json", tmp_path, deep):
        with pytest.raises(MarkupError, match="cannot be read"):
            read_markup(path, TINY)


def test_markup_is_written_to_a_folder_that_is_there_under_a_name_that_slicer_knows(tmp_path):
    with pytest.raises(MarkupError, match=r"must end in \.mrk\.json"):
        write_markup(tmp_path / "plane.json", TINY, ACTION)
    with pytest.raises(MarkupError, match="cannot be written"):
        write_markup(tmp_path / "none" / "plane.mrk.json", TINY, ACTION)
    assert list(tmp_path.iterdir()) == []


def test_markup_refuses_arguments_of_other_types(tmp_path):
    path, _ = written(tmp_path)
    with pytest.raises(InvalidValueError, match="must be a LabelVolume"):
        write_markup(path, TINY, (0, 0, 0, 0))
    with pytest.raises(InvalidValueError, match="must be a LabelVolume"):
        read_markup(path, TINY.labels)
