"""Evaluating folders of videos against a labelled street: perfect samples at the noise floor, bad ones counted."""

import json
import shutil
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import cv2
import numpy as np
import pytest
from pipeline_fixtures import run_all
from training_fixtures import walker
from typer.testing import CliRunner

from dataset.loader import Sample, ShardDataset
from dataset.street import StreetConfig, write_street_video
from labeling.camera import rebased_trajectory, write_tum
from labeling.encoding import VideoWriter, lossless_rgb
from labeling.errors import ConfigError, DataError, ModelError, VideoError
from labeling.extractors import ExtractorChoice
from labeling.model_cards import load_cards
from labeling.object_video import chosen_tracks
from pipelines.cli import app
from pipelines.config import Config, merged
from pipelines.evaluate import EvaluateOptions, Evaluation, evaluate
from pipelines.evaluate_console import coverage_table, figure_table
from pipelines.evaluate_notes import blind_ruler, clip_notes, record_notes, ruler_notes
from pipelines.evaluate_ruler import Ruler
from pipelines.generate_clips import ClipsRequest, chosen_clips, generate_clips
from pipelines.job import Job
from pipelines.sources import Source
from training.evaluation_estimates import LEAST_CONFIDENCE, ClipEstimator, EstimateSettings, clip_truth, ego_fault
from training.evaluation_files import (
    SampleFiles,
    SampleFolder,
    find_samples,
    read_sample,
    sample_name,
    shown_frames,
    video_rate,
)
from training.evaluation_report import FLOOR, HELD, SAMPLES, TRUE_SKELETONS, VELOCITY

WIDTH, HEIGHT, CLIP = 288, 192, 17
_SETTINGS = {
    "clip": {"clip_frames": CLIP, "stride_frames": 16, "run_frames": 48}, "encoder": {"gop": 8},
    "picture": {"width": WIDTH, "height": HEIGHT}, "keypoints": {"extractors": ["street"]},
    "views": {"width": 192, "height": 128, "skeleton_encoder": {"gop": 8}, "view_encoder": {"gop": 8}},
    "select": {"keep_share": 1.0, "split": {"avenue": "val"}},
}  # fmt: skip
OPTIONS = EvaluateOptions(every=8)


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive through traffic, labelled by the street models: one held-out clip."""
    cv2.setNumThreads(1)
    root = tmp_path_factory.mktemp("evaluate")
    video = root / "avenue.mp4"
    write_street_video(StreetConfig(seed=11, scenario="traffic", frames=CLIP, width=WIDTH, height=HEIGHT), video)
    made = Job(root / "J", merged(Config(), _SETTINGS), {"avenue": Source(video_id="avenue", path=video)})
    _, reports = run_all(made)
    assert not [one for report in reports for one in report.failed]
    return made.root


@pytest.fixture(scope="module")
def clip(job: Path) -> Sample:
    return ShardDataset(job, "val").sample("avenue_0")


def write(path: Path, frames: Any, *, fps: int = 24, lossless: bool = False) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = frames[0].shape[:2]
    settings = lossless_rgb() if lossless else None
    with VideoWriter(path, width=width, height=height, fps=fps, settings=settings) as writer:
        for frame in frames:
            writer.write(np.ascontiguousarray(frame))
    return path


@pytest.fixture(scope="module")
def mixed(job: Path, clip: Sample, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six samples: perfect, at half the rate and another size, a held frame, noise, no video, one that broke off."""
    folder, frames = tmp_path_factory.mktemp("mixed"), clip.frames("rgb.mp4")
    write(folder / "avenue_0_0.mp4", frames)
    write(folder / "skeleton/avenue_0_0.mp4", clip.frames("skeleton.mp4"), lossless=True)
    small = [cv2.resize(frame, (192, 128), interpolation=cv2.INTER_AREA) for frame in frames[::2]]
    write(folder / "avenue_0_1.mp4", small, fps=12)
    write(folder / "skeleton/avenue_0_1.mp4", small[:4])
    write(folder / "avenue_0_2.mp4", [frames[0]] * CLIP)
    noise = np.random.default_rng(0).integers(0, 256, frames.shape, dtype=np.uint8)
    write(folder / "avenue_0_3.mp4", noise)
    (folder / "avenue_0_4.mp4").write_text("this is no video\n" * 100)
    write(folder / "avenue_0_5.mp4", frames[:6])
    write(folder / "other_0.mp4", frames[:2])
    return folder


@pytest.fixture(scope="module")
def perfect(job: Path, mixed: Path, tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    """The truth's own video, encoded again."""
    folder = tmp_path_factory.mktemp("perfect")
    (folder / "skeleton").mkdir()
    for name in ("avenue_0_0.mp4", "skeleton/avenue_0_0.mp4"):
        shutil.copy(mixed / name, folder / name)
    return evaluate(job, folder, OPTIONS)


@pytest.fixture(scope="module")
def found(job: Path, mixed: Path) -> Evaluation:
    return evaluate(job, mixed, OPTIONS)


def figures(evaluation: Evaluation, name: str) -> dict[str, float]:
    return {figure: one.mean for figure, one in evaluation.report.sets[name].figures.items()}


def test_perfect_samples_score_at_the_noise_floor_and_a_held_frame_worse(perfect: Evaluation) -> None:
    ours, floor, held = (figures(perfect, name) for name in (SAMPLES, FLOOR, HELD))
    assert ours["min_ade_m"] < 0.1 and floor["min_ade_m"] < 0.1 and held["min_ade_m"] > 1
    for name in ("min_ade_m", "box_iou", "truth_pck", "psnr_db", "ssim"):
        assert ours[name] == pytest.approx(floor[name], abs=0.01), "both are the truth, encoded again"
    for name in ("motion_pck", "skeleton_pck"):
        # One skeleton was coded, the other is drawn anew: of 300 points read back from a pile of cars at 192x128, the
        # few of one car more or less.
        assert ours[name] == pytest.approx(floor[name], abs=0.02), "both are the truth's skeletons, read back"
    for name in ("box_iou", "truth_pck", "psnr_db", "ssim"):
        assert held[name] < ours[name]
    assert ours["psnr_db"] > 30 and ours["ssim"] > 0.9
    assert floor["box_iou"] < 1, "the very frames that were labelled would be no floor"
    assert all(one.estimated == one.of == 1 for one in perfect.report.sets[SAMPLES].coverage.values())
    assert figures(perfect, VELOCITY)["min_ade_m"] < held["min_ade_m"]


def test_what_fails_is_counted_with_its_reason(found: Evaluation) -> None:
    coverage = found.report.sets[SAMPLES].coverage
    assert {part: (one.estimated, one.of) for part, one in coverage.items()} == {
        "video": (4, 6), "ego": (3, 6), "labels": (4, 6), "skeleton": (1, 6), "picture": (4, 6),
    }  # fmt: skip
    faults = {(name, part): reason for name, part, reason in found.results[0].sets[SAMPLES].faults}
    assert f"< {LEAST_CONFIDENCE}" in faults["avenue_0_3", "ego"]
    assert faults["avenue_0_4", "video"].startswith("avenue_0_4.mp4: is not a video"), "and no folder in it"
    assert "too short: 0.21 s" in faults["avenue_0_5", "video"]
    assert faults["avenue_0_1", "skeleton"] == "skeleton video has 4 frames, the RGB video 9"
    assert found.results[0].sets[SAMPLES].score.samples["min_ade_m"] == 3
    assert figures(found, SAMPLES)["min_ade_m"] < 0.15, "the best of those that were estimated"


def test_a_picture_too_small_to_be_compared_is_a_fault(clip: Sample, tmp_path: Path) -> None:
    path = write(tmp_path / "avenue_0_0.mp4", [cv2.resize(frame, (2, 2)) for frame in clip.frames("rgb.mp4")])
    looker = ClipEstimator(clip, clip_truth(clip), extractors=None)
    found = looker.estimate(SampleFiles(rgb=path))
    assert found.readable and found.faults["picture"] == "pictures of 2x2 are too small to be compared"


def test_each_sample_is_judged_at_its_own_rate_and_size(found: Evaluation) -> None:
    assert dict(found.report.sets[SAMPLES].geometries) == {
        "288x192 at 24 fps, 17 frames": 3, "192x128 at 12 fps, 9 frames": 1,
    }  # fmt: skip
    assert any("2 frame rates, sizes or lengths" in note for note in found.notes)
    assert any("other_0.mp4" in note for note in found.notes)
    assert any("3 of 6 samples: minADE and APD rest on 3.0" in note for note in found.notes)


def test_a_second_run_looks_at_nothing_again_and_a_changed_sample_is_seen(
    job: Path, perfect: Evaluation, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pipelines.evaluate as module

    folder, before = perfect.file.parent.parent, perfect.file.read_bytes()
    looked = []
    monkeypatch.setattr(module, "_evaluate_clip", lambda task: looked.append(task.sample.key) or perfect.results[0])
    with (perfect.file.parent / "clips.jsonl").open("a") as stream:
        stream.write('{"stamp": "torn')
    kept = perfect.file.parent / "clips.jsonl"
    kept.write_bytes(b"\xff\xfe damaged\n" + kept.read_bytes())
    assert evaluate(job, folder, OPTIONS).report == perfect.report and not looked
    assert perfect.file.read_bytes() == before
    evaluate(job, folder, EvaluateOptions(every=4))
    assert looked == ["avenue_0"]
    lines = kept.read_bytes().splitlines()
    assert len(lines) == 4 and json.loads(lines[3])["result"]["key"] == "avenue_0", "a torn line swallows no other"


@pytest.mark.parametrize("workers", [0, 1, 4])
def test_clips_are_shared_out_and_a_dead_worker_is_an_error(workers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    import pipelines.evaluate as module

    def threads(count: int, mp_context: Any) -> ThreadPoolExecutor:
        assert workers > 1 and count == 3 and mp_context.get_start_method() == "spawn"
        return ThreadPoolExecutor(count)

    monkeypatch.setattr(module, "ProcessPoolExecutor", threads)
    monkeypatch.setattr(module, "_evaluate_clip", lambda task: f"result of {task}")
    tasks: Any = {"s1": "a", "s2": "b", "s3": "c"}
    results: Any = dict(module._worked(tasks, workers=workers))
    assert results == {"s1": "result of a", "s2": "result of b", "s3": "result of c"}

    def die(task: Any) -> Any:
        raise BrokenProcessPool("killed")

    monkeypatch.setattr(module, "_evaluate_clip", die)
    with pytest.raises(ConfigError if workers > 1 else BrokenProcessPool, match="fewer --workers|killed"):
        dict(module._worked(tasks, workers=workers))


def test_workers_that_cannot_start_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """A broken pipe that got through would end the command with 1 and not a word, as ``animatic ... | head`` does."""
    import pipelines.evaluate as module

    def broken(*_: Any, **__: Any) -> ThreadPoolExecutor:
        raise BrokenPipeError

    monkeypatch.setattr(module, "ProcessPoolExecutor", broken)
    with pytest.raises(ConfigError, match="ended while it was being started.*fewer --workers"):
        dict(module._worked({"s1": "a", "s2": "b"}, workers=2))  # type: ignore[dict-item]


def test_imported_trajectories_and_asked_ones_and_true_skeletons(
    job: Path, clip: Sample, mixed: Path, tmp_path: Path
) -> None:
    """Trajectories by another system, a drive that was asked for, and the attribution of errors to stages."""
    for name in ("a/avenue_0_0.mp4", "a/avenue_0_1.mp4", "b/avenue_0_0.mp4"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(mixed / "avenue_0_0.mp4", tmp_path / name)
    poses, times = clip.cam_to_world.copy(), np.arange(CLIP) / 24
    poses[:, 2, 3] += 2 * times
    for folder in ("t", "a/conditions"):
        (tmp_path / folder).mkdir()
    write_tum(rebased_trajectory(times, poses), tmp_path / "t/avenue_0_0.tum")
    write_tum(rebased_trajectory(times, poses), tmp_path / "a/conditions/avenue_0.tum")
    options = EvaluateOptions(trajectories=tmp_path / "t", true_skeletons=tmp_path / "b", every=16, out=tmp_path / "o")
    made = evaluate(job, tmp_path / "a", options)
    ours = figures(made, SAMPLES)
    assert ours["min_ade_m"] == pytest.approx((2 * times).mean(), abs=1e-6), "2 m/s too fast"
    assert ours["ate_m"] == pytest.approx(0, abs=1e-6), "as it was asked for"
    assert made.report.sets[SAMPLES].coverage["ego"].reasons == {"no trajectory file": 1}
    assert made.report.differences[TRUE_SKELETONS]["min_ade_m"].mean == pytest.approx(ours["min_ade_m"], abs=0.1)
    assert made.file == tmp_path / "o/evaluation.json"
    text = "\n".join(str(cell) for column in figure_table(made.report).columns for cell in column.cells)
    assert "minADE2" in text and "[" in text
    assert "1 no trajectory file" in [str(cell) for cell in coverage_table(made.report).columns[3].cells]


def test_the_command_prints_figures_and_says_where_they_are(job: Path, perfect: Evaluation, tmp_path: Path) -> None:
    """What was evaluated before is there already, so this is quick."""
    folder = perfect.file.parent.parent
    result = CliRunner().invoke(app, ["evaluate", str(job), "--samples", str(folder)])
    assert result.exit_code == 0
    for words in ("minADE1", "noise floor", "first frame", "evaluation.json", "1 of 1 held-out clips", "note"):
        assert words in result.output
    record = json.loads(perfect.file.read_text())
    assert record["sets"][SAMPLES]["figures"]["min_ade_m"]["groups"] == 1
    assert str(job.parent) not in perfect.file.read_text(), "results name no machine's folders"


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("empty", DataError, "holds no MP4 file; samples are named"),
        ("unknown", DataError, "holds nobody_0.mp4; samples are named"),
        ("missing", DataError, "is no folder"),
    ],
)
def test_folders_without_samples_are_errors(job: Path, mixed: Path, tmp_path: Path, name, error, message) -> None:
    if name != "missing":
        (tmp_path / name).mkdir()
    if name == "unknown":
        shutil.copy(mixed / "other_0.mp4", tmp_path / name / "nobody_0.mp4")
    with pytest.raises(error, match=rf"{message}.*\(of 1 val, \d+ train clips; `animatic inspect .* --keys` lists"):
        evaluate(job, tmp_path / name, OPTIONS)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"effort": "great"}, ConfigError, "effort 'great' is not known"),
        ({"seconds": 0.0}, ConfigError, "leaves nothing to compare"),
        ({"seconds": 0.04}, ConfigError, "leaves nothing to compare; give a frame's duration, 1/24 s, at least"),
        ({"seconds": float("nan")}, ConfigError, "leaves nothing to compare"),
        ({"every": 0}, ConfigError, "at least 1"),
        ({"extractors": ("nobody",)}, ConfigError, "no model card"),
        ({"extractors": ("rtmpose_m",)}, ModelError, "weights"),
        ({"true_skeletons": Path("nowhere")}, DataError, "is no folder"),
        ({"trajectories": Path("nowhere")}, DataError, "is no folder"),
    ],
    ids=lambda value: str(next(iter(value))) if isinstance(value, dict) else "",
)
def test_options_that_cannot_be_used_are_errors(job: Path, mixed: Path, options, error, message) -> None:
    with pytest.raises(error, match=message):
        evaluate(job, mixed, EvaluateOptions(**options))


def test_a_folder_without_a_job_is_an_error(tmp_path: Path, mixed: Path) -> None:
    with pytest.raises(DataError, match="animatic label"):
        evaluate(tmp_path, mixed, OPTIONS)


def test_names_say_clip_and_number() -> None:
    keys = {"a_0", "b-x_48"}
    assert sample_name("a_0", keys) == ("a_0", 0)
    assert sample_name("a_0_5", keys) == ("a_0", 5)
    assert sample_name("b-x_48_12", keys) == ("b-x_48", 12)
    assert sample_name("c_0", keys) is None and sample_name("a_0_x", keys) is None
    with pytest.raises(DataError, match=r"number every sample: a_0_1_0\.mp4"):
        sample_name("a_0_1", {"a_0", "a_0_1"})
    assert sample_name("a_0_1_0", {"a_0", "a_0_1"}) == ("a_0_1", 0)


def test_the_first_samples_count_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (0, 1, 2, 10, 11, 3):
        (tmp_path / f"a_0_{number}.mp4").touch()
    (tmp_path / "notes.txt").touch()
    folder = find_samples(tmp_path, {"a_0"}, most=4)
    assert [one.number for one in folder.by_key["a_0"]] == [0, 1, 2, 3]
    assert (folder.beyond, folder.strangers) == (2, ())
    assert video_rate(np.arange(11) / 10) == pytest.approx(10) and video_rate([0.0]) == 0


@pytest.mark.parametrize("fps", [1, 2, 4])
def test_slow_videos_are_whole_and_one_that_lacks_a_frame_is_not(tmp_path: Path, fps: int) -> None:
    """Two keyframes a second are what many driving models give: no step of them is a hole."""
    frames = np.random.default_rng(0).integers(0, 256, (9, 48, 64, 3), dtype=np.uint8)
    path = write(tmp_path / "whole.mp4", frames, fps=fps)
    video = read_sample(path)
    assert len(video.frames) == 9 and video.times_s == pytest.approx(np.arange(9) / fps)
    with av.open(path) as whole, av.open(tmp_path / "torn.mp4", "w") as torn:
        stream = torn.add_stream_from_template(whole.streams.video[0])
        for number, packet in enumerate(whole.demux(video=0)):
            if packet.dts is not None and number != 4:
                packet.stream = stream
                torn.mux(packet)
    with pytest.raises(VideoError, match="of 8 frames decode"):
        read_sample(tmp_path / "torn.mp4")


def test_objects_are_judged_by_the_tracks_that_the_samples_could_be_given(tmp_path: Path) -> None:
    """Eight walkers in the first 49 frames, eight more after them: the generator saw every other of 25 frames."""
    labels = [walker(frame, x=30, track_id=track) for track in range(1, 9) for frame in range(49)]
    labels += [walker(frame, x=30, track_id=track) for track in range(9, 17) for frame in range(60, 121)]
    sample: Any = SimpleNamespace(
        key="v_0", meta={"video_id": "v", "fps": 24, "picture": {"width": 96, "height": 64}},
        cam_to_world=np.tile(np.eye(4), (121, 1, 1)), keypoints=lambda: labels,
    )  # fmt: skip
    for record in ({"frame_step": 2}, {"backbone": {"picture": {"frame_step": 2}}}):
        (tmp_path / "v_0.json").write_text(json.dumps({"frames": 25, **record}))
        shown = shown_frames(tmp_path / "v_0.json")
        assert shown == 49
        judged = clip_truth(sample, shown=shown).box_tracks
        assert len(judged) == 5 and max(judged) < 9
        assert judged == set(chosen_tracks([one for one in labels if one.frame < 49], key="v_0"))
    (tmp_path / "v_0.json").write_text('{"made by": "others"}')
    assert shown_frames(tmp_path / "v_0.json") is None and shown_frames(tmp_path / "none.json") is None
    assert max(clip_truth(sample).box_tracks) > 8, "without a record, the whole clip"
    assert record_notes(["v_0"], ["v_0"], ExtractorChoice()) == [], "no boxes are judged"
    choice: Any = SimpleNamespace(cards=["one"])
    assert "1 of 2 clips have no record" in record_notes(["v_0", "w_0"], ["v_0"], choice)[0]


@pytest.mark.parametrize("change", ["card", "weights"])
def test_what_was_found_with_another_card_or_other_weights_is_looked_at_again(tmp_path: Path, change: str) -> None:
    shipped: Any = load_cards()["street_detector"]
    card = shipped.model_copy(update={"name": "mine", "file": "mine.onnx", "sha256": None})
    ruler = Ruler(
        choice=ExtractorChoice(detector=card), models_dir=tmp_path, settings=EstimateSettings(), seconds=None,
        object_variant=0,
    )  # fmt: skip
    (tmp_path / "mine.onnx").write_bytes(b"one export")
    before = ruler.as_json()
    assert before == ruler.as_json()
    if change == "card":
        ruler = replace(ruler, choice=ExtractorChoice(detector=card.model_copy(update={"score_threshold": 0.6})))
    else:
        (tmp_path / "mine.onnx").write_bytes(b"another export")
    assert ruler.as_json() != before


def motion(**changes: Any) -> Any:
    made = {
        "confidence": np.full(10, 0.9, np.float32), "mode": np.full(10, "moving"),
        "scale_sigma": np.full(10, 0.05, np.float32),
    }  # fmt: skip
    return SimpleNamespace(**made | changes)


def test_trajectories_that_are_no_answer_say_why() -> None:
    assert ego_fault(motion()) is None
    assert ego_fault(motion(confidence=np.full(10, 0.1))) == "confidence 0.10 < 0.3"
    held = np.array(["held"] * 4 + ["moving"] * 6)
    assert ego_fault(motion(mode=held)) == "no motion of their own in 40% of the frames"
    unsure = np.full(10, 0.8)
    assert "metric scale unknown (sigma 80%)" in str(ego_fault(motion(scale_sigma=unsure)))
    assert ego_fault(motion(scale_sigma=unsure, mode=np.full(10, "still"))) is None, "standing still needs no scale"


def test_figures_that_the_truth_itself_fails_are_named() -> None:
    def report(**floor: float) -> Any:
        guess = {"truth_pck": 0.7, "ade_m": 1.0, "apd_m": 0.0}
        sets = {FLOOR: floor, VELOCITY: guess}
        return SimpleNamespace(
            sets={
                name: SimpleNamespace(figures={key: SimpleNamespace(mean=value) for key, value in means.items()})
                for name, means in sets.items()
            }
        )

    assert blind_ruler(report(truth_pck=0.9, ade_m=0.1, apd_m=0.3, ssim=0.1)) == []
    (note,) = blind_ruler(report(truth_pck=0.4, ade_m=0.1, apd_m=0.3))
    assert "points: RGB against truth:" in note and "ADE" not in note
    assert "ADE" in blind_ruler(report(truth_pck=0.9, ade_m=1.1))[0]
    assert blind_ruler(SimpleNamespace(sets={})) == []  # type: ignore[arg-type]


def test_notes_say_what_was_left_out() -> None:
    folder = SampleFolder(folder=Path("s"), by_key={"a_0": (), "t_0": ()}, strangers=("x.mp4",), beyond=3)
    notes = " | ".join(clip_notes({"a_0": "val", "b_0": "val", "t_0": "train"}, {SAMPLES: folder}, 6))
    for words in ("1 of 2 held-out", "1 clips are of the training split, such as t_0", "x.mp4", "3 samples beyond 6"):
        assert words in notes
    assert "neither boxes nor points" in ruler_notes(ExtractorChoice(), None)[0]
    assert "imported" in ruler_notes(ExtractorChoice(), Path("t"))[-1]


def test_clips_are_chosen_by_split_or_key(job: Path) -> None:
    assert (
        [one.key for one in chosen_clips(job, "val")] == [one.key for one in chosen_clips(job, "all")] == ["avenue_0"]
    )
    assert [one.key for one in chosen_clips(job, "avenue_0")] == ["avenue_0"]
    for clips, words in (
        ("train", r"has no clip in train \(val has 1\): .* --clips all"),
        ("avenue_0,b_0", "has no clip 'b_0'"),
    ):
        with pytest.raises(DataError, match=words):
            chosen_clips(job, clips)


@pytest.fixture(scope="module")
def adapters(job: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Both stages of the tiny backbone after one step, at 96x64."""
    import torch

    from training.latents import cache_latents
    from training.trainer import train

    torch.set_num_threads(1)
    picture = {"control_width": 96, "control_height": 64, "rgb_width": 96, "rgb_height": 64, "frames": 9}
    clips = {"train": list(ShardDataset(job, "val")), "val": []}
    root = tmp_path_factory.mktemp("adapters")
    cache_latents(root, backbone_name="tiny", picture=picture, datasets=clips)
    changes = {"backbone": {"picture": picture}, "optimiser": {"steps": 1}, "trackers": [], "checkpoint": {"keep": 1}}
    found = {}
    for stage in ("motion", "appearance"):
        from training.config import load_config

        recipe = load_config("tiny", stage=stage, overrides={**changes, "validation": {"loss_every_steps": 0}})
        train(recipe, data=root, out=root / stage, quiet=True)
        found[stage] = root / stage
    return found


def test_what_generate_writes_is_what_evaluate_reads(job: Path, adapters: dict[str, Path], tmp_path: Path) -> None:
    from pipelines.train import GenerateOptions, run_generate

    options = GenerateOptions(samples=2, steps=1)
    request = ClipsRequest(clips="val", ego="left 30deg", object_variant=0)
    assert generate_clips(job, request, out=tmp_path / "s", adapters=adapters, options=options) == (1, 0)
    before = (tmp_path / "s/avenue_0_1.mp4").read_bytes()
    assert generate_clips(job, request, out=tmp_path / "s", adapters=adapters, options=options) == (0, 1)
    (tmp_path / "s/avenue_0_1.mp4").unlink()
    assert generate_clips(job, request, out=tmp_path / "s", adapters=adapters, options=options) == (1, 0)
    assert (tmp_path / "s/avenue_0_1.mp4").read_bytes() == before, "the same seed gives the same file"
    true = ClipsRequest(true_skeletons=True)
    generate_clips(job, true, out=tmp_path / "t", adapters=adapters, options=GenerateOptions(steps=1))
    made = evaluate(job, tmp_path / "s", EvaluateOptions(true_skeletons=tmp_path / "t", every=8))
    judged = made.report.sets[SAMPLES]
    assert judged.geometries == {"96x64 at 24 fps, 9 frames": 2}
    assert judged.coverage["skeleton"].estimated == 2 and judged.coverage["video"].estimated == 2
    assert made.report.sets[TRUE_SKELETONS].samples == 1 and judged.seconds == (pytest.approx(1 / 3),) * 2
    assert (tmp_path / "s/conditions/avenue_0.tum").is_file()
    record = json.loads((tmp_path / "s/avenue_0.json").read_text())
    assert (record["ego"], record["object_variant"], record["true_skeletons"]) == ("left 30deg", 0, False)
    run_generate(out=tmp_path / "o", **adapters, data=job, clip="avenue_0", ego="left 30deg", options=options)  # type: ignore[arg-type]
    alone = json.loads((tmp_path / "o/avenue_0.json").read_text())
    assert alone == record | {"object_variant": None}, "the record of one clip tells what those of many tell"


def test_options_of_one_clip_are_refused_for_many(job: Path, adapters: dict[str, Path], tmp_path: Path) -> None:
    from pipelines.generate_clips import show_clips
    from pipelines.train import GenerateOptions

    request = ClipsRequest(clips="val")
    options = GenerateOptions(objects=tmp_path / "o.mp4")
    with pytest.raises(ConfigError, match="--object-variant"):
        generate_clips(job, request, out=tmp_path, adapters=adapters, options=options)
    with pytest.raises(ConfigError, match="give --appearance"):
        only = {"motion": adapters["motion"]}
        generate_clips(job, ClipsRequest(true_skeletons=True), out=tmp_path, adapters=only)
    with pytest.raises(ConfigError, match="give --data JOB"):
        show_clips(None, request, out=tmp_path, motion=None, appearance=None)
