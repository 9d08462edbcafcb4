"""Corner tracking: corners follow the picture, keep out of boxes, restart at cuts; files and bad input."""

import numpy as np
import pytest

from labeling.ego_corners import TrackSettings
from labeling.ego_tracks import load_tracks, matched, track_run
from labeling.errors import DataError

SETTINGS = TrackSettings(corners=150)


def texture(seed=0, width=480, height=320):
    """A smooth random picture, larger than what is cut from it."""
    import cv2

    rng = np.random.default_rng(seed)
    grey = cv2.GaussianBlur(rng.integers(0, 256, (height, width)).astype(np.float32), (0, 0), 2.0)
    grey = (grey - grey.min()) / (grey.max() - grey.min()) * 255
    return grey.astype(np.uint8)


def panned(count, *, step=3, seed=0):
    """Pictures of 320x240 that shift to the left by ``step`` pixels a frame."""
    whole = texture(seed)
    return [np.ascontiguousarray(whole[40:280, 20 + step * i : 340 + step * i]) for i in range(count)]


def test_corners_follow_the_picture():
    tracks = track_run(panned(8), np.arange(8) / 24, settings=SETTINGS)
    for before, after in zip(tracks.frames[:-1], tracks.frames[1:], strict=True):
        one, two = matched(before, after)
        assert len(one) > 80
        flow = after.points_px[two] - before.points_px[one]
        assert np.abs(np.median(flow, axis=0) - [-3, 0]).max() < 0.05


def test_corners_are_spread_over_the_picture():
    first = track_run(panned(1), np.zeros(1), settings=SETTINGS).frames[0]
    quarters = (first.points_px >= [160, 120]) @ [1, 2]
    assert np.bincount(quarters, minlength=4).min() > 20


def test_no_corner_lies_in_a_box():
    box = np.array([[100.0, 60.0, 220.0, 180.0]])
    tracks = track_run(panned(5), np.arange(5) / 24, boxes=[box] * 5, settings=SETTINGS)
    for frame in tracks.frames:
        inside = (frame.points_px > box[0, :2]).all(axis=1) & (frame.points_px < box[0, 2:]).all(axis=1)
        assert not inside.any()


def test_a_cut_is_found_where_it_is():
    dark = [picture // 4 for picture in panned(4, seed=9)]
    tracks = track_run(panned(4) + dark, np.arange(8) / 24, settings=SETTINGS)
    assert [frame.cut for frame in tracks.frames] == [False] * 4 + [True] + [False] * 3
    assert not set(tracks.frames[3].ids) & set(tracks.frames[4].ids)


@pytest.mark.parametrize("breaks", [set(), {3}], ids=["of the run", "after a break"])
def test_a_cut_is_found_in_the_first_frames(breaks):
    """Nothing comes before a run's first picture, so that it is no measure of how much pictures change."""
    before = panned(3, seed=4) if breaks else []
    after = [(picture * 0.75).astype(np.uint8) for picture in panned(3, seed=2)]
    pictures = [*before, *panned(2), *after]
    tracks = track_run(pictures, np.arange(len(pictures)) / 24, breaks=breaks, settings=SETTINGS)
    assert [index for index, frame in enumerate(tracks.frames) if frame.cut] == [*breaks, len(before) + 2]


def test_a_given_break_restarts_the_corners():
    tracks = track_run(panned(4), np.arange(4) / 24, breaks={2}, settings=SETTINGS)
    assert tracks.frames[2].cut
    assert len(matched(tracks.frames[1], tracks.frames[2])[0]) == 0


def test_a_repeated_picture_is_known():
    pictures = panned(5)
    tracks = track_run([*pictures[:3], pictures[2], *pictures[3:]], np.arange(6) / 24, settings=SETTINGS)
    assert [frame.repeated for frame in tracks.frames] == [False, False, False, True, False, False]


def test_tracks_come_back_from_a_file(tmp_path):
    tracks = track_run(panned(4), np.arange(4) / 24, breaks={2}, settings=SETTINGS)
    tracks.save(tmp_path / "run.npz")
    back = load_tracks(tmp_path / "run.npz")
    assert (back.width, back.height, back.source_width) == (tracks.width, tracks.height, tracks.source_width)
    for one, other in zip(tracks.frames, back.frames, strict=True):
        assert np.array_equal(one.ids, other.ids) and np.array_equal(one.points_px, other.points_px)
        assert (one.cut, one.repeated) == (other.cut, other.repeated)


def test_a_file_that_is_not_tracks_is_refused(tmp_path):
    (tmp_path / "run.npz").write_text("hello")
    with pytest.raises(DataError, match="track the run again"):
        load_tracks(tmp_path / "run.npz")


@pytest.mark.parametrize("harm", ["cut off", "empty", "flipped"])
def test_a_broken_file_of_tracks_is_refused(tmp_path, harm):
    path = tmp_path / "run.npz"
    track_run(panned(3), np.arange(3) / 24, settings=SETTINGS).save(path)
    whole = path.read_bytes()
    flipped = whole[:600] + bytes(byte ^ 255 for byte in whole[600:4000]) + whole[4000:]
    path.write_bytes({"cut off": whole[: len(whole) // 2], "empty": b"", "flipped": flipped}[harm])
    with pytest.raises(DataError, match="track the run again"):
        load_tracks(path)


def test_a_dark_picture_still_has_corners():
    dark = [(picture // 12 + 2).astype(np.uint8) for picture in panned(3)]
    tracks = track_run(dark, np.arange(3) / 24, settings=SETTINGS)
    assert min(len(frame.ids) for frame in tracks.frames) > 50


def test_corners_outlive_a_level_that_hovers_where_contrast_is_equalised():
    pictures = panned(8)
    base = SETTINGS.dark_level / np.mean(pictures[0])
    dusk = [(picture * base * (1.04 if at % 2 else 0.96)).astype(np.uint8) for at, picture in enumerate(pictures)]
    tracks = track_run(dusk, np.arange(8) / 24, settings=SETTINGS)
    shared = [len(matched(*pair)[0]) for pair in zip(tracks.frames[:-1], tracks.frames[1:], strict=True)]
    assert min(shared) > 80


def test_the_same_pictures_give_the_same_corners():
    one, other = (track_run(panned(4), np.arange(4) / 24, settings=SETTINGS) for _ in range(2))
    assert all(np.array_equal(a.points_px, b.points_px) for a, b in zip(one.frames, other.frames, strict=True))


@pytest.mark.parametrize(
    ("frames", "times", "boxes", "advice"),
    [
        (3, [0.0, 0.2, 0.1], None, "do not decrease"),
        (3, [0.0, 0.1], None, "more frames"),
        (2, [0.0, 0.1, 0.2], None, "2 frames for 3 times"),
        (2, [0.0, 0.1], [], "0 lists of boxes"),
        (0, [], None, "at least one frame"),
    ],
    ids=["backwards", "too many", "too few", "boxes", "none"],
)
def test_what_does_not_agree_is_refused(frames, times, boxes, advice):
    with pytest.raises(DataError, match=advice):
        track_run(panned(frames), np.array(times), boxes=boxes, settings=SETTINGS)


def test_pictures_of_two_sizes_are_refused():
    with pytest.raises(DataError, match="give one size"):
        track_run([panned(1)[0], panned(1)[0][:100]], np.arange(2) / 24, settings=SETTINGS)
