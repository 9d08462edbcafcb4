"""The few things that are read from MP4 files directly: which boxes there are, and how many frames the index lists.

ISO/IEC 14496-12, 4.2 (boxes) and 8.7.3 (sample sizes).
"""

from dataclasses import dataclass
from pathlib import Path

_MOST_BOXES = 64


@dataclass(frozen=True, slots=True, kw_only=True)
class Box:
    """A top-level box."""

    name: str
    start: int
    """First byte, header included."""
    size: int
    """Bytes, as the box itself claims."""


def top_level_boxes(path: Path) -> list[Box]:
    """The boxes of a file, as far as they can be followed; of anything but an MP4, most likely none."""
    boxes: list[Box] = []
    size = path.stat().st_size
    with path.open("rb") as file:
        at = 0
        while at + 8 <= size and len(boxes) < _MOST_BOXES:
            file.seek(at)
            header = file.read(16)
            length = int.from_bytes(header[:4], "big")
            if length == 1:
                length = int.from_bytes(header[8:16], "big")
            elif length == 0:
                length = size - at
            if not header[4:8].isalnum() or length < 8:
                break
            boxes.append(Box(name=header[4:8].decode("ascii"), start=at, size=length))
            at += length
    return boxes


def is_cut_off(path: Path) -> bool:
    """Whether a box of an MP4 claims more bytes than the file has."""
    boxes = top_level_boxes(path)
    return bool(boxes) and boxes[-1].start + boxes[-1].size > path.stat().st_size


def indexed_frames(path: Path) -> int:
    """How many frames the index of a single-stream MP4 lists; 0 where there is no index or the file ends too early."""
    boxes = top_level_boxes(path)
    index = next((box for box in boxes if box.name == "moov"), None)
    if index is None or is_cut_off(path):
        return 0
    with path.open("rb") as file:
        file.seek(index.start)
        data = file.read(index.size)
    at = data.find(b"stsz")
    return int.from_bytes(data[at + 12 : at + 16], "big") if at >= 0 else 0
