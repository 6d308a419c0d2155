"""Files of references by their formats, and what is in none."""

from __future__ import annotations

import functools
import math
import operator
from pathlib import Path

import numpy as np
import pytest

from localization.errors import EvaluationError
from localization.evaluation.reference_files import read_reference_file
from localization.evaluation.references import ReferenceTrack

T0 = 1_700_000_000
TURN = np.linspace(0.0, 2.0, 21)
TRUTH = np.column_stack([5.0 * np.sin(TURN), 5.0 * (1.0 - np.cos(TURN)), TURN])
"""(21, 3) an arc to the left."""
STAMPS = T0 * 10**9 + 100_000_000 * np.arange(21)


def _track(path: Path, lines: list[str], **more: object) -> ReferenceTrack:
    path.write_text("\n".join(lines) + "\n")
    found = read_reference_file(path, **more)  # type: ignore[arg-type]
    assert isinstance(found, ReferenceTrack)
    return found


def _check(found: ReferenceTrack, atol: float = 1e-6) -> None:
    np.testing.assert_allclose(found.poses, TRUTH, atol=atol)
    np.testing.assert_array_equal(found.stamps_ns, STAMPS)


def test_reference_euroc_is_read_by_its_header(tmp_path):
    head = (
        "#timestamp,p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],v_RS_R_x [m s^-1],b_w_RS_S_x [rad s^-1]"
    )
    rows = [f"{t},{x},{y},0.1,{math.cos(a / 2)},0,0,{math.sin(a / 2)},9,9" for t, (x, y, a) in zip(STAMPS, TRUTH, strict=True)]
    _check(_track(tmp_path / "data.csv", [head, *rows]))
    _check(_track(tmp_path / "bare.csv", [",".join(row.split(",")[:8]) for row in rows]))


def test_reference_tum_with_commas_is_read(tmp_path):
    rows = [f"{t / 1e9:.3f},{x},{y},0,0,0,{math.sin(a / 2)},{math.cos(a / 2)}" for t, (x, y, a) in zip(STAMPS, TRUTH, strict=True)]
    _check(_track(tmp_path / "a.tum", rows))
    _check(_track(tmp_path / "a.csv", rows))


@pytest.mark.parametrize("is_camera", [False, True])
def test_reference_with_y_up_has_the_heading_of_the_axis_that_is_ahead(tmp_path, is_camera):
    """x ahead, y up and z to the right, as of mocap; cameras have z ahead."""
    truth = np.array([[math.cos(a), math.sin(a), a + math.pi / 2] for a in np.linspace(0.0, 4.0, 60)])
    rows = []
    for i, (x, y, a) in enumerate(truth):
        place = (y, x) if is_camera else (x, -y)  # x and z of the file, whose plane is (z, x)
        rows.append(f"{i * 0.1:.1f} {place[0]} 0.3 {place[1]} 0 {math.sin(a / 2)} 0 {math.cos(a / 2)}")
    found = _track(tmp_path / "a.tum", rows)
    way = np.diff(found.poses[:, :2], axis=0)
    along = np.arctan2(way[:, 1], way[:, 0]) - found.poses[:-1, 2]
    np.testing.assert_allclose(np.angle(np.exp(1j * along)), 0.0, atol=0.1)


def test_reference_tum_with_w_first_is_read(tmp_path):
    """As some exports of mocap: with w last they would tumble."""
    rows = [f"{t / 1e9:.3f} {x} {y} 0 {math.cos(a / 2)} 0 0 {math.sin(a / 2)}" for t, (x, y, a) in zip(STAMPS, TRUTH, strict=True)]
    found = _track(tmp_path / "a.tum", rows)
    _check(found)
    assert "have w first" in found.warnings[0]


def test_reference_tum_of_a_body_upside_down_keeps_w_last(tmp_path):
    rows = [f"{t / 1e9:.3f} {x} {y} 0 {math.cos(a / 2)} {math.sin(a / 2)} 0 0" for t, (x, y, a) in zip(STAMPS, TRUTH, strict=True)]
    assert not any("w first" in text for text in _track(tmp_path / "a.tum", rows).warnings)


@pytest.mark.parametrize("per_second", [1e3, 1e6, 1e9])
def test_reference_tum_of_smaller_units_of_time_is_read(tmp_path, per_second):
    rows = [
        f"{t / 1e9 * per_second:.1f} {x} {y} 0 0 0 {math.sin(a / 2)} {math.cos(a / 2)}" for t, (x, y, a) in zip(STAMPS, TRUTH, strict=True)
    ]
    found = _track(tmp_path / "a.tum", rows)
    np.testing.assert_allclose(found.poses, TRUTH, atol=1e-6)
    np.testing.assert_allclose(found.stamps_ns - STAMPS, 0.0, atol=1e6)


def _kitti(truth: np.ndarray) -> list[str]:
    """Of cameras: x to the right, y down, z ahead."""
    return [f"{math.cos(a)} 0 {-math.sin(a)} {-y} 0 1 0 0.01 {math.sin(a)} 0 {math.cos(a)} {x}" for x, y, a in truth]


def test_reference_kitti_takes_times_beside_it_else_the_scans(tmp_path):
    found = _track(tmp_path / "00.txt", _kitti(TRUTH), log_stamps=lambda: STAMPS[[0, 10, 20]])
    _check(found)
    assert not found.has_times
    assert "has no times" in found.warnings[0]
    (tmp_path / "times.txt").write_text("".join(f"{t / 1e9:.1f}\n" for t in STAMPS))
    found = _track(tmp_path / "00.txt", _kitti(TRUTH))
    _check(found)
    assert found.has_times


def test_reference_kitti_of_a_body_with_z_up_is_read(tmp_path):
    rows = [f"{math.cos(a)} {-math.sin(a)} 0 {x} {math.sin(a)} {math.cos(a)} 0 {y} 0 0 1 0" for x, y, a in TRUTH]
    _check(_track(tmp_path / "a.txt", rows, log_stamps=lambda: STAMPS))


@pytest.mark.parametrize(
    ("head", "row"),
    [
        ("time,x,y,yaw", "{s:.1f},{x},{y},{a}"),
        ("t;pos_x [mm];pos_y [mm];heading_deg", "{s:.1f};{mm_x};{mm_y};{deg}"),
        (
            "%time,field.header.seq,field.header.stamp,field.pose.position.x,field.pose.position.y,field.pose.position.z,"
            "field.pose.orientation.x,field.pose.orientation.y,field.pose.orientation.z,field.pose.orientation.w",
            "1,7,{t},{x},{y},0,0,0,{sin},{cos}",
        ),
        (
            "header.stamp.sec,header.stamp.nanosec,twist.linear.x,pose.pose.position.x,pose.pose.position.y,theta",
            "{sec},{nsec},3.0,{x},{y},{a}",
        ),
    ],
)
def test_reference_csv_is_read_by_names_of_columns(tmp_path, head, row):
    rows = []
    for t, (x, y, a) in zip(STAMPS.tolist(), TRUTH.tolist(), strict=True):
        numbers = {"mm_x": 1000 * x, "mm_y": 1000 * y, "deg": math.degrees(a), "sin": math.sin(a / 2), "cos": math.cos(a / 2)}
        rows.append(row.format(t=t, s=t / 1e9, sec=t // 10**9, nsec=t % 10**9, x=x, y=y, a=a, **numbers))
    _check(_track(tmp_path / "a.csv", [head, *rows]))


def test_reference_csv_of_semicolons_has_decimal_commas(tmp_path):
    rows = [f"{t / 1e9:.3f};{x};{y};{a}".replace(".", ",") for t, (x, y, a) in zip(STAMPS, TRUTH, strict=True)]
    _check(_track(tmp_path / "a.csv", ["time;x;y;yaw", *rows]))


def test_reference_with_y_as_height_takes_the_plane_of_z_and_x(tmp_path):
    rows = [f"{t / 1e9:.1f} {y} 0.8 {x} 0 {math.sin(a / 2)} 0 {math.cos(a / 2)}" for t, (x, y, a) in zip(STAMPS, TRUTH, strict=True)]
    found = _track(tmp_path / "mocap.tum", rows)
    _check(found)
    assert "height" in found.warnings[0]


def test_reference_g2o_is_spread_over_the_scans(tmp_path):
    lines = [f"VERTEX_SE2 {i} {x} {y} {a}" for i, (x, y, a) in enumerate(TRUTH)] + ["EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1"]
    found = _track(tmp_path / "a.g2o", lines, log_stamps=lambda: STAMPS)
    _check(found)
    with pytest.raises(EvaluationError, match="has no times"):
        read_reference_file(tmp_path / "a.g2o")


def _degrees(x: float, y: float) -> tuple[float, float]:
    """Latitude and longitude near 48 N, 11 E, on the sphere of the ellipsoid's curvatures there."""
    return 48.0 + y / 111_200.0, 11.0 + x / (111_320.0 * math.cos(math.radians(48.0)) * 1.00185)


def test_reference_gpx_gives_positions_in_metres(tmp_path):
    points = []
    for i, (x, y, _) in enumerate(TRUTH):
        lat, lon = _degrees(x, y)
        points.append(f'<trkpt lat="{lat:.9f}" lon="{lon:.9f}"><ele>500</ele><time>2023-11-14T22:13:{20 + i * 0.1:04.1f}Z</time></trkpt>')
    text = ['<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>', *points, "</trkseg></trk></gpx>"]
    found = _track(tmp_path / "a.gpx", text)
    assert found.yaws is None
    np.testing.assert_allclose(found.positions, TRUTH[:, :2], atol=0.02)
    np.testing.assert_array_equal(found.stamps_ns, STAMPS)


def test_reference_nmea_takes_the_date_of_rmc_else_the_logs(tmp_path):
    def words(x: float, y: float) -> str:
        lat, lon = _degrees(x, y)
        return f"48{60 * (lat - 48):010.7f},N,011{60 * (lon - 11):010.7f},E"

    def sentence(body: str) -> str:
        return f"${body}*{functools.reduce(operator.xor, body.encode()):02X}"

    gga = [sentence(f"GNGGA,2213{20 + i * 0.1:04.1f},{words(x, y)},4,12,0.7,500.0,M,47.0,M,,") for i, (x, y, _) in enumerate(TRUTH)]
    rmc = sentence("GNRMC,221320.0,A,4800.0,N,01100.0,E,0.1,0.0,141123,,,A")
    found = _track(tmp_path / "a.nmea", [rmc, *gga])
    np.testing.assert_allclose(found.positions, TRUTH[:, :2], atol=0.02)
    np.testing.assert_array_equal(found.stamps_ns, STAMPS)
    found = _track(tmp_path / "b.txt", gga, log_stamps=lambda: STAMPS)
    np.testing.assert_array_equal(found.stamps_ns, STAMPS)
    assert "without a date" in found.warnings[0]
    damaged = [line.replace("48", "58", 1) if i % 7 == 3 else line for i, line in enumerate(gga)]
    found = _track(tmp_path / "c.nmea", [rmc, *damaged])
    kept = np.array([i % 7 != 3 for i in range(len(gga))])
    np.testing.assert_array_equal(found.stamps_ns, STAMPS[kept])
    np.testing.assert_allclose(found.positions - found.positions[0], TRUTH[kept, :2] - TRUTH[0, :2], atol=0.02)
    assert f"{(~kept).sum()} NMEA sentences with a wrong checksum" in found.warnings[0]
    with pytest.raises(EvaluationError, match="checksums of all"):
        _track(tmp_path / "d.nmea", ["$GNRMC,221320.0,A,4800.0,N,01100.0,E,0.1,0.0,141123,,,A*00"])


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", "holds no data"),
        ("a note on the drive\nof yesterday\n", "holds no data"),
        ("1 2 3 4 5\n", "5 columns and no header"),
        ("time,speed\n1,2\n", "2 columns and no header"),
        ("1 0 0 0 0 1 0 0 0 0 5 0\n", "not poses of KITTI"),
    ],
)
def test_reference_of_no_format_is_refused_with_what_works(tmp_path, text, found):
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(EvaluationError, match=f"{found}.*KITTI"):
        read_reference_file(tmp_path / "a.txt")


def _degrees_of(x: float, y: float) -> tuple[float, float]:
    """Latitude and longitude [deg] of east and north [m], to centimetres in 10 m."""
    return 47.3 + math.degrees(y / 6.3674e6), 8.5 + math.degrees(x / (6.3893e6 * math.cos(math.radians(47.3))))


@pytest.mark.parametrize("header", ["t,lat_deg,lat_min,lat_sec,lon_deg,lon_min,lon_sec", "t,Lat(D),Lat(M),Lat(S),Lon(D),Lon(M),Lon(S)"])
def test_reference_in_degrees_minutes_and_seconds_is_read(tmp_path: Path, header: str) -> None:
    rows = []
    for t, (x, y, _) in zip(STAMPS, TRUTH, strict=True):
        parts = [(int(a), int(60.0 * (a % 1.0)), 60.0 * (60.0 * (a % 1.0) % 1.0)) for a in _degrees_of(x, y)]
        rows.append(f"{t / 1e9:.3f}," + ",".join(f"{d},{m},{s:.8f}" for d, m, s in parts))
    found = _track(tmp_path / "novatel.csv", [header, *rows])
    np.testing.assert_allclose(found.positions - found.positions[0], TRUTH[:, :2], atol=0.03)


def test_reference_in_minutes_of_nmea_is_read_as_such(tmp_path: Path) -> None:
    rows = []
    for t, (x, y, _) in zip(STAMPS, TRUTH, strict=True):
        latitude, longitude = (100.0 * int(a) + 60.0 * (a % 1.0) for a in _degrees_of(x, y))
        rows.append(f"{t / 1e9:.3f},{latitude:.9f},{longitude:.9f}")
    found = _track(tmp_path / "gps.csv", ["time,latitude,longitude", *rows])
    np.testing.assert_allclose(found.positions - found.positions[0], TRUTH[:, :2], atol=0.03)
    assert "ddmm.mmmm" in found.warnings[0]
    with pytest.raises(EvaluationError, match="beyond 90 degrees"):
        _track(tmp_path / "none.csv", ["time,latitude,longitude", *(f"{t / 1e9:.3f},4790.5,830.5" for t in STAMPS)])


def test_last_line_that_is_cut_is_left_out(tmp_path: Path) -> None:
    rows = [f"{t / 1e9:.3f} {x} {y} 0 0 0 {math.sin(a / 2)} {math.cos(a / 2)}" for t, (x, y, a) in zip(STAMPS, TRUTH, strict=True)]
    (tmp_path / "cut.tum").write_text("\n".join([*rows, "1700000002.1 4.5 7"]))
    found = read_reference_file(tmp_path / "cut.tum")
    assert isinstance(found, ReferenceTrack)
    _check(found)
    (tmp_path / "short.tum").write_text("\n".join([*rows, "1700000002.1 4.5 7"]) + "\n")
    with pytest.raises(EvaluationError, match="line 22: expected 8 numbers"):
        read_reference_file(tmp_path / "short.tum")


def test_point_cloud_and_pointer_are_named_as_no_reference(tmp_path: Path) -> None:
    (tmp_path / "map.pcd").write_text("# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nDATA ascii\n0 0 0\n")
    with pytest.raises(EvaluationError, match=r"is a point cloud \(PCD, PLY\), which has no trajectory"):
        read_reference_file(tmp_path / "map.pcd")
    (tmp_path / "truth.tum").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n")
    with pytest.raises(EvaluationError, match="is a pointer of Git LFS, not the reference itself"):
        read_reference_file(tmp_path / "truth.tum")


def test_poses_that_are_repeated_until_a_jump_are_left_out(tmp_path: Path) -> None:
    """A tracker that has lost its markers publishes its last pose; a robot that stands moves on by small steps."""
    t = np.arange(400) * 0.05
    way = np.minimum(t, 8.0) + np.maximum(t - 10.0, 0.0)
    held = np.where((t > 15.0) & (t < 17.0), way[t <= 15.0][-1], way)
    lines = [f"{T0 + at:.3f} {x:.4f} 0 0 0 0 0 1" for at, x in zip(t, held, strict=True)]
    found = _track(tmp_path / "mocap.tum", lines)
    at = (found.stamps_ns - T0 * 10**9) * 1e-9
    assert not ((at > 15.06) & (at < 16.99)).any()
    assert ((at > 8.0) & (at < 10.0)).sum() == 39
    assert "repeated until a jump" in " ".join(found.warnings)
