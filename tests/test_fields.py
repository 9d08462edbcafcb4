"""CIF/CAF decoding against its plain reference, and against planted objects whose points are known."""

from pathlib import Path

import numpy as np
import onnx_fixtures
import pytest
from field_fixtures import PlantedFields, car_objects, lane_objects, plant, random_fields
from field_reference import PlainDecoder

from labeling import field_growth
from labeling.errors import ModelError
from labeling.fields import FieldDecoder, FieldModel, object_scores, padded_input
from labeling.model_cards import CifcafCard, FieldHeadCard
from labeling.schemas import keypoint_schema

LANE_HEAD = FieldHeadCard(schema="lane24", point_threshold=0.3, instance_threshold=0.2, min_points=4)
CAR_HEAD = FieldHeadCard(schema="car66")


def assert_same(found: list, wanted: list) -> None:
    assert len(found) == len(wanted)
    for (points, score), (plain_points, plain_score) in zip(found, wanted, strict=True):
        assert score == pytest.approx(plain_score, abs=1e-5)
        # Coordinates are float32 of up to 1,000 px, whose last place is 6e-5.
        np.testing.assert_allclose(points, plain_points, rtol=1e-6, atol=1e-5)


def planted_street(seed: int) -> tuple[PlantedFields, PlantedFields]:
    """20 overlapping cars with hidden points and 6 lanes at the full size, 1056x704."""
    rng = np.random.default_rng(seed)
    cars = car_objects(rng, 20, schema="car66", width=1056, height=704)
    lanes = lane_objects(6, width=1056, height=704)
    return (
        plant(cars, rng.uniform(1, 4, 20), schema="car66", height=89, width=133, seed=seed),
        plant(lanes, rng.uniform(1, 4, 6), schema="lane24", height=89, width=133, seed=seed),
    )


@pytest.mark.parametrize("schema", ["car24", "lane24", "coco17"])
@pytest.mark.parametrize("share", [0.05, 0.3, 0.8], ids=lambda share: f"{share:.0%}")
@pytest.mark.parametrize("seed", range(4))
def test_random_fields_decode_as_the_plain_reference(schema: str, share: float, seed: int) -> None:
    cif, caf = random_fields(seed, schema=schema, height=7, width=9, share=share)
    head = FieldHeadCard(schema=schema)
    assert_same(
        FieldDecoder(head, stride=8).decode(cif, caf),
        PlainDecoder(head, stride=8).decode(cif, caf),
    )


@pytest.mark.parametrize("seed", range(2))
def test_planted_full_size_fields_decode_as_the_plain_reference(seed: int) -> None:
    cars, lanes = planted_street(seed)
    for planted, head in ((cars, CAR_HEAD), (lanes, LANE_HEAD)):
        found = FieldDecoder(head, stride=8).decode(planted.cif, planted.caf)
        assert_same(found, PlainDecoder(head, stride=8).decode(planted.cif, planted.caf))
        assert len(found) >= 0.8 * len(planted.objects)


def test_the_lazy_map_equals_a_dense_sum() -> None:
    cif, _ = random_fields(5, schema="car24", height=12, width=15, share=0.5)
    plain = PlainDecoder(FieldHeadCard(schema="car24"), stride=8)
    plain.cells = [plain._cells(field) for field in cif]
    cells = field_growth.gather_cells(cif, 0.3, 8.0)
    index = field_growth.index_map(cells, len(cif), 15 * 8.0, 12 * 8.0)
    rng = np.random.default_rng(0)
    for x, y in rng.uniform(-20, 140, (200, 2)):
        k = int(rng.integers(24))
        assert field_growth.read_map(index, k, x, y) == pytest.approx(plain.map_value(k, x, y), abs=1e-12)


@pytest.mark.parametrize("sigma_cells", [0.5, 3, 12, 60, 400], ids=lambda scale: f"scale-{scale}")
def test_every_size_of_gaussian_is_found(sigma_cells: float) -> None:
    cif = np.zeros((24, 5, 89, 133), np.float32)
    cif[7, 1:, 40, 60] = 0.8, 60.0, 40.0, sigma_cells
    cells = field_growth.gather_cells(cif, 0.3, 8.0)
    index = field_growth.index_map(cells, 24, 1064.0, 712.0)
    sigma = max(1.0, 4.0 * sigma_cells)
    for x, y, inside in ((480, 320, True), (480 + 0.99 * sigma, 320, True), (480, 320 + 1.01 * sigma, False)):
        wanted = 0.05 * np.exp(-0.5 * ((x - 480) ** 2 + (y - 320) ** 2) / sigma**2) if inside else 0
        assert field_growth.read_map(index, 7, x, y) == pytest.approx(wanted, abs=1e-8)
    assert field_growth.read_map(index, 6, 480.0, 320.0) == 0


def test_the_map_is_clipped_at_one() -> None:
    cif = np.zeros((24, 5, 6, 6), np.float32)
    cif[0, 1:] = np.array([1, 3, 3, 2], np.float32)[:, None, None]
    cells = field_growth.gather_cells(cif, 0.3, 8.0)
    assert field_growth.read_map(field_growth.index_map(cells, 24, 48.0, 48.0), 0, 24.0, 24.0) == 1


def test_planted_points_come_back_where_they_were() -> None:
    # Apart from one another, so that none hides a part of another.
    template = np.random.default_rng(3).uniform(-60, 60, (66, 2))
    objects = np.ones((4, 66, 3))
    objects[:, :, :2] = template + np.array([[150, 150], [500, 160], [200, 500], [800, 450]])[:, None]
    planted = plant(objects, np.full(4, 2.0), schema="car66", height=89, width=133)
    found = FieldDecoder(CAR_HEAD, stride=8).decode(planted.cif, planted.caf)
    assert len(found) == 4
    for points, _ in found:
        centre = points[:, :2].mean(axis=0)
        truth = objects[np.argmin(np.linalg.norm(objects[:, :, :2].mean(axis=1) - centre, axis=1))]
        assert (points[:, 2] > 0).mean() > 0.95
        errors = np.linalg.norm(points[:, :2] - truth[:, :2], axis=1)[points[:, 2] > 0]
        assert np.median(errors) < 0.5 and errors.max() < 3


def test_hidden_points_stay_absent() -> None:
    objects = car_objects(np.random.default_rng(1), 1, schema="car66", width=600, height=500)
    planted = plant(objects, np.array([2.0]), schema="car66", height=64, width=77)
    ((points, _),) = FieldDecoder(CAR_HEAD, stride=8).decode(planted.cif, planted.caf)
    assert not (points[:, 2] > 0)[objects[0, :, 2] == 0].any()


def test_two_crossing_lanes_stay_two() -> None:
    objects = np.ones((2, 24, 3))
    along = np.linspace(0, 1, 24)
    objects[0, :, 0], objects[0, :, 1] = 100 + 400 * along, 500 - 400 * along
    objects[1, :, 0], objects[1, :, 1] = 500 - 400 * along, 520 - 400 * along
    planted = plant(objects, np.array([1.5, 1.5]), schema="lane24", height=70, width=70)
    found = FieldDecoder(LANE_HEAD, stride=8).decode(planted.cif, planted.caf)
    assert len(found) == 2
    starts = sorted(points[points[:, 2] > 0][0, 0] for points, _ in found)
    assert starts[0] == pytest.approx(100, abs=3) and starts[1] == pytest.approx(500, abs=3)


@pytest.mark.parametrize("visible, kept", [(3, False), (4, True), (24, True)])
def test_a_lane_needs_four_connected_points(visible: int, kept: bool) -> None:
    objects = lane_objects(1, width=500, height=500)
    objects[0, visible:, 2] = 0
    planted = plant(objects, np.array([2.0]), schema="lane24", height=64, width=64)
    head = LANE_HEAD.model_copy(update={"instance_threshold": 0.1})
    assert len(FieldDecoder(head, stride=8).decode(planted.cif, planted.caf)) == kept


def test_components_count_joined_points_only() -> None:
    edges = np.array(keypoint_schema("lane24").edges)
    present = np.zeros(24, bool)
    present[[0, 1, 2, 5, 6, 7, 8, 20]] = True
    assert field_growth.largest_component(present, edges) == 4
    assert field_growth.largest_component(np.zeros(24, bool), edges) == 0


def test_empty_fields_hold_nothing() -> None:
    fields = np.zeros((66, 5, 89, 133), np.float32), np.zeros((108, 8, 89, 133), np.float32)
    assert FieldDecoder(CAR_HEAD, stride=8).decode(*fields) == []


def test_a_frame_of_noise_ends_at_the_cap() -> None:
    cif, caf = random_fields(0, schema="car24", height=45, width=67, share=0.9)
    head = FieldHeadCard(schema="car24", max_objects=30, seed_threshold=0.05, instance_threshold=0.0)
    decoder = FieldDecoder(head, stride=8)
    assert 0 < len(decoder.decode(cif, caf)) <= 30
    first = decoder.left_out
    assert first > 0, "and it is said"
    decoder.decode(cif, caf)
    assert decoder.left_out == 2 * first
    roomy = FieldDecoder(head.model_copy(update={"max_objects": 5000}), stride=8)
    roomy.decode(cif, caf)
    assert roomy.left_out == 0


def test_object_scores_count_the_best_three_thrice() -> None:
    scores = np.zeros((1, 24))
    scores[0, :4] = 0.9, 0.6, 0.3, 0.2
    assert object_scores(scores)[0] == pytest.approx((3 * 1.8 + 0.2) / 30)
    assert object_scores(np.ones((1, 66)))[0] == pytest.approx(1)


def field_card(**changes: object) -> CifcafCard:
    values = {
        "name": "toy", "file": "toy.onnx", "input_width": 129, "input_height": 97, "licence": "none",
        "source": "a test",
        "heads": ({"schema": "car24", "cif": "cif_car", "caf": "caf_car"}, {"schema": "lane24"}), **changes,
    }  # fmt: skip
    return CifcafCard.model_validate(values)


def test_a_card_has_one_head_of_a_category() -> None:
    """A track that met two schemas would have points of two kinds."""
    heads = [{"schema": name, "cif": f"{name}_cif", "caf": f"{name}_caf"} for name in ("car24", "car66")]
    with pytest.raises(ValueError, match="two heads give the same category.*leave one of them out"):
        field_card(heads=heads)


def test_one_network_serves_cars_and_lanes(tmp_path: Path) -> None:
    card = field_card()
    cars = plant(
        car_objects(np.random.default_rng(2), 1, schema="car24", width=128, height=96), np.array([1.0]),
        schema="car24", height=13, width=17,
    )  # fmt: skip
    lanes = plant(lane_objects(1, width=128, height=96), np.array([0.6]), schema="lane24", height=13, width=17)
    outputs = {"cif_car": cars.cif, "caf_car": cars.caf, "cif": lanes.cif, "caf": lanes.caf}
    path = onnx_fixtures.constant_model(tmp_path / "toy.onnx", card, outputs)
    frames = [np.zeros((192, 256, 3), np.uint8)] * 5
    found = FieldModel(card, path).estimate(frames, first_frame=10)
    assert [objects[0].frame for objects in found] == [10, 11, 12, 13, 14]
    assert {one.category for one in found[0]} == {"car", "lane"}
    car = next(one for one in found[0] if one.category == "car")
    present = car.present & (cars.objects[0, :, 2] > 0)
    # The frame is twice the network's size; pixel centres lie on integers in both.
    errors = np.abs(car.points[present, :2] - (cars.objects[0, present, :2] * 2 + 0.5))
    assert np.median(errors) < 0.5
    assert (car.point_source == car.present).all()


@pytest.mark.parametrize("size", [(96, 128), (192, 256), (96, 64), (540, 960)], ids=str)
def test_padding_is_right_and_bottom_in_the_mean_colour(size: tuple[int, int]) -> None:
    frame, batch = np.full((*size, 3), 255, np.uint8), np.full((2, 3, 97, 129), np.nan, np.float32)
    planes, ratio = padded_input(frame, field_card())
    height, width = round(size[0] * ratio), round(size[1] * ratio)
    # Where a batch is waiting, nothing of it is left, and nothing beside it is touched.
    padded_input(frame, field_card(), out=batch[1])
    np.testing.assert_array_equal(batch[1], planes)
    assert np.isnan(batch[0]).all()
    assert planes.shape == (3, 97, 129) and width <= 128 and height <= 96
    assert planes[:, :height, :width].min() > 2 and not planes[:, height:].any() and not planes[:, :, width:].any()


def test_nan_in_a_field_is_an_error(tmp_path: Path) -> None:
    card = field_card(heads=({"schema": "lane24"},))
    fields = random_fields(0, schema="lane24", height=13, width=17)
    fields[0][3, 2, 5, 5] = np.nan
    path = onnx_fixtures.constant_model(tmp_path / "toy.onnx", card, {"cif": fields[0], "caf": fields[1]})
    with pytest.raises(ModelError, match="NaN"):
        FieldModel(card, path).estimate([np.zeros((96, 128, 3), np.uint8)])
