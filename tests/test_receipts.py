import errno
import json
import os
from typing import Any

import pytest

from dataset.receipts import (
    Output,
    Receipt,
    ReceiptLog,
    atomic_write,
    digest,
    hashed_share,
    make_folder,
    outputs_present,
    publish,
    read_receipts,
    reason_counts,
    storage_error,
    try_folder,
)
from labeling.errors import DataError, StorageError


def receipt(item="a", *, turn=1, state: Any = "done", key="k", **fields):
    return Receipt(stage="cut", item=item, state=state, key=key, turn=turn, **fields)


def test_what_is_appended_is_read_back(tmp_path):
    first = receipt(outputs=(Output(path="videos/a/x.mp4", size=3, sha256="00"),), facts={"frames": 9}, seconds=1.5)
    log = ReceiptLog(tmp_path, "cut")
    log.append(first)
    log.append(receipt("b", state="dropped", reason="hole=3 frames from 1.000 s"))
    found = read_receipts(tmp_path, "cut")
    assert list(found) == ["a", "b"]
    assert found["a"] == first


def test_the_highest_turn_holds_whatever_log_it_is_in(tmp_path):
    ReceiptLog(tmp_path, "cut", worker="z").append(receipt(turn=1, state="failed", reason="video"))
    ReceiptLog(tmp_path, "cut", worker="a").append(receipt(turn=2))
    assert read_receipts(tmp_path, "cut")["a"].state == "done"


@pytest.mark.parametrize("other", ["failed", "dropped"])
@pytest.mark.parametrize("workers", [("a", "z"), ("z", "a")], ids=str)
def test_of_two_of_one_turn_the_one_that_is_done_holds(tmp_path, workers, other):
    """Two workers that both took an item: what one of them made is there, whichever log is read last."""
    ReceiptLog(tmp_path, "cut", worker=workers[0]).append(receipt(turn=2))
    ReceiptLog(tmp_path, "cut", worker=workers[1]).append(receipt(turn=2, state=other, reason="video"))
    assert read_receipts(tmp_path, "cut")["a"].state == "done"


@pytest.mark.parametrize("kept", [1, 20, 60])
def test_a_torn_last_line_is_ignored(tmp_path, kept):
    log = ReceiptLog(tmp_path, "cut", worker="w")
    log.append(receipt("a"))
    log.append(receipt("b"))
    path = tmp_path / "receipts" / "cut" / "w.jsonl"
    first = path.read_bytes().index(b"\n") + 1
    path.write_bytes(path.read_bytes()[: first + kept])
    assert list(read_receipts(tmp_path, "cut")) == ["a"]


def test_a_line_without_its_newline_is_torn_too(tmp_path):
    log = ReceiptLog(tmp_path, "cut", worker="w")
    log.append(receipt("a"))
    path = tmp_path / "receipts" / "cut" / "w.jsonl"
    path.write_bytes(path.read_bytes()[:-1])
    assert read_receipts(tmp_path, "cut") == {}


def test_a_whole_line_that_is_no_receipt_is_an_error(tmp_path):
    ReceiptLog(tmp_path, "cut", worker="w").append(receipt("a"))
    path = tmp_path / "receipts" / "cut" / "w.jsonl"
    path.write_bytes(b'{"item": "a"}\n' + path.read_bytes())
    with pytest.raises(DataError, match=r"w.jsonl:1: is no receipt"):
        read_receipts(tmp_path, "cut")


@pytest.mark.parametrize(
    ("field", "value", "told"),
    [
        ("facts", None, "facts is None"),
        ("facts", [1], r"facts is \[1\]"),
        ("state", "well", "state is 'well'"),
        ("turn", "1", "turn is '1'"),
        ("item", 7, "item is 7"),
        ("outputs", [{"path": 5, "size": 1, "sha256": ""}], "path is 5"),
        ("outputs", [{"path": "a", "size": None, "sha256": ""}], "size is None"),
        ("outputs", 3, "not iterable"),
    ],
)
def test_a_record_of_other_types_is_no_receipt(tmp_path, field, value, told):
    ReceiptLog(tmp_path, "cut", worker="w").append(receipt("a"))
    path = tmp_path / "receipts" / "cut" / "w.jsonl"
    path.write_text(json.dumps({**json.loads(path.read_text()), field: value}) + "\n")
    with pytest.raises(DataError, match=f"w.jsonl:1: is no receipt .*{told}.*; move the line away"):
        read_receipts(tmp_path, "cut")


@pytest.mark.parametrize("line", [b"[" * 99_999, b"[]", b"3", b"null", b'{"outputs": 0}'], ids=lambda line: line[:9])
def test_a_line_that_is_no_record_is_no_receipt(tmp_path, line):
    path = tmp_path / "receipts" / "cut" / "w.jsonl"
    path.parent.mkdir(parents=True)
    path.write_bytes(line + b"\n")
    with pytest.raises(DataError, match="is no receipt"):
        read_receipts(tmp_path, "cut")


def test_a_line_that_does_not_fit_is_taken_back(tmp_path, monkeypatch):
    log = ReceiptLog(tmp_path, "cut", worker="w")
    log.append(receipt("a"))
    path = tmp_path / "receipts" / "cut" / "w.jsonl"
    before = path.read_bytes()
    write = os.write

    def full(descriptor, data):
        write(descriptor, data[:10])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(StorageError, match="no space left"):
        log.append(receipt("b"))
    monkeypatch.undo()
    assert path.read_bytes() == before


@pytest.mark.parametrize("place", ["/proc/none", "file"], ids=["proc", "below a file"])
def test_a_folder_that_cannot_be_made_is_an_error_of_storage(tmp_path, place):
    (tmp_path / "file").write_text("")
    folder = tmp_path / place / "x"
    for write in (
        make_folder,
        lambda path: atomic_write(path / "a", b""),
        lambda job: ReceiptLog(job, "s").append(receipt()),
    ):
        with pytest.raises(StorageError, match=f"{place}.*; give a folder that can be written to"):
            write(folder)


def test_a_folder_that_is_there_and_cannot_be_written_to_is_found_out(tmp_path, monkeypatch):
    try_folder(tmp_path / "a")
    assert list(tmp_path.iterdir()) == [tmp_path / "a"] and not list((tmp_path / "a").iterdir())

    def refuse(**_):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    with pytest.raises(StorageError, match="a: read-only file system; give a folder"):
        try_folder(tmp_path / "a")


def test_published_files_are_whole_and_hashed(tmp_path):
    staging = tmp_path / "staging"
    staging.mkdir()
    (staging / "run.mp4").write_bytes(b"abc")
    (output,) = publish(staging, tmp_path, ["videos/a/run.mp4"])
    assert (tmp_path / "videos/a/run.mp4").read_bytes() == b"abc"
    assert output == Output(
        path="videos/a/run.mp4", size=3, sha256="ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    )
    assert outputs_present(tmp_path, receipt(outputs=(output,)))
    (tmp_path / "videos/a/run.mp4").write_bytes(b"ab")
    assert not outputs_present(tmp_path, receipt(outputs=(output,)))


def test_a_file_that_was_not_made_is_not_published(tmp_path):
    staging = tmp_path / "staging"
    staging.mkdir()
    (staging / "a").write_bytes(b"")
    with pytest.raises(DataError, match="was not made"):
        publish(staging, tmp_path, ["a"])


def test_nothing_is_published_where_a_file_stands_in_the_way(tmp_path):
    staging = tmp_path / "staging"
    staging.mkdir()
    (staging / "a").write_bytes(b"1")
    (tmp_path / "videos").write_text("in the way")
    with pytest.raises(StorageError, match="give a folder"):
        publish(staging, tmp_path, ["videos/a"])


def test_a_write_is_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "x.json"
    atomic_write(path, b"old")
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(StorageError, match="free some space"):
        atomic_write(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_errors_about_the_program_stay_what_they_are(tmp_path):
    error = OSError(22, "Invalid argument")
    assert storage_error(error, tmp_path) is error


def test_digests_do_not_depend_on_the_order_of_keys():
    assert digest({"a": 1, "b": [1, 2]}) == digest(json.loads('{"b": [1, 2], "a": 1}'))
    assert digest({"a": 1}) != digest({"a": 2})


def test_hashed_shares_are_even_and_separate_their_parts():
    shares = [hashed_share(0, f"video{i}") for i in range(2000)]
    assert abs(sum(shares) / len(shares) - 0.5) < 0.03
    assert hashed_share("ab", "c") != hashed_share("a", "bc")


def test_reasons_are_counted_by_their_slug():
    reasons = ["objects=1 < threshold=4", "objects=0 < threshold=4", "hole=3 frames", "too_short: frames=3", ""]
    assert reason_counts(reasons) == {"hole": 1, "objects": 2, "too_short": 1, "unknown": 1}
