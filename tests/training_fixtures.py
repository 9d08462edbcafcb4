"""Synthetic clips with the interface of ``dataset.loader.Sample``, and a tiny cached job, for the training tests."""

import multiprocessing
import os
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from labeling.labels import Keypoints
from training.config import TrainConfig, load_config

FRAMES, WIDTH, HEIGHT = 9, 96, 64
PICTURE = {"control_width": WIDTH, "control_height": HEIGHT, "rgb_width": WIDTH, "rgb_height": HEIGHT}


@dataclass
class FakeSample:
    """One clip: a person who walks across a gradient that scrolls."""

    key: str
    frames_count: int = FRAMES
    meta: dict[str, Any] = field(default_factory=lambda: {"width": WIDTH, "height": HEIGHT})
    empty: bool = False
    """Without any label."""

    @property
    def seed(self) -> int:
        return sum(self.key.encode())

    @property
    def caption(self) -> str:
        return f"A road, take {self.seed % 3}."

    @property
    def cam_to_world(self) -> np.ndarray:
        poses = np.tile(np.eye(4), (self.frames_count, 1, 1))
        poses[:, 2, 3] = 0.3 * np.arange(self.frames_count)
        return poses

    def keypoints(self) -> list[Keypoints]:
        if self.empty:
            return []
        return [walker(frame, x=10 + self.seed % 40 + 2 * frame) for frame in range(self.frames_count)]

    def frames(self, suffix: str) -> np.ndarray:
        rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
        video = [
            np.stack([(columns * 2 + 5 * t + self.seed) % 256, (rows * 3) % 256, (rows + columns + t) % 256], axis=-1)
            for t in range(self.frames_count)
        ]
        return np.stack(video).astype(np.uint8)


def walker(frame: int, *, x: float, track_id: int = 1) -> Keypoints:
    """A person of 17 joints, 12 by 34 pixels, in the lower left."""
    points = np.zeros((17, 3), np.float32)
    points[:, 0] = x + 6 * np.cos(np.arange(17))
    points[:, 1] = 20 + 2 * np.arange(17)
    points[:, 2] = 1
    box = np.array([x - 6, 20, x + 6, 54], np.float32)
    return Keypoints(
        frame=frame, track_id=track_id, category="person", schema="coco17", score=1.0, box_xyxy=box, points=points,
        point_source=np.ones(17, np.int8),
    )  # fmt: skip


def fake_datasets(train: int = 4, val: int = 2) -> dict[str, list[FakeSample]]:
    """Clips by split."""
    return {
        "train": [FakeSample(key=f"street_{48 * index}") for index in range(train)],
        "val": [FakeSample(key=f"other_{48 * index}") for index in range(val)],
    }


def cached_job(folder: Path, **settings: Any) -> Path:
    """A job folder with the tiny latents of the fake clips."""
    from training.latents import cache_latents

    cache_latents(folder, backbone_name="tiny", picture=PICTURE, datasets=fake_datasets(), **settings)
    return folder


def tiny_config(stage: Any, **overrides: Any) -> TrainConfig:
    """The tiny recipe at the fake clips' size, without trackers."""
    tree: dict[str, Any] = {
        "backbone": {"picture": PICTURE}, "trackers": [], "validation": {"loss_every_steps": 0},
        "optimiser": {"steps": 4, "global_batch": 2, "micro_batch": 2},
    }  # fmt: skip
    for key, value in overrides.items():
        tree[key] = {**tree.get(key, {}), **value} if isinstance(value, dict) else value
    return load_config("tiny", stage=stage, overrides=tree)


def in_children(count: int, body: Callable[[int], Any], *, timeout_s: float = 90) -> list[Any]:
    """Results of ``body(rank)`` in forked processes that see each other as torchrun's do; None for those that fell.

    Forked and not spawned: importing the libraries takes longer than the tests.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    context = multiprocessing.get_context("fork")
    results = context.Queue()

    def run(rank: int) -> None:
        from accelerate.state import AcceleratorState, PartialState

        for state in (AcceleratorState, PartialState):
            state._reset_state()
        if count > 1:
            os.environ |= {
                "RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": str(count), "LOCAL_WORLD_SIZE": str(count),
                "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "ACCELERATE_USE_CPU": "true",
            }  # fmt: skip
        torch.set_num_threads(1)
        results.put((rank, body(rank)))

    children = [context.Process(target=run, args=(rank,)) for rank in range(count)]
    for child in children:
        child.start()
    deadline, found = time.monotonic() + timeout_s, {}
    while any(child.is_alive() for child in children):
        # One that fell leaves the others waiting for it.
        if time.monotonic() > deadline or any(child.exitcode not in (None, 0) for child in children):
            for child in children:
                child.kill()
        wait([child.sentinel for child in children if child.is_alive()], timeout=0.5)
    while len(found) < sum(child.exitcode == 0 for child in children):
        rank, value = results.get(timeout=5)
        found[rank] = value
    return [found.get(rank) for rank in range(count)]


@pytest.fixture(scope="session")
def tiny_job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A job with cached tiny latents, made once; read it, do not write to it."""
    return cached_job(tmp_path_factory.mktemp("tiny_job"))


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> None:
    """Small tensors are slower on two threads than on one."""
    torch.set_num_threads(1)
