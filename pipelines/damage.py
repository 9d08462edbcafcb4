"""Source videos that are less than they claim: cut off, with packets that are gone, with frames that do not decode."""

import contextlib
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from dataset.layout import parse_run_item
from dataset.receipts import Receipt
from labeling.errors import AnimaticError
from pipelines.console import counted
from pipelines.job import Job

_SHORT_S, _SHORT_SHARE = 1.0, 0.05
"""Headers round, and count sound that goes on after the pictures: a video that lacks less than both is whole."""


def damaged_videos(job: Job) -> list[str]:
    """A line for each video of a job that is damaged, as far as the job has come."""
    cuts: Iterable[Receipt] = ()
    # Nothing is selected yet, or cannot be as the job stands: its packets can be told of all the same.
    with contextlib.suppress(AnimaticError):
        cuts = job.done("cut").values()
    return damage_lines({name: receipt.facts for name, receipt in job.done("index").items()}, cuts)


def damage_lines(facts: Mapping[str, Mapping[str, Any]], cuts: Iterable[Receipt]) -> list[str]:
    """A line for each video that is damaged.

    Args:
        facts: by video id, those of ``packet_facts``, as far as they are known.
        cuts: receipts of runs that were cut.
    """
    undecoded: Counter[str] = Counter()
    for receipt in cuts:
        # Runs are laid around what the packets show to be whole, so that a hole is what did not decode.
        undecoded[parse_run_item(receipt.item)[0]] += int(receipt.facts["holes"])
    faults = {name: _faults(facts.get(name, {}), undecoded[name]) for name in sorted({*facts, *undecoded})}
    return [f"{name}: {', '.join(found)}; get the file again" for name, found in faults.items() if found]


def _faults(facts: Mapping[str, Any], undecoded: int) -> list[str]:
    broken, promised_s, found_s = (facts.get(name, 0) for name in ("broken_packets", "promised_s", "seconds"))
    faults = [f"{counted(broken, 'packet')} broken or gone"] if broken else []
    if promised_s - found_s > max(_SHORT_S, _SHORT_SHARE * promised_s):
        faults.append(f"{found_s:.1f} s there of the {promised_s:.1f} s that it promises")
    return faults + ([f"{counted(undecoded, 'frame')} lost in decoding"] if undecoded else [])
