"""The picture of a clip's trajectory: its numbers, and that it can be drawn of whatever a clip may be."""

import io
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from ego_fixtures import driven
from matplotlib.figure import Figure

from dataset.receipts import Output, Receipt, ReceiptLog
from dataset.selection import ClipRow, Selection, write_selection
from dataset.tables import EgoTable, read_ego, write_ego
from dataset.trajectory_marks import MODE_COLOURS
from dataset.trajectory_picture import (
    clip_motion,
    draw_trajectory,
    sliced,
    speeds_m_s,
    write_trajectory_picture,
    yaw_rates_deg_s,
)
from dataset.trajectory_plan import plan_of, tick_step
from labeling.camera import Trajectory, prior_intrinsics
from labeling.ego_motion import EgoMotion, RoadView
from labeling.errors import DataError


def stored(
    path: Path, poses: np.ndarray, *, modes: str = "moving", confidence: float = 1.0, first_frame: int = 48
) -> EgoTable:
    count = len(poses)
    motion = EgoMotion(
        trajectory=Trajectory(timestamps_s=10 + np.arange(count) / 24, cam_to_world=poses),
        mode=np.full(count, modes), confidence=np.full(count, confidence, np.float32),
        scale_source=np.full(count, "road"), scale_sigma=np.full(count, 0.1, np.float32),
        intrinsics=prior_intrinsics(96, 64), road=RoadView(height_m=1.5, pitch_rad=0.02, pitch_sigma_rad=np.inf),
    )  # fmt: skip
    write_ego(path, motion, first_frame=first_frame)
    return read_ego(path)


def told(root: Path, start: int, end: int, *, speed: float) -> None:
    """A run of video v with its receipt."""
    path = f"videos/v/run_{start}_{end}.ego.parquet"
    (root / path).parent.mkdir(parents=True, exist_ok=True)
    stored(root / path, driven(np.full(end - start, speed), 20.0), first_frame=start)
    outputs = (Output(path=path, size=(root / path).stat().st_size, sha256="0"),)
    receipt = Receipt(stage="ego", item=f"v/run_{start}_{end}", state="done", key="k", outputs=outputs)
    ReceiptLog(root, "ego", worker="w").append(receipt)


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    """A labelled run [48, 96) that holds one clip, another clip without a run, and a dropped one."""
    root = tmp_path_factory.mktemp("job")
    told(root, 48, 96, speed=6.0)
    rows = [ClipRow(key=f"v_{start}", video_id="v", start=start, end=start + 24) for start in (56, 200)]
    rows.append(ClipRow(key="v_300", video_id="v", start=300, end=324, kept=False, reason="objects=1 < threshold=3"))
    selection = Selection(rows=tuple(rows), threshold=None, sample_cutoff=None, digests={}, rule_digest="r")
    write_selection(root / "selection.parquet", selection)
    return root


def test_a_clip_s_motion_is_its_run_s_from_its_own_start(job):
    ego = clip_motion(job, "v_56")
    assert ego.frame.tolist() == list(range(56, 80))
    assert len(ego.mode) == len(ego.confidence) == len(ego.scale_sigma) == 24
    assert ego.trajectory.timestamps_s[0] == 0 and np.array_equal(ego.trajectory.cam_to_world[0], np.eye(4))
    assert speeds_m_s(ego) == pytest.approx(np.full(24, 6.0), rel=1e-6)
    assert yaw_rates_deg_s(ego) == pytest.approx(np.full(24, 20.0), rel=1e-6)


def test_of_two_runs_the_one_that_the_job_speaks_of_is_shown(tmp_path):
    rows = [ClipRow(key=f"v_{start}", video_id="v", start=start, end=start + 24) for start in (48, 72)]
    selection = Selection(rows=tuple(rows), threshold=None, sample_cutoff=None, digests={}, rule_digest="r")
    write_selection(tmp_path / "selection.parquet", selection)
    (tmp_path / "videos" / "v").mkdir(parents=True)
    stored(tmp_path / "videos" / "v" / "run_0_96.ego.parquet", driven(np.full(96, 1.0)), first_frame=0)
    with pytest.raises(DataError, match="animatic ego"):
        clip_motion(tmp_path, "v_72")
    told(tmp_path, 24, 120, speed=3.0)  # Of an earlier selection.
    told(tmp_path, 48, 96, speed=6.0)
    assert speeds_m_s(clip_motion(tmp_path, "v_72")) == pytest.approx(np.full(24, 6.0), rel=1e-6)


@pytest.mark.parametrize("speed", [-3.0, 0.0, 8.0], ids=str)
def test_speed_has_the_sign_of_where_the_camera_looks(tmp_path, speed):
    ego = stored(tmp_path / "e.parquet", driven(np.full(10, speed), -90.0))
    assert speeds_m_s(ego) == pytest.approx(np.full(10, speed), abs=1e-6)
    assert yaw_rates_deg_s(ego)[1:] == pytest.approx(np.full(9, -90.0), rel=1e-6)


def test_a_clip_without_a_trajectory_says_why(job):
    with pytest.raises(DataError, match="animatic ego"):
        clip_motion(job, "v_200")
    with pytest.raises(DataError, match="objects=1 < threshold=3"):
        clip_motion(job, "v_300")
    with pytest.raises(DataError, match="has no clip"):
        clip_motion(job, "v_1")


def pixels(figure: Figure) -> np.ndarray:
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    picture = cv2.imdecode(np.frombuffer(stream.getvalue(), np.uint8), cv2.IMREAD_COLOR_RGB)
    assert picture is not None
    return picture


def shown(picture: np.ndarray, colour: str) -> int:
    wanted = np.array([int(colour[at : at + 2], 16) for at in (1, 3, 5)])
    return int((np.abs(picture.astype(int) - wanted).max(axis=-1) <= 3).sum())


def test_modes_have_their_colours_and_doubt_pales_them(tmp_path):
    drive = driven(np.full(30, 6.0), 20.0)
    sure = pixels(draw_trajectory(stored(tmp_path / "a", drive), title="a"))
    unsure = pixels(draw_trajectory(stored(tmp_path / "b", drive, confidence=0.1), title="b"))
    held = pixels(draw_trajectory(stored(tmp_path / "c", drive, modes="held"), title="c"))
    blue, pink = MODE_COLOURS["moving"], MODE_COLOURS["held"]
    assert shown(sure, blue) > 5 * shown(unsure, blue) and shown(sure, blue) > 2000
    assert shown(held, pink) > 2000 and shown(held, blue) == 0


@pytest.mark.parametrize("count", [1, 2, 121], ids=str)
@pytest.mark.parametrize("speed", [0.0, 30.0], ids=str)
def test_any_clip_can_be_drawn_the_same_twice(tmp_path, count, speed):
    ego = stored(tmp_path / "e.parquet", driven(np.full(count, speed)), confidence=0.0)
    first, second = (pixels(draw_trajectory(sliced(ego, 0, count), title="k")) for _ in range(2))
    assert np.array_equal(first, second) and first.shape[1] > 900 and first.shape[0] > 600


WAYS = {
    "ahead": (8.0, 0.0), "a bend": (8.0, 5.0), "a turn": (6.0, 18.0), "to the left": (6.0, -18.0),
    "a circle": (6.0, 75.0), "still": (0.0, 0.0), "on the spot": (0.0, 60.0), "backwards": (-3.0, 0.0),
}  # fmt: skip


@pytest.mark.parametrize("way", WAYS)
def test_heads_and_views_open_to_where_the_camera_looks(tmp_path, way):
    speed, rate = WAYS[way]
    plan = plan_of(sliced(stored(tmp_path / "e.parquet", driven(np.full(121, speed), rate)), 0, 121))
    assert len(plan.moments) == 6 and len(plan.apart) == (1 if way == "still" else 6)
    for moment in plan.moments:
        at, ahead = plan.way[moment], plan.looks[moment]
        tip, *tail = (plan.head(moment) - at) @ ahead
        assert tip > 0 and max(tail) < 0, "a dart's tip, and nothing else of it, is before the camera"
        left, apex, right = plan.view(moment) - at
        assert not apex.any() and left @ ahead == pytest.approx(plan.reach_m) == pytest.approx(right @ ahead)
        assert left[0] * ahead[1] < left[1] * ahead[0] and right[0] * ahead[1] > right[1] * ahead[0]


@pytest.mark.parametrize("way", WAYS)
def test_the_plan_shows_all_of_the_way_and_little_else(tmp_path, way):
    speed, rate = WAYS[way]
    ego = sliced(stored(tmp_path / "e.parquet", driven(np.full(121, speed), rate)), 0, 121)
    plan = plan_of(ego)
    drawn = np.concatenate([plan.way, *(plan.view(moment) for moment in plan.moments)])
    assert (drawn >= plan.low).all() and (drawn <= plan.high).all()
    figure = draw_trajectory(ego, title="k")
    figure.draw_without_rendering()
    box = figure.axes[0].get_window_extent()
    metres_px = box.width / (plan.high - plan.low)[0]
    assert metres_px == pytest.approx(box.height / (plan.high - plan.low)[1], rel=0.01), "a metre is a metre"
    if np.ptp(plan.way, axis=0).max() > 6:
        assert ((plan.high - plan.low) - np.ptp(plan.way, axis=0)).max() < 0.62 * np.ptp(plan.way, axis=0).max()


@pytest.mark.parametrize("span", [3.0, 6.0, 17.3, 50.0, 149.0, 2000.0], ids=str)
def test_ticks_are_round_and_few(span):
    assert 5 <= span / tick_step(span) <= 12.5
    assert f"{tick_step(span):e}"[0] in "125"


def test_doubt_is_said_in_figures(tmp_path):
    ego = sliced(stored(tmp_path / "e.parquet", driven(np.full(49, 6.0)), confidence=0.98), 0, 49)
    ego = replace(ego, confidence=np.where(np.arange(49) == 24, np.float32(0.91), ego.confidence))
    names = [axes.get_title(loc="left") for axes in draw_trajectory(ego, title="k").axes]
    assert "confidence, median 0.98, least 0.91 at 1.0 s" in names


def test_a_picture_that_cannot_be_written_is_an_error(job, tmp_path):
    write_trajectory_picture(job, "v_56", tmp_path / "t.png")
    assert (tmp_path / "t.png").stat().st_size > 10_000
    with pytest.raises(DataError, match="end it in .png"):
        write_trajectory_picture(job, "v_56", tmp_path / "t.nonsense")
    with pytest.raises(DataError, match="way: is no picture's name; end it in .png"):
        write_trajectory_picture(job, "v_56", tmp_path / "way")
    assert [path.name for path in tmp_path.iterdir()] == ["t.png"]
    with pytest.raises(DataError, match="folder that is there"):
        write_trajectory_picture(job, "v_56", tmp_path / "none" / "t.png")
