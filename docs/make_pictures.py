"""Draw the README's pictures of a clip again: ``python docs/make_pictures.py FOLDER`` labels two streets there.

Minutes on two cores. The streets are chosen to show much at once: near cars and people in one, a sharp turn in the
other.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from dataset.contact_sheet import contact_sheet
from dataset.inspection import find_sample
from dataset.street import StreetConfig, write_street_video
from dataset.trajectory_picture import write_trajectory_picture
from pipelines.commands import JobOptions, run_label

STREETS = {
    "avenue": StreetConfig(seed=25, scenario="drive", frames=264, walkers_per_100_m=45.0, focal_px=1500.0),
    "turning": StreetConfig(seed=14, scenario="sharp_turn", frames=264, focal_px=1300.0),
}
"""By video id; a longer lens brings people on the pavement nearer."""
WIDTH = 1600
"""Of the sheet on the page, pixels."""
SETTINGS = """
select: {keep_share: 1.0}
keypoints: {extractors: [street]}
views: {object_variant: 6}
"""
"""Variant 6 draws objects that are in view at all four moments of the clip; most variants draw far ones."""
CLIP, WAY = "avenue_96", "turning_0"


def main(folder: Path) -> None:
    """Videos, a job and both pictures, the latter beside this file."""
    (folder / "videos").mkdir(parents=True, exist_ok=True)
    (folder / "settings.yaml").write_text(SETTINGS, encoding="utf-8")
    for name, street in STREETS.items():
        path = folder / "videos" / f"{name}.mp4"
        if not path.is_file():
            write_street_video(street, path)
    job = folder / "job"
    run_label([folder / "videos"], job, JobOptions(config=folder / "settings.yaml"))
    here = Path(__file__).parent
    sheet = contact_sheet(find_sample(job, CLIP))
    write_small(sheet, here / "clip.png")
    write_trajectory_picture(job, WAY, here / "trajectory.png")


def write_small(picture: np.ndarray, path: Path) -> None:
    """A PNG as wide as a page and of 256 colours: a third of the bytes, and no difference that is seen."""
    whole = Image.fromarray(picture)
    size = (WIDTH, round(whole.height * WIDTH / whole.width))
    small = whole.resize(size, Image.Resampling.LANCZOS)
    small.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
