"""Model cards and ONNX sessions: what is right works, and nothing that is wrong stays quiet."""

import hashlib
import os
from pathlib import Path

import numpy as np
import onnx
import onnx_fixtures
import pytest
from onnx import TensorProto, helper, numpy_helper
from onnx_fixtures import simcc_card
from pydantic import ValidationError

from labeling.errors import ModelError
from labeling.model_cards import (
    CifcafCard,
    FieldHeadCard,
    YoloxCard,
    file_sha256,
    find_weights,
    load_cards,
    read_card,
    weights_folders,
    weights_state,
    weights_without_card,
    write_card,
)
from labeling.onnx_files import check_external_data, check_file, weights_sha256
from labeling.onnx_model import OnnxModel, network_input, resolve_providers


@pytest.fixture
def head_path(tmp_path: Path) -> Path:
    return onnx_fixtures.random_simcc(tmp_path / "head.onnx", points=17, width=64, height=96)


def random_batch(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3, 96, 64)).astype(np.float32)


class TestCards:
    def test_every_shipped_card_is_valid_and_says_where_its_weights_come_from(self) -> None:
        cards = load_cards()
        real = {"yolox_l", "yolox_nano", "dw-ll_ucoco_384", "rtmpose_t", "rtmpose_s", "rtmpose_m"}
        assert real | {"apollo-66", "apollo-24", "lane-24"} <= set(cards)
        assert all(card.licence and card.source and card.output_shapes() for card in cards.values())
        assert list(cards) == sorted(cards)

    def test_shapes_are_the_published_ones(self) -> None:
        cards = load_cards()
        assert cards["yolox_nano"].output_shapes() == {"output": (None, 3549, 85)}
        assert cards["yolox_l"].output_shapes() == {"output": (None, 8400, 85)}
        assert cards["dw-ll_ucoco_384"].output_shapes() == {"simcc_x": (None, 133, 576), "simcc_y": (None, 133, 768)}
        assert cards["apollo-66"].output_shapes() == {"cif": (None, 66, 5, 89, 133), "caf": (None, 108, 8, 89, 133)}

    def test_writing_and_reading_gives_the_same_card(self, tmp_path: Path) -> None:
        cards = [*load_cards().values(), simcc_card(accuracy={"PCK@0.1": 0.97}, notes='says "hello"\\ and é\n')]
        for card in cards:
            write_card(card, tmp_path / "card.toml")
            assert read_card(tmp_path / "card.toml") == card

    @pytest.mark.parametrize(
        "line, complaint",
        [
            ("colour = 3", "colour"),
            ('kind = "yolo"', "kind"),
            ('schema = "cat9"', "cat9"),
            ("std = [1.0, 0.0, 1.0]", "std"),
            ('sha256 = "beef"', "sha256"),
            ('file = "../head.onnx"', "file"),
            ("input_width = -1", "input_width"),
            ("input_width = 640000000000", "input_width"),
            ("std = [1.0, nan, 1.0]", "std"),
            ("std = [1.0, inf, 1.0]", "std"),
            ("std = [1.0, 1e-320, 1.0]", "std must be 0.001 to"),
            ("mean = [nan, 0.0, 0.0]", "mean"),
            ("mean = [0.0, 0.0, -1e300]", "mean must be at most"),
            ("simcc_split = inf", "simcc_split"),
            ("simcc_split = 1e308", "simcc_split"),
            ("crop_padding = inf", "crop_padding"),
            pytest.param("input_width = 1" + "0" * 5000, "TOML", id="a number of 5001 digits"),
            pytest.param("notes = " + "[" * 5000, "TOML", id="lists in lists"),
            ("input_width", "TOML"),
        ],
    )
    def test_a_wrong_card_says_what_is_wrong(self, tmp_path: Path, line: str, complaint: str) -> None:
        write_card(simcc_card(), tmp_path / "card.toml")
        key = line.split(" ")[0]
        lines = [old for old in (tmp_path / "card.toml").read_text().splitlines() if not old.startswith(f"{key} =")]
        (tmp_path / "card.toml").write_text("\n".join([line, *lines]))
        with pytest.raises(ModelError, match=complaint):
            read_card(tmp_path / "card.toml")

    def test_classes_categories_and_sizes_must_agree(self) -> None:
        values = {"name": "d", "file": "d.onnx", "input_height": 64, "licence": "-", "source": "-", "classes": ("car",)}
        with pytest.raises(ValidationError, match="truck"):
            YoloxCard.model_validate({**values, "input_width": 64, "categories": {"truck": "car"}})
        with pytest.raises(ValidationError, match="multiple of 32"):
            YoloxCard.model_validate({**values, "input_width": 65, "categories": {}})
        fields = {"name": "f", "file": "f.onnx", "input_width": 1057, "licence": "-", "source": "-"}
        with pytest.raises(ValidationError, match="plus 1"):
            CifcafCard.model_validate({**fields, "input_height": 704, "heads": [{"schema": "car24"}]})
        with pytest.raises(ValidationError, match="same output"):
            heads = [{"schema": "car24"}, {"schema": "lane24"}]
            CifcafCard.model_validate({**fields, "input_height": 705, "heads": heads})

    def test_no_threshold_is_infinite_or_none(self) -> None:
        values = {
            "name": "d", "file": "d.onnx", "input_width": 64, "input_height": 64, "licence": "-", "source": "-",
            "classes": ("car",), "categories": {},
        }  # fmt: skip
        nan = float("nan")
        for wrong in ({"soft_nms": {"sigma": np.inf}}, {"score_threshold": nan}, {"score_thresholds": {"car": nan}}):
            with pytest.raises(ValidationError, match="finite"):
                YoloxCard.model_validate({**values, **wrong})
        with pytest.raises(ValidationError, match="point_threshold\n.*finite"):
            FieldHeadCard.model_validate({"schema": "car24", "point_threshold": nan})

    def test_cards_of_a_users_folder_join_and_must_not_clash(self, tmp_path: Path) -> None:
        write_card(simcc_card(name="mine"), tmp_path / "mine.toml")
        assert "mine" in load_cards(tmp_path) and "mine" not in load_cards()
        write_card(simcc_card(name="yolox_nano"), tmp_path / "mine.toml")
        with pytest.raises(ModelError, match="two model cards are called 'yolox_nano'"):
            load_cards(tmp_path)

    def test_weights_are_looked_for_in_the_folder_given_else_the_variable_else_the_cache(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        for name in ("given", "variable", "cache/animatic/models"):
            (tmp_path / name).mkdir(parents=True)
            (tmp_path / name / "head.onnx").write_bytes(name.encode())
        monkeypatch.setenv("ANIMATIC_MODELS", str(tmp_path / "variable"))
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        card = simcc_card()
        assert find_weights(card, tmp_path / "given") == tmp_path / "given" / "head.onnx"
        assert find_weights(card) == tmp_path / "variable" / "head.onnx"
        monkeypatch.delenv("ANIMATIC_MODELS")
        assert find_weights(card) == tmp_path / "cache/animatic/models" / "head.onnx"
        assert find_weights(card, tmp_path / "nowhere") is None
        monkeypatch.delenv("XDG_CACHE_HOME")
        assert weights_folders()[0] == Path.home() / ".cache/animatic/models"

    def test_the_state_of_weights_is_told(self, tmp_path: Path) -> None:
        content = b"weights"
        card = simcc_card(sha256=hashlib.sha256(content).hexdigest())
        assert weights_state(card, tmp_path) == "absent"
        (tmp_path / "head.onnx").write_bytes(content)
        assert weights_state(card, tmp_path) == "present"
        (tmp_path / "head.onnx").write_bytes(b"other weights")
        assert weights_state(card, tmp_path) == "wrong hash"
        assert weights_state(simcc_card(), tmp_path) == "present"
        (tmp_path / "stray.onnx").write_bytes(b"?")
        assert weights_without_card(tmp_path, {"head": card}) == [tmp_path / "stray.onnx"]


class TestSessions:
    @pytest.mark.parametrize("batch", ["batch", 1, 4, None], ids=str)
    @pytest.mark.parametrize("count", [0, 1, 3, 9])
    def test_batches_of_any_size_give_what_single_pictures_give(
        self, tmp_path: Path, batch: int | str | None, count: int
    ) -> None:
        path = onnx_fixtures.random_simcc(tmp_path / "head.onnx", points=17, width=64, height=96, batch=batch)
        model = OnnxModel(simcc_card(), path)
        together = model.run(random_batch(count))
        assert [output.shape for output in together] == [(count, 17, 128), (count, 17, 192)]
        for i in range(count):
            for output, alone in zip(together, model.run(random_batch(count)[i : i + 1]), strict=True):
                np.testing.assert_allclose(output[i], alone[0], atol=1e-5)

    def test_outputs_come_in_the_cards_order_whatever_their_names(self, tmp_path: Path) -> None:
        tall, wide = np.ones((17, 192), np.float32), np.zeros((17, 128), np.float32)
        for names in (("simcc_y", "simcc_x"), ("b", "a")):
            outputs = dict(zip(names, (tall, wide), strict=True))
            path = onnx_fixtures.constant_model(tmp_path / "head.onnx", simcc_card(), outputs)
            assert [output.shape for output in OnnxModel(simcc_card(), path).run(random_batch(1))] == [
                (1, 17, 128), (1, 17, 192),
            ]  # fmt: skip

    def test_shapes_that_the_graph_leaves_out_are_found_by_running_it(self, tmp_path: Path) -> None:
        outputs = {"simcc_x": np.zeros((17, 128)), "simcc_y": np.zeros((17, 192))}
        path = onnx_fixtures.constant_model(tmp_path / "head.onnx", simcc_card(), outputs, state_shapes=False)
        assert OnnxModel(simcc_card(), path).run(random_batch(2))[0].shape == (2, 17, 128)
        outputs["simcc_y"] = np.zeros((17, 190))
        path = onnx_fixtures.constant_model(tmp_path / "head.onnx", simcc_card(), outputs, state_shapes=False)
        with pytest.raises(ModelError, match=r"190.*192"):
            OnnxModel(simcc_card(), path)

    @pytest.mark.parametrize(
        "changes, complaint",
        [
            ({"input_width": 96, "input_height": 64}, r"96, 64\].*64, 96\]"),
            ({"schema": "car24"}, r"17, 128.*24, 128"),
            ({"simcc_split": 1.0}, r"17, 128.*17, 64"),
            ({"sha256": "0" * 64}, r"has sha256 .*card says 0000"),
        ],
        ids=["input", "points", "bins", "hash"],
    )
    def test_a_contract_that_is_not_met_names_both_sides(self, head_path: Path, changes: dict, complaint: str) -> None:
        with pytest.raises(ModelError, match=complaint):
            OnnxModel(simcc_card(**changes), head_path)

    def test_a_graph_without_a_batch_axis_is_refused(self, tmp_path: Path) -> None:
        node = helper.make_node("Identity", ["images"], ["output"])
        shape = [3, 96, 64]
        path = onnx_fixtures.save_graph(
            tmp_path / "head.onnx", [node], inputs={"images": shape}, outputs={"output": shape}, weights={}
        )
        with pytest.raises(ModelError, match=r"\[N, 3, 96, 64\]"):
            OnnxModel(simcc_card(), path)

    def test_one_row_for_many_inputs_stops(self, tmp_path: Path) -> None:
        card = YoloxCard(
            name="d", file="d.onnx", input_width=64, input_height=64, licence="-", source="-", classes=("car",),
            categories={},
        )  # fmt: skip
        model = OnnxModel(card, onnx_fixtures.deaf_model(tmp_path / "d.onnx", card, np.zeros((84, 6))))
        assert model.run(np.zeros((1, 3, 64, 64), np.float32))[0].shape == (1, 84, 6)
        with pytest.raises(ModelError, match=r"\[1, 84, 6\] in 'output' for a batch of 5, not \[5, 84, 6\]"):
            model.run(np.zeros((5, 3, 64, 64), np.float32))

    @pytest.mark.parametrize("value", [np.nan, np.inf], ids=str)
    def test_numbers_that_are_none_stop(self, tmp_path: Path, value: float) -> None:
        outputs = {"simcc_x": np.zeros((17, 128)), "simcc_y": np.zeros((17, 192))}
        outputs["simcc_y"][3, 7] = value
        path = onnx_fixtures.constant_model(tmp_path / "head.onnx", simcc_card(), outputs)
        with pytest.raises(ModelError, match="NaN or infinity in 'simcc_y'"):
            OnnxModel(simcc_card(), path).run(random_batch(1))

    def test_outputs_that_are_not_asked_for_are_not_computed(self, head_path: Path) -> None:
        whole = OnnxModel(simcc_card(), head_path)
        batch = random_batch(3)
        wanted = whole.run(batch)
        np.testing.assert_array_equal(whole.run(batch, outputs=[1])[0], wanted[1])
        broken = onnx.load(str(head_path))
        along_y = next(node for node in broken.graph.node if list(node.output) == ["simcc_y"])
        along_y.CopyFrom(helper.make_node("Reshape", ["rows", "impossible"], ["simcc_y"]))
        broken.graph.initializer.append(numpy_helper.from_array(np.array([1, 17, 192]), "impossible"))
        onnx.save(broken, str(head_path))
        model = OnnxModel(simcc_card(), head_path)
        with pytest.raises(ModelError, match="failed on"):
            model.run(batch)
        np.testing.assert_array_equal(model.run(batch, outputs=[0])[0], wanted[0])

    def test_a_batch_of_another_shape_or_type_is_refused(self, head_path: Path) -> None:
        model = OnnxModel(simcc_card(), head_path)
        for wrong in (random_batch(1)[:, :, :64], random_batch(1)[0], random_batch(1).astype(np.float64)):
            with pytest.raises(ModelError, match="takes float32"):
                model.run(wrong)

    @pytest.mark.parametrize("name", ["cuda", "TensorrtExecutionProvider", "abacus"])
    def test_a_provider_that_is_not_there_is_an_error(self, head_path: Path, name: str) -> None:
        with pytest.raises(ModelError, match="is not there"):
            OnnxModel(simcc_card(), head_path, providers=[name, "cpu"])

    def test_providers_are_shown_and_none_is_no_choice(self, head_path: Path) -> None:
        assert OnnxModel(simcc_card(), head_path, providers=["cpu"]).providers == ("CPUExecutionProvider",)
        with pytest.raises(ModelError, match="none given"):
            resolve_providers([])


class TestFiles:
    @pytest.mark.parametrize(
        "content, complaint",
        [
            (b"<!DOCTYPE html><html><body>404</body></html>", "a web page"),
            (b"\n  <html></html>", "a web page"),
            (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git-lfs pointer"),
            (b"PK\x03\x04rest of an archive", "zip archive"),
            (b"", "no graph"),
            (b"hello, I am text", "not ONNX"),
            (os.urandom(2000), "not ONNX"),
        ],
        ids=["html", "html-indented", "lfs", "zip", "empty", "text", "noise"],
    )
    def test_what_is_not_onnx_is_called_what_it_is(self, tmp_path: Path, content: bytes, complaint: str) -> None:
        path = tmp_path / "head.onnx"
        path.write_bytes(content)
        with pytest.raises(ModelError, match=complaint):
            OnnxModel(simcc_card(), path)

    def test_a_truncated_file_is_refused(self, head_path: Path) -> None:
        head_path.write_bytes(head_path.read_bytes()[:-100])
        with pytest.raises(ModelError, match="not ONNX"):
            check_file(simcc_card(), head_path)

    def test_a_missing_file_says_where_to_get_it(self, tmp_path: Path) -> None:
        with pytest.raises(ModelError, match="make it with a test"):
            OnnxModel(simcc_card(), tmp_path / "head.onnx")


def external_model(
    folder: Path, location: str, *, offset: str = "0", length: str = "256", nested: bool = False
) -> Path:
    """A model whose one weight lies in another file; ``nested`` puts it into the branch of an If."""
    weight = TensorProto(name="weight", data_type=TensorProto.FLOAT, dims=[64])
    weight.data_location = TensorProto.EXTERNAL
    for key, value in (("location", location), ("offset", offset), ("length", length)):
        weight.external_data.add(key=key, value=value)
    result = helper.make_tensor_value_info("y", TensorProto.FLOAT, [64])
    node = helper.make_node("Constant", [], ["y"], value=weight)
    if nested:
        branch = helper.make_graph([node], "branch", [], [result])
        choice = helper.make_tensor_value_info("choice", TensorProto.BOOL, [])
        outer = helper.make_node("If", ["choice"], ["z"], then_branch=branch, else_branch=branch)
        final = helper.make_tensor_value_info("z", TensorProto.FLOAT, [64])
        graph = helper.make_graph([outer], "outer", [choice], [final])
    else:
        graph = helper.make_graph([helper.make_node("Identity", ["weight"], ["y"])], "g", [], [result], [weight])
    (folder / "model.onnx").write_bytes(helper.make_model(graph).SerializeToString())
    return folder / "model.onnx"


class TestExternalData:
    @pytest.mark.parametrize("nested", [False, True])
    @pytest.mark.parametrize("location", ["../secret.bin", "/etc/passwd", "sub/../../secret.bin", "", ".", "link.bin"])
    def test_data_outside_the_models_folder_is_refused(self, tmp_path: Path, location: str, nested: bool) -> None:
        folder = tmp_path / "models"
        folder.mkdir()
        (tmp_path / "secret.bin").write_bytes(bytes(256))
        (folder / "link.bin").symlink_to(tmp_path / "secret.bin")
        with pytest.raises(ModelError, match="outside the model's folder; refused"):
            check_external_data(external_model(folder, location, nested=nested))

    @pytest.mark.parametrize("location", ["a\0b", "a" * 400, "circle"], ids=["NUL", "long", "circle"])
    def test_what_names_no_file_is_refused(self, tmp_path: Path, location: str) -> None:
        (tmp_path / "circle").symlink_to(tmp_path / "circle")
        path = external_model(tmp_path, location)
        with pytest.raises(ModelError, match="'weight' is stored in .*; (export|copy)"):
            check_external_data(path)
        assert weights_sha256(path) == hashlib.sha256(path.read_bytes()).hexdigest()

    @pytest.mark.parametrize(
        "offset, length, complaint",
        [
            ("0", "512", "which has 256"),
            ("-8", "16", "which has 256"),
            ("300", "1", "which has 256"),
            ("x", "1", "no number"),
        ],
    )
    def test_ranges_must_lie_in_the_file(self, tmp_path: Path, offset: str, length: str, complaint: str) -> None:
        (tmp_path / "weights.bin").write_bytes(bytes(256))
        with pytest.raises(ModelError, match=complaint):
            check_external_data(external_model(tmp_path, "weights.bin", offset=offset, length=length))

    def test_data_beside_the_model_is_welcome_and_must_be_there(self, tmp_path: Path) -> None:
        path = external_model(tmp_path, "weights.bin")
        with pytest.raises(ModelError, match="not there"):
            check_external_data(path)
        (tmp_path / "weights.bin").write_bytes(bytes(256))
        check_external_data(path)
        assert onnx.load(str(path)).graph.node

    def test_a_hash_covers_the_weights_wherever_they_lie(self, tmp_path: Path) -> None:
        (tmp_path / "weights.bin").write_bytes(bytes(256))
        path = external_model(tmp_path, "weights.bin")
        before = weights_sha256(path)
        assert before != file_sha256(path)
        (tmp_path / "weights.bin").write_bytes(bytes(255) + b"x")
        os.utime(tmp_path / "weights.bin", ns=(1, 1))
        assert weights_sha256(path) != before
        card = simcc_card(file="model.onnx", sha256=file_sha256(path))
        with pytest.raises(ModelError, match=r"weights\.bin, which its card's sha256 does not cover"):
            check_file(card, path)


def test_the_network_sees_the_channels_and_numbers_that_the_card_says() -> None:
    picture = np.zeros((96, 64, 3), np.uint8)
    picture[..., 0], picture[..., 1], picture[..., 2] = 10, 20, 30
    plain = {"mean": (0, 0, 0), "std": (1, 1, 1)}
    assert network_input(picture, simcc_card(**plain))[:, 0, 0].tolist() == [10, 20, 30]
    assert network_input(picture, simcc_card(channel_order="bgr", **plain))[:, 0, 0].tolist() == [30, 20, 10]
    scaled = network_input(picture, simcc_card(mean=(1, 2, 3), std=(2, 3, 4)))
    np.testing.assert_allclose(scaled[:, 5, 5], [9 / 2, 18 / 3, 27 / 4], rtol=1e-6)


@pytest.mark.parametrize("tampered", [False, True])
def test_the_real_weights_are_told_by_their_hash(real_data: Path, tmp_path: Path, tampered: bool) -> None:
    card = load_cards()["yolox_nano"]
    content = bytearray((real_data / card.file).read_bytes())
    content[-1] ^= tampered
    (tmp_path / card.file).write_bytes(content)
    if tampered:
        with pytest.raises(ModelError, match=f"card says {card.sha256}"):
            OnnxModel(card, tmp_path / card.file)
    else:
        assert OnnxModel(card, tmp_path / card.file).weights_sha256 == card.sha256
