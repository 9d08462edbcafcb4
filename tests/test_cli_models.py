"""``animatic models check`` on the command line."""

import json
from pathlib import Path

import cv2
import numpy as np
import onnx_fixtures
import pytest
from typer.testing import CliRunner

from labeling.errors import ConfigError, ModelError
from labeling.model_cards import SimccCard, write_card
from pipelines.cli import app
from pipelines.model_check import read_images

RUNNER = CliRunner()


@pytest.fixture
def models(tmp_path: Path) -> Path:
    """A folder with one card and its weights, and a card whose weights are missing."""
    values = {"schema": "coco17", "input_width": 64, "input_height": 96, "licence": "none", "source": "make it"}
    for name in ("toy", "gone"):
        card = SimccCard.model_validate({"name": name, "file": f"{name}.onnx", **values})
        write_card(card, tmp_path / f"{name}.toml")
    onnx_fixtures.random_simcc(tmp_path / "toy.onnx", points=17, width=64, height=96)
    cv2.imwrite(str(tmp_path / "noise.png"), np.random.default_rng(0).integers(0, 256, (90, 120, 3), dtype=np.uint8))
    return tmp_path


def test_a_card_is_checked_on_a_picture(models: Path) -> None:
    arguments = ["models", "check", "toy", "--models", str(models), "--image", str(models / "noise.png")]
    result = RUNNER.invoke(app, [*arguments, "--json"])
    check = json.loads(result.stdout)
    assert check["card"] == "toy" and len(check["variants"]) == 6
    assert result.exit_code == (check["verdict"] == "another fits better")
    assert check["advice"].split(":")[0] in RUNNER.invoke(app, arguments).stdout


def test_listing_still_needs_no_subcommand(models: Path) -> None:
    result = RUNNER.invoke(app, ["models", "--models", str(models), "--json"])
    states = {name: card["state"] for name, card in json.loads(result.stdout)["cards"].items()}
    assert states["toy"] == "present" and states["gone"] == "absent"


@pytest.mark.parametrize(
    "card, image, error, complaint",
    [
        ("nobody", "noise.png", ConfigError, "no model card"),
        ("gone", "noise.png", ModelError, "no gone.onnx in .*make it"),
        ("toy", "none.png", ConfigError, "cannot be read as a picture"),
        ("toy", "toy.toml", ConfigError, "neither a picture nor a video"),
    ],
)
def test_what_is_missing_is_named(models: Path, card: str, image: str, error: type[Exception], complaint: str) -> None:
    result = RUNNER.invoke(app, ["models", "check", card, "--models", str(models), "--image", str(models / image)])
    assert isinstance(result.exception, error)
    with pytest.raises(error, match=complaint):
        raise result.exception


def test_a_video_gives_ten_frames_in_colour(real_data: Path) -> None:
    images = read_images([real_data / "solidWhiteRight.mp4"])
    assert len(images) == 10 and all(image.shape == (540, 960, 3) for image in images)
    assert not (images[0] == images[5]).all()
