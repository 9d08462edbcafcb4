import tarfile
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dataset.shards import (
    ClipSize,
    Member,
    ShardPlan,
    check_shard,
    find_shards,
    plan_shards,
    read_member,
    read_shard_index,
    write_shard,
    write_shard_index,
)
from dataset.tables import SHARD_INDEX_SCHEMA, table_of, write_table
from labeling.errors import ConfigError, DataError
from labeling.timeline import LONGEST_VIDEO_ID, clip_key


def sizes(counts, *, split="train", round_=0):
    return [ClipSize(key=f"v_{n}", split=split, round=round_, size=size) for n, size in enumerate(counts)]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(1, 90), max_size=40))
def test_every_clip_goes_to_one_shard_and_shards_are_filled(counts):
    clips = sizes(counts)
    plans = plan_shards(clips, target_bytes=100)
    assert sorted(key for plan in plans for key in plan.keys) == sorted(clip.key for clip in clips)
    by_key = {clip.key: clip.size for clip in clips}
    filled = [sum(by_key[key] for key in plan.keys) for plan in plans]
    assert all(size <= 100 for size in filled)
    # No shard could have taken the first clip of the next.
    assert all(size + by_key[after.keys[0]] > 100 for size, after in zip(filled[:-1], plans[1:], strict=True))
    assert [plan.name for plan in plans] == [f"train-{n:06d}.tar" for n in range(len(plans))]


def test_splits_have_their_own_shards_and_an_oversized_clip_has_one_alone():
    clips = [*sizes([10, 300, 10]), ClipSize(key="w_0", split="val", round=0, size=10)]
    plans = plan_shards(clips, target_bytes=100)
    assert [(plan.name, len(plan.keys)) for plan in plans] == [
        ("train-000000.tar", 1), ("train-000001.tar", 1), ("train-000002.tar", 1), ("val-000000.tar", 1)
    ]  # fmt: skip


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(1, 60), min_size=1, max_size=20), st.lists(st.integers(1, 60), min_size=1, max_size=20))
def test_a_later_round_leaves_earlier_shards_as_they_are(first, second):
    before = plan_shards(sizes(first), target_bytes=100)
    added = [ClipSize(key=f"a_{n}", split="train", round=1, size=size) for n, size in enumerate(second)]
    assert plan_shards([*added, *sizes(first)], target_bytes=100)[: len(before)] == before


def write(path, keys=("a_0", "a_48"), content=b"x" * 700):
    plan = ShardPlan(name=path.name, split="train", keys=tuple(keys))
    samples = [(key, {"rgb.mp4": lambda: content, "txt": lambda key=key: key.encode()}) for key in keys]
    return write_shard(path, plan, samples)


def test_rows_say_where_the_bytes_are(tmp_path):
    rows = write(tmp_path / "train-000000.tar", content=bytes(range(256)) * 9)
    data = (tmp_path / "train-000000.tar").read_bytes()
    with tarfile.open(tmp_path / "train-000000.tar") as tar:
        for row, member in zip(rows, tar.getmembers(), strict=True):
            assert member.name == f"{row.key}.{row.member}" and member.mtime == 0
            file = tar.extractfile(member)
            assert file is not None and data[row.offset : row.offset + row.size] == file.read()
            assert read_member(tmp_path, row) == data[row.offset : row.offset + row.size]


def test_the_same_samples_give_the_same_bytes(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / "train-000000.tar")
    assert (tmp_path / "a/train-000000.tar").read_bytes() == (tmp_path / "b/train-000000.tar").read_bytes()


def test_the_longest_video_id_fits_into_a_shard(tmp_path):
    key = clip_key("v" * LONGEST_VIDEO_ID, 9_999_999)
    plan = ShardPlan(name="train-000000.tar", split="train", keys=(key,))
    (row,) = write_shard(tmp_path / plan.name, plan, [(key, {"cam_to_world.npy": lambda: b"numbers"})])
    assert read_member(tmp_path, row) == b"numbers"
    with pytest.raises(ConfigError, match="76 characters.*room for 75"):
        clip_key("v" * (LONGEST_VIDEO_ID + 1), 0)


def test_an_index_comes_back_and_is_found_from_the_job(tmp_path):
    (tmp_path / "shards").mkdir()
    rows = write(tmp_path / "shards" / "train-000000.tar")
    write_shard_index(tmp_path / "shards" / "index.parquet", rows[::-1])
    assert read_shard_index(tmp_path / "shards" / "index.parquet") == rows
    assert find_shards(tmp_path) == find_shards(tmp_path / "shards") == tmp_path / "shards"
    with pytest.raises(DataError, match="animatic pack"):
        find_shards(tmp_path / "elsewhere")


@pytest.mark.parametrize(
    ("key", "shard"),
    [("../../a_0", "t.tar"), ("a.b_0", "t.tar"), ("", "t.tar"), ("a_0", "../t.tar"), ("a_0", "/t.tar"), ("a_0", "..")],
)
def test_names_that_lead_out_of_the_folder_are_refused(tmp_path, key, shard):
    row = Member(key=key, split="train", shard=shard, member="txt", offset=0, size=1, sha256="")
    write_shard_index(tmp_path / "index.parquet", [row])
    with pytest.raises(DataError, match="lie beside their index"):
        read_shard_index(tmp_path / "index.parquet")


def test_a_broken_shard_is_found_out(tmp_path):
    path = tmp_path / "train-000000.tar"
    rows = write(path)
    check_shard(path, rows)
    data = bytearray(path.read_bytes())
    data[rows[2].offset + 5] ^= 1
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"a_48\.rgb\.mp4 is not as it was written"):
        check_shard(path, rows)
    with pytest.raises(DataError, match=r"a_48\.rgb\.mp4 is not as it was packed .*; copy it again, or remove it"):
        read_member(tmp_path, rows[2])
    assert read_member(tmp_path, rows[1]) == b"a_0"
    path.write_bytes(data[: rows[2].offset + 10])
    with pytest.raises(DataError, match=r"ends inside a_48\.rgb\.mp4"):
        read_member(tmp_path, rows[2])
    path.unlink()
    with pytest.raises(DataError, match="cannot be read"):
        read_member(tmp_path, rows[2])


@pytest.mark.parametrize(("offset", "size"), [(0, 1 << 62), (1 << 40, 5)])
def test_a_damaged_index_makes_no_buffer_of_what_it_claims(tmp_path, offset, size):
    row = replace(write(tmp_path / "train-000000.tar")[0], offset=offset, size=size)
    with pytest.raises(DataError, match=r"ends inside a_0\.rgb\.mp4"):
        read_member(tmp_path, row)


def test_an_index_with_empty_fields_is_refused(tmp_path):
    write_table(tmp_path / "index.parquet", table_of(SHARD_INDEX_SCHEMA, [{"key": "a_0"}]))
    with pytest.raises(DataError, match="rows with empty fields; remove it"):
        read_shard_index(tmp_path / "index.parquet")


def test_stock_webdataset_reads_the_samples(tmp_path):
    webdataset = pytest.importorskip("webdataset")
    rows = write(tmp_path / "train-000000.tar")
    samples = list(webdataset.WebDataset(str(tmp_path / "train-000000.tar"), shardshuffle=False))
    assert [sample["__key__"] for sample in samples] == ["a_0", "a_48"]
    assert {key for key in samples[0] if not key.startswith("__")} == {row.member for row in rows if row.key == "a_0"}
