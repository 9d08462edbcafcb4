"""What a file is, its times, its pictures by time; writing; and every way in which a file can be bad."""

import resource
import subprocess
import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from pydantic import ValidationError
from video_fixtures import (
    SourceSpec,
    coded,
    cut_off,
    patches,
    read_code,
    read_patches,
    regular_times,
    variable_times,
    write_audio_only,
    write_source,
)

from labeling.camera import cover_map
from labeling.conversion import colour_matrix
from labeling.encoding import EncoderSettings, VideoWriter, copy_packets, lossless_rgb
from labeling.errors import ConfigError, StorageError, VideoError
from labeling.mp4_boxes import indexed_frames, top_level_boxes
from labeling.read_ahead import read_ahead
from labeling.video import (
    decode_at,
    decode_frames,
    frame_count,
    probe,
    read_frames,
    read_packet_times,
)


def bad_files(folder: Path) -> dict[str, tuple[Path, str]]:
    """Each bad file, and a word of the message that tells it from the others."""
    good = write_source(folder / "good.mp4", regular_times(24, 24))
    (folder / "text.mp4").write_text("this is no video\n" * 300)
    (folder / "zero.mp4").write_bytes(b"")
    (folder / "html.mp4").write_text("<!doctype html><html>404</html>")
    fast = write_source(folder / "fast.mp4", regular_times(24, 24), SourceSpec(faststart=True))
    size = next(box.start + 8 for box in top_level_boxes(fast) if box.name == "mdat")
    (folder / "no_frames.mp4").write_bytes(fast.read_bytes()[:size])
    return {
        "missing": (folder / "missing.mp4", "no such file"),
        "folder": (folder, "is a folder"),
        "zero": (folder / "zero.mp4", "0 bytes"),
        "text": (folder / "text.mp4", "not a video"),
        "html": (folder / "html.mp4", "not a video"),
        "audio": (write_audio_only(folder / "audio.mp4"), "only audio"),
        "moov_gone": (cut_off(good, folder / "moov_gone.mp4"), "moov"),
        "all_mdat_gone": (folder / "no_frames.mp4", "frame"),
    }


@pytest.mark.parametrize("read", [probe, read_packet_times, lambda path: next(decode_frames(path))])
def test_every_bad_file_is_told_apart(tmp_path: Path, read: Callable[[Path], object]) -> None:
    for name, (path, word) in bad_files(tmp_path).items():
        with pytest.raises(VideoError, match=word) as caught:
            read(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value), name


@pytest.mark.parametrize(
    ("spec", "size"),
    [
        (SourceSpec(), (128, 96)),
        (SourceSpec(rotation_deg=90), (96, 128)),
        (SourceSpec(rotation_deg=180), (128, 96)),
        (SourceSpec(rotation_deg=270), (96, 128)),
        (SourceSpec(aspect=Fraction(4, 3)), (171, 96)),
        (SourceSpec(aspect=Fraction(3, 4)), (128, 128)),
        (SourceSpec(aspect=Fraction(4, 3), rotation_deg=90), (96, 171)),
    ],
    ids=["plain", "90", "180", "270", "wide-pixels", "tall-pixels", "wide-turned"],
)
def test_probe_sees_what_a_person_sees(tmp_path: Path, spec: SourceSpec, size: tuple[int, int]) -> None:
    info = probe(write_source(tmp_path / "source.mp4", regular_times(24, 12), spec))
    assert (info.width, info.height) == size
    assert (info.coded_width, info.coded_height, info.rotation_deg) == (128, 96, spec.rotation_deg)
    assert (info.codec, info.interlaced, info.full_range, info.color_matrix) == ("h264", False, False, "bt709")
    assert abs(info.duration_s - 0.5) < 0.05
    assert next(decode_frames(info.path)).rgb.shape == (size[1], size[0], 3)


def test_probe_sees_colours_and_fields(tmp_path: Path) -> None:
    def info_of(spec: SourceSpec) -> tuple[str, bool, bool, bool]:
        info = probe(write_source(tmp_path / "source.mp4", regular_times(24, 4), spec))
        return info.color_matrix, info.color_tagged, info.full_range, info.interlaced

    assert info_of(SourceSpec(matrix="bt601", full_range=True)) == ("smpte170m", True, True, False)
    assert info_of(SourceSpec(tagged=False)) == ("smpte170m", False, False, False)
    assert info_of(SourceSpec(interlaced=True)) == ("bt709", True, False, True)
    assert colour_matrix(2, width=1920, height=1080) == colour_matrix(2, width=720, height=1280) == "bt709"
    assert colour_matrix(2, width=720, height=576) == "smpte170m"


@pytest.mark.parametrize("b_frames", [0, 3])
@pytest.mark.parametrize("first_s", [Fraction(0), Fraction(-1, 2), Fraction(5)], ids=str)
@pytest.mark.parametrize("container", ["mp4", "matroska"])
def test_packets_alone_give_the_decoders_times(
    tmp_path: Path, b_frames: int, first_s: Fraction, container: str
) -> None:
    times = variable_times(50)
    spec = SourceSpec(b_frames=b_frames, first_s=first_s, container=container, gop=10)
    path = write_source(tmp_path / "source", times, spec)
    packets = read_packet_times(path)
    frames = list(decode_frames(path))
    assert packets.times_s.tolist() == [frame.time_s for frame in frames]
    # An MP4 shows nothing from before its zero: an edit list hides those frames.
    shown = [i for i in range(50) if container != "mp4" or times[i] + first_s >= 0]
    assert np.abs(np.diff(packets.times_s) - np.diff([float(times[i]) for i in shown])).max() < 1.1e-3
    assert [shown[i] for i in np.flatnonzero(packets.is_keyframe)] == [i for i in shown if i % 10 == 0]
    assert packets.broken_packets == 0 and all(frame.is_clean for frame in frames)


def test_frames_of_an_edit_that_starts_later_are_not_shown(tmp_path: Path) -> None:
    path = write_source(tmp_path / "source.mp4", regular_times(24, 48), SourceSpec(b_frames=2, gop=48))
    data = bytearray(path.read_bytes())
    at = data.index(b"elst")
    # Version 0: count, then duration, media time, rate. Ten frames are cut off the start.
    media_time = int.from_bytes(data[at + 16 : at + 20], "big")
    data[at + 16 : at + 20] = (media_time + 10 * 3750).to_bytes(4, "big")
    path.write_bytes(data)
    packets = read_packet_times(path)
    frames = list(decode_frames(path))
    assert [read_code(frame.rgb) for frame in frames] == list(range(10, 48))
    assert packets.times_s.tolist() == [frame.time_s for frame in frames]


@pytest.mark.parametrize("container", ["mp4", "mpegts", "matroska"])
@pytest.mark.parametrize("b_frames", [0, 3])
def test_decoding_from_anywhere_gives_the_same_frames(tmp_path: Path, container: str, b_frames: int) -> None:
    spec = SourceSpec(container=container, b_frames=b_frames, gop=20)
    path = write_source(tmp_path / "source", regular_times(30, 70), spec)
    times = read_packet_times(path).times_s
    for start, end in ((0, 3), (19, 22), (33, 41), (60, 70)):
        stop = times[end] if end < 70 else np.inf
        frames = list(decode_frames(path, start_s=times[start], end_s=stop))
        assert [frame.time_s for frame in frames] == times[start:end].tolist()
        assert [read_code(frame.rgb) for frame in frames] == list(range(start, end))


def test_frames_by_time_keyframes_or_not(tmp_path: Path) -> None:
    path = write_source(tmp_path / "source.mp4", regular_times(30, 70), SourceSpec(gop=20, b_frames=2))
    packets = read_packet_times(path)
    keys = packets.times_s[packets.is_keyframe]
    picture = cover_map(128, 96, width=96, height=64)
    frames = list(decode_at(path, keys.tolist(), picture=picture))
    assert [frame.time_s for frame in frames] == keys.tolist()
    assert [read_code(frame.rgb) for frame in frames] == [0, 20, 40, 60]
    assert frames[0].rgb.shape == (64, 96, 3)
    wanted = packets.times_s[[3, 4, 19, 20, 55, 69]]
    assert [read_code(frame.rgb) for frame in decode_at(path, wanted.tolist())] == [3, 4, 19, 20, 55, 69]
    assert list(decode_at(path, [0.51])) == []


@pytest.mark.parametrize("settings", [EncoderSettings(), EncoderSettings(b_frames=0, threads=2, gop=8)], ids=str)
def test_written_files_are_what_the_design_says(tmp_path: Path, settings: EncoderSettings) -> None:
    path = tmp_path / "out.mp4"
    rng = np.random.default_rng(0)
    with VideoWriter(path, width=96, height=64, settings=settings) as writer:
        for i in range(50):
            # Every frame is another scene, which would draw keyframes wherever they were allowed.
            writer.write(rng.integers(0, 256, (64, 96, 3), dtype=np.uint8) if i % 3 else coded(i, 96, 64))
    packets = read_packet_times(path)
    assert np.flatnonzero(packets.is_keyframe).tolist() == list(range(0, 50, settings.gop))
    assert np.abs(packets.times_s - np.arange(50) / 24).max() < 1e-9
    assert frame_count(path) == indexed_frames(path) == 50
    with av.open(str(path)) as container:
        context = container.streams.video[0].codec_context
        assert (context.colorspace, context.color_primaries, context.color_trc, context.color_range) == (1, 1, 1, 1)
        assert container.streams.video[0].average_rate == 24 and not container.metadata.get("creation_time")


def test_a_patch_comes_back_in_pyav_and_in_opencv(tmp_path: Path) -> None:
    path = tmp_path / "patches.mp4"
    with VideoWriter(path, width=192, height=128) as writer:
        for _ in range(3):
            writer.write(patches(0, 192, 128))
    expected = read_patches(patches(0, 192, 128))
    with av.open(str(path)) as container:
        by_pyav = next(container.decode(video=0)).to_ndarray(format="rgb24")
    capture = cv2.VideoCapture(str(path))
    by_opencv = np.asarray(capture.read()[1])[..., ::-1]
    ours = next(read_frames(path))
    for rgb in (by_pyav, by_opencv, ours):
        assert np.abs(read_patches(rgb) - expected).max() <= 3.0


def test_drawings_come_back_exactly(tmp_path: Path) -> None:
    pictures = np.random.default_rng(1).integers(0, 256, (5, 33, 47, 3), dtype=np.uint8)
    with VideoWriter(tmp_path / "exact.mp4", width=47, height=33, settings=lossless_rgb()) as writer:
        for rgb in pictures:
            writer.write(rgb)
    assert np.array_equal(np.stack(list(read_frames(tmp_path / "exact.mp4"))), pictures)


@pytest.mark.parametrize("settings", [EncoderSettings(), lossless_rgb()], ids=["yuv", "rgb"])
def test_frames_by_index_and_the_same_bytes_again(tmp_path: Path, settings: EncoderSettings) -> None:
    for name in ("a.mp4", "b.part"):
        with VideoWriter(tmp_path / name, width=96, height=64, settings=settings) as writer:
            for i in range(60):
                writer.write(coded(i, 96, 64))
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.part").read_bytes()
    for start, end in ((0, 60), (23, 25), (24, 48), (59, 60), (7, 7)):
        shown = [read_code(rgb) for rgb in read_frames(tmp_path / "a.mp4", start=start, end=end)]
        assert shown == list(range(start, end))
    with pytest.raises(VideoError, match="has 60 frames"):
        next(read_frames(tmp_path / "a.mp4", start=50, end=61))


def test_a_container_that_lists_no_frames_is_refused(tmp_path: Path) -> None:
    source = write_source(tmp_path / "a.mkv", regular_times(24, 8), SourceSpec(container="matroska"))
    with pytest.raises(VideoError, match="lists no frames; remux it"):
        list(read_frames(source))


def test_a_video_of_no_frames_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(VideoError, match="not one frame"), VideoWriter(tmp_path / "a.mp4", width=64, height=64):
        pass
    assert not list(tmp_path.iterdir())


def test_copying_from_what_is_no_video_says_so(tmp_path: Path) -> None:
    (tmp_path / "run.mp4").write_bytes(b"no video")
    with pytest.raises(VideoError, match=r"run\.mp4"):
        copy_packets(tmp_path / "run.mp4", tmp_path / "clip.mp4", start=0, end=5)


def test_wrong_frames_and_settings_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="even"):
        VideoWriter(tmp_path / "odd.mp4", width=95, height=64)
    with pytest.raises(VideoError, match=r"frame 0 is \(64, 95, 3\)"), VideoWriter(
        tmp_path / "x.mp4", width=96, height=64
    ) as writer:  # fmt: skip
        writer.write(np.zeros((64, 95, 3), np.uint8))
    assert not (tmp_path / "x.mp4").exists()
    for wrong in ({"crf": 60}, {"threads": 0}, {"speed": "fast"}, {"codec": "hevc"}):
        with pytest.raises(ValidationError):
            EncoderSettings.model_validate(wrong)


def test_copied_packets_need_whole_groups(tmp_path: Path) -> None:
    path = tmp_path / "run.mp4"
    with VideoWriter(path, width=96, height=64, settings=EncoderSettings(gop=8)) as writer:
        for i in range(40):
            writer.write(coded(i, 96, 64))
    copy_packets(path, tmp_path / "clip.mp4", start=8, end=25)
    assert [read_code(rgb) for rgb in read_frames(tmp_path / "clip.mp4")] == list(range(8, 25))
    with pytest.raises(VideoError, match="B-frames reach out"):
        copy_packets(path, tmp_path / "clip2.mp4", start=8, end=10)
    with pytest.raises(VideoError, match="check the span"):
        copy_packets(path, tmp_path / "clip2.mp4", start=32, end=49)
    assert not (tmp_path / "clip2.mp4").exists()


_FULL_DISK = """
import resource, sys
from pathlib import Path
import numpy as np
from labeling.encoding import VideoWriter, copy_packets
from labeling.errors import StorageError
folder = Path(sys.argv[1])
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
rng = np.random.default_rng(0)
try:
    if sys.argv[2] == "write":
        with VideoWriter(folder / "out.mp4", width=96, height=64) as writer:
            for _ in range(int(sys.argv[3])):
                writer.write(rng.integers(0, 256, (64, 96, 3), dtype=np.uint8))
    else:
        copy_packets(folder / "source.mp4", folder / "out.mp4", start=0, end=24)
except StorageError as error:
    assert not (folder / "out.mp4").exists()
    print("refused:", error)
"""


@pytest.mark.parametrize(("what", "frames"), [("write", 40), ("write", 8), ("copy", 0)])
def test_a_full_disk_is_a_storage_error_and_leaves_nothing(tmp_path: Path, what: str, frames: int) -> None:
    rng = np.random.default_rng(0)
    with VideoWriter(tmp_path / "source.mp4", width=96, height=64) as writer:
        for _ in range(24):
            writer.write(rng.integers(0, 256, (64, 96, 3), dtype=np.uint8))
    done = subprocess.run(
        [sys.executable, "-c", _FULL_DISK, str(tmp_path), what, str(frames)],
        capture_output=True, text=True, check=True, cwd=Path(__file__).parents[1],
    )  # fmt: skip
    assert done.stdout.startswith("refused:"), done.stdout + done.stderr
    assert StorageError.retryable and resource.RLIMIT_FSIZE is not None


def test_reading_ahead_keeps_order_passes_errors_and_stops() -> None:
    assert list(read_ahead(iter(range(100)), depth=3)) == list(range(100))
    made: list[int] = []

    def numbers():
        for i in range(1000):
            made.append(i)
            yield i
        raise AssertionError("nobody asked for so many")

    ahead = read_ahead(numbers(), depth=2)
    assert [next(ahead) for _ in range(3)] == [0, 1, 2]
    ahead.close()
    assert len(made) <= 7

    def broken():
        yield 1
        raise VideoError("broken")

    with pytest.raises(VideoError, match="broken"):
        list(read_ahead(broken(), depth=2))


def test_real_files(real_data: Path) -> None:
    info = probe(real_data / "solidWhiteRight.mp4")
    assert (info.width, info.height, info.frame_rate, info.color_matrix) == (960, 540, 25.0, "smpte170m")
    packets = read_packet_times(info.path)
    assert len(packets.times_s) == 221 and abs(packets.times_s[-1] - 8.8) < 1e-9
    kitti = probe(real_data / "kitti_03" / "left_gray_10fps.mp4")
    assert (kitti.width, kitti.height, kitti.frame_rate) == (1242, 376, 10.0)
