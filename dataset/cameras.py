"""The one camera of a video as a small file of a job: what was used, where it came from, and how sure it is."""

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

from labeling.camera import Intrinsics
from labeling.ego_calibration import CameraCalibration
from labeling.ego_motion import RoadView
from labeling.errors import DataError


def camera_record(camera: CameraCalibration) -> dict[str, Any]:
    """A camera as JSON values; what is not known is null."""
    return {
        "intrinsics": asdict(camera.intrinsics), "road": road_record(camera), "turns": camera.turns,
    }  # fmt: skip


def road_record(camera: CameraCalibration) -> dict[str, float | str | None]:
    """How a camera looks at the road, with where height and pitch came from and their sigmas."""
    road = {name: value if math.isfinite(value) else None for name, value in asdict(camera.road).items()}
    return {
        **road, "height_source": camera.height_source, "height_sigma": camera.height_sigma,
        "pitch_source": camera.pitch_source,
    }  # fmt: skip


def write_camera(path: Path, camera: CameraCalibration) -> None:
    """Write a video's camera."""
    path.write_text(json.dumps(camera_record(camera), sort_keys=True, indent=1) + "\n", encoding="utf-8")


def read_camera(path: Path) -> CameraCalibration:
    """A video's camera.

    Raises:
        DataError: the file is missing, or is no camera.
    """
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        road = record["road"]
        sigma = road["pitch_sigma_rad"]
        return CameraCalibration(
            intrinsics=Intrinsics(**record["intrinsics"]), turns=record["turns"],
            road=RoadView(
                height_m=road["height_m"], pitch_rad=road["pitch_rad"],
                pitch_sigma_rad=math.inf if sigma is None else sigma,
            ),
            pitch_source=road["pitch_source"], height_source=road["height_source"], height_sigma=road["height_sigma"],
        )  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}: cannot be read as a video's camera ({error}); run `animatic ego` again") from error
