"""The grid against a brute-force truth in fractions; clips, runs, hard cuts; runs and clips as files."""

import math
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import cast

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from video_fixtures import (
    SourceSpec,
    coded,
    cut_off,
    patches,
    read_code,
    read_patches,
    regular_times,
    retimed,
    variable_times,
    with_garbage,
    write_source,
)

from labeling.camera import cover_map
from labeling.encoding import EncoderSettings, VideoWriter
from labeling.errors import ConfigError, StorageError, VideoError
from labeling.hard_cuts import find_hard_cuts, thumbnail
from labeling.run_encoder import RunEncoder
from labeling.timeline import (
    RunFrames,
    Span,
    Timeline,
    clip_fault,
    clip_key,
    copy_clip,
    cut_run,
    plan_clips,
    plan_runs,
    plan_timeline,
    run_name,
)
from labeling.video import SourceFrame, decode_frames, probe, read_frames, read_packet_times

SIZE = {"width": 96, "height": 64}
RATES = [24, 25, 20, 60, 10, Fraction(30000, 1001), Fraction(24000, 1001)]


def nearest_by_fractions(times: list[Fraction], fps: int) -> list[int]:
    """Index of the frame that each grid frame shows, straight from the definition, in exact arithmetic."""
    count = math.floor((times[-1] - times[0]) * fps) + 1
    grid = [times[0] + Fraction(i, fps) for i in range(count)]
    return [min(range(len(times)), key=lambda k: (abs(times[k] - at), times[k])) for at in grid]


def as_floats(times: list[Fraction]) -> np.ndarray:
    return np.array([float(time) for time in times])


def planned(path: Path) -> Timeline:
    return plan_timeline(read_packet_times(path).times_s)


def cut_whole(path: Path, out: Path, *, b_frames: int = 3) -> RunFrames:
    info = probe(path)
    picture = cover_map(info.width, info.height, **SIZE)
    timeline = planned(path)
    encoder = EncoderSettings(preset="ultrafast", crf=12, b_frames=b_frames)
    return cut_run(path, timeline, Span(start=0, end=len(timeline)), out, picture=picture, encoder=encoder)


def codes(path: Path) -> list[int]:
    return [read_code(rgb) for rgb in read_frames(path)]


@pytest.mark.parametrize("rate", RATES, ids=str)
@pytest.mark.parametrize("first_s", [Fraction(0), Fraction(-1, 3), Fraction(7200) + Fraction(1, 90000)], ids=str)
def test_every_grid_frame_shows_the_nearest_source_frame(rate: Fraction | int, first_s: Fraction) -> None:
    times = [first_s + time for time in regular_times(rate, 61)]
    timeline = plan_timeline(as_floats(times))
    expected = nearest_by_fractions(times, 24)
    assert timeline.source_time_s.tolist() == [float(times[k]) for k in expected]
    assert timeline.duplicate.tolist() == [False] + [a == b for a, b in zip(expected, expected[1:], strict=False)]
    assert not timeline.hole.any()


@given(st.lists(st.integers(1, 20000), min_size=1, max_size=40), st.integers(-90000, 900000))
def test_variable_rates_agree_with_exact_arithmetic(steps: list[int], first: int) -> None:
    times = [Fraction(int(tick), 90000) for tick in first + np.concatenate([[0], np.cumsum(steps)])]
    timeline = plan_timeline(as_floats(times))
    assert timeline.source_time_s.tolist() == [float(times[k]) for k in nearest_by_fractions(times, 24)]


def test_rounding_never_costs_the_last_frame() -> None:
    for count in range(1, 300):
        assert len(plan_timeline(1 / 3 + np.arange(count) / 24)) == count


def test_a_tie_goes_to_the_earlier_frame() -> None:
    timeline = plan_timeline(np.array([0.0, 1 / 48, 3 / 48, 4 / 48]))
    assert timeline.source_time_s.tolist() == [0.0, 1 / 48, 4 / 48]


def test_only_gaps_over_a_quarter_second_are_holes_and_only_inside() -> None:
    times = np.concatenate([np.arange(0, 25), np.arange(30, 49), np.arange(56, 73)]) / 24
    timeline = plan_timeline(times)
    assert np.flatnonzero(timeline.hole).tolist() == list(range(49, 56))


@pytest.mark.parametrize("times", [[], [0.0, math.nan], [math.inf]], ids=str)
def test_times_that_are_none_are_refused(times: list[float]) -> None:
    with pytest.raises(VideoError, match="finite"):
        plan_timeline(np.array(times))


def test_clips_stand_on_the_stride_and_are_dropped_with_numbers() -> None:
    times = np.concatenate([np.arange(0, 130), np.arange(140, 480)]) / 24
    plan = plan_clips(plan_timeline(times), leave_out_s=(1.5, 3.0))
    assert [clip.start for clip in plan.kept] == [144, 192, 240]
    assert all(len(clip) == 121 for clip in plan.kept)
    reasons = {item.span.start: item.reason for item in plan.dropped}
    assert reasons == {
        0: "left_out: start=0.000 s < 1.5 s",
        48: "hole=10 frames from 5.417 s",
        96: "hole=10 frames from 5.417 s",
        288: "left_out: end=17.042 s > 17.000 s",
        336: "left_out: end=19.042 s > 17.000 s",
    }


def test_the_real_numbers_of_clips_and_a_video_too_short() -> None:
    plan = plan_clips(plan_timeline(np.arange(1440) / 24))
    assert (len(plan.kept), plan.kept[-1].end) == (28, 1417)
    short = plan_clips(plan_timeline(np.arange(120) / 24))
    assert short.kept == () and short.dropped[0].reason == "too_short: frames=120 < clip_frames=121"
    assert len(plan_clips(plan_timeline(np.arange(121) / 24)).kept) == 1


@given(st.lists(st.integers(0, 120), unique=True, max_size=60))
def test_runs_cover_every_clip_once_and_nothing_else(starts: list[int]) -> None:
    clips = [Span(start=48 * start, end=48 * start + 121) for start in starts]
    runs = plan_runs(clips)
    wanted = {frame for clip in clips for frame in range(clip.start, clip.end)}
    assert {frame for run in runs for frame in range(run.start, run.end)} == wanted
    for clip in clips:
        owners = [run for run in runs if run.contains(clip) and run.start // 1440 == clip.start // 1440]
        assert len(owners) == 1 and (clip.start - owners[0].start) % 24 == 0
    same_minute = [(a, b) for a, b in zip(runs, runs[1:], strict=False) if a.start // 1440 == b.start // 1440]
    assert all(a.end < b.start for a, b in same_minute)
    assert all(a.end - b.start <= 73 for a, b in zip(runs, runs[1:], strict=False))


def test_clips_that_touch_are_one_run_and_a_frame_between_makes_two() -> None:
    first = Span(start=0, end=121)
    assert plan_runs([first, Span(start=121, end=242)]) == [Span(start=0, end=242)]
    assert plan_runs([first, Span(start=122, end=243)]) == [first, Span(start=122, end=243)]


def test_names() -> None:
    assert clip_key("nOP1blfMCTg", 25392) == "nOP1blfMCTg_25392"
    assert run_name(Span(start=48, end=1440)) == "run_48_1440"
    for wrong in ("a.b", "", "a b", "a/b", "ä", "a\n"):
        with pytest.raises(ConfigError, match="video id"):
            clip_key(wrong, 0)


@pytest.mark.parametrize("rate", [25, 60, Fraction(30000, 1001), "variable"], ids=str)
def test_a_run_shows_the_planned_frames(tmp_path: Path, rate: Fraction | int | str) -> None:
    times = variable_times(80) if isinstance(rate, str) else regular_times(rate, 80)
    source = write_source(tmp_path / "source.mp4", times, SourceSpec(first_s=Fraction(1, 3)))
    frames = cut_whole(source, tmp_path / "run.mp4")
    assert codes(tmp_path / "run.mp4") == nearest_by_fractions(times, 24)
    assert not frames.hole.any() and not frames.cut.any()


@pytest.mark.parametrize("container", ["mp4", "mpegts", "matroska"])
def test_a_run_in_the_middle_is_the_same_frames(tmp_path: Path, container: str) -> None:
    spec = SourceSpec(container=container, gop=30, b_frames=3)
    source = write_source(tmp_path / "source", regular_times(24, 120), spec)
    out = tmp_path / "run.mp4"
    frames = cut_run(source, planned(source), Span(start=55, end=100), out, picture=cover_map(128, 96, **SIZE))
    assert codes(out) == list(range(55, 100)) == frames.frame.tolist()


@pytest.mark.parametrize(("fps", "held"), [(12, range(0)), (24, range(20, 44)), (12, range(10, 22))], ids=str)
def test_what_is_shown_again_is_told(tmp_path: Path, fps: int, held: range) -> None:
    """A source of fewer frames, and one whose camera froze for a second, which its own coder codes as what it is."""

    def picture(index: int, width: int, height: int) -> np.ndarray:
        return coded(held[0] if index in held else index, width, height)

    count = 2 * fps
    source = write_source(tmp_path / "source.mp4", regular_times(fps, count), picture=picture)
    frames = cut_whole(source, tmp_path / "run.mp4")
    shown = [min(frame * fps // 24, count - 1) for frame in range(len(frames.frame))]
    of = [held[0] if index in held else index for index in shown]
    assert frames.duplicate.tolist() == [False, *(a == b for a, b in pairwise(of))]


@pytest.mark.parametrize("b_frames", [0, 3])
def test_copied_clips_are_the_runs_frames_bit_for_bit(tmp_path: Path, b_frames: int) -> None:
    source = write_source(tmp_path / "source.mp4", regular_times(24, 121 + 48))
    run_mp4, run = tmp_path / "run.mp4", Span(start=0, end=169)
    cut_whole(source, run_mp4, b_frames=b_frames)
    whole = list(read_frames(run_mp4))
    for clip in (Span(start=0, end=121), Span(start=48, end=169)):
        copy_clip(run_mp4, run, clip, tmp_path / "clip.mp4")
        copied = list(read_frames(tmp_path / "clip.mp4"))
        assert len(copied) == 121
        assert all(np.array_equal(a, b) for a, b in zip(copied, whole[clip.start : clip.end], strict=True))
    assert [read_code(rgb) for rgb in whole] == list(range(169))


def test_overlapping_runs_agree_on_the_frames_they_share(tmp_path: Path) -> None:
    source = write_source(tmp_path / "source.mp4", regular_times(30, 150))
    timeline, picture = planned(source), cover_map(128, 96, **SIZE)
    shared = []
    for name, span in (("a", Span(start=0, end=96)), ("b", Span(start=48, end=120))):
        cut_run(source, timeline, span, tmp_path / name, picture=picture)
        shared.append([read_code(rgb) for rgb in read_frames(tmp_path / name)][48 - span.start : 96 - span.start])
    assert shared[0] == shared[1] and len(shared[0]) == 48


def test_clips_that_cannot_be_copied_whole_are_refused(tmp_path: Path) -> None:
    run_mp4, run = tmp_path / "run.mp4", Span(start=0, end=96)
    cut_whole(write_source(tmp_path / "source.mp4", regular_times(24, 96)), run_mp4)
    with pytest.raises(VideoError, match="not a keyframe"):
        copy_clip(run_mp4, run, Span(start=12, end=36), tmp_path / "clip.mp4")
    with pytest.raises(VideoError, match="outside"):
        copy_clip(run_mp4, run, Span(start=72, end=97), tmp_path / "clip.mp4")
    assert not (tmp_path / "clip.mp4").exists()


def test_the_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    source = write_source(tmp_path / "source.mp4", variable_times(60))
    outputs = []
    for name in ("first.mp4", "second.tmp"):
        cut_whole(source, tmp_path / name)
        copy_clip(tmp_path / name, Span(start=0, end=49), Span(start=24, end=49), tmp_path / f"clip_{name}")
        outputs.append(((tmp_path / name).read_bytes(), (tmp_path / f"clip_{name}").read_bytes()))
    assert outputs[0] == outputs[1]


@pytest.mark.parametrize(
    "spec",
    [
        SourceSpec(matrix="bt601"),
        SourceSpec(matrix="bt601", tagged=False),
        SourceSpec(full_range=True),
        SourceSpec(full_range=True, matrix="bt601"),
        SourceSpec(pixel_format="yuv420p10le"),
        SourceSpec(pixel_format="yuv420p10le", full_range=True),
        SourceSpec(interlaced=True),
        SourceSpec(width=160, height=90),
        SourceSpec(width=90, height=160),
        SourceSpec(width=98, height=74),
        SourceSpec(aspect=Fraction(4, 3)),
        SourceSpec(tagged=False, width=1280, height=720),
    ],
    ids=[
        "601",
        "untagged-sd",
        "full",
        "full-601",
        "10-bit",
        "10-bit-full",
        "interlaced",
        "wide",
        "portrait",
        "odd-sized",
        "sar",
        "hd",
    ],
)
def test_colours_come_out_within_three_levels(tmp_path: Path, spec: SourceSpec) -> None:
    source = write_source(tmp_path / "source.mp4", regular_times(24, 3), spec, picture=patches)
    cut_whole(source, tmp_path / "run.mp4")
    expected = read_patches(patches(0, 96, 64))
    for rgb in read_frames(tmp_path / "run.mp4"):
        assert np.abs(read_patches(rgb) - expected).max() <= 3.0


@pytest.mark.parametrize("rotation_deg", [90, 180, 270])
def test_turned_sources_come_out_upright(tmp_path: Path, rotation_deg: int) -> None:
    spec = SourceSpec(rotation_deg=rotation_deg)
    source = write_source(tmp_path / "source.mp4", regular_times(24, 2), spec, picture=patches)
    assert (probe(source).width, probe(source).height) == ((128, 96) if rotation_deg == 180 else (96, 128))
    cut_whole(source, tmp_path / "run.mp4")
    upright = np.rot90(patches(0, 128, 96), -rotation_deg // 90)
    rgb = next(read_frames(tmp_path / "run.mp4"))
    assert np.abs(read_patches(rgb) - read_patches(upright)).max() <= 3.0


@pytest.mark.parametrize(("width", "height"), [(160, 90), (90, 160), (128, 96), (98, 74)])
def test_what_is_cropped_is_what_the_picture_map_says(tmp_path: Path, width: int, height: int) -> None:
    def cross(index: int, width: int, height: int) -> np.ndarray:
        rgb = np.full((height, width, 3), 40, np.uint8)
        rgb[height * 5 // 8 // 2 * 2 :, width * 5 // 8 // 2 * 2 :] = 220
        return rgb

    source = write_source(
        tmp_path / "s.mp4", regular_times(24, 2), SourceSpec(width=width, height=height), picture=cross
    )
    cut_whole(source, tmp_path / "run.mp4")
    picture = cover_map(width, height, **SIZE)
    grey = next(read_frames(tmp_path / "run.mp4"))[..., 0] > 130
    row = height * 5 // 8 // 2 * 2 * picture.scale_y - picture.crop_y
    column = width * 5 // 8 // 2 * 2 * picture.scale_x - picture.crop_x
    assert abs(64 - grey[:, -4].sum() - row) <= 1.0
    assert abs(96 - grey[-4].sum() - column) <= 1.0


def test_interlaced_motion_is_not_combed(tmp_path: Path) -> None:
    def bar(index: int, width: int, height: int) -> np.ndarray:
        rgb = np.full((height, width, 3), 30, np.uint8)
        rgb[:, 8 * index % width : 8 * index % width + 32] = 200
        return rgb

    spec = SourceSpec(width=96, height=64, interlaced=True)
    source = write_source(tmp_path / "source.mp4", regular_times(24, 8), spec, picture=bar)
    assert probe(source).interlaced
    cut_whole(source, tmp_path / "run.mp4")
    for shown in (read_frames(tmp_path / "run.mp4"), (frame.rgb for frame in decode_frames(source))):
        combing = [np.abs(np.diff(rgb[8:-8, :, 0].astype(int), axis=0)).mean() for rgb in shown]
        assert len(combing) == 8 and max(combing) < 3.0


@pytest.mark.parametrize("b_frames", [0, 2])
@pytest.mark.parametrize("broken", [(100, 100), (101, 103), (96, 96)], ids=str)
def test_what_does_not_decode_is_a_hole_up_to_the_next_keyframe(
    tmp_path: Path, b_frames: int, broken: tuple[int, int]
) -> None:
    spec = SourceSpec(gop=24, b_frames=b_frames)
    whole = write_source(tmp_path / "whole.mp4", regular_times(24, 144), spec)
    source = with_garbage(whole, tmp_path / "broken.mp4", first=broken[0], last=broken[1])
    frames = cut_whole(source, tmp_path / "run.mp4")
    shown = codes(tmp_path / "run.mp4")
    assert [i for i, code in enumerate(shown) if code != i and not frames.hole[i]] == []
    holes = np.flatnonzero(frames.hole)
    assert frames.hole[broken[0]] and holes.min() >= broken[0] - 4 and holes.max() < 120
    assert clip_fault(frames, Span(start=0, end=73)) is None
    assert clip_fault(frames, Span(start=120, end=144)) is None
    assert str(clip_fault(frames, Span(start=48, end=121))).startswith(f"hole={len(holes)} frames from ")


def test_b_frames_before_a_damaged_frame_are_lost_with_it() -> None:
    class Sink:
        def write_frame(self, picture: av.VideoFrame) -> None:
            assert (picture.width, picture.height) == (96, 64)

    run = RunEncoder(np.arange(7) / 24, writer=cast(VideoWriter, Sink()))
    for i, (is_bidirectional, is_clean) in enumerate([(0, 1), (1, 1), (0, 1), (1, 1), (1, 1), (0, 0), (0, 1)]):
        picture = av.VideoFrame.from_ndarray(np.full((96, 96), 20 * i, np.uint8), format="yuv420p")
        run.show(
            SourceFrame(
                time_s=i / 24, picture=picture, is_keyframe=False, is_clean=bool(is_clean),
                is_bidirectional=bool(is_bidirectional),
            )
        )  # fmt: skip
    assert np.flatnonzero(run.lost).tolist() == [3, 4, 5]


def test_a_file_without_its_end_keeps_what_is_there(tmp_path: Path) -> None:
    whole = write_source(tmp_path / "whole.mp4", regular_times(24, 144), SourceSpec(gop=24, faststart=True))
    source = cut_off(whole, tmp_path / "half.mp4")
    times = read_packet_times(source)
    assert 40 < len(times.times_s) < 110 and times.broken_packets == 144 - len(times.times_s)
    frames = cut_whole(source, tmp_path / "run.mp4")
    shown = codes(tmp_path / "run.mp4")
    assert [i for i, code in enumerate(shown) if code != i and not frames.hole[i]] == []
    first = int(np.argmax(frames.hole)) if frames.hole.any() else len(shown)
    assert frames.hole[first:].all() and len(shown) - first < 24


def test_a_time_that_comes_twice_costs_no_frame(tmp_path: Path) -> None:
    """Matroska may hold two frames at one time: the first is shown, and nothing after it is late."""
    plain = write_source(tmp_path / "plain.mkv", regular_times(24, 30), SourceSpec(b_frames=0, container="matroska"))
    source = retimed(plain, tmp_path / "twice.mkv", lambda place: -(-(place - (place > 12)) * 1000 // 24))
    timeline = planned(source)
    assert len(timeline) == 29
    out = tmp_path / "run.mp4"
    cut_run(source, timeline, Span(start=0, end=29), out, picture=cover_map(128, 96, **SIZE))
    shown = [read_code(frame) for frame in read_frames(out)]
    assert shown == [*range(13), *range(14, 30)]


def test_recordings_joined_as_they_were_are_refused(tmp_path: Path) -> None:
    """Their times begin again, so that all but one of them would be lost in silence."""
    spec = SourceSpec(b_frames=0, container="mpegts")
    parts = [write_source(tmp_path / f"{n}.ts", regular_times(24, 48), spec).read_bytes() for n in range(2)]
    (tmp_path / "both.ts").write_bytes(b"".join(parts))
    with pytest.raises(VideoError, match="timestamps start again"):
        read_packet_times(tmp_path / "both.ts")


def test_a_wild_time_is_refused_before_it_takes_the_memory() -> None:
    with pytest.raises(VideoError, match="a timestamp is wild"):
        plan_timeline(np.array([0.0, 0.04, 2.0**35]))


def test_a_hard_cut_is_found_and_drops_only_clips_that_contain_it(tmp_path: Path) -> None:
    scenes = np.random.default_rng(0).integers(0, 256, (2, 6, 8, 3), dtype=np.uint8)

    def two_shots(index: int, width: int, height: int) -> np.ndarray:
        big = np.kron(scenes[int(index >= 30)], np.ones((20, 20, 1), np.uint8))
        return np.roll(big, 2 * index, axis=1)[:height, :width]

    source = write_source(tmp_path / "source.mp4", regular_times(25, 60), picture=two_shots)
    frames = cut_whole(source, tmp_path / "run.mp4")
    assert np.flatnonzero(frames.cut).tolist() == [29]
    assert clip_fault(frames, Span(start=0, end=29)) is None
    assert clip_fault(frames, Span(start=29, end=50)) is None
    assert clip_fault(frames, Span(start=24, end=48)) == "cut=1 first at 1.208 s"
    with pytest.raises(VideoError, match="outside"):
        clip_fault(frames, Span(start=40, end=90))


def drive(count: int, *, speed: int, seed: int = 0) -> np.ndarray:
    """(N, 66, 99) uint8: a smooth random scene that is panned over."""
    rng = np.random.default_rng(seed)
    coarse = np.kron(rng.integers(0, 256, (11, 12 + count * speed // 9)), np.ones((6, 9)))
    smooth = cv2.blur(coarse, (7, 7))
    return np.stack([smooth[:, i * speed : i * speed + 99] for i in range(count)]).astype(np.uint8)


def cuts_of(pictures: np.ndarray) -> list[int]:
    return np.flatnonzero(find_hard_cuts(np.stack([thumbnail(picture) for picture in pictures]))).tolist()


@pytest.mark.parametrize("speed", [0, 1, 3, 9, 30])
def test_motion_of_any_speed_is_no_cut(speed: int) -> None:
    assert cuts_of(drive(60, speed=speed)) == []


def test_flashes_exposure_and_jolts_are_no_cuts() -> None:
    still = drive(60, speed=1)
    flash, exposure, jolt = still.copy(), still.copy(), still.copy()
    flash[20:24] = np.clip(flash[20:24].astype(int) * 2 + 80, 0, 255)
    flash[40] = 255
    exposure[30:] = (exposure[30:] * 0.5 + 5).astype(np.uint8)
    jolt[25] = np.roll(jolt[25], 3, axis=0)
    assert cuts_of(flash) == cuts_of(exposure) == cuts_of(jolt) == []


@pytest.mark.parametrize("speed", [0, 1, 3])
def test_cuts_are_found_in_motion(speed: int) -> None:
    shots = [drive(30, speed=speed, seed=seed) for seed in (1, 2, 3)]
    assert cuts_of(np.concatenate(shots)) == [30, 60]


def test_tables_too_short_for_a_cut() -> None:
    assert cuts_of(drive(1, speed=0)) == []


def test_a_real_drive_has_no_cut_and_two_drives_joined_have_one(real_data: Path, tmp_path: Path) -> None:
    source = real_data / "solidWhiteRight.mp4"
    timeline, info = planned(source), probe(source)
    assert [clip.start for clip in plan_clips(timeline).kept] == [0, 48]
    frames = cut_run(
        source, timeline, Span(start=0, end=48), tmp_path / "run.mp4",
        picture=cover_map(info.width, info.height, width=528, height=352),
    )  # fmt: skip
    assert not frames.cut.any() and not frames.hole.any()
    white = [rgb[..., 1] for rgb in read_frames(tmp_path / "run.mp4")]
    other = real_data / "kitti_03" / "left_gray_10fps.mp4"
    kitti = [rgb[..., 1] for rgb in read_frames(other, start=100, end=140)]
    joined = np.stack([thumbnail(picture) for picture in white[:40] + kitti])
    assert np.flatnonzero(find_hard_cuts(joined)).tolist() == [40]


def test_output_that_cannot_be_written_is_a_storage_error(tmp_path: Path) -> None:
    source = write_source(tmp_path / "source.mp4", regular_times(24, 30))
    (tmp_path / "folder").write_text("a file where a folder should be")
    with pytest.raises(StorageError, match="cannot be written"):
        cut_whole(source, tmp_path / "folder" / "run.mp4")


def test_a_run_outside_the_timeline_is_refused(tmp_path: Path) -> None:
    source = write_source(tmp_path / "source.mp4", regular_times(24, 30), picture=coded)
    with pytest.raises(VideoError, match="leaves the timeline"):
        cut_run(
            source, planned(source), Span(start=24, end=48), tmp_path / "run.mp4", picture=cover_map(128, 96, **SIZE)
        )  # fmt: skip
