"""Centre of gravity with arms: weighing minus arms plus arms, payload, covariance against Monte Carlo, VaultBot's postures, tracking."""

from __future__ import annotations

import dataclasses
import math
import time
import xml.etree.ElementTree as ET
from importlib import resources

import numpy as np
import pytest

from motion_models.center_of_gravity.cg_model import CgTracker, cg_model, parse_postures, posture_for, static_part_from_weighing
from motion_models.center_of_gravity.files import arms_model, arms_postures, urdf_cg, weighed_cg
from motion_models.center_of_gravity.kinematics import COM, MASS, flatten
from motion_models.center_of_gravity.parts import Arms, Payload, StaticPart, Tolerances, require_support, support_margin
from motion_models.center_of_gravity.urdf import parse_urdf
from motion_models.center_of_gravity.weighing import Scales, WeighedCg, cg_from_scales, wheel_contacts
from motion_models.errors import CgError, RobotError
from tests.helpers import urdf_reference
from tests.helpers.extended import cases

TEXT = (resources.files("motion_models") / "robots" / "vaultbot.urdf").read_text()
URDF = parse_urdf(TEXT, "vaultbot.urdf")
CHAIN = flatten(URDF)
VAULTBOT = Arms(urdf="vaultbot.urdf", postures="vaultbot.srdf")
POSTURES = arms_postures(VAULTBOT)
CONTACTS = wheel_contacts(0.52, 0.56)
SAMPLES = 2000


def readings_of(mass, cg):
    """(4,) loads of the wheels of a robot on level scales."""
    return mass / 4 * (1.0 + CONTACTS[:, 0] * cg[0] / 0.26**2 + CONTACTS[:, 1] * cg[1] / 0.28**2)


def assert_covariance(samples, claimed):
    """Sample covariance of ``samples`` (n, 2) is ``claimed`` (2, 2), to five sigma of its own scatter (Wishart)."""
    scatter = np.sqrt((np.outer(np.diag(claimed), np.diag(claimed)) + claimed**2) / len(samples))
    assert np.all(np.abs(np.cov(samples.T) - claimed) <= 5 * scatter), (np.cov(samples.T), claimed)


def moment_of_arms(chain, q):
    """(2,) first moment of the moving bodies [kg m]: all minus what is there when the moving bodies weigh nothing."""
    light = chain.constants.copy()
    light[1:, MASS] = 0.0
    base = dataclasses.replace(chain, constants=light)
    return (chain.center_of_mass(q) * chain.mass - base.center_of_mass(q) * base.mass)[:2]


def shaken(chain, rng, tolerances):
    """The same robot, built with other masses: each moving body errs in mass and in place."""
    constants = chain.constants.copy()
    bodies = len(constants) - 1
    constants[1:, MASS] *= 1 + rng.normal(0, tolerances.mass_fraction, bodies)
    constants[1:, COM:] += rng.normal(0, tolerances.com_m, (bodies, 3))
    return dataclasses.replace(chain, constants=constants)


def test_cg_model_of_weighing_minus_and_plus_arms_is_the_robot():
    """Weigh the robot that the URDF describes, take its arms away, and find it again at every other posture."""
    cg = CHAIN.center_of_mass(CHAIN.posture(POSTURES["stow_back"]))
    weighed = cg_from_scales(readings_of(CHAIN.mass, cg)[None], CONTACTS)
    static = static_part_from_weighing(weighed, CHAIN, POSTURES["stow_back"])
    # Independent: the static links' masses, added up by the other reader.
    fixed = ET.fromstring(TEXT)
    for link in fixed.findall("link"):
        name, inertial = link.get("name"), link.find("inertial")
        if inertial is not None and name.startswith(("left_", "right_")) and not name.endswith(("base_link", "controller")):
            link.remove(inertial)
    expected, mass = urdf_reference.center_of_mass(ET.tostring(fixed, encoding="unicode"), {})
    assert static.mass == pytest.approx(mass)
    np.testing.assert_allclose(static.position, expected[:2], atol=1e-12)

    model = cg_model(URDF, static=static)
    for posture in POSTURES.values():
        expected, _ = urdf_reference.center_of_mass(TEXT, posture)
        np.testing.assert_allclose(model.cg(model.chain.posture(posture)), expected[:2], atol=1e-12)


def test_cg_model_with_a_static_part_replaces_the_urdf():
    static = StaticPart(50.0, np.array([0.03, -0.01]), np.zeros((3, 3)))
    model = cg_model(URDF, static=static)
    q = np.linspace(-1, 1, 10)
    arms = CHAIN.mass - CHAIN.constants[0, MASS]
    assert model.chain.mass == pytest.approx(50.0 + arms)
    np.testing.assert_allclose(model.cg(q), (50.0 * static.position + moment_of_arms(CHAIN, q)) / (50.0 + arms), atol=1e-12)


NOTHING = Tolerances(0.0, 0.0, 0.0)
NO_SCALES = Scales(0.0, 0.0, 0.0)
SOURCES = {
    "scales": (NOTHING, Scales(0.3, 0.0, 0.0)),
    "calibration": (NOTHING, Scales(0.0, 0.004, 0.0)),
    "contacts": (NOTHING, Scales(0.0, 0.0, 0.004)),
    "masses": (Tolerances(0.05, 0.0, 0.0), NO_SCALES),
    "centres": (Tolerances(0.0, 0.01, 0.0), NO_SCALES),
    "joints": (Tolerances(0.0, 0.0, 0.02), NO_SCALES),
    "all": (Tolerances(0.05, 0.01, 0.02), Scales(0.3, 0.004, 0.004)),
}


@pytest.mark.extended
@pytest.mark.parametrize("source", cases(SOURCES, usual=("contacts", "centres", "all")))
def test_cg_covariance_of_a_weighed_robot_is_that_of_samples(source):
    """The whole way: scales err, wheels stand elsewhere, the arms' masses are wrong in what is taken away and in what is added."""
    tolerances, scales = SOURCES[source]
    rng = np.random.default_rng(3)
    weighed_at, posture = POSTURES["stow_back"], POSTURES["front_left"]
    q0, q = CHAIN.posture(weighed_at), CHAIN.posture(posture)
    readings = readings_of(CHAIN.mass, CHAIN.center_of_mass(q0))
    found = []
    for _ in range(SAMPLES):
        chain = shaken(CHAIN, rng, tolerances)
        noisy = readings * (1 + rng.normal(0, scales.calibration_sigma, 4)) + rng.normal(0, scales.reading_sigma_kg, 4)
        weighed = cg_from_scales(noisy[None], CONTACTS + rng.normal(0, scales.contact_sigma_m, (4, 2)), scales)
        static = static_part_from_weighing(weighed, chain, weighed_at)
        moved = moment_of_arms(chain, q + rng.normal(0, tolerances.joint, 10))
        found.append((static.mass * static.position + moved) / weighed.mass)
    weighed = cg_from_scales(readings[None], CONTACTS, scales)
    estimate = cg_model(URDF, static=static_part_from_weighing(weighed, CHAIN, weighed_at), tolerances=tolerances).estimate(q)
    np.testing.assert_allclose(estimate.position, CHAIN.center_of_mass(q)[:2], atol=1e-12)
    assert_covariance(np.array(found), estimate.covariance)


def test_cg_covariance_at_the_weighed_posture_has_no_arms():
    weighed = cg_from_scales(readings_of(118.84, [0.01, 0.0])[None], CONTACTS)
    static = static_part_from_weighing(weighed, CHAIN, POSTURES["stow_back"])
    model = cg_model(URDF, static=static, tolerances=Tolerances(0.2, 0.05, 0.0))
    there, elsewhere = (model.estimate(model.chain.posture(POSTURES[name])) for name in ("stow_back", "ready"))
    np.testing.assert_allclose(there.covariance, weighed.covariance[1:, 1:], rtol=1e-9, atol=1e-15)
    assert np.linalg.eigvalsh(elsewhere.covariance - there.covariance).max() > 1e-5


LOADED = {
    "masses": (Tolerances(0.05, 0.0, 0.0), 0.0, 0.0),
    "centres": (Tolerances(0.0, 0.01, 0.0), 0.0, 0.0),
    "joints": (Tolerances(0.0, 0.0, 0.02), 0.0, 0.0),
    "payload's mass": (NOTHING, 0.3, 0.0),
    "payload's place": (NOTHING, 0.0, 0.03),
    "all": (Tolerances(0.05, 0.01, 0.02), 0.3, 0.03),
}


@pytest.mark.parametrize("source", LOADED)
def test_cg_covariance_of_a_urdf_with_payload_is_that_of_samples(source):
    tolerances, mass_sigma, position_sigma = LOADED[source]
    rng = np.random.default_rng(4)
    payload = Payload("left_gripper", 3.0, (0.05, -0.02, 0.15), mass_sigma, position_sigma)
    model = cg_model(URDF, payload=payload, tolerances=tolerances)
    assert "left_wrist_3_joint" in model.chain.joint_names  # off the wrist's axis, the payload makes it matter
    q = model.chain.posture(POSTURES["front_left"] | {"left_wrist_3_joint": 0.7})
    bare = flatten(URDF.with_mass("left_gripper", 1e-9, np.array([0.05, 0, 0])), joints=model.chain.joint_names)  # the same bodies
    body, place = bare.point("left_gripper", np.array(payload.position))
    found = []
    for _ in range(SAMPLES):
        chain = shaken(bare, rng, tolerances)
        constants = chain.constants
        constants[0, MASS] *= 1 + rng.normal(0, tolerances.mass_fraction)
        constants[0, COM:] += rng.normal(0, tolerances.com_m, 3)
        m, at = payload.mass + rng.normal(0, mass_sigma), place + rng.normal(0, position_sigma, 3)
        total = constants[body, MASS] + m
        constants[body, COM:] = (constants[body, MASS] * constants[body, COM:] + m * at) / total
        constants[body, MASS] = total
        found.append(chain.center_of_mass(q + rng.normal(0, tolerances.joint, len(q)))[:2])
    estimate = model.estimate(q)
    assert_covariance(np.array(found), estimate.covariance)
    assert estimate.mass == pytest.approx(118.84 + 3.0)


def test_cg_covariance_in_another_frame_is_the_same():
    payload = Payload("left_gripper", 3.0, (0.0, 0.0, 0.1), 0.5, 0.02)
    here, there = (cg_model(URDF, base, payload=payload, tolerances=Tolerances(0.1, 0.01, 0.01)) for base in ("base_link", "laser"))
    q = here.chain.posture(POSTURES["front_left"])
    offset = urdf_reference.link_poses(TEXT, {})["laser"][:2, 3]
    assert offset[0] > 0.3
    np.testing.assert_allclose(there.cg(q), here.cg(q) - offset, atol=1e-12)
    np.testing.assert_allclose(there.estimate(q).covariance, here.estimate(q).covariance, rtol=1e-9, atol=1e-15)


def test_cg_model_with_a_payload_is_one_more_mass():
    payload = Payload("left_gripper", 3.0, (0.05, -0.02, 0.15))
    posture = POSTURES["front_left"] | {"left_wrist_3_joint": 0.7}
    model = cg_model(URDF, payload=payload)
    extra = '<link name="load"><inertial><origin xyz="0.05 -0.02 0.15"/><mass value="3"/></inertial></link>' + (
        '<joint name="hold" type="fixed"><parent link="left_gripper"/><child link="load"/></joint></robot>'
    )
    expected, _ = urdf_reference.center_of_mass(TEXT.replace("</robot>", extra), posture)
    np.testing.assert_allclose(model.estimate(model.chain.posture(posture)).position, expected[:2], atol=1e-12)


def test_cg_model_with_a_payload_on_the_static_part_adds_it():
    static = StaticPart(80.0, np.array([0.0, 0.0]), np.diag([0.04, 1e-6, 4e-6]))
    payload = Payload("base_link", 20.0, (0.2, 0.1, 0.3), mass_sigma=0.5, position_sigma=0.02)
    without, with_load = (cg_model(URDF, static=static, tolerances=NOTHING, payload=p) for p in (None, payload))
    q = np.zeros(10)
    mass = without.chain.mass
    np.testing.assert_allclose(with_load.cg(q), (mass * without.cg(q) + 20.0 * np.array([0.2, 0.1])) / (mass + 20.0), atol=1e-12)
    rng = np.random.default_rng(6)
    arms, found = moment_of_arms(CHAIN, q), []
    for _ in range(SAMPLES):
        m, load = 80.0 + rng.normal(0, 0.2), 20.0 + rng.normal(0, 0.5)
        moment = m * rng.normal(0, [1e-3, 2e-3]) + load * (np.array([0.2, 0.1]) + rng.normal(0, 0.02, 2)) + arms
        found.append(moment / (m + load + mass - 80.0))
    assert_covariance(np.array(found), with_load.estimate(q).covariance)


def test_cg_model_with_named_joints_takes_wheels_and_wrists():
    names = tuple(POSTURES["ready"])
    static = StaticPart(50.0, np.array([0.03, -0.01]), np.zeros((3, 3)))
    named = cg_model(URDF, joints=(*names, "front_left_wheel"), static=static)
    assert named.chain.joint_names == CHAIN.joint_names
    np.testing.assert_array_equal(named.cg(np.ones(10)), cg_model(URDF, static=static).cg(np.ones(10)))
    # With the right arm left out, it stands at 0.
    left = cg_model(URDF, joints=names[:6])
    expected, _ = urdf_reference.center_of_mass(TEXT, dict(zip(names[:5], np.ones(5), strict=True)))
    np.testing.assert_allclose(left.cg(np.ones(5)), expected[:2], atol=1e-12)


def test_cg_model_of_a_weighed_robot_without_arms_is_constant():
    husky = (
        '<robot><link name="base_link"><inertial><mass value="46"/></inertial></link>'
        '<link name="wheel"><inertial><mass value="2.6"/></inertial></link><joint name="w" type="continuous">'
        '<parent link="base_link"/><child link="wheel"/><axis xyz="0 1 0"/></joint></robot>'
    )
    static = StaticPart(50.0, np.array([0.03, -0.01]), np.diag([1.0, 4e-6, 9e-6]))
    estimate = cg_model(parse_urdf(husky, "husky.urdf"), static=static).estimate(np.empty(0))
    assert estimate.mass == 50.0
    np.testing.assert_allclose(estimate.position, [0.03, -0.01], atol=1e-15)
    np.testing.assert_allclose(estimate.covariance, np.diag([4e-6, 9e-6]), atol=1e-18)


def test_cg_jacobian_is_a_difference():
    model = cg_model(URDF, payload=Payload("right_gripper", 5.0))
    q, h = np.linspace(-1, 1, 10), 1e-6
    steps = np.eye(10) * h
    np.testing.assert_allclose(model.jacobian(q), (model.cg(q + steps) - model.cg(q - steps)).T / (2 * h), atol=1e-9)


def test_cg_estimate_takes_microseconds():
    model = cg_model(URDF, payload=Payload("right_gripper", 5.0))
    q, times = np.zeros(10), []
    model.estimate(q)
    for _ in range(50):
        start = time.thread_time()
        for _ in range(100):
            model.estimate(q)
        times.append((time.thread_time() - start) / 100)
    assert min(times) < 10e-6


def test_postures_of_vaultbot_are_where_their_names_place_them():
    """All seven of the thesis's arm configurations and its front stow, with centres of gravity between the wheels."""
    model = arms_model(VAULTBOT)
    cg = {name: model.cg(model.chain.posture(posture)) for name, posture in POSTURES.items()}
    assert set(cg) == {"ready", "stow_back", "ready_back", "front_left", "front_right", "back_left", "back_right", "stow_front"}
    for name, (x, y) in cg.items():
        assert -0.06 <= x <= 0.12, name
        assert -0.03 <= y <= 0.03, name
        mirrored = {"front_left": "front_right", "back_left": "back_right"}
        if name in mirrored:
            # To half a millimetre: the Husky's own centre of mass is not quite in the middle.
            np.testing.assert_allclose(cg[mirrored[name]], [x, -y], atol=6e-4)
            assert y > 0.01
        elif name not in mirrored.values():
            assert abs(y) < 1e-3, name
    assert cg["front_left"][0] > 0.04
    assert cg["back_left"][0] < -0.02
    # Sec. 1.6: back stow is nearest to the centre, front stow before it, ready further still.
    assert abs(cg["stow_back"][0]) < 0.01 < cg["stow_front"][0] < cg["ready"][0]
    assert np.linalg.norm(cg["stow_back"]) == min(np.linalg.norm(v) for v in cg.values())


def test_postures_of_vaultbot_keep_the_arms_apart():
    """Along the lines of the links: each arm on its side, and above the bulkhead where it is over the robot."""
    for name, posture in POSTURES.items():
        poses = urdf_reference.link_poses(TEXT, posture)
        for side, sign in (("left", 1.0), ("right", -1.0)):
            at = {link: poses[f"{side}_{link}"] for link in ("upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link", "gripper")}
            lifted = {
                link: (pose @ [0, 0, offset, 1])[:3] for (link, pose), offset in zip(at.items(), (0.11, 0.11, 0, 0, 0.15), strict=True)
            }
            lines = [("upper_arm_link", "forearm_link"), ("forearm_link", "wrist_1_link"), ("wrist_2_link", "gripper")]
            lifted_points = [lifted[a] * (1 - t) + lifted[b] * t for a, b in lines for t in np.linspace(0.2, 1, 9)]
            for x, y, z in lifted_points:
                assert sign * y > 0.04, (name, side)
                assert z > (0.34 if abs(x) < 0.5 and abs(y) < 0.34 else 0.0), (name, side)


@pytest.mark.parametrize("x", np.arange(-0.06, 0.121, 0.02).round(3))
@pytest.mark.parametrize("y", np.arange(-0.03, 0.031, 0.01).round(3))
def test_posture_for_every_point_of_the_grid_is_found(x, y):
    model = arms_model(VAULTBOT)
    posture = posture_for(model, np.array([x, y]), POSTURES)
    found, _ = urdf_reference.center_of_mass(TEXT, posture)
    np.testing.assert_allclose(found[:2], [x, y], atol=1e-8)
    q = model.chain.posture(posture)
    assert np.all((q >= model.chain.lower) & (q <= model.chain.upper))
    # Not far from a posture that is known to be good.
    assert min(np.abs(q - model.chain.posture(start)).max() for start in POSTURES.values()) < 1.0


def test_posture_for_a_cg_out_of_reach_is_refused():
    with pytest.raises(CgError, match=r"no arm posture puts the centre of gravity at \(0.400, 0.000\) m; the nearest .* \(0\.1"):
        posture_for(arms_model(VAULTBOT), np.array([0.4, 0.0]), POSTURES)
    with pytest.raises(CgError, match="no posture to start from"):
        posture_for(arms_model(VAULTBOT), np.zeros(2), {})


def test_require_support_of_a_tipping_robot_is_refused():
    assert support_margin(np.array([[0.0, 0.0], [0.2, 0.0], [0.0, -0.3]]), 0.52, 0.56) == pytest.approx([0.26, 0.06, -0.02])
    require_support(np.array([0.26, 0.28]), 0.52, 0.56)
    heavy = Payload("base_link", 60.0, (1.0, 0.0, 0.0))
    assert cg_model(URDF, payload=heavy).estimate(np.zeros(10)).margin(0.52, 0.56) < 0.0
    with pytest.raises(CgError, match=r"lies outside the wheels' contacts \(\|x\| <= 0.260, \|y\| <= 0.280\): the robot would tip over"):
        urdf_cg(URDF, POSTURES["ready"], payload=heavy, support=(0.52, 0.56))
    urdf_cg(URDF, POSTURES["ready"], payload=heavy)  # not asked, not refused
    with pytest.raises(CgError, match="outside"):
        require_support(np.array([math.nan, 0.0]), 0.52, 0.56)


def bad_payload(**changes):
    return lambda: cg_model(URDF, payload=dataclasses.replace(Payload("left_gripper", 1.0), **changes))


NO_BASE = parse_urdf(
    '<robot><link name="base_link"/><link name="arm"><inertial><origin xyz="1 0 0"/><mass value="1"/></inertial></link>'
    '<joint name="j" type="continuous"><parent link="base_link"/><child link="arm"/><axis xyz="0 0 1"/></joint></robot>',
    "r.urdf",
)

BAD = {
    "payload at no link": (bad_payload(link="hand"), RobotError, r"no link 'hand'; links are base_link, "),
    "negative payload": (bad_payload(mass=-1.0), CgError, r"payload at left_gripper: mass is -1.0 kg; it must be positive"),
    "payload nan": (bad_payload(mass=math.nan), CgError, "mass is nan kg"),
    "payload at infinity": (bad_payload(position=(0.0, math.inf, 0.0)), CgError, "its place must be three finite numbers"),
    "payload in the plane": (bad_payload(position=(0.1, 0.2)), CgError, "its place must be three finite numbers"),
    "payload sigma": (bad_payload(position_sigma=-0.1), CgError, "sigmas not below 0"),
    "static mass": (lambda: cg_model(URDF, static=StaticPart(-3.0, np.zeros(2), np.zeros((3, 3)))), CgError, "its mass must be positive"),
    "no static mass": (lambda: cg_model(NO_BASE), CgError, r"r.urdf: nothing but its arms has a mass; give the static part"),
    "light robot": (
        lambda: static_part_from_weighing(WeighedCg(30.0, np.zeros(2), np.eye(3), 1, math.nan), CHAIN, POSTURES["ready"]),
        CgError,
        r"the scales show 30.00 kg, but the arms in vaultbot.urdf alone have 38.59 kg",
    ),
    "unknown joint": (lambda: urdf_cg(URDF, POSTURES["ready"] | {"elbow": 0.0}), RobotError, r"has no joint elbow; its joints are left_"),
    "missing joint": (
        lambda: urdf_cg(URDF, {"left_elbow_joint": 0.0}),
        RobotError,
        r"no position of joint left_shoulder_pan_joint, left_sh",
    ),
    "degrees": (lambda: urdf_cg(URDF, POSTURES["ready"] | {"left_elbow_joint": 90.0}), RobotError, "position 90 .*radians"),
    "too few joints": (lambda: cg_model(URDF).estimate(np.zeros(9)), CgError, r"needs positions of left_.*got an array of shape \(9,\)"),
    "no file": (lambda: urdf_cg("none.urdf", {}), RobotError, "'none.urdf' cannot be read"),
    "no shipped file": (lambda: arms_model(Arms("none.urdf")), RobotError, "'none.urdf', which the robot file names, cannot be read"),
    "no posture": (
        lambda: arms_model(dataclasses.replace(VAULTBOT, static_mass_kg=80.0, weighed_posture="stow")),
        CgError,
        "no posture 'stow'; .*ready",
    ),
    "bad SRDF": (lambda: parse_postures("<robot", "a.srdf"), RobotError, "a.srdf: not valid XML"),
    "empty SRDF": (lambda: parse_postures("<robot/>", "a.srdf"), RobotError, "a.srdf: no <group_state>"),
    "SRDF value": (
        lambda: parse_postures('<r><group_state name="x"><joint name="j" value="1 2"/></group_state></r>', "a.srdf"),
        RobotError,
        r"posture 'x': joint j has value '1 2', not one number",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_cg_model_of_bad_input_is_refused(case):
    attempt, error, message = BAD[case]
    with pytest.raises(error, match=message):
        attempt()


def test_cg_model_of_a_urdf_without_base_is_refused():
    model = cg_model(NO_BASE, static=StaticPart(9.0, np.array([0.1, 0.0]), np.zeros((3, 3))))
    np.testing.assert_allclose(model.cg(np.zeros(1)), [(0.9 + 1.0) / 10, 0.0], atol=1e-12)


def test_arms_model_takes_files_beside_the_robot_file(tmp_path):
    (tmp_path / "my.urdf").write_text(TEXT)
    (tmp_path / "my.srdf").write_text((resources.files("motion_models") / "robots" / "vaultbot.srdf").read_text())
    arms = Arms("my.urdf", postures="my.srdf", static_mass_kg=80.0, static_x_m=0.01, static_sigma_m=0.003, weighed_posture="stow_back")
    model = arms_model(arms, tmp_path)
    q = model.chain.posture(arms_postures(arms, tmp_path)["stow_back"])
    assert model.chain.mass == pytest.approx(80.0 + CHAIN.mass - CHAIN.constants[0, MASS])
    assert model.estimate(q).covariance[0, 0] < 0.003**2  # its share of the mass; the arms' errors cancel here
    with pytest.raises(RobotError, match="cannot be read"):
        arms_model(arms, tmp_path / "elsewhere")


def test_weighed_cg_of_a_file_is_that_of_its_rows(tmp_path):
    table = tmp_path / "weighings.csv"
    rows = [",".join(str(v) for v in readings_of(118.84, [0.03, -0.01])) for _ in range(5)]
    table.write_text("front_left_kg,front_right_kg,rear_left_kg,rear_right_kg\n" + "\n".join(rows))
    found = weighed_cg(table, 0.52, 0.56)
    np.testing.assert_allclose([found.mass, *found.position], [118.84, 0.03, -0.01], atol=1e-9)
    assert found.weighings == 5


# --- along a log


def test_cg_tracker_takes_joints_of_several_publishers():
    model = arms_model(VAULTBOT)
    tracker = CgTracker(model)
    posture = POSTURES["front_left"]
    wheels = ["front_left_wheel", "front_right_wheel", "rear_left_wheel", "rear_right_wheel"]
    left = [name for name in posture if name.startswith("left")]
    right = [name for name in posture if name.startswith("right")]
    assert tracker.update(wheels, [100.0, 1e6, -3.0, math.nan]) is None
    assert tracker.update(left, [posture[name] for name in left]) is None
    assert tracker.missing == tuple(name for name in model.chain.joint_names if name.startswith("right"))
    mixed = [*reversed(right), *wheels]
    found = tracker.update(mixed, [*(posture[name] for name in reversed(right)), 1.0, 2.0, 3.0, 4.0])
    assert not tracker.missing
    expected = model.estimate(model.chain.posture(posture))
    np.testing.assert_array_equal(found.position, expected.position)
    np.testing.assert_array_equal(found.covariance, expected.covariance)
    assert found.covariance.shape == (2, 2)
    # The right arm moves on; the left one is remembered.
    moved = tracker.update(["right_elbow_joint"], [0.3])
    np.testing.assert_array_equal(moved.position, model.cg(model.chain.posture({**posture, "right_elbow_joint": 0.3})))


def test_cg_tracker_of_empty_or_broken_messages_gives_none():
    tracker = CgTracker(arms_model(VAULTBOT))
    names = list(POSTURES["ready"])
    first = tracker.update(names, list(POSTURES["ready"].values()))
    assert tracker.update(["front_left_wheel"], [1.0]) is None
    assert tracker.update(names, []) is None
    assert tracker.update(names[:1], [math.nan]) is None
    values = np.array(list(POSTURES["ready"].values()))
    values[2] = math.inf
    np.testing.assert_array_equal(tracker.update(names, values).position, first.position)
    with pytest.raises(CgError, match=r"joint state with 12 names .* but positions of shape \(11,\)"):
        tracker.update(names, values[:11])
