"""The detector's second look: where it looks, what it is told, what it learns, and the graph that it becomes."""

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from labeling.detection import decode_yolox, grid_cells, letterbox
from labeling.model_cards import YoloxCard
from labeling.schemas import Category
from pipelines.model_variants import resized_detector
from training.street_augment import AugmentSettings
from training.street_batches import DetectorBatches, Windows, to_input
from training.street_export import export_model
from training.street_losses import MINOR, match_candidates, second_look_loss
from training.street_networks import FirstLook
from training.street_pool import PICTURE_SCALE, PICTURE_SIZE, ObjectTruth, PoolFrame, StreetPool
from training.street_second_look import (
    OBJECTS,
    Candidates,
    SecondLook,
    SecondScores,
    TwoLookDetector,
    TwoLookGraph,
    _relations,
    best_candidates,
    sample_boxes,
)
from training.street_targets import encode_boxes

WIDTH, HEIGHT = 256, 192
CARD = YoloxCard(
    name="toy", file="toy.onnx", licence="", source="", classes=("car", "person"), categories={"car": "car"},
    input_width=WIDTH, input_height=HEIGHT, nms_threshold=1.0, mean=(128.0, 128.0, 128.0),
    std=(64.0, 64.0, 64.0),
)  # fmt: skip


def first_look(boxes: np.ndarray, scores: list[float], classes: list[int] | None = None) -> FirstLook:
    """A first look at 256x192 pixels that claims the boxes with the scores, and nothing else."""
    cells, strides = grid_cells(WIDTH, HEIGHT)
    rows = np.full((len(cells), 7), -9.0, np.float32)
    for index, (box, score) in enumerate(zip(boxes, scores, strict=True)):
        label = (classes or [0] * len(boxes))[index]
        target = encode_boxes(box[None], np.array([label]), np.ones(1, bool), width=WIDTH, height=HEIGHT)
        (at,) = np.flatnonzero(target.classes >= 0)
        assert rows[at, 4] == -9.0, "two boxes in one cell"
        rows[at, :2] = (box[:2] + box[2:]) / 2 / strides[at] - cells[at]
        rows[at, 2:4] = np.log((box[2:] - box[:2]) / strides[at])
        rows[at, 4], rows[at, 5 + label] = np.log(score / (1 - score)), 9.0
    return FirstLook(
        rows=torch.from_numpy(rows)[None], cell_features=torch.zeros(1, 8, len(cells)),
        fine=torch.zeros(1, 4, HEIGHT // 4, WIDTH // 4), coarse=torch.zeros(1, 8, HEIGHT // 8, WIDTH // 8),
    )  # fmt: skip


def score_left(found: Candidates, box: np.ndarray) -> float:
    """Of the candidate with the box; 0 where there is none."""
    same = (found.boxes_xyxy[0] - torch.from_numpy(box)).abs().amax(dim=1) < 1e-3
    return float((found.softened[0].exp() * same).sum())


def candidates(boxes: list[list[float]]) -> Candidates:
    count = len(boxes)
    return Candidates(
        index=torch.arange(count)[None], rows=torch.zeros(1, count, 7), boxes_xyxy=torch.tensor([boxes]),
        strides=torch.full((1, count), 8.0), softened=torch.zeros(1, count),
    )  # fmt: skip


def test_candidates_are_the_best_cells_and_what_a_better_one_claims_too_is_cleared() -> None:
    boxes = np.array(
        [[20, 20, 59, 50], [28, 20, 67, 50], [44, 20, 83, 50], [150, 100, 189, 130], [150, 108, 189, 138]], np.float32
    )
    found = best_candidates(first_look(boxes, [0.9, 0.8, 0.7, 0.6, 0.5], [0, 0, 0, 0, 1]))
    assert found.index.shape == (1, OBJECTS)
    left = [score_left(found, box) for box in boxes]
    # The second is the first's double; the third overlaps the first by less, and the second no longer counts; a person
    # is no double of a car.
    assert left[1] < 1e-4
    overlap = 15 / (78 - 15)
    assert left[2] == pytest.approx(0.7 * min(np.exp(-(overlap**2) / 0.4), 1 - 0.4 * 15 / 39), rel=1e-2)
    np.testing.assert_allclose([left[0], left[3], left[4]], [0.9, 0.6, 0.5], rtol=1e-2)


def test_doubles_of_what_is_cleared_stay() -> None:
    """As one after the other would do it: the best clears the second, which can no longer clear the third."""
    boxes = np.array([[20, 20, 59, 50], [28, 20, 67, 50], [36, 20, 75, 50]], np.float32)
    found = best_candidates(first_look(boxes, [0.9, 0.8, 0.7]))
    left = [score_left(found, box) for box in boxes]
    assert left[0] > 0.85 and left[1] < 1e-4 and left[2] > 0.4


def test_features_are_sampled_where_the_box_is() -> None:
    """On a plane of slopes, linear sampling is exact: cell i lies at input pixel 4 i."""
    y, x = torch.meshgrid(torch.arange(12.0), torch.arange(16.0), indexing="ij")
    sampled = sample_boxes(torch.stack([4 * x, 4 * y])[None], torch.tensor([[[8.0, 4.0, 24.0, 40.0]]]), 4)
    assert sampled.shape == (1, 1, 24, 2)
    wide, high = 8 + 16 * (np.arange(4) + 0.5) / 4, 4 + 36 * (np.arange(6) + 0.5) / 6
    np.testing.assert_allclose(sampled[0, 0, :, 0].reshape(6, 4), np.tile(wide, (6, 1)), atol=1e-4)
    np.testing.assert_allclose(sampled[0, 0, :, 1].reshape(6, 4), np.tile(high[:, None], (1, 4)), atol=1e-4)


def test_how_candidates_stand_to_one_another_is_what_the_shipped_weights_learnt() -> None:
    """Order and signs: a graph exported with others would judge by nonsense."""
    found = candidates([[20, 20, 60, 80], [40, 20, 60, 50], [200, 100, 240, 160]])
    values, near = _relations(replace(found, softened=torch.tensor([[-1.0, -3.0, -1.0]])))
    # Half as wide and high, a quarter of the area, wholly inside: 10 px right and 15 px up of a middle, of 40 by 60.
    ln2 = float(np.log(2))
    wanted = [0.25, 0.25, 1, 0, 1, 1, 0.5, -0.25, 0.25, ln2, ln2, -1, -1 / 3]
    back = [0.25, 1, 0.25, 0, -1, 0, 0.5, 0.5, -0.5, -ln2, -ln2, -1 / 3, -1]
    np.testing.assert_allclose(values[0, 0, 1], wanted, atol=1e-6)
    np.testing.assert_allclose(values[0, 1, 0], back, atol=1e-6)
    np.testing.assert_array_equal(near[0], [[0, 1, 0], [1, 0, 0], [0, 0, 0]])


def test_an_untrained_second_look_says_what_the_first_did() -> None:
    torch.manual_seed(0)
    look = first_look(np.array([[20, 20, 59, 50], [150, 100, 189, 130]], np.float32), [0.9, 0.3], [0, 1])
    found = best_candidates(look)
    scores = SecondLook(2, fine=4, pyramid=8).eval()(found, look).sigmoid()
    np.testing.assert_allclose(scores[0, :2].detach(), [[0.9, 0], [0, 0.3]], atol=2e-3)


def test_each_object_is_chosen_once_and_the_best_candidate_chooses_first() -> None:
    overlap = torch.tensor([[[0.9, 0.0], [0.8, 0.5], [0.7, 0.45], [0.0, 0.3]]])
    assert match_candidates(torch.tensor([[0.1, 0.9, 0.5, 0.8]]), overlap).tolist() == [[-1, 0, 1, -1]]
    assert match_candidates(torch.tensor([[0.9, 0.8, 0.7, 0.1]]), overlap).tolist() == [[0, 1, -1, -1]]


def test_the_second_loss_asks_for_one_candidate_of_each_judged_object() -> None:
    boxes = [[20.0, 20, 60, 80], [22, 20, 62, 80], [100, 20, 140, 80], [200, 20, 240, 80], [200, 20, 210, 30],
             [105, 25, 130, 55]]  # fmt: skip
    truth = torch.tensor([[[20.0, 20, 60, 80], [100, 20, 140, 80], [0, 0, 0, 0]]])
    classes, importance = torch.tensor([[0, 1, -1]]), torch.tensor([[1.0, 0.0, 0.0]])

    sure, no = 9.0, -9.0
    nothing = (no, no)

    def loss(*logits: tuple[float, float]) -> float:
        padded = [*logits, *[nothing] * (len(boxes) - len(logits))]
        look = SecondScores(candidates=candidates(boxes), logits=torch.tensor([padded]))
        return float(second_look_loss(look, truth, classes, importance, size=(WIDTH, HEIGHT), low_px=23.0))

    right = loss((sure, no), nothing, nothing, nothing, nothing)
    assert right < 0.01
    # Either of two doubles will do, but not both, and not neither.
    assert loss(nothing, (sure, no), nothing, nothing, nothing) == pytest.approx(right, abs=1e-5)
    assert loss((sure, no), (sure - 1, no), nothing, nothing, nothing) > 7
    assert loss(nothing, nothing, nothing, nothing, nothing) > 8
    # The person who is not judged may be found or not, but is no car; what is low costs less than what is high.
    assert loss((sure, no), nothing, (no, sure), nothing, nothing) == pytest.approx(right, abs=1e-3)
    assert loss((sure, no), nothing, (sure, no), nothing, nothing) > 8
    # Nor is what lies within that person a mistake, unless it is called a car.
    part = loss((sure, no), nothing, (no, sure), nothing, nothing, (no, sure - 1))
    assert part == pytest.approx(right, abs=1e-3)
    assert loss((sure, no), nothing, (no, sure), nothing, nothing, (sure - 1, no)) > 7
    high = loss((sure, no), nothing, nothing, (sure, no), nothing)
    low = loss((sure, no), nothing, nothing, nothing, (sure, no))
    assert low - right == pytest.approx(MINOR * (high - right), rel=1e-3)


def thing(box: list[float], *, share: float = 1.0, category: Category = "car") -> ObjectTruth:
    return ObjectTruth(
        category=category, box_xyxy=np.array(box, np.float32), points_xy=np.zeros((24, 2), np.float32),
        visible=np.ones(24, bool), visible_share=share,
    )  # fmt: skip


def test_batches_tell_which_objects_are_judged() -> None:
    objects = (
        thing([100, 100, 200, 140]), thing([300, 100, 400, 140], share=0.25), thing([500, 100, 600, 128]),
        thing([700, 100, 800, 112]), thing([800, 300, 900, 400], share=0.1),
        thing([400, 400, 440, 500], category="person"), thing([0, 600, 1056, 700], category="lane"),
    )  # fmt: skip
    picture = np.zeros((PICTURE_SIZE[1], PICTURE_SIZE[0], 3), np.uint8)
    picture[300:350, 300:310] = 255
    frame = PoolFrame(picture=picture, scale=PICTURE_SCALE, objects=objects)
    pool = StreetPool(frames=(frame,), crops={"car": (), "person": (), "lane": ()})
    whole = Windows(width=PICTURE_SIZE[0], height=PICTURE_SIZE[1], count=8)
    batches = DetectorBatches(pool=pool, windows=(whole,), augment=AugmentSettings(), plain_share=1.0)
    batch = batches(np.random.default_rng(0))
    *grids, boxes, classes, importance = batch.targets
    assert [tensor.shape[0] for tensor in batch.targets] == [8] * 6 and len(grids) == 3
    np.testing.assert_array_equal(classes, np.tile([0, 0, 0, 0, 0, 1], (8, 1)))
    np.testing.assert_allclose(importance, np.tile([1, 0.5, 0.5, MINOR, 0, 1], (8, 1)))
    width = PICTURE_SIZE[0]
    mirrored = boxes[:, 5, 0] > width / 2
    assert 0 < mirrored.sum() < 8
    plain = objects[5].box_xyxy * PICTURE_SCALE
    for flipped, box, shown in zip(mirrored, boxes[:, 5], batch.pictures, strict=True):
        wanted = [width - plain[2], plain[1], width - plain[0], plain[3]] if flipped else plain
        np.testing.assert_allclose(box, wanted, atol=1.01)
        # The white thing in the picture goes where its box would go.
        left = int(np.flatnonzero(shown[310, :, 0])[0])
        assert left == (width - 310 if flipped else 300)
    # Of two kinds of windows each is drawn as often as its share says; what lies outside is not there.
    sky = Windows(width=PICTURE_SIZE[0], height=64, count=2, share=3.0)
    drawn = [replace(batches, windows=(whole, sky))(np.random.default_rng(seed)) for seed in range(40)]
    assert 20 < sum(len(one.pictures) == 2 for one in drawn) < 40
    assert all((one.targets[3][..., 3] <= 64).all() for one in drawn if len(one.pictures) == 2)
    # A moved and disturbed picture has its boxes inside.
    moved = replace(batches, plain_share=0.0)(np.random.default_rng(1))
    there = moved.targets[4] >= 0
    assert (moved.targets[3][there] >= 0).all() and (moved.targets[3][there] <= width).all()


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[TwoLookDetector, YoloxCard, Path]:
    """A detector whose second look disagrees with its first, and its graph."""
    torch.manual_seed(1)
    network = TwoLookDetector(2).eval()
    torch.nn.init.normal_(network.second.score.weight, std=0.5)
    torch.nn.init.constant_(network.second.score.bias, 8.0)
    for listen in network.second.neighbours:
        torch.nn.init.normal_(listen.taken_in.weight, std=0.2)  # type: ignore[union-attr]
    # Weights that half precision holds: a candidate more or less would make all the difference.
    network = network.half().float()
    folder = tmp_path_factory.mktemp("model")
    return network, export_model(TwoLookGraph(network), CARD, folder), folder  # type: ignore[return-value]


def run_graph(path: Path, pictures: torch.Tensor) -> np.ndarray:
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    return np.asarray(session.run(None, {"input": pictures.numpy()})[0])


def test_the_graph_scores_candidates_and_nothing_else(exported) -> None:
    network, card, folder = exported
    pictures = torch.rand(2, 3, HEIGHT, WIDTH) * 4 - 2
    rows = run_graph(folder / card.file, pictures)
    with torch.no_grad():
        first, second = network(pictures)
    assert ((rows[..., 4] > 0).sum(axis=1) <= OBJECTS).all()
    scores = rows[..., 4:5] * rows[..., 5:]
    assert (scores > 0.2).any()
    for picture in range(2):
        np.testing.assert_allclose(
            scores[picture, second.candidates.index[picture]], second.logits[picture].sigmoid(), atol=0.02
        )
        np.testing.assert_allclose(rows[picture, :, :4], first.rows[picture, :, :4], atol=0.02)
    found = decode_yolox(rows[0], card, ratio=1.0, width=WIDTH, height=HEIGHT)
    assert len(found) == (scores[0] > card.score_threshold).sum()


def test_training_and_labelling_make_the_same_of_a_picture(exported) -> None:
    card = exported[1]
    picture = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    given, ratio = letterbox(picture, card)
    wanted = to_input(torch.from_numpy(picture)[None], card)[0]
    assert ratio == 1 and np.array_equal(given, wanted.numpy())
    assert np.array_equal(given, (picture[..., ::-1].transpose(2, 0, 1) - np.float32(128)) / np.float32(64))


def test_the_graph_keeps_to_the_size_of_its_picture(exported, tmp_path: Path, monkeypatch) -> None:
    network, card, folder = exported
    monkeypatch.setattr("pipelines.model_variants.find_weights", lambda card: folder / card.file)
    larger = resized_detector(card, tmp_path, width=320, height=224)
    pictures = torch.rand(1, 3, 224, 320) * 4 - 2
    rows = run_graph(tmp_path / larger.file, pictures)
    with torch.no_grad():
        np.testing.assert_allclose(rows, TwoLookGraph(network)(pictures), atol=0.05)


def test_a_picture_of_nothing_at_all_gives_nothing_and_no_nan(exported, tmp_path: Path) -> None:
    """Logits of -200, whose sigmoid is 0 in float32."""
    network = copy.deepcopy(exported[0])
    with torch.no_grad():
        network.first.head.weight[4:] = 0
        network.first.head.bias[4:] = -200.0
        network.second.score.bias.zero_()
    card = export_model(TwoLookGraph(network), CARD, tmp_path)
    rows = run_graph(tmp_path / card.file, torch.full((1, 3, HEIGHT, WIDTH), 114.0))
    assert np.isfinite(rows).all() and not rows[..., 4:].any()


def test_inner_names_are_short_and_weights_keep_theirs(exported) -> None:
    _, card, folder = exported
    graph = onnx.load(str(folder / card.file)).graph
    assert "network.first.trunk.stem.0.weight" in {name for node in graph.node for name in node.output}
    assert [value.name for value in graph.output] == ["output"]
    inner = {name for node in graph.node if node.op_type != "Cast" for name in node.output} - {"output"}
    assert max(len(name) for name in inner) <= 6
