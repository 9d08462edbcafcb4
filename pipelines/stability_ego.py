"""``animatic stability ego``: where ego-motion fails, for the default and for stock OpenCV, on drives with exact truth.

Stock OpenCV (``findEssentialMat`` + ``recoverPose``) knows neither modes, lengths nor confidence: it takes steps of a
constant 8 m/s, and gets a row where its answer can be compared.
"""

from collections.abc import Callable

from pipelines import ego_scenarios as moved
from pipelines import ego_scenarios_harmed as harmed
from pipelines.ego_clips import SECONDS
from pipelines.ego_methods import STOCK, UNCALIBRATED
from pipelines.stability import StabilityRow, StabilityTable, make_table

_SCENARIOS: dict[str, Callable[[str], list[StabilityRow]]] = {
    "1 still": moved.still_noise,
    "2 still in traffic": moved.still_traffic,
    "3 pure turn": moved.pure_turn,
    "4 crawl": moved.crawl,
    "5 stop-and-go": moved.stop_and_go,
    "6 straight at 30 m/s": moved.fast,
    "7 sharp turn": moved.sharp_turn,
    "8 one plane": moved.planes,
    "9 moving objects": harmed.movers,
    "10 night": harmed.night,
    "11 rain and wiper": harmed.rain,
    "12 rolling shutter": harmed.rolling,
    "13 focal length off": moved.focal,
    "14 pitch and height": moved.pitch_and_height,
    "15 cut": moved.cut_in_the_middle,
    "16 repeated frames": moved.repeated,
    "17 bonnet and overlay": harmed.overlay,
    "18 nothing to see": harmed.nothing,
    "19 reversing": moved.reversing,
    "20 H.264 and brightness": harmed.compressed,
    "21 twice": moved.same_again,
}
_QUICK = ("1 still", "4 crawl", "15 cut", "18 nothing to see", "21 twice")


def stability(*, quick: bool = False) -> StabilityTable:
    """Play every scenario; ``quick`` plays a handful."""
    rows: list[StabilityRow] = []
    for name, play in _SCENARIOS.items():
        if not quick or name in _QUICK:
            rows += play(name)
    data = f"street drives of {SECONDS} s at 24 fps with exact truth; KITTI 03 at half size where it is named"
    return make_table("ego", data, rows, references=(STOCK, UNCALIBRATED))
