"""`fg-calib board`: images become tables that a job takes as they are; what cannot be used is named in one line."""

import json
import shutil
from dataclasses import asdict, astuple

import numpy as np
import polars as pl
import pytest
import yaml
from boards import BOARD, CAMERA, SIZE, render, views
from scipy.spatial.transform import Rotation

from fg_calib import InputError
from fg_calib.importers import board as images
from fg_calib.importers.board import load_opencv
from fg_calib.io.job import read_camera

cv2 = pytest.importorskip("cv2", reason="no OpenCV: pip install 'fg_calib[camera]'")

CHECKERBOARD = {"type": "checkerboard", "columns": 9, "rows": 6, "square": 20, "units": {"length": "mm"}}
CHARUCO = CHECKERBOARD | {"type": "charuco", "rows": 7, "marker": 14, "dictionary": "DICT_5X5_100"}
TABLES = {"board.csv", "board.json", "camera.yaml", "pixels.csv"}
N = 4


def drawn(folder, board, rng, n=N, **of_views):
    """Images of a board in a folder, and the true poses."""
    folder.mkdir()
    R, t = views(board, n, rng, **({"tilt": 35.0, "off": 0.05} | of_views))
    for k in range(n):
        cv2.imwrite(str(folder / f"view{k}.png"), render(board, R[k], t[k], rng))
    return R, t


@pytest.fixture(scope="module")
def drawing(tmp_path_factory):
    """Images of a checkerboard, board and camera next to them, and the true poses."""
    folder = tmp_path_factory.mktemp("board")
    (folder / "board.yaml").write_text(yaml.safe_dump(CHECKERBOARD))
    (folder / "camera.yaml").write_text(yaml.safe_dump(asdict(CAMERA)))
    true = drawn(folder / "images", BOARD, np.random.default_rng(0))
    rows = "".join(f"view{k},{10 * k},0.50,,{1 + k}\n" for k in range(N))
    (folder / "poses.csv").write_text(f"id,q1,q2,split,x\n{rows}absent,1,2,test,3\n")
    return folder, true


@pytest.fixture
def job(drawing, tmp_path):
    """A copy of it, to be changed at will."""
    return shutil.copytree(drawing[0], tmp_path / "job")


def add_wall(job):
    """An image without the board."""
    cv2.imwrite(str(job / "images" / "wall.png"), np.full(SIZE[::-1], 170, np.uint8))


def run(fg_calib, folder, *arguments, camera=True):
    given = ["board", folder / "images", "--board", folder / "board.yaml", "--out", folder / "out"]
    return fg_calib(*given, *(["--camera", folder / "camera.yaml"] if camera else []), *arguments)


@pytest.mark.slow
def test_images_become_tables_of_corners_and_poses(drawing, job, fg_calib):
    add_wall(job)
    ended = run(fg_calib, job)
    assert (ended.code, ended.err) == (0, f"wrote {', '.join(sorted(TABLES))} to {job / 'out'}\n")
    seen = "checkerboard 9 x 6, square 20 mm: seen in 4 of 5 images, 216 corners\nRMS of residuals 0"
    assert ended.out.startswith(seen)
    assert "No board in wall.png: no board." in ended.out
    assert "The tables have no joint readings: add q1, q2" in ended.out
    assert {f.name for f in (job / "out").iterdir()} == TABLES
    poses, pixels = (pl.read_csv(job / "out" / f"{name}.csv") for name in ("board", "pixels"))
    assert poses["id"].to_list() == [f"view{k}" for k in range(N)]
    assert pixels.columns == ["id", "u", "v", "corner_x", "corner_y", "sigma_pixel"]
    assert len(pixels) == N * 54
    for row, R, t in zip(poses.iter_rows(named=True), *drawing[1], strict=True):
        C = np.zeros((6, 6))
        C[np.triu_indices(6)] = [row[name] for name in poses.columns if name.startswith("cov_")]
        C = C + np.triu(C, 1).T
        turn = Rotation.from_matrix(R) * Rotation.from_rotvec([row["rx"], row["ry"], row["rz"]]).inv()
        e = np.append(turn.as_rotvec(), t - [row["x"], row["y"], row["z"]])
        assert e @ np.linalg.solve(C, e) < 30.0  # 1 in 25 000
        assert np.sqrt(np.diag(C)[3:]).max() < 1e-3


@pytest.mark.slow
def test_joint_readings_are_joined_by_the_images_name_as_they_are_written(job, fg_calib):
    assert run(fg_calib, job).code == 0
    in_m = pl.read_csv(job / "out" / "board.csv")
    ended = run(fg_calib, job, "--configurations", job / "poses.csv", "--length", "mm", "--angle", "deg")
    assert ended.code == 0
    assert "Rows of joint readings without an image of the board: absent." in " ".join(ended.out.split())
    assert "units: {length: mm, angle: deg}" in " ".join(ended.out.split())
    lines = (job / "out" / "pixels.csv").read_text().splitlines()
    assert lines[0] == "id,q1,q2,split,u,v,corner_x,corner_y,sigma_pixel"
    assert lines[55].startswith("view1,10,0.50,")
    found = pl.read_csv(job / "out" / "pixels.csv")
    assert found["corner_x"].unique().sort().to_list() == pytest.approx(np.arange(9) * 20.0)
    in_mm = pl.read_csv(job / "out" / "board.csv")
    for name, factor in {"z": 1e3, "cov_11": (180 / np.pi) ** 2, "cov_14": 180e3 / np.pi, "cov_66": 1e6}.items():
        assert in_mm[name].to_list() == pytest.approx((factor * in_m[name]).to_list(), rel=1e-9)


def test_the_camera_is_estimated_from_the_same_images(job, fg_calib):
    add_wall(job)
    ended = run(fg_calib, job, "--estimate-camera", "--json", camera=False)
    assert ended.code == 0
    found = json.loads(ended.out)
    for name, true in asdict(CAMERA).items():
        assert abs(found["camera"][name] - true) < 4.0 * found["camera_sigma"][name]
    written = yaml.safe_load((job / "out" / "camera.yaml").read_text())
    assert written["sigma"] == found["camera_sigma"]
    assert (written["width"], written["height"]) == SIZE
    assert astuple(read_camera(job / "out" / "camera.yaml")) == tuple(found["camera"].values())
    assert json.loads((job / "out" / "board.json").read_text()) == found
    assert found["schema"] == "fg-calib/board/1"
    assert [image["id"] for image in found["images"]] == [f"view{k}" for k in range(N)]
    assert found["without_board"] == {"wall.png": "no board"}


@pytest.mark.slow
def test_images_that_do_not_determine_the_camera_end_with_3(job, fg_calib):
    shutil.rmtree(job / "images")
    drawn(job / "images", BOARD, np.random.default_rng(1), n=3, tilt=4.0, off=0.02, distance=(0.5, 0.52))
    ended = run(fg_calib, job, "--estimate-camera", camera=False)
    assert ended.code == 3
    assert ended.err.splitlines()[-1].startswith("not to be trusted: the images do not determine the camera: f")
    assert "DOUBTFUL: the images do not determine the camera" in ended.out


def test_a_board_with_two_poses_is_in_the_table_of_corners_alone(job, fg_calib, monkeypatch):
    """One is far away, hardly tilted, and its corners are noisy; where all are, there is no table of poses."""
    R = Rotation.from_euler("x", 10.0, degrees=True).as_matrix()
    uv = CAMERA.image(np.array([-0.08, -0.05, 3.0]) + BOARD.corners @ R[:, :2].T)[0]
    uv += np.random.default_rng(10).normal(scale=0.3, size=uv.shape)
    search, pick = images.find_corners, iter([1, 0, 0, 0] + [1] * N)
    monkeypatch.setattr(images, "find_corners", lambda *a: (np.arange(54), uv) if next(pick) else search(*a))
    ended = run(fg_calib, job)
    assert ended.code == 0
    told = "Only in pixels.csv, as a second pose, tilted the other way, explains the corners as well: view0."
    assert told in " ".join(ended.out.split())
    assert pl.read_csv(job / "out" / "board.csv")["id"].to_list() == ["view1", "view2", "view3"]
    assert pl.read_csv(job / "out" / "pixels.csv")["id"].n_unique() == N
    assert run(fg_calib, job).code == 0
    assert {f.name for f in (job / "out").iterdir()} == TABLES - {"board.csv"}


@pytest.mark.parametrize("given", [[], ["--camera", "camera.yaml", "--estimate-camera"]])
def test_one_camera_is_needed(job, fg_calib, given):
    ended = run(fg_calib, job, *given, camera=False)
    assert ended.code == 2
    assert "--camera and --estimate-camera: one of the two is needed" in ended.err


def test_without_opencv_it_says_what_to_install(job, fg_calib, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "cv2", None)
    load_opencv.cache_clear()
    try:
        ended = run(fg_calib, job)
    finally:
        load_opencv.cache_clear()
    assert (ended.code, ended.err) == (1, "error: fg-calib board needs OpenCV: pip install 'fg_calib[camera]'\n")


BOARDS = [
    ({"colums": 9}, "board.yaml: unknown key 'colums', expected one of type, columns, rows, square, marker"),
    ({"square": 20, "units": {}}, "board.yaml: square: found 20.0 m, expected at most 2 m; is it in mm? units: {"),
    ({"columns": 8}, "board.yaml: 8 x 6 inner corners look the same after half a turn, expected columns + rows odd, or "
     "a charuco board; where the camera never turns more than a quarter about its axis, say upright: true"),
    (CHARUCO | {"dictionary": "DICT_5x5_1"}, "board.yaml: dictionary: found 'DICT_5x5_1', expected one of DICT_"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "message"), BOARDS, ids=[m.partition(": ")[2][:30] for _, m in BOARDS])
def test_a_board_that_cannot_be_used_is_named(changes, message, job, fg_calib):
    (job / "board.yaml").write_text(yaml.safe_dump(CHECKERBOARD | changes))
    ended = run(fg_calib, job)
    assert ended.code == 1
    assert ended.err.startswith(f"error: {message}")
    assert ended.err.count("\n") == 1


def test_what_libraries_print_of_half_an_image_is_left_out(job, capfd):
    with pytest.raises(InputError, match=r"^half\.png: no image that OpenCV can read"):
        images.decode((job / "images" / "view1.png").read_bytes()[:-5000], "half.png")
    assert capfd.readouterr().err == ""


def _replace(path, old, new):
    path.write_text(path.read_text().replace(old, new))


CASES = {
    "an image that is none": (
        lambda job: (job / "images" / "view1.png").write_bytes(b"GIF89a"),
        "view1.png: no image that OpenCV can read, expected PNG, JPEG, TIFF, BMP or the like"),
    "no images": (
        lambda job: [file.unlink() for file in (job / "images").iterdir()],
        "{job}/images: no images, expected files that end in .png, .jpg, .jpeg, .tif, .tiff, .bmp, .pgm, .ppm,"),
    "a board in none": (
        lambda job: (add_wall(job), [file.unlink() for file in (job / "images").glob("view*")]),
        "images: the board in none of 1 (no board), expected at least one; are columns, rows and dictionary those of "
        "the board? older charuco boards: legacy: true"),
    "a camera of other images": (
        lambda job: (job / "camera.yaml").write_text(yaml.safe_dump(asdict(CAMERA) | {"width": 1280, "height": 960})),
        "camera.yaml: width: found 1280, expected 640 px as the images have; the intrinsics of other"),
    "readings without an id": (lambda job: _replace(job / "poses.csv", "id,", "name,"),
                               "poses.csv: no column id, expected the name of each row's image without its ending"),
}  # fmt: skip


@pytest.mark.sampled(2)
@pytest.mark.parametrize("case", CASES)
def test_what_cannot_be_used_is_named(case, job, fg_calib):
    change, message = CASES[case]
    change(job)
    ended = run(fg_calib, job, "--configurations", job / "poses.csv")
    assert ended.code == 1
    assert ended.err.startswith(f"error: {message}".replace("{job}", str(job)))
    assert ended.err.count("\n") == 1
    assert not (job / "out").exists()
