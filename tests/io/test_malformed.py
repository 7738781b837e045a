"""One table of malformed input over every format and command, with the whole message of each.

More stand beside the tests of each reader. What an enemy would write: figures in other units, bases and spellings, keys
of another case, files of another kind or encoding, links in circles, control characters, numbers beyond all arithmetic.
"""

import copy
import datetime
import json
import math

import numpy as np
import polars as pl
import pytest

from fg_calib import (
    InputError,
    Measurements,
    Robot,
    calibrate,
    pose,
    read_job,
    read_measurements,
    read_result,
    read_robot,
    read_scenario,
)


def result_document():
    """A small calibration's `result.json`."""
    rng = np.random.default_rng(0)
    arm = Robot.from_dh([[0.4, 0.1, 0.2, 0.3]], convention="dh", tolerance={"a": 0.01, "theta": 0.01})
    q = rng.uniform(-1.0, 1.0, (6, 1))
    data = Measurements.from_arrays(q, position=pose(arm, q).position, sigma_position=1e-3)
    return calibrate(arm, data, model="position", frame="unknown").result.document()


# fmt: off
HEAD = "convention: dh\njoints:\n"
ROW = "  - {a: 0, alpha: 0, d: 0, theta: 0}\n"
R = HEAD + ROW


def row(text):
    """A robot of one joint, this."""
    return f"{HEAD}  - {{{text}}}\n"


ROBOTS = [
    (row("a: 0, alpha: -90, d: 0, theta: 0, limits: [-180, 180]"), 'robot.yaml: joint 1: alpha: found -90, expected angles in rad, two turns at most; units: {angle: deg} are deg'),
    (row("a: 0,5, alpha: 0, d: 0, theta: 0"), 'robot.yaml:3: key 5, expected a word; is it a decimal comma? numbers have a decimal point'),
    (row("a: 0,0005, alpha: 0, d: 0, theta: 0"), 'robot.yaml:3: key 0005, expected a word; is it a decimal comma? numbers have a decimal point'),
    (row("a: '0,5', alpha: 0, d: 0, theta: 0"), "robot.yaml: joint 1: a: found '0,5', expected a finite number; is it a decimal comma? numbers have a decimal point"),
    (row("a: 045, alpha: 0, d: 0, theta: 0"), 'robot.yaml:3: 045 is a number of base 8 in YAML, expected one of base 10'),
    (row("a: 1:30, alpha: 0, d: 0, theta: 0"), 'robot.yaml:3: 1:30 is a number of base 60 in YAML, expected one of base 10'),
    (row("a: 0:30.5, alpha: 0, d: 0, theta: 0"), 'robot.yaml:3: 0:30.5 is a number of base 60 in YAML, expected one of base 10'),
    (row("a: 0x10, alpha: 0, d: 0, theta: 0"), 'robot.yaml:3: 0x10 is a number of base 16 in YAML, expected one of base 10'),
    (row("a: 0b11, alpha: 0, d: 0, theta: 0"), 'robot.yaml:3: 0b11 is a number of base 2 in YAML, expected one of base 10'),
    (row("a: 1_000, alpha: 0, d: 0, theta: 0"), 'robot.yaml:3: 1_000 has an underscore, expected a number without it'),
    (row("a: 1_0.5, alpha: 0, d: 0, theta: 0"), 'robot.yaml:3: 1_0.5 has an underscore, expected a number without it'),
    (row("a: '1_000', alpha: 0, d: 0, theta: 0"), "robot.yaml: joint 1: a: found '1_000', expected a finite number"),
    (R + "tool: {roll: 90}\n", "robot.yaml: tool: roll: found 90, expected angles in rad, two turns at most; units: {angle: deg} are deg"),
    (row("a: 0o17, alpha: 0, d: 0, theta: 0"), "robot.yaml: joint 1: a: found '0o17', expected a finite number"),
    (row("a: 2024-01-01, alpha: 0, d: 0, theta: 0"), 'robot.yaml: joint 1: a: found 2024-01-01, expected a finite number'),
    (row("a: 90°, alpha: 0, d: 0, theta: 0"), "robot.yaml: joint 1: a: found '90°', expected a finite number"),
    (row("a: pi/2, alpha: 0, d: 0, theta: 0"), "robot.yaml: joint 1: a: found 'pi/2', expected a finite number"),
    (row("a: 10 mm, alpha: 0, d: 0, theta: 0"), "robot.yaml: joint 1: a: found '10 mm', expected a finite number"),
    (row("a: [0], alpha: 0, d: 0, theta: 0"), 'robot.yaml: joint 1: a: found [0], expected a finite number'),
    (row("a: {b: 1}, alpha: 0, d: 0, theta: 0"), "robot.yaml: joint 1: a: found {'b': 1}, expected a finite number"),
    (row("a: , alpha: 0, d: 0, theta: 0"), "robot.yaml: joint 1: missing key 'a'"),
    (row("a: 1e16, alpha: 0, d: 0, theta: 0"), "robot.yaml: joint 1: a: found '1e16', expected a number no larger than 1e+15; sigmas and tolerances no less than 1e-30"),
    (row("a: "+"9"*400+", alpha: 0, d: 0, theta: 0"), 'robot.yaml: joint 1: a: found 999999999999999999999999999999999999999999999999...999999..., expected a finite number'),
    (row("a: "+"9"*5000+", alpha: 0, d: 0, theta: 0"), "robot.yaml:3: '99999999999999999999999999999999999999999999999999999999... is no YAML of type int"),
    (row("a: -.inf, alpha: 0, d: 0, theta: 0"), 'robot.yaml: joint 1: a: found -inf, expected a finite number'),
    (row("a: !!binary aGk=, alpha: 0, d: 0, theta: 0"), "robot.yaml: joint 1: a: found b'hi', expected a finite number"),
    (row("a: !!python/object/apply:os.system [exit 1], alpha: 0, d: 0, theta: 0"), "robot.yaml:3: tag 'tag:yaml.org,2002:python/object/apply:os.system', expected a value without it"),
    (row("a: !!set {a, b}, alpha: 0, d: 0, theta: 0"), "robot.yaml: joint 1: a: found {'a', 'b'}, expected a finite number"),
    (row("a: !x 1, alpha: 0, d: 0, theta: 0"), "robot.yaml:3: tag '!x', expected a value without it"),
    (row("a: *b, alpha: 0, d: 0, theta: 0"), "robot.yaml:3: found undefined alias 'b'"),
    (row("<<: 1, a: 0"), 'robot.yaml:3: expected a mapping or list of mappings for merging, but found scalar'),
    (row("<<: [1], a: 0"), 'robot.yaml:3: expected a mapping for merging, but found scalar'),
    (row("A: 0, alpha: 0, d: 0, theta: 0"), "robot.yaml: joint 1: unknown key 'A', expected one of type, name, a, alpha, d, theta, beta, limits; did you mean a?"),
    (row("a: 0, alpha: 0, d: 0, theta: 0, limits: [-.inf, .nan]"), 'robot.yaml: joint 1: limits: found [-inf, nan], expected lower below upper'),
    (row("a: 0, alpha: 0, d: 0, theta: 0, limits: [1, 1]"), 'robot.yaml: joint 1: limits: found [1.0, 1.0], expected lower below upper'),
    (row("a: 0, alpha: 0, d: 0, theta: 0, limits: {lower: 0, upper: 1}"), "robot.yaml: joint 1: limits: found {'lower': 0, 'upper': 1}, expected a list"),
    (row("a: 0, alpha: 0, d: 0, theta: 0, limits: [0, 1, 2]"), 'robot.yaml: joint 1: limits: found [0, 1, 2], expected at most 2 in the list'),
    (row("a: 0, alpha: 0, d: 0, theta: 0, limits: [0, 1e300]"), "robot.yaml: joint 1: limit 2: found '1e300', expected a number no larger than 1e+15; sigmas and tolerances no less than 1e-30"),
    (row("a: 0, alpha: 0, d: 0, theta: 0, type: Revolute"), "robot.yaml: joint 1: type: found 'Revolute', expected one of revolute, prismatic; did you mean revolute?"),
    (row("a: 0, alpha: 0, d: 0, theta: 0, type: "), 'robot.yaml: joint 1: type: found nothing, expected one of revolute, prismatic'),
    (row("a: 0, alpha: 0, d: 0, theta: 0, name: [1]"), 'robot.yaml: joint 1: name: found [1], expected text'),
    (R+"name: no\n", 'robot.yaml: name: found False, expected text; text such as no, on or true stands in quotes'),
    (R+"name: 2024-01-01\n", 'robot.yaml: name: found 2024-01-01, expected text'),
    (R+'name: "\\ud800"\n', "robot.yaml:4: '\\ud800' is no text of Unicode"),
    (R+"units: mm\n", "robot.yaml: units: found 'mm', expected a mapping"),
    (R+"units: [m, deg]\n", "robot.yaml: units: found ['m', 'deg'], expected a mapping"),
    (R+"units: {length: M}\n", "robot.yaml: units: length: found 'M', expected one of m, cm, mm, um, in; did you mean m?"),
    (R+"units: {angle: 1}\n", 'robot.yaml: units: angle: found 1, expected one of rad, deg, mrad'),
    (R+"units:\n", 'robot.yaml: units: found nothing, expected a mapping'),
    (R+"base: [0, 0, 1]\n", 'robot.yaml: base: found [0, 0, 1], expected a mapping'),
    (R+"tool: {x: '1 mm'}\n", "robot.yaml: tool: x: found '1 mm', expected a finite number"),
    (R+"fixed: [1]\n", 'robot.yaml: fixed 1: found 1, expected text'),
    (R+"fixed: {a1: 1}\n", "robot.yaml: fixed: found {'a1': 1}, expected a list"),
    (R+"fixed: [a1, [d1]]\n", "robot.yaml: fixed 2: found ['d1'], expected text"),
    (R+"fixed: [a1]\nestimate: [a1]\n", "robot.yaml: estimate: 'a1' stands under fixed too, expected it under one of the two"),
    (R+"estimate: [tool]\n", "robot.yaml: estimate: unknown parameter 'tool', expected one of base.x, base.y, base.z, base.yaw, base.pitch, base.roll, theta1, d1, a1, alpha1, tool.x, tool.y, ..."),
    (R+"tolerance: 0.1\n", 'robot.yaml: tolerance: found 0.1, expected a mapping'),
    (R+"tolerance: {a: 1e-40}\n", "robot.yaml: tolerance: a: found '1e-40', expected a number no larger than 1e+15; sigmas and tolerances no less than 1e-30"),
    (R+"units: {length: um}\ntolerance: {a: 1e-29}\n", "robot.yaml: tolerance: a: found 1e-29 um, expected 1e-30 m or more"),
    (R+"tolerance: {a: .inf}\n", 'robot.yaml: tolerance: a: found inf, expected a finite number'),
    (R+"tolerance: {a: }\n", 'robot.yaml: tolerance: a: found nothing, expected a finite number'),
    (R+"tolerance: {\"\\e[31m\": 1}\n", "robot.yaml: tolerance: unknown parameter or kind '\\x1b[31m', expected one of a, alpha, base, d, theta, tool"),
    (R+"tolerance: {\"a\\a\": -1}\n", 'robot.yaml: tolerance: a\\x07: found -1, expected a number above 0'),
    (R+"tolerance: [a]\n", "robot.yaml: tolerance: found ['a'], expected a mapping"),
    (R+"Name: x\n", "robot.yaml: unknown key 'Name', expected one of name, units, base, tool, fixed, estimate, tolerance, convention, joints; did you mean name?"),
    (R+"\"\\e[31mkey\": 1\n", "robot.yaml: unknown key '\\x1b[31mkey', expected one of name, units, base, tool, fixed, estimate, tolerance, convention, joints"),
    ("convention: mdh\njoints:\n  - {a: 0}\n", "robot.yaml: joint 1: missing key 'alpha'"),
    ("convention: [dh]\njoints: []\n", "robot.yaml: convention: found ['dh'], expected one of dh, mdh, mdh-hayati, dh-hayati (and 1 more)"),
    ("convention: DH\n"+"joints:\n"+ROW, "robot.yaml: convention: found 'DH', expected one of dh, mdh, mdh-hayati, dh-hayati; did you mean dh?"),
    ("joints:\n"+ROW+"urdf: a.urdf\n", "robot.yaml: unknown key 'joints', expected one of name, units, base, tool, fixed, estimate, tolerance, urdf, base_link, tip_link"),
    ("urdf: ''\n", "robot.yaml: urdf: found '', expected a path"),
    ("urdf: 5\n", 'robot.yaml: urdf: found 5, expected a path'),
    ("urdf: nowhere.urdf\n", '{folder}/nowhere.urdf: no such file'),
    ("--- a\n--- b\n", 'robot.yaml:2: expected a single document in the stream, but found another document'),
    (R+"---\n"+R, 'robot.yaml:4: expected a single document in the stream, but found another document'),
    ("%YAML 9.9\n---\n"+R, 'robot.yaml:1: found incompatible YAML document (version 1.* is required)'),
    ("<robot name='x'></robot>", 'robot.yaml: found "<robot name=\'x\'></robot>", expected a mapping, key: value; is it a URDF? its name ends in .urdf'),
    ("{", "robot.yaml:1: expected the node content, but found '<stream end>'"),
    ("}", "robot.yaml:1: expected the node content, but found '}'"),
    ("'", 'robot.yaml:1: found unexpected end of stream'),
    ("a: |\n", "robot.yaml: unknown key 'a', expected one of name, units, base, tool, fixed, estimate, tolerance, convention, joints"),
    ("\t", "robot.yaml:1: found character '\\t' that cannot start any token"),
    ("a: b: c\n", 'robot.yaml:1: mapping values are not allowed here'),
    ("@", "robot.yaml:1: found character '@' that cannot start any token"),
    ("`", "robot.yaml:1: found character '`' that cannot start any token"),
    ("%", "robot.yaml:1: expected alphabetic or numeric character, but found '\\x00'"),
    ("- - - -\n", 'robot.yaml: found [[[[None]]]], expected a mapping, key: value'),
    ("true", 'robot.yaml: found True, expected a mapping, key: value'),
    ("42", 'robot.yaml: found 42, expected a mapping, key: value'),
    ("\"text\"", "robot.yaml: found 'text', expected a mapping, key: value"),
    ("!!python/object:os.system {}\n", "robot.yaml:1: tag 'tag:yaml.org,2002:python/object:os.system', expected a value without it"),
    ("!!map [a]", 'robot.yaml:1: a tag of a mapping, expected a mapping behind it'),
    ("a: &a [*a, *b]", "robot.yaml:1: found undefined alias 'b'"),
    ("a: *a", "robot.yaml:1: found undefined alias 'a'"),
    ("\x00", 'robot.yaml:1: a null character, expected UTF-8 text; is it UTF-16, or no text at all? save it as UTF-8'),
    (b"\xff\xfe\x00\x00a\x00\x00\x00", 'robot.yaml: UTF-16 or UTF-32 text, expected UTF-8 text; save it as UTF-8'),
    (b"\xfe\xffa", 'robot.yaml: UTF-16 or UTF-32 text, expected UTF-8 text; save it as UTF-8'),
    (b"a: \xff\n", 'robot.yaml:1: byte 0xff, expected UTF-8 text; is it Latin-1 or Windows text? save it as UTF-8'),
    (b"\x80", 'robot.yaml:1: byte 0x80, expected UTF-8 text; is it Latin-1 or Windows text? save it as UTF-8'),
    (b"a\xcc\x80\xed\xa0\x80: 1", 'robot.yaml:1: byte 0xed, expected UTF-8 text; is it Latin-1 or Windows text? save it as UTF-8'),
    ("a: \x1b[31m\n", 'robot.yaml:1: character 0x1b, expected printable text'),
    ("{a: 1", "robot.yaml:1: expected ',' or '}', but got '<stream end>'"),
]

L = '<link name="a"/><link name="b"/>'
X = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'


def j(inner="", name="j", type="continuous", p="a", c="b"):
    """A joint."""
    return f'<joint name="{name}" type="{type}"><parent link="{p}"/><child link="{c}"/>{inner}</joint>'


def r(inner, attributes='name="r"'):
    """A robot."""
    return f"<robot {attributes}>{inner}</robot>"


def J(inner):
    """A joint between the links a and b, with this in it."""
    return f'<joint name="j" type="revolute"><parent link="a"/><child link="b"/>{inner}</joint>'


URDFS = [
    (r(L+J('<Origin xyz="1 0 0"/>')), "arm.urdf:1: joint 'j': element <Origin>, expected <origin>"),
    (r(L+J('<origin XYZ="1 0 0"/>')), "arm.urdf:1: joint 'j': origin: attribute XYZ, expected xyz"),
    (r(L+J('<origin xyz="1 0 0"/><origin xyz="2 0 0"/>')), "arm.urdf:1: joint 'j': two elements <origin>, expected one"),
    (r(L+J('<origin rpy="90 0 180"/>')), "arm.urdf:1: joint 'j': origin rpy: found 90 0 180, expected angles in rad, two turns at most; are they in deg?"),
    (r(L+J('<origin xyz="1_0 0 0"/>')), "arm.urdf:1: joint 'j': origin xyz: found '1_0 0 0', expected three finite numbers"),
    (r(L+J('<origin xyz="1 0 ٣"/>')), "arm.urdf:1: joint 'j': origin xyz: found '1 0 ٣', expected three finite numbers"),
    (r(L+J('<limit lower="-1_0" upper="1"/>')), "arm.urdf: joint 'j': limit lower: found '-1_0', expected a number"),
    ("", 'arm.urdf:1: not XML: Document is empty, line 1, column 1'),
    ("   ", "arm.urdf:1: not XML: Start tag expected, '<' not found, line 1, column 4"),
    ("hello", "arm.urdf:1: not XML: Start tag expected, '<' not found, line 1, column 1"),
    ("<robot>", 'arm.urdf:1: not XML: Premature end of data in tag robot line 1, line 1, column 8'),
    ("<robot/>", 'arm.urdf: no links and joints, expected <link> and <joint> within <robot>'),
    (r(L), 'arm.urdf: 2 root links (a, b), expected one; name one as base_link: {urdf: arm.urdf, base_link: ...} in a file, --base-link of observe'),
    (r('<link name="a"/>'), "arm.urdf: no moving joint between links 'a' and 'a', expected at least one"),
    (r(L+j(p='b',c='a')+j(name='k')), 'arm.urdf: links in a circle: a below b below a, expected a tree of links'),
    (r(L+j(p='a',c='a')), 'arm.urdf: links in a circle: a below a, expected a tree of links'),
    (r(L+'<link name="c"/><link name="d"/>'+j()+j(name='k',p='c',c='d')+j(name='l',p='d',c='c')), 'arm.urdf: links in a circle: c below d below c, expected a tree of links'),
    (r(L+j(name='')), 'arm.urdf:1: a joint without a name'),
    (r(L+j()+j()), "arm.urdf:1: joint 'j': a second joint of this name, expected different names"),
    (r(L+j()+j(name='k')), "arm.urdf: link 'b' is the child of joints 'j' and 'k', expected one"),
    (r('<link/>'+j()), 'arm.urdf:1: a link without a name'),
    (r(L+'<joint name="j" type="fixed"><child link="b"/></joint>'), 'arm.urdf:1: joint \'j\': no <parent>, expected <parent link="..."/>'),
    (r(L+'<joint name="j" type="fixed"><parent link="a"/></joint>'), 'arm.urdf:1: joint \'j\': no <child>, expected <child link="..."/>'),
    (r(L+j(type='')), "arm.urdf: joint 'j': no type, expected revolute, continuous, prismatic or fixed on the chain"),
    (r(L+j(type='Revolute')), "arm.urdf: joint 'j': type Revolute, expected revolute, continuous, prismatic or fixed on the chain"),
    (r(L+j(type='floating')), "arm.urdf: joint 'j': type floating, expected revolute, continuous, prismatic or fixed on the chain"),
    (r(L+j(type='planar')), "arm.urdf: joint 'j': type planar, expected revolute, continuous, prismatic or fixed on the chain"),
    (r(L+j(type='\x1b[31m'.replace('\x1b','&#27;'))), 'arm.urdf:1: not XML: xmlParseCharRef: invalid xmlChar value 27, line 1, column 76'),
    (r(L+j(type='fixed')), "arm.urdf: no moving joint between links 'a' and 'b', expected at least one"),
    (r(L+j('<mimic joint="k"/>')), "arm.urdf: joint 'j': mimics joint 'k', expected joints on the chain that move by themselves"),
    (r(L+j('<mimic/>')), "arm.urdf: joint 'j': mimics joint '', expected joints on the chain that move by themselves"),
    (r(L+j('<origin xyz="1 2"/>')), "arm.urdf:1: joint 'j': origin xyz: found '1 2', expected three finite numbers"),
    (r(L+j('<origin xyz="1,2,3"/>')), "arm.urdf:1: joint 'j': origin xyz: found '1,2,3', expected three finite numbers"),
    (r(L+j('<origin xyz="1 2 3 4"/>')), "arm.urdf:1: joint 'j': origin xyz: found '1 2 3 4', expected three finite numbers"),
    (r(L+j('<origin rpy="0 0 nan"/>')), "arm.urdf:1: joint 'j': origin rpy: found '0 0 nan', expected three finite numbers"),
    (r(L+j('<origin rpy="0 0 90deg"/>')), "arm.urdf:1: joint 'j': origin rpy: found '0 0 90deg', expected three finite numbers"),
    (r(L+j('<origin xyz="0 0 1e300"/>')), "arm.urdf:1: joint 'j': origin xyz: found '0 0 1e300', expected a number no larger than 1e+15; sigmas and tolerances no less than 1e-30"),
    (r(L+j('<origin xyz="0 0 inf"/>')), "arm.urdf:1: joint 'j': origin xyz: found '0 0 inf', expected three finite numbers"),
    (r(L+j('<origin xyz="${a} 0 0"/>')), "arm.urdf:1: joint 'j': origin xyz: found '${a} 0 0', expected three finite numbers"),
    (r(L+j('<origin xyz=""/>')), "arm.urdf:1: joint 'j': origin xyz: found '', expected three finite numbers"),
    (r(L+j('<origin xyz="0,1 0 0"/>')), "arm.urdf:1: joint 'j': origin xyz: found '0,1 0 0', expected three finite numbers"),
    (r(L+j('<origin xyz="'+'9'*5000+' 0 0"/>')), "arm.urdf:1: joint 'j': origin xyz: found '99999999999999999999999999999999999999999999999999999999..., expected three finite numbers"),
    (r(L+j('<axis xyz="0 0 0"/>')), "arm.urdf: joint 'j': axis: found '0 0 0', expected a direction of three numbers"),
    (r(L+j('<axis xyz="1 0"/>')), "arm.urdf: joint 'j': axis: found '1 0', expected a direction of three numbers"),
    (r(L+j('<axis xyz="z"/>')), "arm.urdf: joint 'j': axis: found 'z', expected a direction of three numbers"),
    (r(L+j('<axis xyz="1e200 0 0"/>')), "arm.urdf: joint 'j': axis: found '1e200 0 0', expected a direction of three numbers"),
    (r(L+j('<axis xyz="1e-200 0 0"/>')), "arm.urdf: joint 'j': axis: found '1e-200 0 0', expected a direction of three numbers"),
    (r(L+j('<axis xyz="nan 0 0"/>')), "arm.urdf: joint 'j': axis: found 'nan 0 0', expected a direction of three numbers"),
    (r(L+j('<axis xyz="inf 0 0"/>')), "arm.urdf: joint 'j': axis: found 'inf 0 0', expected a direction of three numbers"),
    (r(L+j('<limit lower="1" upper="-1"/>',type='revolute')), "arm.urdf: joint 'j': limit: lower 1, upper -1, expected lower below upper"),
    (r(L+j('<limit lower="1" upper="1"/>',type='revolute')), "arm.urdf: joint 'j': limit: lower 1, upper 1, expected lower below upper"),
    (r(L+j('<limit lower="a"/>',type='revolute')), "arm.urdf: joint 'j': limit lower: found 'a', expected a number"),
    (r(L+j('<limit lower="1 2"/>',type='revolute')), "arm.urdf: joint 'j': limit lower: found '1 2', expected a number"),
    (r(L+j('<limit lower="" upper="1"/>',type='revolute')), "arm.urdf: joint 'j': limit lower: found '', expected a number"),
    (r(L+j('<limit upper="1e300"/>',type='prismatic')), "arm.urdf: joint 'j': limit upper: found '1e300', expected a number no larger than 1e+15; sigmas and tolerances no less than 1e-30"),
    (r(L+j('<limit upper="nan"/>',type='prismatic')), "arm.urdf: joint 'j': limit upper: found 'nan', expected a number"),
    (r(L+j(name='tool')), "arm.urdf: two frames called 'tool', expected different names; base and tool are the frames before and behind the joints"),
    (r(L+j(name='base')), "arm.urdf: two frames called 'base', expected different names; base and tool are the frames before and behind the joints"),
    (r(L+'<link name="c"/>'+j()+j(name='k',c='c')), 'arm.urdf: 2 leaf links (b, c), expected one; name one as tip_link: {urdf: arm.urdf, tip_link: ...} in a file, --tip-link of observe'),
    (r('<link name="c"/>'+L+j()), 'arm.urdf: 2 root links (c, a), expected one; name one as base_link: {urdf: arm.urdf, base_link: ...} in a file, --base-link of observe'),
    (r(L+''.join(f'<link name="x{i}"/>' for i in range(60))+j()), 'arm.urdf: 61 root links (a, x0, x1, x2, x3, x4, x5, x6, x7, x8, x9, x10, ...), expected one; name one as base_link: {urdf: arm.urdf, base_link: ...} in a file, --base-link of observe'),
    (r(L+j(p='a'*500)), 'arm.urdf: 2 root links (a, aaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaaa...), expected one; name one as base_link: {urdf: arm.urdf, base_link: ...} in a file, --base-link of observe'),
    (r('<xacro:arm/>',X), 'arm.urdf: no links and joints, expected <link> and <joint> within <robot>; it holds elements of xacro: expand them by `xacro arm.urdf.xacro > arm.urdf`'),
    (r(L+j('<origin xyz="${d} 0 0"/>')+'<xacro:property name="d" value="1"/>',X), "arm.urdf:1: joint 'j': origin xyz: found '${d} 0 0', expected three finite numbers; it holds elements of xacro: expand them by `xacro arm.urdf.xacro > arm.urdf`"),
    (r('<xacro:arm/>'), 'arm.urdf:1: not XML: Namespace prefix xacro on arm is not defined, line 1, column 27; it holds elements of xacro: expand them by `xacro arm.urdf.xacro > arm.urdf`'),
    (b'<robot name="\xff">'+b'</robot>', 'arm.urdf:1: byte 0xff, expected UTF-8 text; is it Latin-1 or Windows text? save it as UTF-8'),
    ('<?xml version="1.0" encoding="utf-16"?>'+r(L+j()), 'arm.urdf:1: not XML: Blank needed here, line 1, column 38'),
    ('<?xml version="1.0" encoding="nonsense"?>'+r(L+j()), 'arm.urdf:1: not XML: Unsupported encoding: nonsense, line 1, column 40'),
    ('<?xml version="9.0"?>'+r(L), "arm.urdf:1: not XML: Unsupported version '9.0', line 1, column 20"),
    (r(L+j()).encode('utf-16')[:50], 'arm.urdf: UTF-16 or UTF-32 text, expected UTF-8 text; save it as UTF-8'),
    (r(L+'\x00'), 'arm.urdf:1: a null character, expected UTF-8 text; is it UTF-16, or no text at all? save it as UTF-8'),
    (r(L+'\x1b'), 'arm.urdf:1: not XML: PCDATA invalid Char value 27, line 1, column 49'),
    (r(L+'&#0;'), 'arm.urdf:1: not XML: xmlParseCharRef: invalid xmlChar value 0, line 1, column 53'),
    (r(L+'&nbsp;'), "arm.urdf:1: not XML: Entity 'nbsp' not defined, line 1, column 55, expected a URDF without entities: they are not expanded"),
    (r(L+'<a'), 'arm.urdf:1: not XML: error parsing attribute name, line 1, column 51'),
    (r(L)+r(L), 'arm.urdf:1: not XML: Extra content at the end of the document, line 1, column 57'),
    (r(L).replace('robot','Robot'), 'arm.urdf: root element <Robot>, expected <robot>'),
    ('<sdf version="1.6"><model name="a"/></sdf>', 'arm.urdf: root element <sdf>, expected <robot>'),
    ('<mujoco/>', 'arm.urdf: root element <mujoco>, expected <robot>'),
    (r(L,'name="r" name="s"'), 'arm.urdf:1: not XML: Attribute name redefined, line 1, column 25'),
    (r(L,'name=r'), 'arm.urdf:1: not XML: AttValue: " or \' expected, line 1, column 13'),
    ('<robot '+'a="1" '*3+'/>', 'arm.urdf:1: not XML: Attribute a redefined, line 1, column 26'),
    ('<a>'*300+'</a>'*300, 'arm.urdf:1: not XML: Excessive depth in document: 256 ...'),
    (r('<b>'*300), 'arm.urdf:1: not XML: Excessive depth in document: 256 ...'),
    (r(L+'<!-- -- -->'), 'arm.urdf:1: not XML: Double hyphen within comment: <!-- , line 1, column 54'),
    ('<!DOCTYPE robot SYSTEM "file:///etc/passwd">'+r(L), 'arm.urdf: a <!DOCTYPE> with entities or of another file, expected a URDF without entities: they are not expanded'),
    ('<?xml-stylesheet href="x"?>', "arm.urdf:1: not XML: Start tag expected, '<' not found, line 1, column 28"),
]

TWO_JOINTS = "convention: mdh\njoints:\n" + ROW + "  - {a: 0, alpha: 0, d: 0, theta: 0, type: prismatic}\n"
ONE_JOINT = "convention: mdh\njoints:\n" + ROW
JOB = "robot: robot.yaml\nmeasurements: poses.csv\nmodel: pose\n"
T = "robot: robot.yaml\nmeasurements:\n"
JOBS = [
    (JOB + "columns: [q1]\n", "job.yaml: columns: found ['q1'], expected a mapping"),
    (JOB + "columns: {q1: 3}\n", "job.yaml: columns: q1: found 3, expected a mapping"),
    (JOB + "columns: {q1: ''}\n", "job.yaml: columns: q1: found '', expected the name of a column"),
    (JOB + "columns: {q1: {scale: 2}}\n", "job.yaml: columns: q1: missing key 'name'"),
    (JOB + "columns: {q1: {name: x, scale: 0}}\n", "job.yaml: columns: q1: found 0.0, expected a finite number other than 0"),
    (JOB + "columns: {q1: {name: x, factor: 2}}\n", "job.yaml: columns: q1: unknown key 'factor', expected one of name, scale, zero"),
    (JOB + "prior: false\ngauge: prior\n", "prior: found False beside gauge: prior, expected gauge alone"),
    (JOB + "prior: true\ngauge: none\n", "prior: found True beside gauge: none, expected gauge alone"),
    (JOB.replace("robot.yaml","''"), "job.yaml: robot: found '', expected a path, or the mapping of a robot file"),
    (JOB.replace("robot.yaml",""), 'job.yaml: robot: found nothing, expected a path, or the mapping of a robot file'),
    (JOB.replace("robot.yaml","/dev/null"), '/dev/null: is a pipe or a device, expected a file'),
    (JOB.replace("robot.yaml","{}"), "job.yaml: robot: missing keys 'convention', 'joints'"),
    (JOB.replace("robot.yaml","{urdf: ''}"), "job.yaml: robot: urdf: found '', expected a path"),
    (JOB.replace("robot.yaml","poses.csv"), "poses.csv: found 'q1,q2,x,y,z 0,0,0,0,0 10,20,1000,0,0', expected a mapping, key: value"),
    (JOB.replace("robot.yaml","5"), 'job.yaml: robot: found 5, expected a path, or the mapping of a robot file'),
    (JOB.replace("robot.yaml","\"a\\0b\""), '{folder}/a\\x00b: cannot be read: ...'),
    (JOB.replace("robot.yaml","robot.yml"), '{folder}/robot.yml: no such file'),
    (JOB.replace("poses.csv","''"), "job.yaml: measurements: found '', expected a path, or a list of tables"),
    (JOB.replace("poses.csv",""), 'job.yaml: measurements: found nothing, expected a path, or a list of tables'),
    (JOB.replace("poses.csv","robot.yaml"), "robot.yaml: ending '.yaml', expected one of .csv, .parquet, .pq"),
    (JOB.replace("poses.csv","poses"), '{folder}/poses: no such file'),
    (JOB.replace("poses.csv","poses.xlsx"), '{folder}/poses.xlsx: no such file'),
    (JOB.replace("poses.csv","poses-*.csv"), '{folder}/poses-*.csv: no such file'),
    (JOB.replace("poses.csv","{table: poses.csv}"), "job.yaml: measurements: found {'table': 'poses.csv'}, expected a path, or a list of tables"),
    (JOB.replace("poses.csv","[]"), 'job.yaml: measurements: found [], expected a path, or a list of tables'),
    (JOB.replace("poses.csv","[poses.csv]"), "job.yaml: measurement 1: found 'poses.csv', expected a mapping"),
    (JOB.replace("poses.csv","https://example.org/poses.csv"), '{folder}/https:/example.org/poses.csv: no such file'),
    (JOB.replace("poses.csv","~/poses.csv"), '{folder}/~/poses.csv: no such file'),
    (JOB+"pairs: ''\n", "job.yaml: pairs: found '', expected a path"),
    (JOB+"pairs: nowhere.csv\n", '{folder}/nowhere.csv: no such file'),
    (JOB+"pairs: [pairs.csv]\n", "job.yaml: pairs: found ['pairs.csv'], expected a path"),
    (JOB+"pairs: poses.csv\n", 'poses.csv: no column a, expected a and b, the two configurations of a pair'),
    (JOB+"truth: ''\n", "job.yaml: truth: found '', expected a path"),
    (JOB+"truth: other.yaml\n", 'other.yaml: another robot, expected the parameters of robot, with their true values'),
    (JOB.replace("pose\n","Pose\n"), "job.yaml: model: found 'Pose', expected one of pose, position, orientation, distance, rotation, distance-rotation, anchor, plane, board, pixels; did you mean pose?"),
    (JOB.replace("pose\n","[pose]\n"), "job.yaml: model: found ['pose'], expected one of pose, position, orientation, distance, rotation, distance-rotation, anchor, plane, board, pixels"),
    (JOB.replace("pose\n","\n"), 'job.yaml: model: found nothing, expected one of pose, position, orientation, distance, rotation, distance-rotation, anchor, plane, board, pixels'),
    (JOB.replace("pose\n","sphere\n"), "job.yaml: model: found 'sphere', expected one of pose, position, orientation, distance, rotation, distance-rotation, anchor, plane, board, pixels"),
    (JOB+"model: pose\n", "job.yaml:4: key 'model' stands here twice"),
    (JOB+"Model: pose\n", "job.yaml: unknown key 'Model', expected one of robot, measurements, pairs, model, pairing, frame, units, noise, prior, gauge, prefer, pair_errors, encoder, loss, max_iterations, accept, folds, truth, targets, anchors, tolerance, offset, camera, columns; did you mean model?"),
    (JOB+"frame: Known\n", "job.yaml: frame: found 'Known', expected one of known, unknown; did you mean known?"),
    (JOB+"frame: {x: 0}\n", "job.yaml: frame: found {'x': 0}, expected one of known, unknown"),
    (JOB+"frame: true\n", 'job.yaml: frame: found True, expected one of known, unknown'),
    (JOB+"pairing: {random: -1}\n", 'job.yaml: pairing: random: found -1, expected a number not below 0'),
    (JOB+"pairing: {random: 1e3}\n", "job.yaml: pairing: random: found '1e3', expected a whole number"),
    (JOB+"pairing: {random: '5'}\n", "job.yaml: pairing: random: found '5', expected a whole number"),
    (JOB+"pairing: {random: 3, seed: -1}\n", 'job.yaml: pairing: seed: found -1, expected a number not below 0'),
    (JOB+"pairing: {random: 3, seed: 1.5}\n", 'job.yaml: pairing: seed: found 1.5, expected a whole number'),
    (JOB+"pairing: {}\n", "job.yaml: pairing: missing key 'random'"),
    (JOB+"pairing: [star]\n", "job.yaml: pairing: found ['star'], expected one of star, chain, all, {random: N, seed: S}"),
    (JOB+"pairing: random\n", "job.yaml: pairing: found 'random', expected one of star, chain, all, {random: N, seed: S}"),
    (JOB+"pairing: Star\n", "job.yaml: pairing: found 'Star', expected one of star, chain, all, {random: N, seed: S}; did you mean star?"),
    (JOB+"pairing:\n", 'job.yaml: pairing: found nothing, expected one of star, chain, all, {random: N, seed: S}'),
    (JOB+"pairing: {random: 99999999999999999999}\n", 'job.yaml: pairing: random: found 99999999999999999999, expected a number not above 1e+07'),
    (JOB+"units: {length: inch}\n", "job.yaml: units: length: found 'inch', expected one of m, cm, mm, um, in; did you mean in?"),
    (JOB+"units: deg\n", "job.yaml: units: found 'deg', expected a mapping"),
    (JOB+"units: {angle: °}\n", "job.yaml: units: angle: found '°', expected one of rad, deg, mrad"),
    (JOB+"unit: {angle: deg}\n", "job.yaml: unknown key 'unit', expected one of robot, measurements, pairs, model, pairing, frame, units, noise, prior, gauge, prefer, pair_errors, encoder, loss, max_iterations, accept, folds, truth, targets, anchors, tolerance, offset, camera, columns; did you mean units?"),
    (JOB+"noise: {position: 0,001}\n", 'job.yaml:4: key 001, expected a word; is it a decimal comma? numbers have a decimal point'),
    (JOB+"noise:\n  position: 0,001\n", "job.yaml: noise: position: found '0,001', expected a finite number; is it a decimal comma? numbers have a decimal point"),
    (JOB+"noise: {position: -1}\n", 'job.yaml: noise: position: found -1, expected a number above 0'),
    (JOB+"noise: {position: 1 mm}\n", "job.yaml: noise: position: found '1 mm', expected a finite number"),
    (JOB+"noise: {position: .nan}\n", 'job.yaml: noise: position: found nan, expected a finite number'),
    (JOB+"noise: {position: 1e-40}\n", "job.yaml: noise: position: found '1e-40', expected a number no larger than 1e+15; sigmas and tolerances no less than 1e-30"),
    (JOB+"units: {angle: deg}\nnoise: {orientation: 1e-29}\n", "job.yaml: noise: orientation: found 1e-29 deg, expected 1e-30 rad or more"),
    (JOB+"units: {length: um}\nnoise: {position: 1e-29}\n", "job.yaml: noise: position: found 1e-29 um, expected 1e-30 m or more"),
    (JOB+"units: {angle: deg}\nnoise: {joint: [1e-29, 1]}\n", "job.yaml: noise: joint: found 1e-29 deg, expected 1e-30 rad or more"),
    (JOB+"noise: {position: 1e20}\n", "job.yaml: noise: position: found '1e20', expected a number no larger than 1e+15; sigmas and tolerances no less than 1e-30"),
    (JOB+"noise: {position: true}\n", 'job.yaml: noise: position: found True, expected a finite number'),
    (JOB+"noise: {position: [1, 1, 1]}\n", 'job.yaml: noise: position: found [1, 1, 1], expected a finite number'),
    (JOB+"noise: {joint: []}\n", 'job.yaml: noise: joint: 0 figures, expected one for all or 2, one a joint'),
    (JOB+"noise: {joint: .inf}\n", 'job.yaml: noise: joint: found inf, expected a finite number'),
    (JOB+"noise: {joint: [1, -1]}\n", 'job.yaml: noise: joint 2: found -1, expected a number not below 0'),
    (JOB+"noise: {joint: [1, [1]]}\n", 'job.yaml: noise: joint 2: found [1], expected a finite number'),
    (JOB+"noise: {joint: {q1: 1}}\n", "job.yaml: noise: joint: found {'q1': 1}, expected a finite number"),
    (JOB+"noise: {Position: 1}\n", "job.yaml: noise: unknown key 'Position', expected one of position, orientation, joint, distance, angle, point, pixel, estimate; did you mean position?"),
    (JOB+"noise: {estimate: yes please}\n", "job.yaml: noise: estimate: found 'yes please', expected true or false"),
    (JOB+"noise: [1]\n", 'job.yaml: noise: found [1], expected a mapping of figures, or estimate'),
    (JOB+"noise: true\n", 'job.yaml: noise: found True, expected a mapping of figures, or estimate'),
    (JOB+"prior: maybe\n", "job.yaml: prior: found 'maybe', expected true or false"),
    (JOB+"prior: 'true'\n", "job.yaml: prior: found 'true', expected true or false"),
    (JOB+"gauge: free\n", "job.yaml: gauge: found 'free', expected one of prior, keep, none"),
    (JOB+"prefer: a1\n", "job.yaml: prefer: found 'a1', expected a list"),
    (JOB+"prefer: [a9]\n", "job.yaml: prefer: unknown parameter 'a9', expected one of base.x, base.y, base.z, base.yaw, base.pitch, base.roll, a1, alpha1, d1, theta1, a2, alpha2, ..."),
    (JOB+"prefer: [1]\n", 'job.yaml: prefer 1: found 1, expected text'),
    (JOB+"encoder: estimate\n", "job.yaml: encoder: found 'estimate', expected one of propagated, estimated; did you mean estimated?"),
    (JOB+"loss: Huber\n", "job.yaml: loss: found 'Huber', expected one of none, huber, cauchy, geman-mcclure, gnc; did you mean huber?"),
    (JOB+"loss: {huber: 1}\n", "job.yaml: loss: found {'huber': 1}, expected one of none, huber, cauchy, geman-mcclure, gnc"),
    (JOB+"max_iterations: 0\n", 'job.yaml: max_iterations: found 0, expected a number above 0'),
    (JOB+"max_iterations: 1.5\n", 'job.yaml: max_iterations: found 1.5, expected a whole number'),
    (JOB+"max_iterations: many\n", "job.yaml: max_iterations: found 'many', expected a whole number"),
    (JOB+"max_iterations: 1e400\n", "job.yaml: max_iterations: found '1e400', expected a whole number"),
    (JOB+"pair_errors: Shared\n", "job.yaml: pair_errors: found 'Shared', expected one of shared, independent; did you mean shared?"),
    (JOB+"\"\\e[2J\": 1\n", "job.yaml: unknown key '\\x1b[2J', expected one of robot, measurements, pairs, model, pairing, frame, units, noise, prior, gauge, prefer, pair_errors, encoder, loss, max_iterations, accept, folds, truth, targets, anchors, tolerance, offset, camera, columns"),
    (JOB+"? {a: 1}\n: 2\n", 'job.yaml:4: key that is no word, expected a word'),
    (JOB+"include: other.yaml\n", "job.yaml: unknown key 'include', expected one of robot, measurements, pairs, model, pairing, frame, units, noise, prior, gauge, prefer, pair_errors, encoder, loss, max_iterations, accept, folds, truth, targets, anchors, tolerance, offset, camera, columns"),
    (T+"  - {}\n", "job.yaml: measurement 1: missing key 'table'"),
    (T+"  - {table: ''}\n", "job.yaml: measurement 1: table: found '', expected a path"),
    (T+"  - {table: poses.csv}\n", "job.yaml: measurement 1: missing key 'model'"),
    (T+"  - {table: poses.csv, model: poses}\n", "job.yaml: measurement 1: model: found 'poses', expected one of pose, position, orientation, distance, rotation, distance-rotation, anchor, plane, board, pixels; did you mean pose?"),
    (T+"  - {table: poses.csv, model: pose, noise: {estimate: true}}\n", 'job.yaml: measurement 1: noise: estimate in the entry of a table, expected the key noise of the whole job'),
    (T+"  - {table: poses.csv, model: pose, noise: 1}\n", 'job.yaml: measurement 1: noise: found 1, expected a mapping of figures, or estimate'),
    (T+"  - {table: poses.csv, model: pose, pairing: {random: 0}}\n", 'job.yaml: measurement 1: pairing: random: found 0, expected a number above 0'),
    (T+"  - {table: poses.csv, model: pose, units: {length: ft}}\n", "job.yaml: measurement 1: units: length: found 'ft', expected one of m, cm, mm, um, in"),
    (T+"  - {table: poses.csv, model: pose, robot: r}\n", "job.yaml: measurement 1: unknown key 'robot', expected one of table, pairs, model, pairing, frame, units, noise, offset, camera, columns"),
    (T+"  - {tabel: poses.csv, model: pose}\n", "job.yaml: measurement 1: unknown key 'tabel', expected one of table, pairs, model, pairing, frame, units, noise, offset, camera, columns; did you mean table?"),
    (T+"  - {table: poses.csv, model: pose, frame: maybe}\n", "job.yaml: measurement 1: frame: found 'maybe', expected one of known, unknown"),
    (T+"  - {table: [poses.csv], model: pose}\n", "job.yaml: measurement 1: table: found ['poses.csv'], expected a path"),
    (T+"  -\n", 'job.yaml: measurement 1: found nothing, expected a mapping'),
    (T+"  - {table: poses.csv, model: pose}\npairs: pairs.csv\n", "job.yaml: pairs: beside a list of tables, expected the key in the table's own entry"),
    (T+"  - {table: poses.csv, model: pose}\nmodel: 1\n", 'job.yaml: model: found 1, expected one of pose, position, orientation, distance, rotation, distance-rotation, anchor, plane, board, pixels'),
    (T+"  - {table: poses.csv, model: distance, pairs: ''}\n", "job.yaml: measurement 1: pairs: found '', expected a path"),
]

SC = (
    "robot: robot.yaml\nerrors: {uniform: {a: 0.01}}\nconfigurations: {random: {count: 3}}\n"
    "noise: {position: 0.001, orientation: 0.002}\n"
)
B = "{board: {pose: {x: 1, z: 2}, count: 5%s}}"


def s(old, new):
    """The scenario with something else."""
    assert SC.count(old) == 1
    return SC.replace(old, new)


SCENARIOS = [
    (s("robot.yaml","''"), "scenario.yaml: robot: found '', expected a path, or the mapping of a robot file"),
    (s("robot.yaml","nowhere.yaml"), '{folder}/nowhere.yaml: no such file'),
    (s("{uniform: {a: 0.01}}","[]"), 'scenario.yaml: errors: found [], expected a mapping'),
    (s("{uniform: {a: 0.01}}","uniform"), "scenario.yaml: errors: found 'uniform', expected a mapping"),
    (s("{uniform: {a: 0.01}}","{normal: tolerance}"), 'scenario.yaml: errors: normal: a1 of the robot has no tolerance, expected one for all that is estimated'),
    (s("{a: 0.01}","{a: 0,01}"), 'scenario.yaml:2: key 01, expected a word; is it a decimal comma? numbers have a decimal point'),
    (s("{a: 0.01}","{a: 1e20}"), "scenario.yaml: errors: uniform: a: found '1e20', expected a number no larger than 1e+15; sigmas and tolerances no less than 1e-30"),
    (s("{a: 0.01}","{a: '1 mm'}"), "scenario.yaml: errors: uniform: a: found '1 mm', expected a finite number"),
    (s("{a: 0.01}","{A: 1}"), "scenario.yaml: errors: uniform: unknown parameter or kind 'A', expected one of a, alpha, base, d, theta, tool; did you mean a?"),
    (s("{a: 0.01}","{fixed: 1}"), "scenario.yaml: errors: uniform: unknown parameter or kind 'fixed', expected one of a, alpha, base, d, theta, tool"),
    (s("{a: 0.01}","[a]"), "scenario.yaml: errors: uniform: found ['a'], expected a mapping"),
    (s("uniform: {a: 0.01}","normal: 0.1"), 'scenario.yaml: errors: normal: found 0.1, expected tolerance, or figures by kind or by parameter name'),
    (s("uniform: {a: 0.01}","values: {a1: .nan}"), 'scenario.yaml: errors: values: a1: found nan, expected a finite number'),
    (s("uniform: {a: 0.01}","gaussian: {a: 1}"), "scenario.yaml: errors: unknown key 'gaussian', expected one of uniform, normal, values"),
    (s("count: 3","count: 1000000000"), 'scenario.yaml: configurations: random: count: found 1000000000, expected a number not above 1e+06'),
    (s("count: 3","count: 99999999999999999999999"), 'scenario.yaml: configurations: random: count: found 99999999999999999999999, expected a number not above 1e+06'),
    (s("count: 3","count: '3'"), "scenario.yaml: configurations: random: count: found '3', expected a whole number"),
    (s("count: 3","count: true"), 'scenario.yaml: configurations: random: count: found True, expected a whole number'),
    (s("count: 3",""), "scenario.yaml: configurations: random: missing key 'count'"),
    (s("{random: {count: 3}}","{random: 3}"), 'scenario.yaml: configurations: random: found 3, expected a mapping'),
    (s("{random: {count: 3}}","random"), "scenario.yaml: configurations: found 'random', expected a mapping"),
    (s("{random: {count: 3}}","{table: ''}"), "scenario.yaml: configurations: table: found '', expected a path"),
    (s("{random: {count: 3}}","{table: 3}"), 'scenario.yaml: configurations: table: found 3, expected a path'),
    (s("{random: {count: 3}}",B%", cone: 0"), 'scenario.yaml: configurations: board: cone: found 0, expected a number above 0'),
    (s("{random: {count: 3}}",B%", distance: [1, 2], cone: .inf"), 'scenario.yaml: configurations: board: cone: found inf, expected a finite number'),
    (s("{random: {count: 3}}",B%", distance: [1, .nan]"), 'scenario.yaml: configurations: board: distance 2: found nan, expected a finite number'),
    (s("{random: {count: 3}}",B%", distance: 1"), 'scenario.yaml: configurations: board: distance: found 1, expected a list'),
    (s("{random: {count: 3}}",B%", distance: [1, 2, 3]"), 'scenario.yaml: configurations: board: distance: found [1, 2, 3], expected at most 2 in the list'),
    (s("{random: {count: 3}}",B%", roll: true"), 'scenario.yaml: configurations: board: roll: found True, expected a finite number'),
    (s("{random: {count: 3}}",B%", roll: 1e20"), "scenario.yaml: configurations: board: roll: found '1e20', expected random, or an angle"),
    (s("{random: {count: 3}}",B%", roll: "), 'scenario.yaml: configurations: board: roll: found nothing, expected a finite number'),
    (s("{random: {count: 3}}",B%", height: 1e-40"), "scenario.yaml: configurations: board: height: found '1e-40', expected a number no larger than 1e+15; sigmas and tolerances no less than 1e-30"),
    (s("{random: {count: 3}}",B%", self_motion: hold"), "scenario.yaml: configurations: board: self_motion: found 'hold', expected one of random, held; did you mean held?"),
    (s("{random: {count: 3}}",B%", self_motion: held, posture: 3"), 'scenario.yaml: configurations: board: posture: found 3, expected a list'),
    (s("{random: {count: 3}}",B%", self_motion: held, posture: [a, b]"), "scenario.yaml: configurations: board: posture 1: found 'a', expected a finite number (and 1 more)"),
    (s("{random: {count: 3}}",B%", self_motion: held, posture: []"), 'scenario.yaml: configurations: board: posture: 0 figures, expected 2, one a joint'),
    (s("{random: {count: 3}}",B%", radius: -1"), 'scenario.yaml: configurations: board: radius: found -1, expected a number above 0'),
    (s("{random: {count: 3}}",B.replace("5%s","-5")), 'scenario.yaml: configurations: board: count: found -5, expected a number not below 0'),
    (s("{random: {count: 3}}",B.replace("5%s","1000000000")), 'scenario.yaml: configurations: board: count: found 1000000000, expected a number not above 1e+06'),
    (s("{random: {count: 3}}",B.replace("{x: 1, z: 2}","[1, 2]")%""), 'scenario.yaml: configurations: board: pose: found [1, 2], expected a mapping'),
    (s("{random: {count: 3}}",B.replace("{x: 1, z: 2}","{x: 1e300}")%""), "scenario.yaml: configurations: board: pose: x: found '1e300', expected a number no larger than 1e+15; sigmas and tolerances no less than 1e-30"),
    (s("{random: {count: 3}}",B.replace("{x: 1, z: 2}","")%""), 'scenario.yaml: configurations: board: pose: found nothing, expected a mapping'),
    (s("position: 0.001","position: .inf"), 'scenario.yaml: noise: position: found inf, expected a finite number'),
    (s("position: 0.001","position: 0,001"), 'scenario.yaml:4: key 001, expected a word; is it a decimal comma? numbers have a decimal point'),
    (s("position: 0.001","position: low"), "scenario.yaml: noise: position: found 'low', expected a finite number"),
    (s(", orientation: 0.002",", orientation: 0.002, distance: 1"), "scenario.yaml: noise: unknown key 'distance', expected one of position, orientation, joint"),
    (s("orientation: 0.002","orientation: 0.002, joint: [1, 2, 3]"), 'scenario.yaml: noise: joint: 3 figures, expected one for all or 2, one a joint'),
    (s("{position: 0.001, orientation: 0.002}","estimate"), "scenario.yaml: noise: found 'estimate', expected a mapping"),
    (s("{position: 0.001, orientation: 0.002}",""), 'scenario.yaml: noise: found nothing, expected a mapping'),
    (SC+"name: 5\n", 'scenario.yaml: name: found 5, expected text'),
    (SC+"frame:\n", 'scenario.yaml: frame: found nothing, expected base, unknown, or a mapping of x, y, z, roll, pitch, yaw'),
    (SC+"frame: [0]\n", 'scenario.yaml: frame: found [0], expected base, unknown, or a mapping of x, y, z, roll, pitch, yaw'),
    (SC+"frame: {x: a}\n", "scenario.yaml: frame: x: found 'a', expected a finite number"),
    (SC+"units: {length: mile}\n", "scenario.yaml: units: length: found 'mile', expected one of m, cm, mm, um, in"),
    (SC+"validation: {random: {count: 0}}\n", 'scenario.yaml: validation: random: count: found 0, expected a number above 0'),
    (SC+"validation: []\n", 'scenario.yaml: validation: found [], expected a mapping'),
    (SC+"job: pose\n", "scenario.yaml: job: found 'pose', expected a mapping"),
    (SC+"job: {}\n", "scenario.yaml: job: missing key 'model'"),
    (SC+"job: {model: pose, loss: l1}\n", "scenario.yaml: job: loss: found 'l1', expected one of none, huber, cauchy, geman-mcclure, gnc"),
    (SC+"job: {model: pose, noise: {position: 0}}\n", 'scenario.yaml: job: noise: position: found 0, expected a number above 0'),
    (SC+"job: {model: pose, noise: estimate}\n", "scenario.yaml: job: noise: found 'estimate', expected a mapping"),
    (SC+"job: {model: pose, pairs: p.csv}\n", "scenario.yaml: job: found key 'pairs', expected none; the simulation writes it"),
    (SC+"job: {model: pose, truth: t.yaml}\n", "scenario.yaml: job: found key 'truth', expected none; the simulation writes it"),
    (SC+"job: {model: pose, units: {}}\n", "scenario.yaml: job: found key 'units', expected none; it follows from the scenario"),
    (SC+"seed: 3\n", "scenario.yaml: unknown key 'seed', expected one of name, robot, units, errors, configurations, noise, frame, validation, job, instruments"),
    (SC+"errors: {}\n", "scenario.yaml:5: key 'errors' stands here twice"),
]

XYZ = "q1,q2,x,y,z\n"
POSES = [
    ("q1|q2\n0|0\n", "poses.csv:1: one column 'q1|q2', expected columns with , ; or tab between; not '|'"),
    ("q1;q2\n0,5\n", "poses.csv:2: 1 cell, expected 2 as in the header"),
    ("q1;q2\n1.234,5;0\n", "poses.csv:2: q1: found '1.234,5', expected a finite number"),
    ("q1;q2\n1,2,3;0\n", "poses.csv:2: q1: found '1,2,3', expected a finite number"),
    ("q1\tq2\n0\tzero\n", "poses.csv:2: q2: found 'zero', expected a finite number"),
    ("q1 q2\n0 0\n", "poses.csv: no joint columns, expected q1 to q2 for the robot's 2 joints; the columns are q1 q2"),
    ("q1,q2\n0.1;0.2\n", 'poses.csv:2: 1 cell, expected 2 as in the header'),
    ("0.1,0.2\n0.3,0.4\n", "poses.csv: no joint columns, expected q1 to q2 for the robot's 2 joints; the columns are 0.1, 0.2"),
    ("q2,q3\n0,0\n", "poses.csv: 2 joint columns (q2, q3), expected q1 to q2 for the robot's 2 joints; the columns are q2, q3"),
    ("Q1,Q2\n0,0,0\n", 'poses.csv:2: 3 cells, expected 2 as in the header'),
    ("joint1,joint2\n0,0\n", "poses.csv: no joint columns, expected q1 to q2 for the robot's 2 joints; the columns are joint1, joint2"),
    ("q01,q02\n0,0\n", "poses.csv: 2 joint columns (q01, q02), expected q1 to q2 for the robot's 2 joints; the columns are q01, q02"),
    ("q1,q2,,\n0,0,0,0\n", 'poses.csv:1: two columns without a name, expected different names'),
    ("#comment\nq1,q2\n0,0\n", "poses.csv: no joint columns, expected q1 to q2 for the robot's 2 joints; the columns are #comment"),
    ("q1,q2\n−0.5,0\n", "poses.csv:2: q1: found '−0.5', expected a finite number; its minus is another character, a dash; write -"),
    ('q1,q2\n"0,5",0\n', "poses.csv:2: q1: found '0,5', expected a finite number; is it a decimal comma? numbers have a decimal point"),
    ("q1,q2\n#0,0\n", "poses.csv:2: q1: found '#0', expected a finite number"),
    (XYZ + "0,0,1,2\n", 'poses.csv:2: 4 cells, expected 5 as in the header'),
    (XYZ + "0,0,1,2,3,4\n", 'poses.csv:2: 6 cells, expected 5 as in the header'),
    (XYZ + '0,0,"1,2,3\n1,1,1,1,1\n', 'poses.csv:2: 3 cells, expected 5 as in the header; a quote joins it with lines below: is one missing?'),
    (XYZ + "0,0,1,2,3\n\n0,0,x,2,3\n", "poses.csv:4: x: found 'x', expected a finite number"),
    (XYZ + "0,0,1.2.3,2,3\n", "poses.csv:2: x: found '1.2.3', expected a finite number"),
    (XYZ + "0,0,1e400,2,3\n", "poses.csv:2: x: found '1e400', expected a finite number"),
    (XYZ + "0,0,1e16,2,3\n", "poses.csv:2: x: found '1e16', expected a number no larger than 1e+15; sigmas and tolerances no less than 1e-30"),
    (XYZ + "0,0,-1e300,2,3\n", "poses.csv:2: x: found '-1e300', expected a number no larger than 1e+15; sigmas and tolerances no less than 1e-30"),
    (XYZ + "0,0,1 mm,2,3\n", "poses.csv:2: x: found '1 mm', expected a finite number"),
    (XYZ + "0,0,--1,2,3\n", "poses.csv:2: x: found '--1', expected a finite number"),
    (XYZ + "0,0,1e,2,3\n", "poses.csv:2: x: found '1e', expected a finite number"),
    (XYZ + "0,0,0x10,2,3\n", "poses.csv:2: x: found '0x10', expected a finite number"),
    (XYZ + "0,0,1_000,2,3\n", "poses.csv:2: x: found '1_000', expected a finite number"),
    (XYZ + "0,0,NULL,2,3\n", "poses.csv:2: x: found 'NULL', expected a finite number"),
    (XYZ + "0,0,N/A,2,3\n", "poses.csv:2: x: found 'N/A', expected a finite number"),
    (XYZ + "0,0,-,2,3\n", "poses.csv:2: x: found '-', expected a finite number"),
    (XYZ + "0,0,True,2,3\n", "poses.csv:2: x: found 'True', expected a finite number"),
    (XYZ + "0,0,١,2,3\n", "poses.csv:2: x: found '١', expected a finite number"),
    (XYZ + "0,0,\x1b[31m1,2,3\n", "poses.csv:2: x: found '\\x1b[31m1', expected a finite number"),
    (XYZ + "0,0,=1+1,2,3\n", "poses.csv:2: x: found '=1+1', expected a finite number"),
    (XYZ + "0,0,"+"9"*400+",2,3\n", "poses.csv:2: x: found '99999999999999999999999999999999999999999999999999999999..., expected a finite number"),
    (XYZ + "0,0,"+"x"*5000+",2,3\n", "poses.csv:2: x: found 'xxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxx..., expected a finite number"),
    (XYZ + "5,0,1,2,3\n", 'poses.csv:2: q1 = 5 rad is outside [-2, 2]; is q1 in deg?'),
    (XYZ + "180,0,1,2,3\n", "poses.csv:2: q1 = 180 rad is outside [-2, 2]; widen the joint's limits if the reading is right"),
    (XYZ + "2.5,0,1,2,3\n", "poses.csv:2: q1 = 2.5 rad is outside [-2, 2]; widen the joint's limits if the reading is right"),
    ("q1,q2,X,y,z\n0,0,a,2,3\n", "poses.csv:2: x: found 'a', expected a finite number"),
    ("q1,q2,qx,qy,qz,qw\n0,0,0,0,0,0\n", 'poses.csv:2: quaternion of norm 0, expected 1 within 0.001'),
    ("q1,q2,qx,qy,qz,qw\n0,0,1,1,1,1\n", 'poses.csv:2: quaternion of norm 2, expected 1 within 0.001'),
    ("q1,q2,qx,qy,qz,qw\n0,0,0,0,0,1e200\n", "poses.csv:2: qw: found '1e200', expected a number no larger than 1e+15; sigmas and tolerances no less than 1e-30"),
    ("q1,q2,qx,qy,qz,qw\n0,0,,,,\n", 'poses.csv:2: qx: found an empty cell, expected a finite number'),
    ("q1,q2,roll,pitch\n0,0,0,0\n", 'poses.csv: no column yaw, expected roll pitch yaw together'),
    ("q1,q2,roll,pitch,yaw\n0,0,0,nan,0\n", "poses.csv:2: pitch: found 'nan', expected a finite number"),
    ("q1,q2,id\n0,0,a\n0,0,a\n", "poses.csv:3: id: found 'a', expected different ids; the same as poses.csv:2"),
    ("q1,q2,id\n0,0,\n", 'poses.csv:2: id: found an empty cell, expected an id'),
    ("q1,q2,split\n0,0,TEST\n", "poses.csv:2: split: found 'TEST', expected train or test"),
    ("q1,q2,split\n0,0,validation\n", "poses.csv:2: split: found 'validation', expected train or test"),
    ("q1,q2,split\n0,0,1\n", "poses.csv:2: split: found '1', expected train or test"),
    ("q1,q2,sigma_position\n0,0,0\n", "poses.csv:2: sigma_position: found '0', expected a number above 0"),
    ("q1,q2,sigma_position\n0,0,1e-40\n", "poses.csv:2: sigma_position: found '1e-40', expected a number no larger than 1e+15; sigmas and tolerances no less than 1e-30"),
    ("q1,q2,sigma_position\n0,0,1e20\n", "poses.csv:2: sigma_position: found '1e20', expected a number no larger than 1e+15; sigmas and tolerances no less than 1e-30"),
    ("q1,q2,sigma_x,sigma_position\n0,0,1,1\n", 'poses.csv: both sigma_position and sigma_x, expected one of the two'),
    ("q1,q2,sigma_rx\n0,0,1\n", 'poses.csv: no column sigma_ry, expected sigma_rx sigma_ry sigma_rz together'),
    ("q1,q2,sigma_orientation\n0,0,abc\n", "poses.csv:2: sigma_orientation: found 'abc', expected a finite number"),
    ("q1,q2,group,sigma_point\n0,0,g,-1\n", "poses.csv:2: sigma_point: found '-1', expected a number above 0"),
    ("q1,q2,group,sigma_point\n0,0,g,\n", 'poses.csv:2: sigma_point: found an empty cell, expected a number above 0'),
    (b"q1,q2\n0,\xff\n", 'poses.csv:2: byte 0xff, expected UTF-8 text; is it Latin-1 or Windows text? save it as UTF-8'),
    (b"\xff\xfeq\x001\x00", 'poses.csv: UTF-16 or UTF-32 text, expected UTF-8 text; save it as UTF-8'),
    ("q1,q2\n0,1\n".encode("utf-16-le"), 'poses.csv:1: a null character, expected UTF-8 text; is it UTF-16, or no text at all? save it as UTF-8'),
    ("q1,q2\n0,1\n".encode("utf-32"), 'poses.csv: UTF-16 or UTF-32 text, expected UTF-8 text; save it as UTF-8'),
    (b"q1,q2\n0,\x000\n", 'poses.csv:2: a null character, expected UTF-8 text; is it UTF-16, or no text at all? save it as UTF-8'),
    (b"PAR1", "poses.csv: no joint columns, expected q1 to q2 for the robot's 2 joints; the columns are PAR1"),
    (" \n", 'poses.csv:1: no names of columns, expected a header and rows'),
    ("{}", "poses.csv: no joint columns, expected q1 to q2 for the robot's 2 joints; the columns are {}"),
    ("<html></html>", "poses.csv: no joint columns, expected q1 to q2 for the robot's 2 joints; the columns are <html></html>"),
    ("q1,q2\r0,a\r", "poses.csv:2: q2: found 'a', expected a finite number"),
    ("q1,q2\r0,a\r1,1\n", "poses.csv:2: q2: found 'a', expected a finite number"),
    ("q1,q2\r\r\n0,0\r\r\n1,a\r\r\n", "poses.csv:3: q2: found 'a', expected a finite number"),
    ('""id","q1","q2"\n""p0","0","0"\n"p1","0","0"\n', "poses.csv:1: a quote that is not closed, expected whole cells in quotes, or none"),
    ('id","q1","q2"\np0,a,0\np1,0,0', "poses.csv:1: a quote that is not closed, expected whole cells in quotes, or none"),
    ("q1,q2,group\n0,0,A\n0,1,NA\n", "poses.csv:3: group: found 'NA', expected the name of a point, or an empty cell"),
    ("q1,q2,group\n0,0,-\n", "poses.csv:2: group: found '-', expected the name of a point, or an empty cell"),
    ("q1,q2,id\n0,0,a\n0,1,nan\n", "poses.csv:3: id: found 'nan', expected an id"),
    ("id,q1,q2\na,0,0\n#b,1,1\n", "poses.csv:3: id: found '#b', expected ids with # all or none; # does not comment a row out"),
    ("# ID,q1,q2\na,0,0\n", "poses.csv: column '# ID', expected id, or another name"),
    ("q1,q1\n0,0\n", "poses.csv:1: two columns called 'q1', expected different names"),
    ("q1,q2,"+",".join(f"c{i}" for i in range(500))+"\n0,0\n", 'poses.csv:2: 2 cells, expected 502 as in the header'),
    ("c1,"+",".join(f"c{i}" for i in range(2,500))+"\n0,0\n", "poses.csv: no joint columns, expected q1 to q2 for the robot's 2 joints; the columns are c1, c2, c3, c4, c5, c6, c7, c8, c9, c10, c11, c12, c13, c14, c15, c16, c17, c18, c19, c20, c21, c22, c23, c24, c25, c26, c27, c28, c29, c30, c31, c32, c33, c34, c35, c36, c37, c38, c39, c40, c41, c42, c43, c44, c45, c46, c47, c48, c49, c50, c51, c52, c53, c54, c55, c56, c57, c58, c59, c60, c61, c62, c63, c64, c65, c66, c67, c68, c69, c70, c71, c72, c73, c74, c75, c76, c77, c78, ..."),
    ("\x1b]0;x\x07,b\n0,0\n", "poses.csv: no joint columns, expected q1 to q2 for the robot's 2 joints; the columns are \\x1b]0;x\\x07, b"),
]

IDS = "q1,q2,id\n0,0,a\n1,0,b\n2,0,c\n"
PAIRS = [
    ("", 'pairs.csv:1: an empty file, expected a header and rows'),
    ("a|b|distance\na|b|1\n", "pairs.csv:1: one column 'a|b|distance', expected columns with , ; or tab between; not '|'"),
    ("b,distance\nb,1\n", 'pairs.csv: no column a, expected a and b, the two configurations of a pair'),
    ("A,B,Distance\na,b,x\n", "pairs.csv:2: distance: found 'x', expected a finite number"),
    ("a,b,distance\na,z,1\n", "pairs.csv:2: b = 'z' is not an id of poses.csv"),
    ("a,b,distance\na,a,1\n", "pairs.csv:2: a and b are both 'a', expected two different configurations"),
    ("a,b,distance\na,,1\n", 'pairs.csv:2: b: found an empty cell, expected a configuration'),
    ("a,b,distance\na,b,-1\n", "pairs.csv:2: distance: found '-1', expected a number not below 0"),
    ("a,b,distance\na,b,nan\n", "pairs.csv:2: distance: found 'nan', expected a finite number"),
    ("a,b,distance\na,b,1e20\n", "pairs.csv:2: distance: found '1e20', expected a number no larger than 1e+15; sigmas and tolerances no less than 1e-30"),
    ("a,b,angle\na,b,4\n", "pairs.csv:2: angle: found '4', expected 0 to 3.14159 rad; is the table in deg?"),
    ("a,b,angle\na,b,180\n", "pairs.csv:2: angle: found '180', expected 0 to 3.14159 rad; is the table in deg?"),
    ("a,b,angle\na,b,-1\n", "pairs.csv:2: angle: found '-1', expected 0 to 3.14159 rad"),
    ("a,b,distance,sigma_distance\na,b,1,0\n", "pairs.csv:2: sigma_distance: found '0', expected a number above 0"),
    ("a,b,distance,sigma_distance\na,b,1,x\n", "pairs.csv:2: sigma_distance: found 'x', expected a finite number"),
    ("a,b,distance,sigma_distance\na,b,1,1e-50\n", "pairs.csv:2: sigma_distance: found '1e-50', expected a number no larger than 1e+15; sigmas and tolerances no less than 1e-30"),
    ("a,b,angle,sigma_angle\na,b,1,-1\n", "pairs.csv:2: sigma_angle: found '-1', expected a number above 0"),
    ("a,b,distance,split\na,b,1,both\n", "pairs.csv:2: split: found 'both', expected train or test"),
    ("a,b,distance\na,b\n", 'pairs.csv:2: 2 cells, expected 3 as in the header'),
    ("a,b,distance\na,b,1,2\n", 'pairs.csv:2: 4 cells, expected 3 as in the header'),
    ("a,a,distance\na,b,1\n", "pairs.csv:1: two columns called 'a', expected different names"),
    ('a,b,distance\na,b,"1\n', 'pairs.csv:2: a quote that is not closed, expected whole cells in quotes, or none'),
    ('a,b,distance\n0,1,1\n', "pairs.csv:2: a = '0' is not an id of poses.csv"),
    ("a,b,distance\n\x1b[31m,b,1\n", "pairs.csv:2: a = '\\x1b[31m' is not an id of poses.csv"),
    ("a,b,distance\n"+"x"*300+",b,1\n", "pairs.csv:2: a = 'xxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxx... is not an id of poses.csv"),
]

GROUPS = "q1,q2,id,group\n0,0,a,g\n1,0,b,g\n1,1,c,h\n0,1,d,\n"
GROUP_PAIRS = [
    ("a,b,distance\ng,a,1\n", 'pairs.csv:2: a is a group and b a configuration, expected two configurations or two groups'),
    ("a,b,distance\na,g,1\n", 'pairs.csv:2: b is a group and a a configuration, expected two configurations or two groups'),
    ("a,b,distance\ng,g,1\n", "pairs.csv:2: a and b are both 'g', expected two different groups"),
    ("a,b,distance\ng,h,0\n", "pairs.csv:2: distance: found '0', expected a number above 0 between two groups; one point is one group"),
    ("a,b,angle\ng,h,1\n", "pairs.csv:2: angle: found '1', expected an empty cell: two points have a distance, but no angle"),
    ("a,b,distance\ng,k,1\n", "pairs.csv:2: b = 'k' is not an id or a group of poses.csv"),
    ("a,b,distance\ng,h,\n", 'pairs.csv:2: distance: found an empty cell, expected a number above 0 between two groups; one point is one group'),
]

ok = {"q1": [0.0, 1.0], "q2": [0.0, 0.0]}
FRAMES = [
    (None, 'frame: found a NoneType, expected a path, or a frame of polars or pandas'),
    (5, 'frame: found a int, expected a path, or a frame of polars or pandas'),
    ("", "frame: found '', expected a path, or a frame of polars or pandas"),
    ([1,2], 'frame: found a list, expected a path, or a frame of polars or pandas'),
    (np.zeros((2,2)), 'frame: found a ndarray, expected a path, or a frame of polars or pandas'),
    ({}, 'frame: a frame without columns, expected a frame with rows'),
    ({"q1":[0.0]}, "frame: 1 joint columns (q1), expected q1 to q2 for the robot's 2 joints; the columns are q1"),
    ({**ok,"x":[1,2]}, 'frame: no column y, expected x y z together'),
    ({**ok,"q1":["a","b"]}, "frame: row 0: q1: found 'a', expected a finite number"),
    ({**ok,"q1":[None,0.0]}, 'frame: row 0: q1: found an empty cell, expected a finite number'),
    ({**ok,"q1":[True,False]}, 'frame: q1: type Boolean, expected numbers'),
    ({**ok,"q1":[[1],[2]]}, 'frame: q1: type List(Int64), expected numbers'),
    ({**ok,"q1":[math.inf,0]}, 'frame: row 0: q1: found inf, expected a finite number'),
    ({**ok,"q1":[1j,0]}, 'frame: q1: type Object, expected numbers'),
    ({**ok,"q1":[datetime.date(2024,1,1)]*2}, 'frame: q1: type Date, expected numbers'),
    ({**ok,"q1":[b"x",b"y"]}, 'frame: q1: type Binary, expected numbers'),
    ({**ok,"q1":[10**400,1]}, "frame: row 0: q1: found '10000000000000000000000000000000000000000000000000000000..., expected a finite number"),
    ({**ok,"q1":5}, 'frame: row 0: q1 = 5 rad is outside [-2, 2]; is q1 in deg?'),
    ({**ok,"q1":"ab"}, "frame: row 0: q1: found 'ab', expected a finite number"),
    ({1:[0.0],2:[0.0]}, "frame: no joint columns, expected q1 to q2 for the robot's 2 joints; the columns are 1, 2"),
    ({" q1":[0.0],"q1":[0.0],"q2":[0.0]}, "frame: two columns called 'q1', expected different names"),
    (pl.DataFrame({"q1":[],"q2":[]}), 'frame: no rows, expected at least one'),
    ({**ok,"id":["a","a"]}, "frame: row 1: id: found 'a', expected different ids; the same as frame: row 0"),
    ({**ok,"id":[[1],[2]]}, 'frame: id: type List(Int64), expected text'),
    ({**ok,"split":["x","y"]}, "frame: row 0: split: found 'x', expected train or test"),
    ({**ok,"split":[True,False]}, 'frame: row 0: split: found True, expected train or test'),
    ({"*":[0.0],"^q.*$":[1.0]}, "frame: no joint columns, expected q1 to q2 for the robot's 2 joints; the columns are *, ^q.*$"),
    (pl.DataFrame({**ok,"q1":[3.0,0.0]}), "frame: row 0: q1 = 3 rad is outside [-2, 2]; widen the joint's limits if the reading is right"),
    ({**ok,"split":[{"a":1},{"a":2}]}, "frame: split: type Struct({'a': Int64}), expected text"),
]

RESULTS = [
    ("", '{folder}/result.json: not JSON: Expecting value: line 1 column 1 (char 0); was it cut off?'),
    ("{", '{folder}/result.json: not JSON: Expecting property name enclosed in double quotes: line 1 column 2 (char 1); was it cut off?'),
    ("[]", '{folder}/result.json: no result of a calibration, expected a result.json of schema fg-calib/result/2'),
    ("null", '{folder}/result.json: no result of a calibration, expected a result.json of schema fg-calib/result/2'),
    ('{"schema": 5}', '{folder}/result.json: no result of a calibration, expected a result.json of schema fg-calib/result/2'),
    ('{"schema": "fg-calib/result/9"}', "{folder}/result.json: schema: found 'fg-calib/result/9', expected one of fg-calib/result/1, fg-calib/result/2 (and 19 more); did you mean fg-calib/result/2?"),
    ('{"schema": "fg-calib/result/2"}', "{folder}/result.json: missing keys 'version', 'robot', 'model', 'frame', 'pairing', 'n_configurations', 'n_pairs', 'n_residuals', 'n_excluded', 'solver', 'chi2', 'dof', 'reduced_chi2', 'residual_rms', 'parameters', 'covariance', 'frame_estimate', 'observability', 'inputs'"),
    ('{"schema": "fg-calib/observability/1"}', '{folder}/result.json: no result of a calibration, expected a result.json of schema fg-calib/result/2'),
    ("["*100000, '{folder}/result.json: nested too deeply, expected a result.json'),
    ('{"a": 1e999}', '{folder}/result.json: no result of a calibration, expected a result.json of schema fg-calib/result/2'),
    ("\x00", 'result.json:1: a null character, expected UTF-8 text; is it UTF-16, or no text at all? save it as UTF-8'),
    (b"\xff\xfe{", 'result.json: UTF-16 or UTF-32 text, expected UTF-8 text; save it as UTF-8'),
    (b'{"a": "\xff"}', 'result.json:1: byte 0xff, expected UTF-8 text; is it Latin-1 or Windows text? save it as UTF-8'),
    ("NaN", '{folder}/result.json: no result of a calibration, expected a result.json of schema fg-calib/result/2'),
    ("{'a': 1}", '{folder}/result.json: not JSON: Expecting property name enclosed in double quotes: line 1 column 2 (char 1); was it cut off?'),
    ('{"schema": "fg-calib/result/2",}', '{folder}/result.json: not JSON: ...'),
    (lambda d: d.pop("dof"), "{folder}/result.json: missing key 'dof'"),
    (lambda d: d.update(dof="many"), "{folder}/result.json: dof: found 'many', expected a whole number"),
    (lambda d: d.update(dof=1.5), '{folder}/result.json: dof: found 1.5, expected a whole number'),
    (lambda d: d.update(dof=None), '{folder}/result.json: dof: found nothing, expected a whole number'),
    (lambda d: d.update(dof=10**400), '{folder}/result.json: dof: found 100000000000000000000000000000000000000000000000...000000..., expected a number not above 1e+15'),
    (lambda d: d.update(n_configurations=-4), '{folder}/result.json: n_configurations: found -4, expected a number not below 0'),
    (lambda d: d["parameters"][0].update(identifiability="maybe"), "{folder}/result.json: parameter 1: identifiability: found 'maybe', expected one of independent, relative, ineffective, fixed"),
    ('{"schema": "fg-calib/result/2", "chi2": 1, "chi2": 2}', '{folder}/result.json: chi2: the key is there twice, expected once'),
    (lambda d: d.update(chi2="x"), "{folder}/result.json: chi2: found 'x', expected a finite number"),
    (lambda d: d.update(chi2=10**400), '{folder}/result.json: chi2: found 100000000000000000000000000000000000000000000000...000000..., expected a finite number'),
    (lambda d: d.update(robot=5), '{folder}/result.json: robot: found 5, expected text'),
    (lambda d: d.update(parameters={}), '{folder}/result.json: parameters: found {}, expected a list'),
    (lambda d: d["parameters"][0].pop("name"), "{folder}/result.json: parameter 1: missing key 'name'"),
    (lambda d: d["parameters"][0].update(sigma=-1), '{folder}/result.json: parameter 1: sigma: found -1, expected a number not below 0'),
    (lambda d: d["parameters"][0].update(estimate="\x1b[31m"), "{folder}/result.json: parameter 1: estimate: found '\\x1b[31m', expected a finite number"),
    (lambda d: d["parameters"].append(5), '{folder}/result.json: parameter 17: found 5, expected a mapping'),
    (lambda d: d["covariance"].update(matrix=5), '{folder}/result.json: covariance: matrix: found 5, expected a list'),
    (lambda d: d["covariance"]["names"].pop(), '{folder}/result.json: covariance: another size than its names, expected 3 rows of 3; was the file changed?'),
    (lambda d: d["covariance"].update(matrix=[]), '{folder}/result.json: covariance: another size than its names, expected 4 rows of 4; was the file changed?'),
    (lambda d: d.update(solver=None), '{folder}/result.json: solver: found nothing, expected a mapping'),
    (lambda d: d["solver"].update(converged="maybe"), "{folder}/result.json: solver: converged: found 'maybe', expected true or false"),
    (lambda d: d.update(inputs=[]), '{folder}/result.json: inputs: found [], expected a mapping'),
    (lambda d: d.update(inputs={"a":1}), '{folder}/result.json: inputs: a: found 1, expected text'),
    (lambda d: d["frames"].update({"Y(0)": d["frames"]["X(0)"]}), "{folder}/result.json: frames: Y(0): found 'Y(0)', expected a name of the pattern ^X\\(\\d{1,4}\\)$"),
    (lambda d: d["frames"].update({"\x1b": d["frames"]["X(0)"]}), "{folder}/result.json: frames: \\x1b: found '\\x1b', expected a name of the pattern ^X\\(\\d{1,4}\\)$"),
    (lambda d: d["frame_estimate"].update(quaternion_xyzw=[0,0,0,0]), '{folder}/result.json: frame_estimate: quaternion_xyzw: found [0, 0, 0, 0], expected x y z w of length 1'),
    (lambda d: d["frame_estimate"].update(quaternion_xyzw=[0,0,1]), '{folder}/result.json: frame_estimate: quaternion_xyzw: found [0, 0, 1], expected more than 3 in the list'),
    (lambda d: d["frame_estimate"].update(quaternion_xyzw=[0,0,1,0,0]), '{folder}/result.json: frame_estimate: quaternion_xyzw: found [0, 0, 1, 0, 0], expected at most 4 in the list'),
    (lambda d: d["frame_estimate"].update(xyz=[1,2,"x"]), "{folder}/result.json: frame_estimate: xyz 3: found 'x', expected a finite number"),
    (lambda d: d["frame_estimate"].update(sigma=[-1]*6), '{folder}/result.json: frame_estimate: sigma 1: found -1, expected a number not below 0 (and 5 more)'),
    (lambda d: d["posterior"].update(covariance=[[1,2],[3,4]]), '{folder}/result.json: posterior: covariance: found [[1, 2], [3, 4]], expected a symmetric matrix of variances and covariances of errors'),
    (lambda d: d["observability"]["lost"].append({"relation": {}, "reason": "none"}), "{folder}/result.json: observability: lost ..."),
    (lambda d: d["observability"].pop("rank"), "{folder}/result.json: observability: missing key 'rank'"),
    (lambda d: d.update(residual_rms=5), '{folder}/result.json: residual_rms: found 5, expected a mapping'),
    (lambda d: d.update(n_excluded={"a":"b"}), "{folder}/result.json: n_excluded: a: found 'b', expected a whole number"),
    (lambda d: d.update(links=["a"]), "{folder}/result.json: links: found ['a'], expected more than 1 in the list"),
    (lambda d: d.update(findings="x"), "{folder}/result.json: findings: found 'x', expected a list"),
]
COMMANDS = [
    ('calibrate nowhere.yaml', 'nowhere.yaml: no such file'),
    ('calibrate robot.yaml', "robot.yaml: unknown key 'convention', expected one of robot, measurements, pairs, model, pairing, frame, units, noise, prior, gauge, prefer, pair_errors, encoder, loss, max_iterations, accept, folds, truth, targets, anchors, tolerance, offset, camera, columns"),
    ("calibrate flat.csv", "flat.csv: found 'q1,q2,x,y,z 0,0,0,0,0 1,2,1000,0,0', expected a mapping, key: value"),
    ('compare nowhere.yaml', 'nowhere.yaml: no such file'),
    ('compare robot.yaml', "robot.yaml: unknown key 'convention', expected one of robot, measurements, pairs, model, pairing, frame, units, noise, prior, gauge, prefer, pair_errors, encoder, loss, max_iterations, accept, folds, truth, targets, anchors, tolerance, offset, camera, columns"),
    ('observe nowhere.urdf', 'nowhere.urdf: no such file'),
    ('observe pairs.csv', "pairs.csv: found 'a,b,distance,angle 0,1,2000,90', expected a mapping, key: value"),
    ('observe robot.yaml --prefer a9', "robot: no parameter 'a9', expected one of base.x, base.y, base.z, base.yaw, base.pitch, base.roll, a1, alpha1, d1, theta1, a2, alpha2, ..."),
    ('observe robot.yaml --tip-link b', 'robot.yaml: a robot without links, expected a URDF; base_link and tip_link name links of one'),
    ('observe robot.yaml --configurations nowhere.csv', 'nowhere.csv: no such file'),
    ('observe robot.yaml --configurations pairs.csv', "pairs.csv: no joint columns, expected q1 to q2 for the robot's 2 joints; the columns are a, b, distance, angle"),
    ('observe robot.yaml --configurations flat.csv --position-noise -1', '--position-noise: found -1.0, expected a finite number above 0'),
    ('observe robot.yaml --configurations flat.csv --position-noise 0', '--position-noise: found 0.0, expected a finite number above 0'),
    ('observe robot.yaml --configurations flat.csv --joint-noise -1', '--joint-noise: found -1.0, expected a finite number not below 0'),
    ('observe robot.yaml --configurations flat.csv --position-noise nan', '--position-noise: found nan, expected a finite number above 0'),
    ('observe robot.yaml --configurations flat.csv --position-noise 1e300', '--position-noise: found 1e+300, expected a number no larger than 1e+15; sigmas and tolerances no less than 1e-30'),
    ('observe robot.yaml --configurations tested.csv', 'tested.csv: test rows alone, expected train rows: test rows are never fitted'),
    ('observe robot.yaml --seed -1', 'seed: found -1, expected a whole number not below 0'),
    ('simulate nowhere --out out', "scenario: found 'nowhere', expected a file, or one of space-robot"),
    ('simulate nowhere.yaml --out out', 'nowhere.yaml: no such file'),
    ('simulate robot.yaml --out out', "robot.yaml: unknown key 'convention', expected one of name, robot, units, errors, configurations, noise, frame, validation, job, instruments"),
    ('example nowhere --out out', "example: found 'nowhere', expected one of space-robot"),
    ('observe escape.yaml', "escape.yaml: unknown key '\\x1b[31m', expected one of name, units, base, tool, fixed, estimate, tolerance, convention, joints"),
    ('observe robot.yaml --configurations escape.csv', "escape.csv:2: q2: found '\\x1b[2J\\x07', expected a finite number"),
]
# fmt: on

ARM = Robot.from_dh([[0.5, 0.1, 0.2, 0.0], [0.4, 0.2, 0.1, 0.0]], convention="dh", limits=[[-2.0, 2.0], None])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with files that others name."""
    folder = tmp_path_factory.mktemp("malformed")
    for name, text in {
        "robot.yaml": TWO_JOINTS,
        "other.yaml": ONE_JOINT,
        "poses.csv": "q1,q2,x,y,z\n0,0,0,0,0\n10,20,1000,0,0\n",
        "pairs.csv": "a,b,distance,angle\n0,1,2000,90\n",
        "ids.csv": IDS,
        "groups.csv": GROUPS,
        "flat.csv": "q1,q2,x,y,z\n0,0,0,0,0\n1,2,1000,0,0\n",
        "tested.csv": "q1,q2,split\n0,0,test\n1,1,test\n",
        "escape.yaml": '"\\e[31m": 1\n',
        "escape.csv": "q1,q2\n0,\x1b[2J\x07\n",
    }.items():
        (folder / name).write_text(text)
    return folder


def cases(table):
    """Parameters of a table, named by their rows."""
    return pytest.mark.parametrize(("given", "message"), table, ids=range(len(table)))


def refuses(folder, name, given, read, message):
    """Whether a reader says this of a file; `{folder}` stands for the folder, ` ...` for what other libraries add."""
    file = folder / name
    file.write_bytes(given if isinstance(given, bytes) else given.encode())
    with pytest.raises(InputError) as caught:
        read(file)
    said, (start, others, _) = str(caught.value).replace(str(folder), "{folder}"), message.partition(" ...")
    assert said.startswith(start) if others else said == message
    assert said.isprintable()


@cases(ROBOTS)
def test_robots(folder, given, message):
    refuses(folder, "damaged.yaml", given, read_robot, message.replace("robot.yaml", "damaged.yaml"))


@cases(URDFS)
def test_urdfs(folder, given, message):
    refuses(folder, "arm.urdf", given, read_robot, message)


@pytest.mark.sampled(44)
@cases(JOBS)
def test_jobs(folder, given, message):
    refuses(folder, "job.yaml", given, read_job, message)


@pytest.mark.sampled(48)
@cases(SCENARIOS)
def test_scenarios(folder, given, message):
    refuses(folder, "scenario.yaml", given, read_scenario, message)


@pytest.mark.sampled(26)
@cases(POSES)
def test_poses(tmp_path, given, message):
    refuses(tmp_path, "poses.csv", given, lambda file: read_measurements(file, ARM), message)


@cases(FRAMES)
def test_frames(given, message):
    with pytest.raises(InputError) as caught:
        read_measurements(given, ARM)
    assert str(caught.value) == message


@pytest.mark.sampled(13)
@cases(PAIRS)
def test_pairs(folder, given, message):
    read = lambda file: read_measurements(folder / "ids.csv", ARM, pairs=file)  # noqa: E731
    refuses(folder, "damaged.csv", given, read, message.replace("pairs.csv", "damaged.csv").replace("poses", "ids"))


@cases(GROUP_PAIRS)
def test_pairs_of_groups(folder, given, message):
    read = lambda file: read_measurements(folder / "groups.csv", ARM, pairs=file)  # noqa: E731
    refuses(folder, "damaged.csv", given, read, message.replace("pairs.csv", "damaged.csv").replace("poses", "groups"))


@pytest.fixture(scope="module")
def document():
    """A result, to be damaged."""
    return result_document()


@cases(RESULTS)
def test_results(tmp_path, document, given, message):
    if callable(given):
        damaged = copy.deepcopy(document)
        given(damaged)
        given = json.dumps(damaged)
    refuses(tmp_path, "result.json", given, read_result, message)


@pytest.mark.sampled(4)
@cases(COMMANDS)
def test_commands(folder, fg_calib, monkeypatch, given, message):
    """Exit code 1 and one line on stderr, nothing on stdout, no folder made."""
    monkeypatch.chdir(folder)
    before = sorted(folder.iterdir())
    ended = fg_calib(*given.split())
    assert (ended.code, ended.out, ended.err) == (1, "", f"error: {message}\n")
    assert sorted(folder.iterdir()) == before


def test_a_quote_within_a_cell(folder):
    """Newer versions of polars read no cell there, older ones a cell that is no number: both are told of."""
    (folder / "poses.csv").write_text(XYZ + '0,0,1"2,3,4\n')
    with pytest.raises(InputError) as caught:
        read_measurements(folder / "poses.csv", read_robot(folder / "robot.yaml"))
    assert str(caught.value) in (
        "poses.csv:2: a quote that is not closed, expected whole cells in quotes, or none",
        "poses.csv:2: x: found '1\"2', expected a finite number",
    )
