"""Pictures to files, whole or not at all."""

from pathlib import Path

import cv2
import numpy as np

from dataset.receipts import atomic_write
from labeling.errors import DataError


def write_picture(path: Path, picture: np.ndarray) -> None:
    """Write an (H, W, 3) uint8 RGB picture; the file's ending says of which kind.

    Raises:
        DataError: an ending that is no picture's, or a folder that is not there.
        StorageError: no space, or the folder cannot be written to.
    """
    if not path.parent.is_dir():
        raise DataError(f"{path}: cannot be written; give a folder that is there")
    try:
        _, data = cv2.imencode(path.suffix.lower(), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    except cv2.error as error:
        raise DataError(f"{path}: is no picture's name; end it in .png or .jpg") from error
    atomic_write(path, data.tobytes())
