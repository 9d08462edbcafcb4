import io
import json
import pickle

import numpy as np
import pytest
from pipeline_fixtures import HEIGHT, WIDTH

from dataset.loader import ShardDataset
from dataset.shards import ShardPlan, write_shard, write_shard_index
from dataset.tables import write_keypoints
from labeling.encoding import EncoderSettings, VideoWriter
from labeling.errors import DataError
from labeling.labels import Keypoints


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    """Two shards: a, b in train, c in val; each a video, labels, poses, a caption and a record."""
    folder = tmp_path_factory.mktemp("shards")
    rows = []
    for split, keys in {"train": ("a_0", "b_0"), "val": ("c_0",)}.items():
        plan = ShardPlan(name=f"{split}-000000.tar", split=split, keys=keys)
        samples = [(key, members(folder, key, level)) for level, key in enumerate(keys)]
        rows += write_shard(folder / plan.name, plan, samples)
    write_shard_index(folder / "index.parquet", rows)
    return folder


def members(folder, key, level):
    video = folder / "v.mp4"
    with VideoWriter(video, width=WIDTH, height=HEIGHT, settings=EncoderSettings(gop=4)) as writer:
        for frame in range(5):
            writer.write(np.full((HEIGHT, WIDTH, 3), 40 * level + 20 * frame, np.uint8))
    labels = [
        Keypoints(
            frame=frame, track_id=level, category="person", schema="coco17", score=1.0,
            box_xyxy=np.zeros(4, np.float32), points=np.ones((17, 3), np.float32), point_source=np.ones(17, np.int8),
        )
        for frame in (0, 3)
    ]  # fmt: skip
    write_keypoints(folder / "k", labels)
    poses = io.BytesIO()
    np.save(poses, np.tile(np.eye(4), (5, 1, 1)))
    values = {
        "rgb.mp4": video.read_bytes(), "labels.parquet": (folder / "k").read_bytes(),
        "cam_to_world.npy": poses.getvalue(), "txt": f"caption of {key}".encode(),
        "json": json.dumps({"key": key}).encode(),
    }  # fmt: skip
    return {suffix: (lambda data=data: data) for suffix, data in values.items()}


def test_samples_are_had_by_index_and_by_key_in_any_order(shards):
    dataset = ShardDataset(shards)
    assert len(dataset) == 2 and dataset.keys == ["a_0", "b_0"]
    assert [dataset[1].key, dataset[0].key, dataset[-1].key] == ["b_0", "a_0", "b_0"]
    assert dataset.sample("b_0").caption == "caption of b_0"
    assert [sample.key for sample in dataset] == dataset.keys
    assert ShardDataset(shards, "val").keys == ["c_0"]


def test_a_sample_gives_its_parts(shards):
    sample = ShardDataset(shards)[1]
    assert sample.frames("rgb.mp4").shape == (5, HEIGHT, WIDTH, 3)
    assert np.allclose(sample.frames("rgb.mp4").mean((1, 2, 3)), [40, 60, 80, 100, 120], atol=2)
    assert [label.frame for label in sample.keypoints()] == [0, 3]
    assert sample.cam_to_world.shape == (5, 4, 4)
    assert sample.meta == {"key": "b_0"}


def test_a_dataset_goes_to_other_processes(shards):
    dataset = pickle.loads(pickle.dumps(ShardDataset(shards)))
    assert dataset[0].caption == "caption of a_0"


def test_what_is_not_there_is_named(shards, tmp_path):
    dataset = ShardDataset(shards)
    with pytest.raises(DataError, match=r"a_0 has no ego\.mp4, only rgb\.mp4"):
        dataset[0].member("ego.mp4")
    with pytest.raises(DataError, match="train has no clip 'c_0'"):
        dataset.sample("c_0")
    with pytest.raises(DataError, match=r"holds no shards/index\.parquet"):
        ShardDataset(tmp_path)


def test_the_fingerprint_follows_the_content(shards):
    assert ShardDataset(shards).fingerprint == ShardDataset(str(shards)).fingerprint
    assert ShardDataset(shards).fingerprint != ShardDataset(shards, "val").fingerprint
