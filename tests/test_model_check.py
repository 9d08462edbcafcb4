"""A wrong card is caught on a picture: planted networks that see only what they were made to see."""

from pathlib import Path

import cv2
import numpy as np
import onnx_fixtures
import pytest
from field_fixtures import lane_objects, plant
from onnx import helper

from labeling.errors import ModelError
from labeling.model_cards import IMAGENET_MEAN, IMAGENET_STD, CifcafCard, ModelCard, SimccCard, YoloxCard, load_cards
from labeling.model_check import CardCheck, check_card

PLAIN = {"mean": (0, 0, 0), "std": (1, 1, 1)}
UNIT = {"mean": (0, 0, 0), "std": (255, 255, 255)}
IMAGENET = {"mean": IMAGENET_MEAN, "std": IMAGENET_STD}
BLUE = np.full((64, 64, 3), (20, 60, 220), np.uint8)


def toy_card(**changes: object) -> YoloxCard:
    values = {
        "name": "toy", "file": "toy.onnx", "input_width": 64, "input_height": 64, "licence": "none", "source": "-",
        "classes": ("car",), "categories": {"car": "car"}, **changes,
    }  # fmt: skip
    return YoloxCard.model_validate(values)


def blue_seeker(path: Path, card: ModelCard, *, logits: bool = False) -> Path:
    """A detector fed as ``card`` says: one car whose score is 1 if the mean colour is blue's, less the farther off."""
    order = [2, 1, 0] if card.channel_order == "bgr" else [0, 1, 2]
    wanted = (np.array([20.0, 60.0, 220.0])[order] - card.mean) / card.std
    boxes = np.zeros((84, 4), np.float32)
    boxes[:, 2:] = 1
    mask = np.zeros((84, 2), np.float32)
    mask[10] = 1
    weights = {
        "wanted": wanted[None].astype(np.float32), "boxes": boxes[None],
        "sharp": np.array([-4 / np.ptp(wanted)], np.float32),
        "mask": mask[None], "rows": np.array([-1, 1, 1]), "none": np.zeros((1,), np.float32),
    }  # fmt: skip
    nodes = [
        helper.make_node("ReduceMean", ["images"], ["colour"], axes=[2, 3], keepdims=0),
        helper.make_node("Sub", ["colour", "wanted"], ["difference"]),
        helper.make_node("Abs", ["difference"], ["apart"]),
        helper.make_node("ReduceMean", ["apart"], ["distance"], axes=[1], keepdims=0),
        helper.make_node("Mul", ["distance", "sharp"], ["falling"]),
        helper.make_node("Exp", ["falling"], ["score"]),
        helper.make_node("Reshape", ["score", "rows"], ["scores"]),
        helper.make_node("Mul", ["scores", "mask"], ["confidences"]),
        helper.make_node("Mul", ["scores", "none"], ["zero"]),
        helper.make_node("Add", ["zero", "boxes"], ["all_boxes"]),
    ]
    last = "confidences"
    if logits:
        weights |= {"gain": np.array([12], np.float32), "offset": np.array([-6], np.float32)}
        nodes += [
            helper.make_node("Mul", ["confidences", "gain"], ["gained"]),
            helper.make_node("Add", ["gained", "offset"], ["logits"]),
        ]
        last = "logits"
    nodes.append(helper.make_node("Concat", ["all_boxes", last], ["output"], axis=2))
    inputs, outputs = {"images": ["n", 3, 64, 64]}, {"output": ["n", 84, 6]}
    return onnx_fixtures.save_graph(path, nodes, inputs=inputs, outputs=outputs, weights=weights)


@pytest.mark.parametrize("truth", [PLAIN, UNIT, IMAGENET], ids=["0-255", "0-1", "imagenet"])
@pytest.mark.parametrize("order", ["rgb", "bgr"])
def test_the_right_card_fits_and_each_mistake_is_named(tmp_path: Path, truth: dict, order: str) -> None:
    right = toy_card(channel_order=order, **truth)
    path = blue_seeker(tmp_path / "toy.onnx", right)
    check = check_card(right, path, [BLUE])
    assert check.verdict == "fits" and check.variants[0].is_card and check.variants[0].objects == 1
    assert len(check.variants) == 6 and sum(result.is_card for result in check.variants) == 1
    for values in (PLAIN, UNIT, IMAGENET):
        for wrong_order in ("rgb", "bgr"):
            wrong = toy_card(channel_order=wrong_order, **values)
            if wrong != right:
                found = check_card(wrong, path, [BLUE])
                assert found.verdict == "another fits better" and found.variants[0].name == check.variants[0].name
                assert check.variants[0].name in found.advice


def test_a_normalisation_of_its_own_joins_the_comparison(tmp_path: Path) -> None:
    card = toy_card(mean=(100, 110, 120), std=(50, 60, 70))
    check = check_card(card, blue_seeker(tmp_path / "toy.onnx", card), [BLUE])
    assert len(check.variants) == 8 and check.verdict == "fits"


def test_logits_are_told_from_confidences(tmp_path: Path) -> None:
    card = toy_card()
    check = check_card(card, blue_seeker(tmp_path / "toy.onnx", card, logits=True), [BLUE])
    assert check.verdict == "another fits better" and "logits" in check.advice
    assert check.variants[0].name == "BGR, 0 to 255, sigmoid added" and not any(one.is_card for one in check.variants)


def test_a_picture_that_shows_nothing_decides_nothing(tmp_path: Path) -> None:
    card = toy_card()
    path = blue_seeker(tmp_path / "toy.onnx", card)
    for images in ([], [np.full((64, 64, 3), 120, np.uint8)]):
        check = check_card(card, path, images)
        assert check.verdict == "unclear" and "picture" in check.advice


def test_field_logits_are_told_too(tmp_path: Path) -> None:
    card = CifcafCard.model_validate(
        {"name": "f", "file": "f.onnx", "input_width": 129, "input_height": 97, "licence": "-", "source": "-",
         "heads": [{"schema": "lane24", "min_points": 4}]}
    )  # fmt: skip
    planted = plant(lane_objects(1, width=128, height=96), np.array([0.6]), schema="lane24", height=13, width=17)
    fields = {"cif": planted.cif.copy(), "caf": planted.caf.copy()}
    picture = np.zeros((96, 128, 3), np.uint8)
    check = check_card(card, onnx_fixtures.constant_model(tmp_path / "f.onnx", card, fields), [picture])
    assert check.variants[0].objects == 1 and not any(result.logits for result in check.variants)
    for field in fields.values():
        field[:, 1] = np.log(field[:, 1] + 1e-6) - np.log1p(-field[:, 1])
    check = check_card(card, onnx_fixtures.constant_model(tmp_path / "f.onnx", card, fields), [picture])
    assert check.variants[0].logits and check.variants[0].objects == 1 and check.verdict == "another fits better"


def test_heads_are_checked_on_their_boxes(tmp_path: Path) -> None:
    card = SimccCard.model_validate(
        {"name": "h", "file": "h.onnx", "schema": "coco17", "input_width": 64, "input_height": 96, "licence": "-",
         "source": "-"}
    )  # fmt: skip
    path = onnx_fixtures.random_simcc(tmp_path / "h.onnx", points=17, width=64, height=96)
    picture = np.random.default_rng(0).integers(0, 256, (200, 200, 3), dtype=np.uint8)
    check = check_card(card, path, [picture], boxes_xyxy=[np.array([[10, 10, 90, 150], [50, 50, 60, 90]])])
    assert {result.objects for result in check.variants} <= set(range(35)) and len(check.variants) == 6
    empty = check_card(card, path, [picture], boxes_xyxy=[np.zeros((0, 4))])
    assert all("boxes" in result.note for result in empty.variants) and empty.verdict == "unclear"


def test_a_broken_contract_is_an_error_before_any_comparison(tmp_path: Path) -> None:
    path = blue_seeker(tmp_path / "toy.onnx", toy_card())
    with pytest.raises(ModelError, match="84, 7"):
        check_card(toy_card(classes=("car", "van")), path, [BLUE])
    with pytest.raises(ModelError, match="uint8 RGB"):
        check_card(toy_card(), path, [BLUE.astype(np.float32)])


@pytest.mark.parametrize("bad", [np.nan, np.inf], ids=str)
@pytest.mark.parametrize("images", [[], [BLUE]], ids=["noise", "picture"])
def test_a_network_that_gives_no_numbers_fails(tmp_path: Path, bad: float, images: list[np.ndarray]) -> None:
    card = toy_card()
    path = onnx_fixtures.constant_model(tmp_path / "toy.onnx", card, {"output": np.full((84, 6), bad)})
    check = check_card(card, path, images)
    assert check.verdict == "fails" and "as its card says (BGR, 0 to 255), toy gave NaN or infinity" in check.advice


def test_a_network_that_gives_one_row_for_two_pictures_fails(tmp_path: Path) -> None:
    card = toy_card()
    check = check_card(card, onnx_fixtures.deaf_model(tmp_path / "toy.onnx", card, np.zeros((84, 6))), [BLUE])
    assert check.verdict == "fails" and "two pictures at once, toy gave [1, 84, 6]" in check.advice


def check_real(real_data: Path, **changes: object) -> CardCheck:
    capture = cv2.VideoCapture(str(real_data / "solidWhiteRight.mp4"))
    frames = [capture.read()[1][:, :, ::-1] for _ in range(61)]
    card = load_cards()["yolox_nano"].model_copy(update=changes)
    return check_card(card, real_data / "yolox_nano.onnx", [np.ascontiguousarray(frames[60])])


def test_the_real_detector_fits_its_card_and_a_normalised_one_does_not(real_data: Path) -> None:
    assert check_real(real_data).verdict == "fits"
    wrong = check_real(real_data, mean=IMAGENET_MEAN, std=IMAGENET_STD)
    assert wrong.verdict == "another fits better" and "BGR, 0 to 255" in wrong.advice
