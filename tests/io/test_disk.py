"""Folders that are filled: all files or none, whatever interrupts, and the next one makes it good."""

import json
import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from fg_calib import Calibration, InputError, calibrate_job
from fg_calib.io import disk
from fg_calib.io.disk import (
    Filling,
    exists,
    fill_folder,
    fill_folders,
    read_bytes,
    require_writable,
    write_text,
)

FILES = ("one", "two", "three")
OWN = dict.fromkeys((*FILES, "four"), b"")


def write(text, names=FILES):
    def fill(into):
        for name in names:
            (into / name).write_text(text)

    return fill


def content(folder):
    """What visible files hold, and how many hidden ones there are."""
    files = [file for file in folder.iterdir() if not file.name.startswith(".")]
    return {file.name: file.read_text() for file in files}, len([*folder.iterdir()]) - len(files)


def killed_at(folder, moment, text):
    """Fill a folder in a process that is killed at its n-th call of the functions by which files appear."""
    code = f"""
import os, signal
from pathlib import Path
from fg_calib.io.disk import fill_folder
left = {moment}
def counted(original):
    def call(*a, **k):
        global left
        left -= 1
        if left < 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return original(*a, **k)
    return call
for name in ("rename", "replace", "rmdir", "mkdir", "unlink", "listdir"):
    setattr(os, name, counted(getattr(os, name)))
def write(into):
    for name in {FILES!r}:
        (into / name).write_text({text!r})
fill_folder(Path({str(folder)!r}), write, {OWN!r})
"""
    return subprocess.run([sys.executable, "-c", code], check=False).returncode


def read(folder):
    """What a reader finds, who moves nothing."""
    before = sorted(folder.rglob("*"))
    found = {name: read_bytes(folder / name).decode() for name in OWN if exists(folder / name)}
    assert sorted(folder.rglob("*")) == before
    return found


@pytest.mark.sampled(7)
@pytest.mark.parametrize("moment", range(20))
def test_a_kill_at_any_moment_leaves_the_old_or_the_new_for_the_next_reader(tmp_path, moment):
    old, new = dict.fromkeys(("two", "four", "one"), "old"), dict.fromkeys(FILES, "new")
    fill_folder(tmp_path, write("old", old), OWN)
    ended = killed_at(tmp_path, moment, "new")
    assert ended in (0, -signal.SIGKILL)
    found = read(tmp_path)
    assert found in (old, new)
    if ended == 0:
        assert found == new
    require_writable(tmp_path)  # and what a killed process left is made good and cleared away
    assert content(tmp_path) == (found, 0)
    fill_folder(tmp_path, write("newer"), OWN)
    assert content(tmp_path) == (dict.fromkeys(FILES, "newer"), 0)


def test_some_moment_is_a_kill_and_some_is_not(tmp_path):
    """That the test above looks at both."""
    assert killed_at(tmp_path, 0, "new") == -signal.SIGKILL
    assert killed_at(tmp_path, 10_000, "new") == 0


def test_many_writers_at_once_leave_the_files_of_one(tmp_path):
    folder = tmp_path / "new"
    sets = (FILES, ("one", "four"))
    with ThreadPoolExecutor(8) as pool:
        [*pool.map(lambda k: fill_folder(folder, write(str(k), sets[k % 2]), OWN), range(40))]
    found, hidden = content(folder)
    assert len(set(found.values())) == 1
    assert sorted(found) == sorted(sets[int(found["one"]) % 2])
    assert hidden == 0


def test_a_writer_that_was_held_up_removes_nothing_of_the_next(tmp_path, monkeypatch):
    """It wants to remove what the writer that overtook it has written."""
    replace, overtaken = os.replace, []

    def held_up(source, target, **folders):
        if Path(source).name == "four" and not overtaken:
            overtaken.append(True)
            fill_folder(tmp_path, write("next", ("four",)), OWN)
        return replace(source, target, **folders)

    monkeypatch.setattr(os, "replace", held_up)
    fill_folder(tmp_path, write("first"), OWN)
    assert content(tmp_path) == ({"four": "next"}, 0)
    assert overtaken


def test_a_failure_leaves_nothing_and_no_folder(tmp_path):
    def fail(into):
        (into / "one").write_text("new")
        raise OSError(28, "No space left on device")

    with pytest.raises(InputError, match="cannot be written: No space left on device"):
        fill_folder(tmp_path / "a" / "b", fail)
    assert [*tmp_path.iterdir()] == []


def test_of_several_folders_all_are_filled_or_none(tmp_path):
    """What the last cannot write, and what is in its way, leave nothing in the first."""

    def fail(into):
        raise OSError(28, "No space left on device")

    first = Filling(tmp_path, write("new"), OWN)
    with pytest.raises(InputError, match="cannot be written: No space left on device"):
        fill_folders([first, Filling(tmp_path / "a" / "b", fail, OWN)])
    assert [*tmp_path.iterdir()] == []
    (tmp_path / "a" / "two").mkdir(parents=True)
    with pytest.raises(InputError, match="two: is no file, expected a place for a file"):
        fill_folders([first, Filling(tmp_path / "a", write("new"), OWN)])
    assert [*tmp_path.iterdir()] == [tmp_path / "a"]
    (tmp_path / "a" / "two").rmdir()
    fill_folders([first, Filling(tmp_path / "a", write("new"), OWN)])
    assert [(folder / "one").read_text() for folder in (tmp_path, tmp_path / "a")] == ["new", "new"]


def test_a_folder_in_the_way_is_named_before_anything_is_replaced(tmp_path):
    fill_folder(tmp_path, write("old"))
    (tmp_path / "two").unlink()
    (tmp_path / "two").mkdir()
    with pytest.raises(InputError, match="two: is a folder, expected a place for a file"):
        fill_folder(tmp_path, write("new"))
    assert (tmp_path / "one").read_text() == "old"


def test_asking_whether_a_folder_can_be_written_leaves_no_trace(tmp_path):
    require_writable(tmp_path / "a" / "b")
    assert [*tmp_path.iterdir()] == []
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file: cannot be written: File exists, expected a folder that can be"):
        require_writable(tmp_path / "file")


def test_a_folder_that_another_writer_only_asked_about_is_made_again(tmp_path, monkeypatch):
    """The other made it, and removes it as it was, before anything of ours is in it."""
    out, times, made = tmp_path / "out", 3, disk.mkdtemp

    def after_the_other(prefix, dir):
        nonlocal times
        if times:
            times -= 1
            out.rmdir()
        return made(prefix=prefix, dir=dir)

    monkeypatch.setattr(disk, "mkdtemp", after_the_other)
    fill_folder(out, write("new"), OWN)
    assert times == 0
    assert content(out) == (dict.fromkeys(FILES, "new"), 0)


def test_a_folder_that_is_always_gone_is_said(tmp_path, monkeypatch):
    out, made = tmp_path / "out", disk.mkdtemp

    def after_the_other(prefix, dir):
        out.rmdir()
        return made(prefix=prefix, dir=dir)

    monkeypatch.setattr(disk, "mkdtemp", after_the_other)
    with pytest.raises(InputError, match="out: cannot be written: No such file or directory"):
        fill_folder(out, write("new"), OWN)
    assert list(tmp_path.iterdir()) == []


def test_what_another_machine_is_writing_is_left_alone(tmp_path):
    others = tmp_path / ".fg-calib-writing-another-machine-1-x"
    others.mkdir()
    fill_folder(tmp_path, write("new"))
    assert others.is_dir()


@pytest.mark.slow
def test_a_result_that_was_written_but_not_moved_is_read(example):
    calibration = calibrate_job(example / "calibration.yaml")
    folder = example / "result"
    calibration.save(folder)
    within = folder / disk._WRITTEN
    within.mkdir()
    for file in [*folder.iterdir()]:
        if file.is_file():
            file.rename(within / file.name)
            (folder / file.name).write_text("of an earlier time")
    assert Calibration.load(folder).parameters == calibration.parameters
    assert within.exists()  # nothing is moved to be read
    calibration.save(folder)
    assert not within.exists()


@pytest.mark.slow
def test_a_job_that_was_written_but_not_moved_is_read_whole(example, fg_calib, tmp_path):
    for seed in (1, 3):
        assert fg_calib("simulate", "space-robot", "--out", tmp_path / str(seed), "--seed", seed).code == 0
    expected = fg_calib("calibrate", tmp_path / "3" / "calibration.yaml", "--json").out
    within = tmp_path / "1" / disk._WRITTEN
    (tmp_path / "3").rename(within)
    (within / "robot_nominal.yaml").rename(tmp_path / "1" / "robot_nominal.yaml")
    found = fg_calib("calibrate", tmp_path / "1" / "calibration.yaml", "--json").out
    assert json.loads(found)["parameters"] == json.loads(expected)["parameters"]


@pytest.mark.parametrize("link", ["folder", "nothing", "a file"])
def test_what_only_has_the_name_of_files_not_yet_moved_is_left_alone(tmp_path, link):
    others, folder = tmp_path / "others", tmp_path / "folder"
    fill_folder(others, write("of a victim"))
    fill_folder(folder, write("old"))
    within = folder / disk._WRITTEN
    if link == "a file":
        within.write_text("")
    else:
        within.symlink_to(others if link == "folder" else "nowhere")
    assert read_bytes(folder / "one") == b"old"
    with pytest.raises(
        InputError, match=r"\.fg-calib-written: is no folder of written files, expected none; remove it$"
    ):
        fill_folder(folder, write("new"))
    assert content(others) == (dict.fromkeys(FILES, "of a victim"), 0)


@pytest.mark.parametrize("check", [disk.require_own, disk.require_absent])
def test_a_link_to_nothing_is_not_replaced(tmp_path, check):
    """It is somebody's, wherever it is to lead one day."""
    (tmp_path / "report.html").symlink_to(tmp_path / "elsewhere" / "report.html")
    with pytest.raises(InputError, match=r"report.html: is (a link to nothing|there already)"):
        check(tmp_path, {"report.html": b"<!DOCTYPE"})
    with pytest.raises(InputError, match="is a link to nothing"):
        disk.fill_folder(tmp_path, lambda into: disk.write_text(into / "report.html", "new"), {"report.html": b"<!"})
    assert (tmp_path / "report.html").is_symlink()
    assert not (tmp_path / "elsewhere").exists()


def test_links_among_files_not_yet_moved_are_refused(tmp_path):
    (tmp_path / disk._WRITTEN).mkdir()
    (tmp_path / disk._WRITTEN / "one").symlink_to("/etc/hostname")
    with pytest.raises(InputError, match=r"\.fg-calib-written/one: is no file, expected files alone; remove it$"):
        fill_folder(tmp_path, write("new"))


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
def test_files_of_another_user_that_are_not_yet_moved_are_neither_read_nor_moved(tmp_path):
    (tmp_path / "one").write_text("old")
    within = tmp_path / disk._WRITTEN
    within.mkdir()
    (within / "one").write_text("another's")
    os.chown(within, 12345, 12345)
    for access in (lambda: read_bytes(tmp_path / "one"), lambda: fill_folder(tmp_path, write("new"))):
        with pytest.raises(InputError, match="fg-calib-written: files of another user, expected none"):
            access()
    assert (tmp_path / "one").read_text() == "old"


# --- a folder that all may write to, and nobody may remove another's files from, as /tmp is ---------------------------

OTHER = 12345


@pytest.fixture
def sticky(tmp_path, monkeypatch):
    """Such a folder, where this process is no longer root."""
    if os.geteuid() != 0:
        pytest.skip("only root becomes another user")
    tmp_path.chmod(0o755)
    folder = Path("shared")  # of the current folder: those above it may not be looked through
    monkeypatch.chdir(tmp_path)
    folder.mkdir()
    folder.chmod(0o1777)
    yield folder
    os.seteuid(0)


def of_another(path, mode=0o755):
    """A file or folder of another user."""
    path.chmod(mode)
    os.chown(path, OTHER, OTHER)
    return path


@pytest.mark.parametrize("mode", [0o700, 0o777])
def test_what_another_user_left_half_written_is_left_alone(sticky, mode):
    left = sticky / f".fg-calib-writing-{disk._host()}-{2**30}-x"
    left.mkdir()
    (left / "one").write_text("another's")
    of_another(left, mode)
    os.seteuid(65534)
    for folder in (sticky, sticky / "out"):
        fill_folder(folder, write("new"), OWN)
        assert (folder / "one").read_text() == "new"
    os.seteuid(0)
    fill_folder(sticky, write("newer"), OWN)  # nor does root remove it
    assert (left / "one").read_text() == "another's"


@pytest.mark.parametrize("name", ["one", "four"])
def test_results_of_another_user_are_not_to_be_replaced_or_removed(sticky, name):
    (sticky / "one").write_text("mine")
    os.chown(sticky / "one", 65534, 65534)
    (sticky / name).write_text("another's")
    of_another(sticky / name)
    os.seteuid(65534)
    expected = f"{sticky / name}: is another user's in a folder that all share, expected another folder"
    with pytest.raises(InputError) as caught:
        fill_folder(sticky, write("new"), OWN)
    assert str(caught.value) == expected
    assert (sticky / name).read_text() == "another's"
    assert [file for file in sticky.iterdir() if file.name.startswith(".")] == []


@pytest.mark.parametrize("mode", [0o700, 0o755])
def test_what_another_user_has_not_moved_is_no_reason_not_to_read_what_stands_there(sticky, mode):
    """Theirs can never take the place of what is not theirs; but who writes there would have to move it."""
    (sticky / "one").write_text("root's")
    within = sticky / disk._WRITTEN
    within.mkdir()
    (within / "one").write_text("another's")
    of_another(within, mode)
    os.seteuid(65534)
    assert read_bytes(sticky / "one") == b"root's"
    with pytest.raises(InputError) as caught:
        fill_folder(sticky, write("new"), {})
    hint = "have them moved to their places or removed, or use another folder"
    assert str(caught.value) == f"{within}: files of another user, expected none; {hint}"


def test_a_file_is_written_whatever_another_user_has_put_beside_it(sticky):
    """The name of the file that was written first could be foreseen."""
    beside = sticky / f".poses.csv.{os.getpid()}.{threading.get_ident()}.tmp"
    beside.write_text("")
    of_another(beside)
    os.seteuid(65534)
    write_text(sticky / "poses.csv", "mine")
    os.seteuid(0)
    assert (sticky / "poses.csv").read_text() == "mine"
    assert sorted(file.name for file in sticky.iterdir()) == [beside.name, "poses.csv"]


def test_what_cannot_be_moved_is_said(tmp_path):
    (tmp_path / disk._WRITTEN).mkdir()
    (tmp_path / disk._WRITTEN / "one").write_text("new")
    (tmp_path / "one").mkdir()
    with pytest.raises(InputError, match="holds files that could not be moved to their places: Is a directory"):
        require_writable(tmp_path)


@pytest.mark.slow
def test_no_file_of_an_earlier_result_stays_beside_a_new_one(example):
    job, folder = example / "calibration.yaml", example / "result"
    calibration = calibrate_job(job)
    calibration.save(folder)
    (folder / "joints.csv").write_text("id,joint,unit,reading,estimate,error\n")
    for name in ("robot_calibrated.urdf", "mine.txt"):
        (folder / name).write_text("old")
    calibration.save(folder)
    names = sorted(file.name for file in folder.iterdir())
    assert names == ["configurations.csv", "mine.txt", "residuals.csv", "result.json", "robot_calibrated.yaml"]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", ["joints.csv", "residuals.csv", "robot_calibrated.yaml", "result.json"])
def test_results_replace_results_and_nothing_else(example, fg_calib, name):
    (example / name).write_text("q1,mine\n")
    before = {file.name: file.read_bytes() for file in example.iterdir()}
    ended = fg_calib("calibrate", example / "calibration.yaml", "--out", example)
    expected = f"error: {example / name}: is there already, not written by this command, expected another folder\n"
    assert ended == (1, "", expected)
    assert {file.name: file.read_bytes() for file in example.iterdir()} == before


@pytest.mark.slow
def test_a_table_that_was_put_among_results_is_not_removed(example, fg_calib):
    out = example / "result"
    assert fg_calib("calibrate", example / "calibration.yaml", "--out", out).code == 0
    assert fg_calib("calibrate", example / "calibration.yaml", "--out", out).code == 0
    (out / "joints.csv").write_text("q1,mine\n")
    ended = fg_calib("calibrate", example / "calibration.yaml", "--out", out)
    expected = f"error: {out / 'joints.csv'}: is there already, not written by this command, expected another folder\n"
    assert ended == (1, "", expected)


def test_results_do_not_replace_what_they_are_of(example, fg_calib):
    job = example / "calibration.yaml"
    (example / "robot_nominal.yaml").rename(example / "robot_calibrated.yaml")
    job.write_text(job.read_text().replace("robot_nominal.yaml", "robot_calibrated.yaml"))
    before = {file.name: file.read_bytes() for file in example.iterdir()}
    ended = fg_calib("calibrate", job, "--out", example)
    name = example / "robot_calibrated.yaml"
    expected = f"error: {name}: the job was read from it, expected another folder for the results\n"
    assert ended == (1, "", expected)
    assert {file.name: file.read_bytes() for file in example.iterdir()} == before


@pytest.mark.slow
def test_a_simulation_replaces_a_simulation_and_nothing_else(fg_calib, tmp_path):
    assert fg_calib("simulate", "space-robot", "--out", tmp_path).code == 0
    assert fg_calib("simulate", "space-robot", "--out", tmp_path, "--seed", 3).code == 0
    (tmp_path / "calibration.yaml").write_text("model: pose\n")
    ended = fg_calib("simulate", "space-robot", "--out", tmp_path, "--seed", 4)
    found = "is there already, not written by this command, expected another folder"
    expected = f"error: {tmp_path / 'calibration.yaml'}: {found}\n"
    assert ended == (1, "", expected)
    assert (tmp_path / "calibration.yaml").read_text() == "model: pose\n"


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_a_full_disk_behind_stdout_is_one_line(example):
    command = [sys.executable, "-m", "fg_calib.cli", "calibrate", str(example / "calibration.yaml")]
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, check=False, env=dict(os.environ))
    assert (ended.returncode, ended.stderr) == (1, b"error: the output cannot be written: No space left on device\n")
