import numpy as np
import pytest
from skeleton_fixtures import car

from dataset.contact_sheet import TILE, contact_sheet, moment_frames, thickened
from dataset.inspection import clip_verdict, find_sample, spread, summarize
from dataset.loader import ShardDataset
from dataset.receipts import Output, Receipt, ReceiptLog
from dataset.selection import ClipRow, Selection, write_selection
from dataset.shards import ShardPlan, write_shard, write_shard_index
from dataset.tables import write_keypoints
from labeling.encoding import VideoWriter
from labeling.errors import DataError
from pipelines.report import bin_edges

FRAMES = 17


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    """Two clips kept, one of them packed, one dropped late; one never kept."""
    root = tmp_path_factory.mktemp("job")
    rows = [
        ClipRow(key="v_0", video_id="v", start=0, end=FRAMES, objects=4.0, split="train"),
        ClipRow(key="v_8", video_id="v", start=8, end=8 + FRAMES, objects=3.0, split="train"),
        ClipRow(key="v_16", video_id="v", start=16, end=16 + FRAMES, objects=1.0, kept=False,
                reason="objects=1 < threshold=3"),
    ]  # fmt: skip
    selection = Selection(rows=tuple(rows), threshold=3.0, sample_cutoff=None, digests={"v": "d"}, rule_digest="r")
    write_selection(root / "selection.parquet", selection)
    receipt(root, "index", "v", facts={"seconds": 7200.0})
    receipt(root, "corners", "v/run_0_9", state="failed", reason="storage", message="no space")
    receipt(root, "index", "w", state="failed", reason="video", message="w.mp4: is no video")
    receipt(root, "render", "v_0", facts={"objects": 2, "metres": 40.0})
    receipt(root, "render", "v_8", state="dropped", reason="cut=1 first at 0.500 s")
    (root / "shards").mkdir()
    plan = ShardPlan(name="train-000000.tar", split="train", keys=("v_0",))
    rows = write_shard(root / "shards" / plan.name, plan, [("v_0", members(root))])
    write_shard_index(root / "shards" / "index.parquet", rows)
    return root


def receipt(root, stage, item, **fields):
    fields.setdefault("state", "done")
    outputs = (Output(path="x", size=1, sha256="0"),) if fields["state"] == "done" else ()
    ReceiptLog(root, stage, worker="w").append(Receipt(stage=stage, item=item, key="k", outputs=outputs, **fields))


def members(root):
    videos = {}
    for suffix, size in {"rgb.mp4": (132, 88), "skeleton.mp4": (96, 64), "objects.mp4": (96, 64)}.items():
        with VideoWriter(root / "clip.mp4", width=size[0], height=size[1]) as writer:
            for frame in range(FRAMES):
                writer.write(np.full((size[1], size[0], 3), 10 * frame, np.uint8))
        videos[suffix] = (root / "clip.mp4").read_bytes()
    write_keypoints(root / "k", [car(frame=0)])
    np.save(root / "poses.npy", np.tile(np.eye(4), (FRAMES, 1, 1)))
    videos |= {
        "labels.parquet": (root / "k").read_bytes(), "cam_to_world.npy": (root / "poses.npy").read_bytes(),
        "txt": b"A road with $1 car & <nothing> else.", "json": b'{"key": "v_0"}',
    }  # fmt: skip
    return {suffix: (lambda data=data: data) for suffix, data in videos.items()}


def test_a_summary_counts_what_there_is(job):
    summary = summarize(job)
    assert (summary.videos, summary.source_hours) == (1, 2.0)
    assert (summary.clips, summary.kept, summary.packed) == (3, 1, {"train": 1, "val": 0})
    assert summary.dropped == {"cut": 1, "objects": 1}
    assert summary.failed == {"corners": 1, "index": 1}
    assert summary.objects_per_clip and summary.tracks_per_clip and summary.path_length_m
    assert summary.objects_per_clip.greatest == 4.0 and summary.threshold == 3.0
    assert summary.tracks_per_clip.total == 2 and summary.path_length_m.median == 40.0
    assert summary.bytes_by_kind["txt"] == 36
    assert summary.clip_hours == pytest.approx(FRAMES / 24 / 3600)


def test_no_selection_is_said(tmp_path):
    with pytest.raises(DataError, match="holds no selection; make one with"):
        summarize(tmp_path)


def test_a_clip_that_is_not_packed_says_what_became_of_it(job):
    assert find_sample(job).key == find_sample(job, "v_0").key == "v_0"
    with pytest.raises(DataError, match="v_16: is not in the shards: objects=1 < threshold=3"):
        find_sample(job, "v_16")
    with pytest.raises(DataError, match="v_8: is not in the shards: cut=1 first at"):
        find_sample(job, "v_8")
    with pytest.raises(DataError, match="has no clip 'x'.*such as v_0$"):
        find_sample(job, "x")
    assert clip_verdict(job, "v_8").kept


def test_moments_are_spread_from_the_first_frame_to_the_last(job):
    moments = moment_frames(ShardDataset(job)[0], "rgb.mp4", 5)
    assert [index for index, _ in moments] == [0, 4, 8, 12, 16]
    assert [round(float(frame.mean()) / 10) for _, frame in moments] == [0, 4, 8, 12, 16]


def test_a_sheet_has_a_row_for_each_video_that_is_there(job):
    sheet = contact_sheet(ShardDataset(job)[0])
    assert sheet.dtype == np.uint8 and sheet.shape[1] > 4 * TILE[0]
    # A column of the last tiles, where all pictures are of one grey each.
    column = sheet[:, -TILE[0] // 2].astype(int)
    grey = np.flatnonzero((np.abs(column - 160) <= 2).all(axis=1))
    runs = np.split(grey, np.flatnonzero(np.diff(grey) > 1) + 1)
    assert [len(run) for run in runs] == [TILE[1]] * 3


def test_a_black_tile_says_that_nothing_was_to_be_drawn(job):
    sample = ShardDataset(job)[0]
    sheet = contact_sheet(sample)
    levels = [int(frame.max()) for _, frame in moment_frames(sample, "objects.mp4", 4)]
    assert levels[0] < 40 < levels[1]
    row = sheet[-TILE[1] - 12 : -12, -4 * (TILE[0] + 6) - 6 : -6]
    tiles = row.reshape(TILE[1], 4, TILE[0] + 6, 3)[:, :, : TILE[0]]
    spread = np.ptp(tiles.max(axis=3), axis=(0, 2))
    assert spread[0] > 100 and (spread[1:] < 10).all(), "words on the first tile alone"


@pytest.mark.parametrize("radius", [0, 1, 2])
def test_thickened_lines_grow_evenly_and_mix_no_colours(radius):
    frame = np.zeros((40, 60, 3), np.uint8)
    frame[20, 5:30], frame[20, 30:55] = (255, 80, 0), (0, 90, 255)
    wide = thickened(frame, radius)
    lit = wide.max(axis=2) > 0
    assert lit[20 - radius : 21 + radius, 5 - radius : 55 + radius].all()
    assert lit.sum() == (2 * radius + 1) * (50 + 2 * radius)
    assert set(map(tuple, wide[lit])) == {(255, 80, 0), (0, 90, 255)}
    assert np.array_equal(wide[frame.max(axis=2) > 0], frame[frame.max(axis=2) > 0]), "what is drawn keeps its place"


def test_a_spread_of_nothing_is_none():
    assert spread([]) is None
    found = spread([3, 1, 2])
    assert found and (found.least, found.median, found.total) == (1, 2, 6)


def test_a_sheet_says_when_the_object_row_shows_a_few_of_many(job, monkeypatch):
    sample = ShardDataset(job)[0]
    plain = contact_sheet(sample)
    for count, same in ((5, True), (6, False)):
        monkeypatch.setattr("dataset.contact_sheet.tracks_of", lambda _, count=count: set(range(count)))
        assert np.array_equal(contact_sheet(sample), plain) == same


@pytest.mark.parametrize("threshold", [0.0, 0.5, 10.0, 17.5, 400.0])
def test_no_bin_has_both_sides_of_the_threshold(threshold):
    counts = np.concatenate([np.arange(0, 18.5, 0.5), [threshold]])
    edges = bin_edges(counts, at=threshold)
    assert threshold in edges and edges[0] <= counts.min() and edges[-1] > counts.max()
    assert len(edges) <= 33 and (np.diff(edges) > 0).all()
