"""Round trip of calibration files, and error messages for invalid ones."""

import json

import numpy as np
import pytest

from contactgraph.data import InvalidInputError
from contactgraph_franka.perception import (
    CalibrationResiduals,
    CameraCalibration,
    Intrinsics,
    Tag,
    TaggedObject,
    read_calibration,
    single_tag,
    write_calibration,
)
from contactgraph_franka.perception.camera import pose, rotation_of

MADE = "2026-01-31T12:00:00+00:00"
LENS = Intrinsics(900.5, 901.25, 639.5, 359.5, 1280, 720, (0.1, -0.02, 1e-4, 2e-4, 0.0))
PLACE = pose(rotation_of(np.array([0.3, 1.0, -0.2])), np.array([1.25, 0.0, 0.55]))


def calibration(**change):
    block = TaggedObject(
        (Tag(0, 0.032, np.eye(4)), Tag(1, 0.032, pose(np.eye(3), np.array([0.0, 0.0, 0.1]))))
    )
    fields = {
        "intrinsics": LENS,
        "camera_pose": PLACE,
        "objects": {"block": block, "other": single_tag(8, 0.05)},
        "made": MADE,
        "residuals": CalibrationResiduals(20, 0.1, 3e-4, 4e-4, 9e-4),
    }
    return CameraCalibration(**{**fields, **change})


def test_a_calibration_is_read_as_written(tmp_path):
    for number, written in enumerate((calibration(), calibration(residuals=None, objects={}))):
        path = tmp_path / f"{number}.json"
        write_calibration(path, written)
        found = read_calibration(path)
        assert found.intrinsics == written.intrinsics and found.residuals == written.residuals
        assert found.made == MADE and list(found.objects) == list(written.objects)
        np.testing.assert_array_equal(found.camera_pose, written.camera_pose)
        for name, tagged in written.objects.items():
            for one, other in zip(found.objects[name].tags, tagged.tags, strict=True):
                assert (one.id, one.size) == (other.id, other.size)
                np.testing.assert_array_equal(one.pose, other.pose)


MISSING = object()


@pytest.mark.parametrize(
    ("where", "value", "said"),
    [
        (["format"], "x", "must be a camera's calibration, whose 'format' is"),
        (["format_version"], 2, "field 'format_version' must be 1, found 2"),
        (["made"], "yesterday", "made must be a time such as 2026-01-31"),
        (["made"], 5, "field 'made' must be a text, found 5"),
        (["intrinsics", "fx"], -1.0, "fx must be at least 1.0 px, found -1.0"),
        (["intrinsics", "width"], 1280.5, "intrinsics: field 'width' must be a whole number"),
        (["intrinsics", "distortion"], [0.1], "intrinsics: field 'distortion' must be 5 numbers"),
        (["intrinsics"], [], "field 'intrinsics' must be an object"),
        (["camera_pose", 0, 0], 2.0, "camera_pose must be a rotation and a position"),
        (["camera_pose"], [[1.0]], "field 'camera_pose' must be 4 x 4 numbers, found 1 x 1"),
        (["camera_pose", 1, 2], "a", r"field 'camera_pose[1][2]' must be a finite number"),
        (["residuals", "pixel"], None, "field 'pixel' must be a finite number, found None"),
        (["objects", 1, "name"], "block", "there is another object called 'block'"),
        (["objects", 1, "tags", 0, "id"], 1, "tag 1 is on 'block' and on 'other'"),
        (["objects", 0, "tags", 0, "size"], 0.0, "size of tag 0 must be 0.001 to 10 m"),
        (["objects", 0, "tags"], [], "tags must be at least one"),
        (["objects"], {}, "field 'objects' must be a list of objects"),
        *[
            ([name], MISSING, f"field '{name}' is missing")
            for name in ("made", "intrinsics", "camera_pose", "objects")
        ],
    ],
)
def test_errors_name_the_wrong_field(where, value, said, tmp_path):
    path = tmp_path / "camera.json"
    write_calibration(path, calibration())
    content = part = json.loads(path.read_text())
    for step in where[:-1]:
        part = part[step]
    if value is MISSING:
        del part[where[-1]]
    else:
        part[where[-1]] = value
    path.write_text(json.dumps(content))
    with pytest.raises(InvalidInputError) as error:
        read_calibration(path)
    assert str(error.value).startswith(f"{path}: ") and said in str(error.value)
    assert "\n" not in str(error.value) and str(error.value).count(str(path)) == 1


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": NaN}', "[" * 100_000, "\x00\xff"])
def test_other_files_are_refused(text, tmp_path):
    path = tmp_path / "camera.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InvalidInputError, match="must be a camera's calibration"):
        read_calibration(path)


def test_no_folder_no_file_and_no_file_at_all(tmp_path):
    with pytest.raises(InvalidInputError, match="does not exist"):
        write_calibration(tmp_path / "none" / "camera.json", calibration())
    with pytest.raises(InvalidInputError, match=r"none\.json: does not exist$"):
        read_calibration(tmp_path / "none.json")
    with pytest.raises(InvalidInputError, match="must be a file, found a folder"):
        read_calibration(tmp_path)
