import json

import pytest

from torchkcreg.implant import Screw
from torchkcreg.io import read_components, write_components

SCREW = {"from": [1, 2, 3], "to": [1, 2, -30], "radius": 2.0, "material": "steel", "fragment": "distal"}


def written(tmp_path, content):
    path = tmp_path / "screws.json"
    path.write_text(json.dumps(content))
    return path


def test_cylinders_are_read_with_names_by_number(tmp_path):
    specs = read_components(written(tmp_path, {"units": "mm", "screws": [SCREW, {**SCREW, "name": "tip"}]}))
    assert specs == [
        Screw((1.0, 2.0, 3.0), (1.0, 2.0, -30.0), 2.0, "steel", "screw0"),
        Screw((1.0, 2.0, 3.0), (1.0, 2.0, -30.0), 2.0, "steel", "tip"),
    ]


def test_cylinders_come_back_as_they_were_written(tmp_path):
    specs = [Screw((0.1, 0.2, 0.3), (4.0, 5.0, 6.0), 1.25, "titanium", "a")]
    write_components(tmp_path / "screws.json", specs)
    assert read_components(tmp_path / "screws.json") == specs


def test_a_common_material_may_stand_once(tmp_path):
    screw = {key: value for key, value in SCREW.items() if key != "material"}
    assert read_components(written(tmp_path, {"material": "cocr", "screws": [screw]}))[0].material == "cocr"


def test_no_screws_are_no_components(tmp_path):
    assert read_components(written(tmp_path, {"screws": []})) == []


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([SCREW], "list 'screws'"),
        ({"screws": {}}, "list 'screws'"),
        ({"units": "m", "screws": [SCREW]}, "units must be mm, got 'm'"),
        ({"screws": ["a"]}, "screw 0 must be an object"),
        ({"screws": [SCREW, {**SCREW, "from": [1, 2]}]}, "'from' of screw 1 must be 3 numbers"),
        ({"screws": [{k: v for k, v in SCREW.items() if k != "to"}]}, "screw 0 has no 'to'"),
        ({"screws": [{**SCREW, "to": SCREW["from"]}]}, "screw 0 has no length"),
        ({"screws": [{**SCREW, "radius": 0}]}, "radius of screw 0 must be a positive number, got 0"),
        ({"screws": [{**SCREW, "radius": "2"}]}, "radius of screw 0"),
        ({"screws": [{**SCREW, "material": 7}]}, "material of screw 0 must be a name"),
        ({"screws": [{**SCREW, "name": ""}]}, "name of screw 0 must be a text"),
        ({"screws": [{**SCREW, "name": "a"}, {**SCREW, "name": "a"}]}, "'a' is there 2 times"),
    ],
)
def test_a_bad_component_is_refused_by_name(tmp_path, content, message):
    with pytest.raises(ValueError, match=rf"^components file .*screws\.json: .*{message}"):
        read_components(written(tmp_path, content))
