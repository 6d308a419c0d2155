"""MJCF as text: what is changed, and that every other byte stays."""

from __future__ import annotations

from pathlib import Path

import pytest

from localization.errors import SimulationError
from localization.twin.xml_file import Change, load, parse

TEXT = b"""<?xml version="1.0"?>
<!-- a comment with <geom friction="9"/> in it -->
<mujoco model='r'>
  <default><geom friction="0.4"/></default>
  <worldbody>
    <geom name="floor" type='plane' size="1 1 1"   friction = "1 .005 .0001" />
    <body name="b"><geom name="a>b" size=".1"/></body>
  </worldbody>
</mujoco>
"""


def _parsed(text: bytes = TEXT):
    return parse({"r.xml": text}, Path("r.xml"))


def test_changed_attribute_leaves_all_other_bytes() -> None:
    mjcf = _parsed()
    floor = mjcf.named("geom", "floor")
    assert floor is not None
    new = mjcf.changed([Change(floor, {"friction": "0.5"})])
    assert new.files["r.xml"] == TEXT.replace(b'friction = "1 .005 .0001"', b'friction = "0.5"')


def test_new_attribute_and_new_element_are_added_in_place() -> None:
    mjcf = _parsed()
    geom = mjcf.named("geom", "a>b")
    assert geom is not None
    new = mjcf.changed([Change(geom, {"condim": "4"}), Change(mjcf.root, {"cone": "elliptic"}, "option")])
    text = new.files["r.xml"]
    assert b'<geom name="a>b" size=".1" condim="4"/>' in text
    assert b"<mujoco model='r'><option cone=\"elliptic\"/>" in text
    assert text.replace(b' condim="4"', b"").replace(b'<option cone="elliptic"/>', b"") == TEXT


def test_attribute_of_none_is_taken_away() -> None:
    mjcf = _parsed()
    floor = mjcf.named("geom", "floor")
    assert floor is not None
    text = mjcf.changed([Change(floor, {"friction": None, "mass": None})]).files["r.xml"]
    assert b"friction = " not in text
    assert b'<geom name="floor" type=\'plane\' size="1 1 1" />' in text


def test_elements_of_defaults_and_comments_are_no_geoms() -> None:
    assert [e.attributes.get("name") for e in _parsed().elements("geom")] == ["floor", "a>b"]


def test_change_in_an_included_file_changes_that_file(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text('<mujoco><include file="robot.xml"/><worldbody/></mujoco>')
    (tmp_path / "robot.xml").write_text('<mujoco><worldbody><geom name="g" size="1"/></worldbody></mujoco>')
    mjcf = load(tmp_path / "scene.xml")
    geom = mjcf.named("geom", "g")
    assert geom is not None
    new = mjcf.changed([Change(geom, {"size": "2"})])
    assert new.files["scene.xml"] == mjcf.files["scene.xml"]
    assert b'size="2"' in new.files["robot.xml"]


@pytest.mark.parametrize(
    ("text", "message"),
    [(b"<mujoco><body></mujoco>", "line 1"), (b"<robot/>", "root is <robot>"), (b"", "no XML")],
)
def test_what_is_no_mjcf_is_named_with_its_place(text: bytes, message: str) -> None:
    with pytest.raises(SimulationError, match=message):
        _parsed(text)


def test_comment_with_two_dashes_is_valid_xml() -> None:
    assert b"a - - b" in _parsed().with_comment("a -- b").files["r.xml"]


def test_meshes_keep_their_folder_in_another_one(tmp_path: Path) -> None:
    text = b'<mujoco><compiler meshdir="meshes"/><asset><mesh name="m" file="m.stl"/></asset></mujoco>'
    mjcf = parse({"r.xml": text}, tmp_path / "sim" / "r.xml")
    moved = mjcf.with_folders_of(tmp_path / "out" / "numbers")
    assert b'meshdir="../../sim/meshes"' in moved.files["r.xml"]
