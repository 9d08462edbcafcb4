"""The two-stage generator: conditions, seeds, hand-over of latents, recipes for ego-motion, clear answers."""

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from training_fixtures import (  # noqa: F401
    HEIGHT,
    PICTURE,
    WIDTH,
    FakeSample,
    fake_datasets,
    one_thread,
    tiny_config,
    tiny_job,
    walker,
)

from dataset.receipts import sha256_file
from dataset.tables import write_keypoints
from labeling.camera import prior_intrinsics, rebased_trajectory, rotation_angle_deg, write_tum
from labeling.errors import ConfigError, DataError, ModelError
from labeling.labels import Keypoints
from labeling.skeleton_video import draw_skeletons
from labeling.video import frame_count, read_frames, read_packet_times
from pipelines.generate_clips import ClipsRequest, _make, show_clips
from pipelines.train import GenerateOptions, run_generate
from training.backbone import SamplingSettings
from training.backbones import load_backbone
from training.clip_views import clip_trajectory
from training.config import PictureConfig, Stage, backbone_config
from training.ego_recipes import recipe_trajectory
from training.generation import ClipConditions, ClipGenerator, prepare_conditions, write_samples
from training.generation import generate as generate_files
from training.latents import cache_latents
from training.sampling_inputs import LABEL_WIDTH, control_clip, ego_trajectory, first_skeleton, object_clip
from training.trainer import TrainSummary, train

SAMPLE = FakeSample(key="other_0")
IMAGE = SAMPLE.frames("rgb.mp4")[0]
SKELETON = draw_skeletons(SAMPLE.keypoints()[:1], width=WIDTH, height=HEIGHT, label_width=WIDTH, label_height=HEIGHT)
generate: Any = generate_files
FAST = SamplingSettings(steps=2, guidance=3.0)


@pytest.fixture(scope="module")
def adapters(tiny_job: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[Stage, Path]:  # noqa: F811
    found: dict[Stage, Path] = {}
    stages: tuple[Stage, ...] = ("motion", "appearance", "end_to_end")
    for stage in stages:
        out = tmp_path_factory.mktemp(stage)
        summary = train(tiny_config(stage, optimiser={"steps": 3}), data=tiny_job, out=out, quiet=True)
        assert isinstance(summary, TrainSummary)
        found[stage] = summary.adapter
    return found


@pytest.fixture(scope="module")
def generator(adapters: dict[Stage, Path]) -> ClipGenerator:
    backbone = load_backbone(backbone_config("tiny", picture=PICTURE))
    return ClipGenerator(backbone, motion=adapters["motion"], appearance=adapters["appearance"])


def packed_clip() -> Any:
    """A clip of nine frames, as a job's shards give it."""
    meta = {
        "picture": {"width": WIDTH, "height": HEIGHT}, "intrinsics": asdict(prior_intrinsics(WIDTH, HEIGHT)), "fps": 24
    }  # fmt: skip
    sample: Any = FakeSample(key="v_0", meta=meta)
    sample.members, sample.iterate_frames = {}, lambda suffix: iter(sample.frames(suffix))
    return sample


def two_stages(adapters: dict[Stage, Path]) -> dict[str, Any]:
    return {"motion": adapters["motion"], "appearance": adapters["appearance"]}


def test_both_videos_are_written_and_a_seed_gives_the_same_files(adapters, tmp_path: Path) -> None:
    runs = [
        generate(
            image=IMAGE, caption="A road.", out=tmp_path / name, skeleton=SKELETON, ego="straight 10m/s", steps=2,
            samples=2, seed=seed, **two_stages(adapters),
        )
        for name, seed in (("a", 7), ("b", 7), ("c", 8))
    ]  # fmt: skip
    names = [(sample.rgb.name, sample.control.parent.name) for sample in runs[0]]
    assert names == [("sample_0.mp4", "skeleton"), ("sample_1.mp4", "skeleton")]
    for first, again, other in zip(*runs, strict=True):
        for kind in ("rgb", "control"):
            data = [getattr(one, kind).read_bytes() for one in (first, again, other)]
            assert data[0] == data[1] != data[2]
        assert frame_count(first.rgb) == frame_count(first.control) == 9
    assert runs[0][0].rgb.read_bytes() != runs[0][1].rgb.read_bytes()


def test_the_motion_latents_pass_to_the_appearance_stage_undecoded(generator, monkeypatch) -> None:
    drawn, given = {}, {}
    real = generator._drawn

    def watched(stage, first, references, *rest, **named):
        drawn[stage] = real(stage, first, references, *rest, **named)
        given[stage] = references
        return drawn[stage]

    monkeypatch.setattr(generator, "_drawn", watched)
    conditions = ClipConditions(image=IMAGE, caption="A road.", first_control=SKELETON)
    generator.sample(conditions, settings=FAST)
    assert given["appearance"]["skeleton"] is drawn["motion"]
    assert set(given["motion"]) == {"image"}


def test_each_stage_starts_from_noise_of_its_own(generator, monkeypatch) -> None:
    started: list[torch.Tensor] = []
    real = generator.backbone.sample

    def watched(*given, noise_BCFHW, **named):
        started.append(noise_BCFHW)
        return real(*given, noise_BCFHW=noise_BCFHW, **named)

    monkeypatch.setattr(generator.backbone, "sample", watched)
    conditions = ClipConditions(image=IMAGE, caption="A road.", first_control=SKELETON)
    generator.sample(conditions, settings=FAST)
    motion, appearance = started
    assert motion.shape == appearance.shape
    assert abs(float(torch.corrcoef(torch.stack([motion.flatten(), appearance.flatten()]))[0, 1])) < 0.2


def test_conditions_change_the_sample_and_their_absence_is_a_condition_too(generator) -> None:
    black = np.zeros((9, HEIGHT, WIDTH, 3), np.uint8)
    bright = np.full_like(black, 200)
    plain: dict[str, Any] = {"image": IMAGE, "caption": "A road.", "first_control": SKELETON}
    variants: list[dict[str, Any]] = [
        {},
        {"ego": bright},
        {"objects": bright // 3},
        {"ego": bright, "objects": black},
        {"caption": "Night."},
    ]
    clips: list[Any] = [generator.sample(ClipConditions(**plain | extra), settings=FAST).control for extra in variants]
    for place, one in enumerate(clips):
        for other in clips[place + 1 :]:
            assert not np.array_equal(one, other)


def test_a_given_skeleton_video_replaces_the_motion_stage(generator, adapters) -> None:
    video = np.stack([SKELETON] * 9)
    alone = ClipGenerator(load_backbone(generator.backbone.config), appearance=adapters["appearance"])
    conditions = ClipConditions(image=IMAGE, caption="A road.", control=video)
    clips: list[Any] = [one.sample(conditions, settings=FAST) for one in (generator, alone)]
    assert np.array_equal(clips[0].control, video)
    assert np.array_equal(clips[0].rgb, clips[1].rgb)


def test_end_to_end_makes_rgb_alone(adapters, tmp_path: Path) -> None:
    (made,) = generate(
        image=IMAGE, caption="A road.", out=tmp_path, end_to_end=adapters["end_to_end"], ego="still", steps=2
    )
    assert made.control is None and frame_count(made.rgb) == 9


def test_files_on_disk_do_as_well_as_arrays(adapters, tmp_path: Path) -> None:
    for name, picture in (("first.png", IMAGE), ("skeleton.png", SKELETON)):
        cv2.imwrite(str(tmp_path / name), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    (a,) = generate(
        image=tmp_path / "first.png", caption="A road.", out=tmp_path / "a", skeleton=tmp_path / "skeleton.png",
        steps=2, **two_stages(adapters),
    )  # fmt: skip
    (b,) = generate(
        image=IMAGE, caption="A road.", out=tmp_path / "b", skeleton=SKELETON, steps=2, name="first",
        **two_stages(adapters),
    )  # fmt: skip
    assert a.rgb.name == "first_0.mp4"
    assert a.rgb.read_bytes() == b.rgb.read_bytes()
    # The skeleton video is lossless, so it can be given back.
    assert np.array_equal(
        control_clip(a.control, frames=9, picture=backbone_config("tiny", picture=PICTURE).picture),
        np.stack(list(read_frames(a.control))),
    )


def test_recipes_drive_where_they_say() -> None:
    straight = recipe_trajectory("straight 10m/s", frames=121, fps=24)
    assert straight.cam_to_world[-1, :3, 3] == pytest.approx([0, 0, 50])
    assert recipe_trajectory("straight 36km/h", frames=121, fps=24).path_length_m == pytest.approx(50)
    left = recipe_trajectory("left 30deg", frames=121, fps=24)
    assert left.cam_to_world[-1, 0, 3] < -5
    assert float(rotation_angle_deg(left.cam_to_world[-1:, :3, :3])[0]) == pytest.approx(30)
    assert left.path_length_m == pytest.approx(40, rel=1e-3)
    # The camera looks where it drives.
    steps = np.diff(left.positions, axis=0)
    ahead = (left.cam_to_world[:-1, :3, 2] + left.cam_to_world[1:, :3, 2]) / 2
    assert np.allclose((steps * ahead).sum(1), np.linalg.norm(steps, axis=1), rtol=1e-3)
    right = recipe_trajectory("right 45deg 8m/s", frames=25, fps=24)
    assert right.cam_to_world[-1, 0, 3] > 0
    assert recipe_trajectory("reverse 3m/s", frames=25, fps=24).cam_to_world[-1, 2, 3] == pytest.approx(-3)
    assert recipe_trajectory("still", frames=9, fps=24).path_length_m == 0


@pytest.mark.parametrize("recipe", ["", "up 3m/s", "left thirty", "straight 10mph", "missing.tum"])
def test_recipes_that_are_not_understood_say_what_is(recipe: str) -> None:
    with pytest.raises(ConfigError, match=r"straight 10m/s \| left 30deg"):
        ego_trajectory(recipe, frames=9, fps=24)


def test_trajectory_files_are_resampled_and_must_be_long_enough(tmp_path: Path) -> None:
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, 2, 3] = np.arange(30.0)
    write_tum(clip_trajectory(poses, fps=10.0), tmp_path / "drive.tum")
    found = ego_trajectory(tmp_path / "drive.tum", frames=25, fps=24)
    assert len(found) == 25
    assert found.cam_to_world[-1, 2, 3] == pytest.approx(10)
    with pytest.raises(ConfigError, match="lasts 2.90 s, the clip 5.00 s"):
        ego_trajectory(tmp_path / "drive.tum", frames=121, fps=24)
    # By its rows, as `animatic ego --import` reads it, whatever its name.
    shutil.copy(tmp_path / "drive.tum", tmp_path / "drive.txt")
    assert np.array_equal(ego_trajectory(tmp_path / "drive.txt", frames=25, fps=24).cam_to_world, found.cam_to_world)
    np.savetxt(tmp_path / "kitti.txt", poses[:, :3].reshape(-1, 12))
    assert ego_trajectory(tmp_path / "kitti.txt", frames=9, fps=24).cam_to_world[-1, 2, 3] == pytest.approx(8)
    np.save(tmp_path / "drive.npy", poses)
    assert ego_trajectory(tmp_path / "drive.npy", frames=9, fps=24).cam_to_world[-1, 2, 3] == pytest.approx(8)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"junk", "is no array of camera poses: it is no whole .npy of numbers; give .T, 4, 4. numbers"),
        (b"", "is no array of camera poses"),
        (np.array([{}], object), "is no array of camera poses"),
        (np.float64(3), r"holds float64 \(\), but a trajectory is \(T, 4, 4\)"),
        (np.array(["a"] * 9), r"holds <U1 \(9,\), but"),
        (np.zeros((3, 3)), r"holds float64 \(3, 3\), but"),
        (np.zeros((0, 4, 4)), r"holds float64 \(0, 4, 4\), but"),
        (np.zeros((9, 4, 4), complex), r"holds complex128 \(9, 4, 4\), but"),
    ],
    ids=["junk", "empty", "objects", "scalar", "text", "other shape", "no pose", "complex"],
)
def test_arrays_that_are_no_trajectory_are_named(tmp_path: Path, content: Any, message: str) -> None:
    path = tmp_path / "drive.npy"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.save(path, content, allow_pickle=True)
    with pytest.raises(ConfigError, match=f"{path} {message}"):
        ego_trajectory(path, frames=9, fps=24)


def test_an_archive_of_arrays_is_no_trajectory(tmp_path: Path) -> None:
    np.savez(tmp_path / "drive.npz", a=np.zeros((9, 4, 4)))
    (tmp_path / "drive.npz").rename(tmp_path / "drive.npy")
    with pytest.raises(ConfigError, match="drive.npy is no array of camera poses"):
        ego_trajectory(tmp_path / "drive.npy", frames=9, fps=24)


def test_what_is_missing_or_wrong_is_named(generator, adapters, tmp_path: Path, monkeypatch) -> None:
    with pytest.raises(ConfigError, match="--motion and --appearance"):
        ClipGenerator(generator.backbone)
    with pytest.raises(ConfigError, match="needs a skeleton video"):
        generator.sample(ClipConditions(image=IMAGE, caption="x"), settings=FAST)
    (tmp_path / "a.png").write_text("no picture")
    with pytest.raises(DataError, match="not a picture"):
        generate(image=tmp_path / "a.png", caption="x", out=tmp_path, skeleton=SKELETON, **two_stages(adapters))
    with pytest.raises(ModelError, match=r"give the \.safetensors file"):
        none = tmp_path / "none.safetensors"
        generate(image=IMAGE, caption="x", out=tmp_path, motion=none, skeleton=SKELETON, backbone="tiny")
    from labeling import extractors

    monkeypatch.setattr(extractors, "find_weights", lambda *_: None)
    with pytest.raises(ConfigError, match="no keypoint extractors"):
        generate(image=IMAGE, caption="x", out=tmp_path, **two_stages(adapters))


def test_a_sample_that_overflows_is_said_and_not_decoded(generator, tmp_path: Path, monkeypatch) -> None:
    sample = generator.backbone.sample

    def overflown(*arguments: Any, **named: Any) -> torch.Tensor:
        latents = sample(*arguments, **named).half() * 60000
        return latents.float()

    monkeypatch.setattr(generator.backbone, "sample", overflown)
    conditions = ClipConditions(image=IMAGE, caption="x", first_control=SKELETON)
    with pytest.raises(ModelError, match=r"motion stage drew latents of which .*% are not finite.*float32"):
        write_samples(generator, conditions, out=tmp_path, name="a", settings=FAST)
    assert not list(tmp_path.rglob("*.mp4"))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"image": Path("nope.png")}, "--image nope.png does not exist; check the path"),
        ({"image": Path("nope.png"), "caption": "x"}, "--image nope.png does not exist; check the path"),
        ({"image": Path(__file__)}, "--caption is missing; give --caption TEXT too"),
        ({"caption": "x"}, "--image is missing; give --image FILE too"),
        ({}, "nothing to start from; give --image FILE and --caption TEXT, or --data JOB"),
    ],
    ids=["no such file", "no such file, with text", "no text", "no picture", "nothing"],
)
def test_what_a_picture_s_start_lacks_is_named(given: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"^{message}"):
        run_generate(out=tmp_path, motion=tmp_path / "unread", appearance=None, **given)


def test_missing_adapters_are_named_by_their_options(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("pipelines.generate_clips.chosen_clips", lambda *_: [SAMPLE])
    words = "^--motion and --appearance are missing; give the adapters .*or --end-to-end alone"
    with pytest.raises(ConfigError, match=words):
        show_clips(tmp_path, ClipsRequest(clips="val"), out=tmp_path, motion=None, appearance=None)
    with pytest.raises(ConfigError, match=words):
        generate(image=IMAGE, caption="x", out=tmp_path, skeleton=SKELETON, backbone="tiny")


@pytest.mark.parametrize("slots", [("motion", "appearance"), ("motion", "end_to_end"), ("end_to_end", "motion")])
def test_an_adapter_of_another_stage_is_refused_by_name(adapters, tmp_path: Path, slots: tuple[Stage, Stage]) -> None:
    given, slot = slots
    words = f"of the {given} stage, not of the {slot} stage.*--{given.replace('_', '-')}"
    with pytest.raises(ConfigError, match=words):
        generate(image=IMAGE, caption="x", out=tmp_path, skeleton=SKELETON, **{slot: adapters[given]})


def test_adapters_of_other_controls_or_frame_rates_do_not_pair(
    adapters, generator, tmp_path: Path, monkeypatch
) -> None:
    real = ClipGenerator.control_name
    monkeypatch.setattr(
        ClipGenerator, "control_name", lambda self, stage: "hdmap" if stage == "motion" else real(self, stage)
    )
    backbone = load_backbone(generator.backbone.config)
    with pytest.raises(ConfigError, match="drafts hdmap videos, the appearance adapter paints over skeleton videos"):
        ClipGenerator(backbone, **two_stages(adapters))
    monkeypatch.undo()
    halved = generator.picture("motion").model_copy(update={"frame_step": 2})
    picture = ClipGenerator.picture
    monkeypatch.setattr(
        ClipGenerator, "picture", lambda one, stage: halved if stage == "motion" else picture(one, stage)
    )
    with pytest.raises(ConfigError, match="works at 12 fps, the appearance adapter at 24 fps"):
        ClipGenerator(load_backbone(generator.backbone.config), **two_stages(adapters))


def test_misspelt_coordinates_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="'relased' are not known; choose one of consistent, released"):
        generate(image=IMAGE, caption="x", out=tmp_path, motion=tmp_path / "unread", coordinates="relased")


def test_a_killed_repeat_leaves_no_record_beside_other_videos(generator, tmp_path: Path, monkeypatch) -> None:
    conditions = ClipConditions(
        image=IMAGE, caption="x", first_control=SKELETON, trajectory=ego_trajectory("still", frames=9, fps=24)
    )
    fast = SamplingSettings(steps=1, guidance=1.0)
    write_samples(generator, conditions, out=tmp_path, name="v_0", samples=2, settings=fast)
    # A neighbour whose name begins alike is not of this clip.
    (tmp_path / "v_0_1_0.mp4").write_bytes(b"another's")
    real = generator.sample

    def killed(*given: Any, number: int, **named: Any) -> Any:
        if number == 1:
            raise KeyboardInterrupt
        return real(*given, number=number, **named)

    monkeypatch.setattr(generator, "sample", killed)
    with pytest.raises(KeyboardInterrupt):
        write_samples(generator, conditions, out=tmp_path, name="v_0", samples=3, seed=1, settings=fast)
    assert sorted(path.name for path in tmp_path.glob("v_0*")) == ["v_0.json", "v_0_0.mp4", "v_0_1_0.mp4"]
    told = json.loads((tmp_path / "v_0.json").read_text())
    assert (told["unfinished"], told["seed"], told["samples"]) == (True, 1, 3)
    monkeypatch.undo()
    write_samples(generator, conditions, out=tmp_path, name="v_0", samples=3, seed=1, settings=fast)
    still = ClipConditions(image=IMAGE, caption="x", first_control=SKELETON)
    write_samples(generator, still, out=tmp_path, name="v_0", samples=1, settings=fast)
    for folder, kept in ((tmp_path, ["v_0_0.mp4", "v_0_1_0.mp4"]), (tmp_path / "skeleton", ["v_0_0.mp4"])):
        assert sorted(path.name for path in folder.glob("*.mp4")) == kept
    assert not list((tmp_path / "conditions").iterdir()), "this one was asked for no trajectory"


def test_what_a_killed_first_run_made_is_not_taken_for_the_next_one_s(generator, tmp_path: Path, monkeypatch) -> None:
    fast = SamplingSettings(steps=1, guidance=1.0)
    still = ClipConditions(image=IMAGE, caption="x", first_control=SKELETON)
    driven = replace(still, trajectory=ego_trajectory("straight 5m/s", frames=9, fps=24))
    real = generator.sample

    def killed(*given: Any, number: int, **named: Any) -> Any:
        if number == 2:
            raise KeyboardInterrupt
        return real(*given, number=number, **named)

    monkeypatch.setattr(generator, "sample", killed)
    with pytest.raises(KeyboardInterrupt):
        write_samples(generator, driven, out=tmp_path, name="v_0", samples=3, seed=5, settings=fast)
    monkeypatch.undo()
    write_samples(generator, still, out=tmp_path, name="v_0", samples=1, settings=fast)
    found = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.*"))
    assert found == ["skeleton/v_0_0.mp4", "v_0.json", "v_0_0.mp4"]
    assert "unfinished" not in json.loads((tmp_path / "v_0.json").read_text())


def test_a_clip_is_made_again_when_the_trajectory_file_changes(generator, tmp_path: Path) -> None:
    sample = packed_clip()
    request = ClipsRequest(ego=str(tmp_path / "drive.tum"))
    options = GenerateOptions(steps=1, guidance=1.0)

    def made(speed: float) -> bool:
        poses = np.tile(np.eye(4), (9, 1, 1))
        poses[:, 2, 3] = speed * np.arange(9)
        write_tum(rebased_trajectory(np.arange(9) / 24, poses), tmp_path / "drive.tum")
        settings = SamplingSettings(steps=1, guidance=1.0)
        return _make(generator, sample, request, out=tmp_path / "o", options=options, settings=settings, adapters={})

    assert [made(speed) for speed in (0.1, 0.1, 2.0, 2.0)] == [True, False, True, False]


@pytest.mark.parametrize(("given", "used"), [(None, packed_clip().caption), ("Night.", "Night."), ("", "")])
def test_a_caption_for_all_clips_may_be_empty(generator, tmp_path: Path, given: str | None, used: str) -> None:
    _make(
        generator, packed_clip(), ClipsRequest(caption=given), out=tmp_path, adapters={},
        settings=SamplingSettings(steps=1), options=GenerateOptions(steps=1),
    )  # fmt: skip
    assert json.loads((tmp_path / "v_0.json").read_text())["caption"] == used


@pytest.mark.parametrize("gone", ["v_0_1.mp4", "skeleton/v_0_1.mp4", "conditions/v_0.tum", "v_0.json"])
def test_a_clip_is_made_again_when_one_of_its_files_is_gone(generator, tmp_path: Path, gone: str) -> None:
    def made() -> bool:
        return _make(
            generator, packed_clip(), ClipsRequest(), out=tmp_path, adapters={}, settings=SamplingSettings(steps=1),
            options=GenerateOptions(samples=2, steps=1),
        )  # fmt: skip

    assert (made(), made()) == (True, False)
    (tmp_path / gone).unlink()
    assert made() and (tmp_path / gone).is_file() and not made()


@pytest.mark.parametrize("asked", [ClipsRequest(ego="still", true_skeletons=True), ClipsRequest(object_variant=0)])
def test_a_clip_s_own_views_are_not_wanted_beyond_its_end(generator, tmp_path: Path, asked: ClipsRequest) -> None:
    """What lies beyond it would be drawn black, as if nothing were there."""
    longer = ClipGenerator(
        load_backbone(generator.backbone.config), motion=generator.motion, appearance=generator.appearance, frames=17
    )
    with pytest.raises(ConfigError, match="v_0 has 9 frames, but its own skeletons or objects are wanted in 17"):
        _make(
            longer, packed_clip(), asked, out=tmp_path, adapters={}, settings=SamplingSettings(steps=1),
            options=GenerateOptions(steps=1),
        )  # fmt: skip


@pytest.mark.parametrize("frames", [0, -7])
def test_no_frames_are_not_taken_for_the_usual_ones(generator, frames: int) -> None:
    with pytest.raises(ConfigError, match=f"--frames {frames} leaves nothing"):
        ClipGenerator(generator.backbone, motion=generator.motion, frames=frames)


def test_the_record_of_one_clip_tells_what_it_was_made_of(adapters, tmp_path: Path) -> None:
    for name, picture in (("first", IMAGE), ("skeleton", SKELETON)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), picture[..., ::-1])
    run_generate(
        out=tmp_path / "o", **two_stages(adapters), image=tmp_path / "first.png", skeleton=tmp_path / "skeleton.png",
        caption="x", ego="left 30deg", options=GenerateOptions(steps=1, guidance=1.0),
    )  # fmt: skip
    record = json.loads((tmp_path / "o" / "first.json").read_text())
    hashes = {stage: sha256_file(path) for stage, path in two_stages(adapters).items()}
    assert (record["adapters"], record["ego"], record["clip"]) == (hashes, "left 30deg", None)
    assert record["files"]["image"] == {"file": "first.png", "sha256": sha256_file(tmp_path / "first.png")}
    assert sorted(record["files"]) == ["image", "skeleton"]


@pytest.mark.parametrize("extractors", [None, ["street_detector"]], ids=["none", "boxes alone"])
def test_no_extractor_for_the_first_skeleton_is_said_before_anything_is_loaded(
    adapters, tmp_path: Path, monkeypatch, extractors
) -> None:
    monkeypatch.setenv("ANIMATIC_MODELS", str(tmp_path))
    monkeypatch.setattr("training.generation.load_backbone", lambda *_, **__: pytest.fail("it was loaded"))
    with pytest.raises(ConfigError, match=r"no keypoint extractors to find the first skeleton.*--models DIR"):
        generate(image=IMAGE, caption="x", out=tmp_path, **two_stages(adapters), extractors=extractors)


def test_videos_have_the_adapters_frame_rate_whatever_the_backbone_says(tmp_path: Path) -> None:
    halved = PICTURE | {"frame_step": 5}
    datasets = {"train": [FakeSample(key="a_0", frames_count=41)], "val": []}
    cache_latents(tmp_path, backbone_name="tiny", picture=halved, datasets=datasets)
    config = tiny_config("motion", backbone={"picture": halved}, optimiser={"steps": 1})
    train(config, data=tmp_path, out=tmp_path / "m", quiet=True)
    (made,) = generate(
        image=IMAGE, caption="x", out=tmp_path / "o", motion=tmp_path / "m", skeleton=SKELETON, steps=1, backbone="tiny"
    )
    times = read_packet_times(made.control).times_s
    assert len(times) == 9 and np.diff(times) == pytest.approx(np.full(8, 5 / 24), abs=1e-4)


def test_an_object_that_enters_late_is_shown_late(tmp_path: Path) -> None:
    picture = PictureConfig.model_validate(PICTURE | {"frame_step": 2})
    write_keypoints(tmp_path / "late.parquet", [walker(frame, x=30) for frame in range(10, 17)])
    video = object_clip(tmp_path / "late.parquet", frames=9, picture=picture)
    assert video.any((1, 2, 3)).tolist() == [False] * 5 + [True] * 4
    with pytest.raises(ConfigError, match="first label is in frame 10, but the clip has frames 0 to 8"):
        object_clip(tmp_path / "late.parquet", frames=5, picture=picture)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"data": Path("job"), "image": Path("a.png")}, "--image would not be used"),
        ({"data": Path("job"), "image": Path("a.png"), "skeleton": Path("b.png")}, "--image and --skeleton would not"),
        ({"image": Path("a.png"), "caption": "x", "clip": "v_0"}, "give --data JOB too"),
    ],
    ids=["image", "skeleton", "clip"],
)
def test_two_things_to_start_from_are_refused(given: Any, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        run_generate(out=Path("out"), motion=Path("m"), appearance=None, **given)
    if "data" in given:
        own = {name: given.get(name) for name in ("image", "skeleton")}
        with pytest.raises(ConfigError, match=words):
            show_clips(given["data"], ClipsRequest(), out=Path("out"), motion=Path("m"), appearance=None, **own)


def test_a_folder_that_cannot_be_written_to_is_a_storage_error(generator, tmp_path: Path) -> None:
    from labeling.errors import StorageError
    from training.generation import GeneratedClip, write_clip

    (tmp_path / "file").write_text("in the way")
    clip = GeneratedClip(rgb=np.zeros((2, 64, 96, 3), np.uint8), control=None)
    with pytest.raises(StorageError):
        write_clip(clip, tmp_path / "file", "a", fps=24, seed=0, number=0)


def test_the_first_skeleton_is_what_the_extractors_see(monkeypatch: pytest.MonkeyPatch) -> None:
    from types import SimpleNamespace

    from labeling import extractors, observation

    shown: list[tuple[int, ...]] = []
    scale = LABEL_WIDTH // WIDTH
    label = walker(0, x=40)
    # Pixel centres lie on integers.
    label.points[:, :2] = (label.points[:, :2] + 0.5) * scale - 0.5

    class Look:
        def see(self, picture: np.ndarray, frame: int) -> list[Keypoints]:
            shown.append(picture.shape)
            return [label]

    monkeypatch.setattr(extractors, "choose_extractors", lambda *_, **__: SimpleNamespace(draws_nothing=False))
    monkeypatch.setattr(extractors, "Extractors", lambda *_, **__: None)
    monkeypatch.setattr(observation, "looks_of", lambda _: [Look()])
    found = first_skeleton(IMAGE, picture=PictureConfig.model_validate(PICTURE))
    assert shown == [(HEIGHT * scale, LABEL_WIDTH, 3)]
    assert np.array_equal(
        found, draw_skeletons([walker(0, x=40)], width=WIDTH, height=HEIGHT, label_width=WIDTH, label_height=HEIGHT)
    )


def test_another_intermediate_representation_goes_through_both_stages(tmp_path: Path) -> None:
    cache_latents(
        tmp_path, backbone_name="tiny", picture=PICTURE, controls=["segmentation"], datasets=fake_datasets(2, 0)
    )
    made: dict[Stage, Path] = {"motion": tmp_path / "m", "appearance": tmp_path / "a"}
    for stage, out in made.items():
        config = tiny_config(stage, conditions={"control": "segmentation"}, optimiser={"steps": 2})
        train(config, data=tmp_path, out=out, quiet=True)
    generator = ClipGenerator(
        load_backbone(backbone_config("tiny", picture=PICTURE)), motion=made["motion"], appearance=made["appearance"]
    )
    assert generator.control_name("motion") == generator.control_name("appearance") == "segmentation"
    first = SAMPLE.frames("segmentation.mp4")[0]
    given = prepare_conditions(generator, image=IMAGE, caption="A road.", skeleton=first)
    clip = generator.sample(given, settings=FAST)
    assert clip.rgb is not None and clip.control is not None and clip.rgb.shape == clip.control.shape
    with pytest.raises(ConfigError, match="first segmentation frame"):
        prepare_conditions(generator, image=IMAGE, caption="A road.")
