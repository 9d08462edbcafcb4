"""``animatic models check``: does a network want what its card says?"""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from rich.markup import escape
from rich.table import Table

from labeling.detection import Detector
from labeling.errors import ConfigError, ModelError, VideoError
from labeling.extractors import STREET_PREFIX, choose_extractors
from labeling.model_cards import SimccCard, find_weights, load_cards, weights_folders
from labeling.model_check import check_card
from labeling.video import decode_at, read_packet_times
from pipelines.console import make_console
from pipelines.models import check_models_folder

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


def object_boxes(card: SimccCard, pictures: Sequence[np.ndarray], *, models_dir: Path | None) -> list[np.ndarray]:
    """(n, 4) boxes of each picture in which a head's objects are: given a whole picture, it sees what is not there.

    The job's own detector finds them; for the shipped street heads it is the street's.

    Raises:
        ConfigError: no detector's weights are there, or it finds nothing that the head is for.
    """
    names = ["street_detector"] if card.name.startswith(STREET_PREFIX) else None
    own = choose_extractors(names, models_dir=models_dir).detector
    weights = find_weights(own, models_dir) if own else None
    if own is None or weights is None:
        raise ConfigError(
            f"{card.name} looks at boxes, and no detector's weights are there to find them; put a detector beside it"
        )
    detector = Detector(own, weights)
    found = [detector.detect([picture])[0].of_category(card.category).boxes_xyxy for picture in pictures]
    if not any(len(boxes) for boxes in found):
        raise ConfigError(
            f"{card.name} is for a {card.category}, and {own.name} finds none in the pictures; give others"
        )
    return found


def print_check(name: str, images: Sequence[Path], *, models_dir: Path | None, as_json: bool = False) -> int:
    """Check one card and show every way it was tried; 1 where another way fits better, or its own fails.

    Raises:
        ConfigError: no such folder or card, a picture that cannot be read, or, for a head, no box to look at.
        ModelError: its weights are not there, or break the contract.
    """
    check_models_folder(models_dir)
    cards = load_cards(models_dir)
    if name not in cards:
        raise ConfigError(f"no model card is called {name!r}; choose one of {', '.join(cards)}")
    path = find_weights(cards[name], models_dir)
    if path is None:
        folders = " or ".join(str(folder) for folder in weights_folders(models_dir))
        raise ModelError(f"{name}: no {cards[name].file} in {folders}; {cards[name].source}")
    card, pictures = cards[name], read_images(images)
    boxes = None
    if isinstance(card, SimccCard) and pictures:
        found = object_boxes(card, pictures, models_dir=models_dir)
        shown = [n for n, one in enumerate(found) if len(one)]
        pictures, boxes = [pictures[n] for n in shown], [found[n] for n in shown]
    check = check_card(card, path, pictures, boxes_xyxy=boxes)
    if as_json:
        print(json.dumps(dataclasses.asdict(check), indent=1))
        return int(check.verdict in ("another fits better", "fails"))
    console = make_console()
    table = Table(box=None, pad_edge=False)
    for column in ("fed as", "objects", "sum of scores", ""):
        table.add_column(column, justify="right" if column in ("objects", "sum of scores") else "left")
    for one in check.variants:
        remark = "the card" if one.is_card else escape(one.note)
        table.add_row(one.name, str(one.objects), f"{one.evidence:.2f}", remark, style="bold" if one.is_card else "")
    console.print(f"{path}; providers {', '.join(check.providers)}")
    console.print(table)
    colour = {"fits": "green", "another fits better": "red", "unclear": "yellow", "fails": "red"}[check.verdict]
    console.print(f"[{colour}]{check.verdict}[/]: {escape(check.advice)}")
    return int(check.verdict in ("another fits better", "fails"))
