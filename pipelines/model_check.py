"""``animatic models check``: does a network want what its card says?"""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from rich.markup import escape
from rich.table import Table

from labeling.errors import ConfigError, ModelError, VideoError
from labeling.model_cards import find_weights, load_cards, weights_folders
from labeling.model_check import check_card
from labeling.video import decode_at, read_packet_times
from pipelines.console import make_console

VIDEO_FRAMES = 10
"""Frames taken from a video, evenly spread."""
_PICTURES = {".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff"}


def read_images(paths: Sequence[Path]) -> list[np.ndarray]:
    """(H, W, 3) uint8 RGB pictures: image files as they are, of each video ten frames.

    Raises:
        ConfigError: a file that is neither picture nor video.
    """
    images: list[np.ndarray] = []
    for path in paths:
        # By its name: OpenCV 5 reads the first frame of a video as a picture, and PyAV a picture as a video.
        if path.suffix.lower() in _PICTURES:
            picture = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
            if picture is None:
                raise ConfigError(f"--image {path} cannot be read as a picture; check the path and the file")
            images.append(np.ascontiguousarray(picture[:, :, ::-1]))
            continue
        try:
            times_s = read_packet_times(path).times_s
            chosen = times_s[np.linspace(0, len(times_s), min(VIDEO_FRAMES, len(times_s)), endpoint=False, dtype=int)]
            images += [frame.rgb for frame in decode_at(path, chosen.tolist())]
        except VideoError as error:
            raise ConfigError(f"--image {path} is neither a picture nor a video: {error}") from error
    return images


def print_check(name: str, images: Sequence[Path], *, models_dir: Path | None, as_json: bool = False) -> int:
    """Check one card and show every way it was tried; 1 where another way fits better.

    Raises:
        ConfigError: no such card, or a picture that cannot be read.
        ModelError: its weights are not there, or break the contract.
    """
    cards = load_cards(models_dir)
    if name not in cards:
        raise ConfigError(f"no model card is called {name!r}; choose one of {', '.join(cards)}")
    path = find_weights(cards[name], models_dir)
    if path is None:
        folders = " or ".join(str(folder) for folder in weights_folders(models_dir))
        raise ModelError(f"{name}: no {cards[name].file} in {folders}; {cards[name].source}")
    check = check_card(cards[name], path, read_images(images))
    if as_json:
        print(json.dumps(dataclasses.asdict(check), indent=1))
        return int(check.verdict == "another fits better")
    console = make_console()
    table = Table(box=None, pad_edge=False)
    for column in ("fed as", "objects", "sum of scores", ""):
        table.add_column(column, justify="right" if column in ("objects", "sum of scores") else "left")
    for one in check.variants:
        remark = "the card" if one.is_card else escape(one.note)
        table.add_row(one.name, str(one.objects), f"{one.evidence:.2f}", remark, style="bold" if one.is_card else "")
    console.print(f"{path}; providers {', '.join(check.providers)}")
    console.print(table)
    colour = {"fits": "green", "another fits better": "red", "unclear": "yellow"}[check.verdict]
    console.print(f"[{colour}]{check.verdict}[/]: {escape(check.advice)}")
    return int(check.verdict == "another fits better")
