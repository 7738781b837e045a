"""The reference says what the readers know: no key of theirs is missing in it, and none stands there alone."""

from pathlib import Path

import pytest

from fg_calib import InputError, read_job
from fg_calib.io import job
from fg_calib.io import robot_file as robot_yaml
from fg_calib.io.pairs import PAIR_COLUMNS
from fg_calib.io.reference import SECTIONS, TABLE_COLUMNS, keys_of, kind_of
from fg_calib.io.tables import KNOWN
from fg_calib.io.yaml import Schema
from fg_calib.report.guide import TOPICS
from fg_calib.report.reference import reference_markdown

DOCS = Path(__file__).resolve().parents[2] / "docs"
EVERY_SECTION = [(topic, section) for topic, sections in SECTIONS.items() for section in sections]


@pytest.mark.parametrize("topic", [*SECTIONS, "tables"])
def test_the_reference_in_docs_is_what_the_command_writes(topic, fg_calib):
    ended = fg_calib("help", topic, "--markdown")
    assert (ended.code, ended.err) == (0, "")
    assert ended.out == (DOCS / f"{topic}.md").read_text() == reference_markdown(topic)


@pytest.mark.parametrize("module", [job, robot_yaml])
def test_every_key_of_every_mapping_that_a_reader_knows_is_in_the_reference(module):
    """Also those of mappings that are not in `SECTIONS`, such as the two forms of `noise: {joint: ...}`."""
    schemas = [v for v in vars(module).values() if isinstance(v, type) and issubclass(v, Schema) and v is not Schema]
    known = {name for schema in schemas for name in schema.model_fields}
    told = {key.name for sections in SECTIONS.values() for one in sections for key in keys_of(one)}
    assert known <= told


@pytest.mark.parametrize(("topic", "section"), EVERY_SECTION, ids=[f"{t} {s.title}" for t, s in EVERY_SECTION])
def test_every_key_says_what_it_may_be_and_what_it_means(topic, section):
    for key in keys_of(section):
        assert key.kind, key.name
        assert key.meaning, key.name
        assert not key.meaning.endswith(".")


GOOD = "robot: robot.yaml, measurements: p.csv, model: pose"
AT = {
    "": f"{{{GOOD}, nonsense: 1}}",
    "measurements: each entry of a list": "{robot: robot.yaml, measurements: [{nonsense: 1}]}",
    "units": f"{{{GOOD}, units: {{nonsense: 1}}}}",
    "noise": f"{{{GOOD}, noise: {{nonsense: 1}}}}",
    "pairing": f"{{{GOOD}, pairing: {{nonsense: 1}}}}",
    "accept": f"{{{GOOD}, accept: {{nonsense: 1}}}}",
    "targets, anchors: each point": f"{{{GOOD}, targets: {{t: {{nonsense: 1}}}}}}",
    "tolerance": f"{{{GOOD}, tolerance: {{nonsense: 1}}}}",
    "columns: each column": f"{{{GOOD}, columns: {{x: {{nonsense: 1}}}}}}",
}
"""Of each mapping of a job, but for the camera's (which may hold a camera's figures), one with a key that is none."""


@pytest.mark.parametrize("section", [s for s in job.SECTIONS if s.title != "camera"], ids=lambda s: s.title)
def test_the_keys_in_the_reference_are_those_that_the_reader_of_a_job_expects(tmp_path, section):
    (tmp_path / "robot.yaml").write_text("convention: dh\njoints: [{a: 1, alpha: 0, d: 0, theta: 0}]\n")
    (tmp_path / "p.csv").write_text("q1,x,y,z,qx,qy,qz,qw\n0,1,0,0,0,0,0,1\n")
    (tmp_path / "job.yaml").write_text(AT[section.title])
    with pytest.raises(InputError, match="unknown key 'nonsense'") as raised:
        read_job(tmp_path / "job.yaml")
    names = [key.name for key in keys_of(section)]
    assert raised.value.expected.split(" (and")[0] == f"one of {', '.join(names)}"


def test_the_columns_in_the_reference_are_those_that_the_readers_know():
    by_table = {title: {n for c in columns for n in c.names} for title, columns in TABLE_COLUMNS}
    assert by_table.pop("a table of pairs") == set(PAIR_COLUMNS)
    assert set().union(*by_table.values()) - {"q1 ... qn"} == KNOWN


def test_a_kind_is_told_by_its_type():
    assert kind_of(int | None) == ""
    job_keys = {key.name: key for key in keys_of(job.SECTIONS[0])}
    assert job_keys["loss"].kind == "none | huber | cauchy | geman-mcclure | gnc"
    assert (job_keys["pairs"].kind, job_keys["model"].default, job_keys["loss"].default) == ("path", "required", "none")
    assert job_keys["units"].default == "{length: m, angle: rad}"


def test_help_without_a_topic_lists_the_topics(fg_calib):
    ended = fg_calib("help")
    assert ended.code == 0
    *topics, last = ended.out.splitlines()
    assert [line.split()[2] for line in topics] == list(TOPICS)
    assert last == "fg-calib COMMAND --help says what a command does"


@pytest.mark.slow
def test_help_of_a_topic_has_every_key_and_fits_a_terminal(fg_calib, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    for topic in ("job", "robot", "tables"):
        lines = fg_calib("help", topic).out.splitlines()
        assert max(map(len, lines)) <= 80
    text = fg_calib("help", "job").out
    assert "\nloss: none | huber | cauchy | geman-mcclure | gnc (default none)\n" in text.replace(" \n", "\n")


def test_help_of_nothing_known_is_wrong_usage(fg_calib):
    ended = fg_calib("help", "jobs")
    assert (ended.code, ended.out, ended.err.count("\n")) == (2, "", 1)
    assert ended.err.startswith("error: TOPIC: found 'jobs', expected one of tutorial, files, job, robot, tables, ")
    assert ended.err.endswith("; did you mean job?\n")
    assert "\x1b" not in fg_calib("help", "\x1b[31m").err
