"""``animatic models check`` on the command line."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from onnx_fixtures import random_simcc, simcc_card
from pipeline_fixtures import write_detector
from typer.testing import CliRunner

from dataset.street import Street, StreetConfig
from labeling.errors import ConfigError, ModelError
from labeling.model_cards import write_card
from pipelines.cli import app
from pipelines.model_check import read_images

RUNNER = CliRunner()


@pytest.fixture
def models(tmp_path: Path) -> Path:
    """A folder with one card and its weights, and a card whose weights are missing."""
    write_detector(tmp_path, name="toy")
    write_card(simcc_card(name="gone", file="gone.onnx"), tmp_path / "gone.toml")
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


@pytest.mark.parametrize("card", ["street_coco17", "street_car24"])
def test_heads_that_are_right_are_not_condemned_on_whole_pictures(tmp_path: Path, card: str) -> None:
    """Their objects are small in the picture: they are looked at in the boxes that the street's detector finds."""
    frame = Street(StreetConfig(seed=2, scenario="traffic", frames=30)).render(5).rgb
    cv2.imwrite(str(tmp_path / "street.png"), frame[:, :, ::-1])
    result = RUNNER.invoke(app, ["models", "check", card, "--image", str(tmp_path / "street.png")])
    assert result.exit_code == 0, result.output


def test_a_head_without_a_box_to_look_at_says_so(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((64, 64, 3), np.uint8))
    arguments = ["models", "check", "street_coco17", "--image", str(tmp_path / "black.png")]
    assert "finds none in the pictures" in str(RUNNER.invoke(app, arguments).exception)
    write_card(simcc_card(), tmp_path / "head.toml")
    random_simcc(tmp_path / "head.onnx", points=17, width=64, height=96)
    arguments = ["models", "check", "head", "--models", str(tmp_path), "--image", str(tmp_path / "black.png")]
    assert "no detector's weights are there" in str(RUNNER.invoke(app, arguments).exception)
