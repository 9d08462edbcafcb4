"""Models that break their promises, in a whole job: nothing crashes, and the receipts say what happened."""

import json

import numpy as np
import onnx
import pytest
from onnx import helper
from onnx_fixtures import constant_model, save_graph
from pipeline_fixtures import SMALL, run_all, small_config, write_detector, write_street

from dataset.layout import run_path
from dataset.receipts import read_receipts
from dataset.tables import read_keypoints
from labeling.errors import ModelError
from labeling.extractors import choose_extractors
from labeling.model_cards import SimccCard, YoloxCard, file_sha256, write_card
from labeling.timeline import Span
from pipelines.commands import JobOptions, run_label
from pipelines.console import ConsoleReporter
from pipelines.job import Job
from pipelines.label import StageReport
from pipelines.models import print_models
from pipelines.sources import find_videos

SIZE = 256
LABELLED = ("source", "index", "count", "select", "cut", "keypoints")
CELLS = sum((SIZE // stride) ** 2 for stride in (8, 16, 32))


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    # These models see the same in every frame, so nothing may move: tracks go with the camera.
    return write_street(tmp_path_factory.mktemp("videos") / "street.mp4", frames=24, level=130, slide=0)


def card_of(folder, *, kind="yolox", name="toy"):
    common = {"name": name, "file": f"{name}.onnx", "licence": "Apache-2.0", "source": "a test"}
    if kind == "simcc":
        return SimccCard(**common, schema="coco17", input_width=64, input_height=96)  # type: ignore[arg-type]
    return YoloxCard(**common, input_width=SIZE, input_height=SIZE, classes=("car",), categories={"car": "car"})  # type: ignore[arg-type]


def with_hash(card, folder):
    write_card(card.model_copy(update={"sha256": file_sha256(folder / card.file)}), folder / f"{card.name}.toml")


def rows(count=0):
    """A YOLOX output with ``count`` small boxes apart from each other, all sure."""
    output = np.zeros((CELLS, 6), np.float32)
    output[:, 5] = 1
    output[:count, 4] = np.linspace(1.0, 0.9, count)
    output[:, 2:4] = -1.5
    return output


def the_job(root, video, models, **changes):
    sources = {source.video_id: source for source in find_videos([video])}
    config = small_config(**{"select": {"keep_share": 1.0}, **changes})
    return Job(root, config, sources, models_dir=models)


def options(folder, models, **changes):
    """Of the command line, for clips of 9 frames."""
    (folder / "c.yaml").write_text(json.dumps({**SMALL, **changes.pop("config", {})}))
    return JobOptions(config=folder / "c.yaml", models=models, keep_share=1.0, workers=0, **changes)


def models_with(folder, output):
    folder.mkdir()
    constant_model(folder / "toy.onnx", card_of(folder), {"output": output})
    with_hash(card_of(folder), folder)
    return folder


def test_nan_fails_the_run_and_the_receipt_says_which_network(tmp_path, video):
    output = rows()
    output[7, 4] = np.nan
    job = the_job(tmp_path / "J", video, models_with(tmp_path / "m", output))
    _, reports = run_all(job)
    (receipt,) = read_receipts(job.root, "keypoints").values()
    assert (receipt.state, receipt.reason, receipt.retryable) == ("failed", "model", False)
    assert "toy gave NaN or infinity in 'output'" in receipt.message
    assert all(one.state == "done" for one in read_receipts(job.root, "cut").values()), "the rest of the job went on"
    assert next(report for report in reports if report.stage == "pack").failed == []


def test_five_hundred_objects_are_cut_to_the_best_and_the_receipt_says_so(tmp_path, video, capsys):
    job = the_job(tmp_path / "J", video, models_with(tmp_path / "m", rows(500)), keypoints={"effort": "exact"})
    run_all(job, stages=LABELLED)
    (receipt,) = read_receipts(job.root, "keypoints").values()
    assert receipt.state == "done"
    # The video stands still: few of its pictures differ, and only those are looked at.
    looks, rest = divmod(receipt.facts["left_out"]["toy"], 300)
    assert rest == 0 and 1 <= looks < receipt.facts["frames"]
    table = read_keypoints(job.root / run_path("street", Span(start=0, end=17), ".keypoints.parquet"))
    assert max(sum(label.frame == frame for label in table) for frame in range(17)) == 200
    reporter = ConsoleReporter()
    reporter.stage_finished(StageReport(stage="keypoints", made=[receipt]))
    assert f"toy saw {300 * looks} more than its card allows in a frame" in capsys.readouterr().out


def test_where_little_is_seen_nothing_is_said(tmp_path, video):
    job = the_job(tmp_path / "J", video, models_with(tmp_path / "m", rows(3)))
    run_all(job, stages=LABELLED)
    assert read_receipts(job.root, "keypoints")["street/run_0_17"].facts["left_out"] == {}


def test_boxes_outside_and_without_area_are_no_objects(tmp_path, video):
    output = rows(4)
    seen = np.flatnonzero(output[:, 4])
    output[seen[0], :2] = 5000.0
    output[seen[1], 2:4] = -90.0
    output[seen[2], :2] = -5000.0
    models = models_with(tmp_path / "m", output)
    head = card_of(models, kind="simcc", name="head")
    constant_model(models / "head.onnx", head, {"simcc_x": np.ones((17, 128)), "simcc_y": np.ones((17, 192))})
    with_hash(head, models)
    job = the_job(tmp_path / "J", video, models, keypoints={"effort": "exact"})
    run_all(job, stages=LABELLED)
    (receipt,) = read_receipts(job.root, "keypoints").values()
    assert receipt.state == "done" and receipt.facts["tracks"] == 1


def test_a_card_without_weights_is_left_out_and_named(tmp_path, video, capsys):
    models = write_detector(tmp_path / "m")
    write_card(card_of(models, kind="simcc", name="head"), models / "head.toml")
    choice = choose_extractors(None, models_dir=models)
    assert "head" in choice.absent and "person" in choice.missing_categories
    assert run_label([video], tmp_path / "J", options(tmp_path, models)) == 0
    said = capsys.readouterr().out
    assert "no keypoints of" in said and "head" in said
    with pytest.raises(ModelError, match=r"head: its weights head\.onnx are not there; a test"):
        run_label([video], tmp_path / "K", options(tmp_path, models, extractors="counter,head"))


def test_weights_without_a_card_are_named_and_never_used(tmp_path, video, capsys):
    models = write_detector(tmp_path / "m")
    (models / "stray.onnx").write_bytes((models / "counter.onnx").read_bytes())
    print_models(models)
    assert "stray.onnx: no card names this file" in " ".join(capsys.readouterr().out.split())
    job = the_job(tmp_path / "J", video, models)
    run_all(job, stages=LABELLED)
    (receipt,) = read_receipts(job.root, "keypoints").values()
    assert receipt.state == "done" and list(job.plan("keypoints")[0].models) == ["counter"]


def no_batch_axis(folder):
    node = helper.make_node("Identity", ["images"], ["output"])
    shape = [3, SIZE, SIZE]
    save_graph(folder / "toy.onnx", [node], inputs={"images": shape}, outputs={"output": shape}, weights={})


def all_axes_dynamic(folder):
    """The graph says nothing of its sizes, and gives other ones than the card's."""
    node = helper.make_node("GlobalAveragePool", ["images"], ["output"])
    shape = ["n", "c", "h", "w"]
    save_graph(folder / "toy.onnx", [node], inputs={"images": shape}, outputs={"output": None}, weights={})


def data_elsewhere(folder):
    constant_model(folder / "toy.onnx", card_of(folder), {"output": rows()})
    model = onnx.load(folder / "toy.onnx")
    (folder.parent / "secret.bin").write_bytes(bytes(CELLS * 6 * 4))
    tensor = next(one for one in model.graph.initializer if one.name == "output_value")
    tensor.ClearField("raw_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="../secret.bin")
    (folder / "toy.onnx").write_bytes(model.SerializeToString())


@pytest.mark.parametrize(
    ("make", "complaint"),
    [
        (no_batch_axis, "wrong file or card"),
        (all_axes_dynamic, "wrong file or card"),
        (data_elsewhere, "outside the model's folder; refused"),
        (lambda folder: (folder / "toy.onnx").write_bytes(b"<html>404</html>"), "a web page"),
    ],
    ids=["no batch axis", "dynamic axes of other sizes", "external data elsewhere", "no ONNX"],
)
def test_a_graph_that_breaks_its_card_stops_the_command_and_fails_the_stage(tmp_path, video, make, complaint):
    models = tmp_path / "m"
    models.mkdir()
    make(models)
    with_hash(card_of(models), models)
    with pytest.raises(ModelError, match=complaint):
        run_label([video], tmp_path / "J", options(tmp_path, models))
    assert not read_receipts(tmp_path / "J", "keypoints"), "found before anything is spent"
    # The weights may also go bad later, under a job that runs: then its runs fail, each with the reason.
    job = the_job(tmp_path / "K", video, models)
    run_all(job, stages=LABELLED)
    (receipt,) = read_receipts(job.root, "keypoints").values()
    assert (receipt.state, receipt.reason) == ("failed", "model") and complaint in receipt.message


def test_a_graph_of_dynamic_axes_that_fits_is_used(tmp_path, video):
    models = tmp_path / "m"
    models.mkdir()
    constant_model(models / "toy.onnx", card_of(models), {"output": rows(2)}, state_shapes=False)
    with_hash(card_of(models), models)
    job = the_job(tmp_path / "J", video, models)
    run_all(job, stages=LABELLED)
    (receipt,) = read_receipts(job.root, "keypoints").values()
    assert receipt.state == "done" and receipt.facts["tracks"] == 2


def test_a_provider_that_is_not_there_is_said_and_never_replaced(tmp_path, video):
    models = write_detector(tmp_path / "m")
    for part in ("keypoints", "count"):
        wanted = options(tmp_path, models, config={part: {"providers": ["cuda"]}})
        with pytest.raises(ModelError, match="CUDAExecutionProvider is not there"):
            run_label([video], tmp_path / "J", wanted)
    job = the_job(tmp_path / "C", video, models, count={"providers": ["cuda"]}, select={"keep_share": 0.5})
    run_all(job, stages=("source", "index", "count"))
    (receipt,) = read_receipts(job.root, "count").values()
    assert (receipt.state, receipt.reason) == ("failed", "model") and "is not there" in receipt.message
    job = the_job(tmp_path / "K", video, models, keypoints={"providers": ["cuda"]})
    run_all(job, stages=LABELLED)
    (receipt,) = read_receipts(job.root, "keypoints").values()
    assert (receipt.state, receipt.reason) == ("failed", "model") and "is not there" in receipt.message
