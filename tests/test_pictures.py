from pathlib import Path

import cv2
import numpy as np
import pytest

from dataset.pictures import write_picture
from labeling.errors import DataError, StorageError

PICTURE = np.random.default_rng(0).integers(0, 256, (9, 14, 3), dtype=np.uint8)


def test_a_png_keeps_every_colour(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.PNG", PICTURE)
    read = cv2.imread(str(tmp_path / "a.PNG"))
    assert read is not None and np.array_equal(read[..., ::-1], PICTURE)


@pytest.mark.parametrize("name", ["a", "a.txt", "a.mp4"])
def test_an_ending_that_is_no_pictures_is_said(tmp_path: Path, name: str) -> None:
    with pytest.raises(DataError, match=r"end it in \.png or \.jpg"):
        write_picture(tmp_path / name, PICTURE)
    assert not list(tmp_path.iterdir())


def test_a_place_that_cannot_be_written_to_is_said(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="give a folder that is there"):
        write_picture(tmp_path / "none" / "a.png", PICTURE)
    (tmp_path / "a.png").mkdir()
    with pytest.raises(StorageError):
        write_picture(tmp_path / "a.png", PICTURE)
