"""One table of malformed input over every format and command, with the whole message of each.

More stand in the tests of each reader. What an enemy would write: figures in other units, bases and spellings, keys
of another case, files of another kind or encoding, links in circles, control characters, numbers beyond all arithmetic.
"""

import pytest
from refusals import refusal

from fg_calib import Robot, read_job, read_robot
from fg_calib.inputs import ORDINARY
from fg_calib.io import read_camera, read_measurements

# fmt: off
HEAD = "convention: dh\njoints:\n"
ROW = "  - {a: 0, alpha: 0, d: 0, theta: 0}\n"
R = HEAD + ROW
P = "convention: poe\njoints:\n"
C = "convention: cpc\njoints:\n"


def row(text):
    """A robot of one joint, this."""
    return f"{HEAD}  - {{{text}}}\n"


ROBOTS = [
    (row("a: 0, alpha: -90, d: 0, theta: 0, limits: [-180, 180]"), 'robot.yaml: joint 1: alpha: found -90, expected angles in rad, two turns at most; units: {angle: deg} are deg'),
    (row("a: 0,5, alpha: 0, d: 0, theta: 0"), "robot.yaml:3: key '5', expected a word; is it a decimal comma? numbers have a decimal point"),
    (row("a: '0,5', alpha: 0, d: 0, theta: 0"), "robot.yaml: joint 1: a: found '0,5', expected a finite number; is it a decimal comma? numbers have a decimal point"),
    (row("a: 1:30, alpha: 0, d: 0, theta: 0"), "robot.yaml: joint 1: a: found '1:30', expected a finite number"),
    (row("a: "+"9"*5000+", alpha: 0, d: 0, theta: 0"), "robot.yaml: not YAML: Exceeds the limit (4300 digits) for integer string conversion: value has 5000 digits; use sys.set_int_max_str_digits() to increase the limit"),
    (row("a: 0, alpha: 0, d: 0, theta: 0, type: Revolute"), "robot.yaml: joint 1: type: found 'Revolute', expected one of revolute, prismatic; did you mean revolute?"),
    (R+"name: no\n", 'robot.yaml: name: found False, expected text; text such as no, on, true or 0012 stands in quotes'),
    ("a: &a [*a]\n", 'robot.yaml:1: found unconstructable recursive node'),
    (R+"fixed: {a1: 1}\n", "robot.yaml: fixed: found {'a1': 1}, expected a list"),
    (R+"estimate: [tool]\n", "robot.yaml: estimate: unknown parameter 'tool', expected one of base.x, base.y, base.z, base.yaw, base.pitch, base.roll, theta1, d1, a1, alpha1, tool.x, tool.y, ..."),
    ('a: 1\nb: \x01\n', 'robot.yaml: not YAML: unacceptable character #x0001 ...'),
    ('name: a\nname: b\n', "robot.yaml:2: key 'name' stands here twice"),
    ('convention: dh\njoints:\n  - {a: 0, alpha: 0, d: 0, theta: 0, beta: 0.1}\n', 'robot.yaml: joint 1: beta: found 0.1, expected none: the convention dh has no beta; dh-hayati has'),
    ("convention: [dh]\njoints: []\n", "robot.yaml: convention: found ['dh'], expected one of dh, mdh, mdh-hayati, dh-hayati, poe, cpc (and 1 more)"),
    (P+"  - {axis: [0, 0, 1]}\n", "robot.yaml: joint 1: missing key 'point'"),
    (P+"  - {axis: [0, 0, 0], point: [0, 0, 0]}\n", "robot.yaml: joint 1: axis: found (0.0, 0.0, 0.0), expected a direction of three numbers"),
    (P+"  - {axis: [0, 0, 1], type: prismatic, y: 0.1}\n", "robot.yaml: joint 1: x or y of a slide, expected pitch and roll: it has a direction alone"),
    (P+"  - {axis: [0, 0, 1], point: [0, 0, 0], pitch: 30}\n", "robot.yaml: joint 1: pitch: found 30, expected angles in rad, two turns at most; units: {angle: deg} are deg"),
    (P+"  - {axis: [0, 0, 1], point: [0, 0, 0], d: 1}\n", "robot.yaml: joint 1: unknown key 'd', expected one of type, name, limits, axis, point, x, y, pitch, roll, sigma"),
    (P+"  - {axis: [0, 0, 1], point: [0, 0, 0]}\nestimate: zeros\n", "robot.yaml: estimate: zeros, expected parameters; poe has no joint zeros"),
    (C+"  - {b: [0, 0, 1.00001], l: [0, 0, 0]}\n", "robot.yaml: joint 1: b: length 1.00001, expected 1 within 1e-06"),
    (C+"  - {b: [0, 0.0001, -1], l: [0, 0, 0]}\n", "robot.yaml: joint 1: b: found [0.0, 0.0001, -1.0], for which R(b) is any, expected bz above -1; take the next axis the other way, bz >= 0 with `sign: -1`; behind the last joint turn `tool`"),
    (C+"  - {b: [0, 0, 1], l: [0, 0, 0], sign: 2}\n", "robot.yaml: joint 1: sign: found 2, expected one of -1, 1"),
]

L = '<link name="a"/><link name="b"/>'
X = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'


def j(inner="", name="j", type="continuous", p="a", c="b"):
    """A joint."""
    return f'<joint name="{name}" type="{type}"><parent link="{p}"/><child link="{c}"/>{inner}</joint>'


def r(inner, attributes='name="r"'):
    """A robot."""
    return f"<robot {attributes}>{inner}</robot>"


URDFS = [
    (r(L+j('<origin rpy="90 0 180"/>',type="revolute")), "arm.urdf:1: joint 'j': origin rpy: found [90.0, 0.0, 180.0], expected angles in rad, two turns at most; are they in deg?"),
    ("<robot/>", 'arm.urdf: no links and joints, expected <link> and <joint> within <robot>'),
    (r(L+j(p='b',c='a')+j(name='k')), "arm.urdf: links in a circle: a below b below a, expected a tree of links"),
    (r(L+j()+j(name='k')), "arm.urdf: link 'b' is the child of joints 'j' and 'k', expected one"),
    (r(L+j('<mimic joint="k"/>')), "arm.urdf: joint 'j': mimics joint 'k', expected joints on the chain that move by themselves"),
    (r(L+j('<axis xyz="0 0 0"/>')), "arm.urdf: joint 'j': axis: found [0.0, 0.0, 0.0], expected a direction of three numbers"),
    (r(L+'<link name="c"/>'+j()+j(name='k',c='c')), "arm.urdf: 2 leaf links (b, c), expected one; name one as tip_link: {urdf: arm.urdf, tip_link: ...} in a file, --tip-link of observe"),
    (r('<xacro:arm/>',X), 'arm.urdf: no links and joints, expected <link> and <joint> within <robot>; it holds elements of xacro: expand them by `xacro arm.urdf.xacro > arm.urdf`'),
]

TWO_JOINTS = "convention: mdh\njoints:\n" + ROW + "  - {a: 0, alpha: 0, d: 0, theta: 0, type: prismatic}\n"
ONE_JOINT = "convention: mdh\njoints:\n" + ROW
JOB = "robot: robot.yaml\nmeasurements: poses.csv\nmodel: pose\n"
JOBS = [
    (JOB + "columns: {q1: {name: x, scale: a}}\n", "job.yaml: columns: q1: scale: found 'a', expected a finite number"),
    (JOB + "prior: false\ngauge: prior\n", "job.yaml: prior: found False with gauge: prior, expected gauge alone"),
    (JOB.replace("robot.yaml","\"a\\0b\""), '{folder}/a\\x00b: cannot be read: ...'),
    (JOB+"pairs: poses.csv\n", "poses.csv: no a, expected a and b, the two configurations of a pair, and distance or angle"),
    (JOB+"truth: other.yaml\n", 'other.yaml: another robot, expected the parameters of robot, with their true values'),
    (JOB+"noise: {position: 1e-40}\n", 'job.yaml: noise: position: found 1e-40 m, expected 1e-30 m or more'),
    (JOB.replace("poses", "groups") + "columns: {id: {name: id, scale: 2}}\n", "groups.csv: columns: id: scale or zero of a column of names, expected name alone"),
    (JOB+"tolerance: {targets: 1}\n", "job.yaml: tolerance: targets: of no use without the key targets, expected no such key"),
    ("robot: robot.yaml\nmeasurements: [{table: poses.csv, model: pose, offset: estimate}]\n", "job.yaml: measurement 1: offset: of no use to model pose, expected no such key"),
    (JOB.replace("robot.yaml", "nowhere.yaml"), "{folder}/nowhere.yaml: no such file"),
    (JOB+"accept: {position: 0.5 deg}\n", "job.yaml: accept: position: found '0.5 deg', expected a number with one of m, cm, mm, um, in ..."),
    (JOB+"accept: {position: 0.5 Mm}\n", "job.yaml: accept: position: found '0.5 Mm', expected a number with one of m, cm, mm, um, in; did you mean mm? ..."),
    (JOB+"accept: {position: a lot}\n", "job.yaml: accept: position: found 'a lot', expected a number, with its unit or without ..."),
    (JOB+"accept: {position: -1}\n", "job.yaml: accept: position: found -1, expected a number above 0 ..."),
    (JOB+"accept: {orientation: 5 mm}\n", "job.yaml: accept: orientation: found '5 mm', expected a number with one of rad, deg, mrad ..."),
    (JOB+"accept: {posiion: 1}\n", "job.yaml: accept: unknown limit 'posiion', expected one of position, orientation, distance, angle ..."),
    (JOB+"accept: [1]\n", "job.yaml: accept: found [1], expected limits by name ..."),
    ("robot: a\n", "job.yaml: missing key 'measurements'"),
    (JOB+"pairing: stars\n", "job.yaml: pairing: found 'stars', expected one of star, chain, all, {random: N, seed: S}; did you mean star?"),
    (JOB+"noise: {joint: -1}\n", "job.yaml: noise: joint 1: found -1, expected a number not below 0"),
    (JOB+"noise: {joint: [0, 0, 0]}\n", "job.yaml: noise: joint: 3 values, expected one for all or 2, one a joint"),
    (JOB+"noise: 1\n", "job.yaml: noise: found 1, expected a mapping"),
    (JOB.replace("pose\n", "anchor\n")+"anchors: {a0: {x: 1, y: 2}}\n", "job.yaml: anchors: a0: missing key 'z' ..."),
    (JOB+"about: {serial: 1}\n", "job.yaml: about: unknown key 'serial', expected one of customer, robot_serial, instrument, operator, note ..."),
    (JOB+"about: {robot_serial: 0012}\n", "job.yaml: about: robot_serial: found 12.0, expected text; text such as no, on, true or 0012 stands in quotes"),
    (JOB+"about: text\n", "job.yaml: about: found 'text', expected a mapping ..."),
    (JOB+"tolerance: {anchor: 1}\n", "job.yaml: tolerance: unknown key 'anchor', expected one of targets, anchors ..."),
    ("robot: robot.yaml\nmeasurements: []\n", "job.yaml: measurements: found [], expected a path, or a list of tables ..."),
    ("robot: robot.yaml\nmeasurements: [{table: poses.csv}]\n", "job.yaml: measurement 1: missing key 'model' ..."),
    ("robot: robot.yaml\nmeasurements: [{model: position}]\n", "job.yaml: measurement 1: missing key 'table' ..."),
    ("robot: robot.yaml\nmeasurements: [{table: poses.csv, model: pose}]\npairs: pairs.csv\n", "job.yaml: pairs: next to a list of tables, expected the key in the table's own entry ..."),
    ("robot: robot.yaml\nmeasurements: [{table: poses.csv, model: position, loss: huber}]\n", "job.yaml: measurement 1: unknown key 'loss' ..."),
]
CAMERAS = [
    ("{fx: 1}", "camera.yaml: missing keys 'fy', 'cx', 'cy' ..."),
    ("{fx: -1, fy: 905, cx: 640, cy: 480}", "camera.yaml: fx: found -1, expected 1 to 1e+06 px ..."),
    ("{fx: 900, fy: 905, cx: 640, cy: 480, k4: 0}", "camera.yaml: unknown key 'k4', expected one of fx, fy, cx, cy, k1, k2, p1, p2, k3 ..."),
]
XYZ = "q1,q2,x,y,z\n"
ROWS = XYZ + "0.1,0.2,1,2,3\n0.4,0.5,4,5,6\n"
POSES = [
    (ROWS.encode("utf-16"), "poses.csv:1: a null character, expected UTF-8 text; is it UTF-16, Latin-1 or Windows text? save it as UTF-8"),
    (ROWS.replace("0.2", '"0.2'), "poses.csv:2: a quote that is not closed, expected whole cells in quotes, or none"),
    ("\n\n" + ROWS.replace("0.2", ""), "poses.csv:4: q2: found an empty cell, expected a finite number; delete the row if nothing was measured"),
    (ROWS.replace("0.2", "1e200"), f"poses.csv:2: q2: found '1e200', expected {ORDINARY}"),
    (ROWS + ",,,,7\n", "poses.csv:4: q1: found an empty cell, expected a finite number; delete the row if nothing was measured"),
    (ROWS.replace("\n", "\r").replace("0.2", "?"), "poses.csv:2: q2: found '?', expected a finite number; delete the row if nothing was measured"),
    ("q1,q2\n−0.5,0\n", "poses.csv:2: q1: found '−0.5', expected a finite number; its minus is another character, a dash; write -"),
    (XYZ + "0,0,1,2,3\n\n0,0,x,2,3\n", "poses.csv:4: x: found 'x', expected a finite number; delete the row if nothing was measured"),
    (XYZ + "180,0,1,2,3\n", "poses.csv:2: q1 = 180 rad is outside [-2, 2]; widen the joint's limits if the reading is right; are the columns in the joints' order?"),
    ("q1,q2,id\n0,0,a\n0,0,a\n", "poses.csv:3: id: found 'a', expected different ids"),
    ("q1,q2,sigma_x,sigma_position\n0,0,1,1\n", "poses.csv: no column sigma_y, expected sigma_x sigma_y sigma_z together"),
    ("id,q1,q2\na,0,0\n#b,1,1\n", "poses.csv:3: id: found '#b', expected ids with # all or none; # does not comment a row out"),
]

GROUPS = "q1,q2,id,group\n0,0,a,g\n1,0,b,g\n1,1,c,h\n0,1,d,\n"
PAIRS = [
    ("A,B,Distance\na,b,x\n", "pairs.csv:2: distance: found 'x', expected a finite number; delete the row if nothing was measured"),
    ("a,b,distance\na,z,1\n", "pairs.csv:2: b: found 'z', expected an id or a group"),
    ("a,b,distance\na,a,1\n", "pairs.csv:2: b: found 'a', expected another than a"),
    ("a,b,angle\na,b,4\n", "pairs.csv:2: angle: found '4', expected 0 to pi, in rad; angles of the table are in rad"),
    ("a,b,distance\ng,a,1\n", "pairs.csv:2: b: found 'a', expected two configurations or two groups"),
    ("a,b,distance\ng,h,0\n", "pairs.csv:2: distance: found '0', expected a number above 0 between two groups"),
    ("a,b,angle\ng,h,1\n", "pairs.csv:2: angle: found '1', expected none: two points have a distance, but no angle"),
]

# fmt: on

ARM = Robot.from_dh([[0.5, 0.1, 0.2, 0.0], [0.4, 0.2, 0.1, 0.0]], convention="dh", limits=[[-2.0, 2.0], None])


FILES = {
    "robot.yaml": (ROBOTS, read_robot),
    "arm.urdf": (URDFS, read_robot),
    "job.yaml": (JOBS, read_job),
    "camera.yaml": (CAMERAS, read_camera),
    "poses.csv": (POSES, lambda file: read_measurements(file, ARM)),
    "pairs.csv": (PAIRS, lambda file: read_measurements(file.with_name("groups.csv"), ARM, pairs=file)),
}
CASES = {f"{name} {k}": (name, *case) for name, (cases, _) in FILES.items() for k, case in enumerate(cases)}


@pytest.mark.parametrize("case", CASES)
def test_a_file_is_refused_in_one_line(tmp_path, case):
    """`{folder}` stands for the folder, ` ...` for what is said behind it."""
    others = {"robot.yaml": TWO_JOINTS, "other.yaml": ONE_JOINT, "groups.csv": GROUPS}
    for name, text in (others | {"poses.csv": "q1,q2,x,y,z\n0,0,0,0,0\n10,20,1000,0,0\n"}).items():
        (tmp_path / name).write_text(text)
    name, given, message = CASES[case]
    (tmp_path / name).write_bytes(given if isinstance(given, bytes) else given.encode())
    said = refusal(FILES[name][1], tmp_path / name).replace(str(tmp_path), "{folder}")
    start, others, _ = message.partition(" ...")
    assert said.startswith(start) if others else said == message
