"""What the documents say of charts and stability tables: ``animatic chart`` and ``animatic stability``."""

from collections.abc import Iterator
from statistics import mean
from typing import Any

from document_quotes import IN_WORDS, Quote, Quotes, measurements, ms, numbers, readme, verdict


def by_method(chart: Any) -> dict[str, Any]:
    return {point["method"]: point for point in chart["points"]}


def error(point: Any) -> float:
    return point["error"]["median"]


def further_errors(point: Any) -> list[float]:
    return [further["median"] for further in point["more_errors"]]


def keypoints_chart(chart: Any) -> Iterator[Quote]:
    points = by_method(chart)
    fast, balanced, exact, alone = (points[method] for method in ("fast", "balanced", "exact", "every frame alone"))
    processor = "Intel Xeon" if "Intel" in chart["machine"] else "AMD EPYC"

    def over_clips(point: Any, figure: str) -> list[float]:
        return [clip[figure] for clip in point["settings"].values()]

    def switches(point: Any) -> float:
        return sum(over_clips(point, "switches"))

    def lanes(point: Any) -> float:
        return 100 * mean(over_clips(point, "lane_recall"))

    def phantoms(point: Any) -> float:
        return 100 * mean(over_clips(point, "phantom_frames"))

    times, lost = ms(exact) / ms(balanced), error(balanced) - error(exact)
    fast_times, fast_lost = ms(exact) / ms(fast), error(fast) - error(exact)
    right = f"[{100 - error(balanced)}] of [{100 - error(exact)}] %"
    empty_road = 100 * balanced["settings"]["empty"]["ms"] / exact["settings"]["empty"]["ms"]
    aims = verdict(times >= 3 and lost <= 1 and switches(balanced) <= switches(exact))

    yield readme(
        f"five street clips of 5 s | [{times}] times cheaper ([{ms(balanced)}] of [{ms(exact)}] ms a frame), [{lost}] "
        f"points of PCK@0.1 lost ({right}), [{switches(balanced)}] id switches against [{switches(exact)}] | 3 times, "
        f"1 point, no more switches: [{aims}] |"
    )
    yield readme(
        f"| `fast` against `exact`, the same | [{fast_times}] times cheaper, [{fast_lost}] points lost, "
        f"[{switches(fast)}] switches | 6 times: [{verdict(fast_times >= 6)}]; 3 points: [{verdict(fast_lost <= 3)}];"
    )
    yield readme(f"| `balanced` on an empty road | [{empty_road}] % of `exact` | 10 %: [{verdict(empty_road <= 10)}] |")
    yield readme(
        f"and not carried between: [{lanes(balanced)}] and [{lanes(fast)}] % are found, [{lanes(exact)}] % by `exact`"
    )
    yield measurements(
        f"`balanced` is [{times}] times cheaper than `exact` ([{ms(balanced)}] of [{ms(exact)}] ms a frame on an "
        f"[{processor}]), makes [{switches(balanced)}] id switches against [{switches(exact)}] and loses [{lost}] "
        f"points of PCK@0.1 ({right};"
    )
    yield measurements(
        f"`fast` is [{fast_times}] times cheaper (at least 6) for [{fast_lost}] points (at most 3) and "
        f"[{switches(fast)}] switches; on an empty road `balanced` costs [{empty_road}] % (at most 10)"
    )
    yield measurements(
        f"`every frame alone` is [{error(exact) - error(alone)}] points better than `exact` at [{ms(alone)}] ms, with "
        f"a phantom in [{phantoms(alone)}] instead of [{phantoms(exact)}] % of the frames"
    )
    yield measurements(
        f"are found in [{lanes(balanced)}] % with `balanced`, [{lanes(fast)}] % with `fast`, in [{lanes(exact)}] % "
        f"with `exact`"
    )
    yield measurements(
        f"rtmlib on the same files takes [{ms(points['rtmlib (no lanes)'])}] ms without lanes and tracks, ours "
        f"[{ms(alone)}] with lanes and [{ms(exact)}] with tracks"
    )


def detect_chart(chart: Any) -> Iterator[Quote]:
    points = by_method(chart)
    tiny, small, middle, shipped = (points[size] for size in ("352x224", "480x320", "768x512", "864x576 (shipped)"))
    (small_phantoms,), (shipped_phantoms,) = further_errors(small), further_errors(shipped)
    nano_ms = shipped["settings"]["yolox_nano_on_the_real_drive_ms"]
    yield measurements(
        f"352x224 / 480x320 / 768x512 / 864x576 costs [{ms(tiny)}] / [{ms(small)}] / [{ms(middle)}] / [{ms(shipped)}] "
        f"ms and misses [{error(tiny)}] / [{error(small)}] / [{error(middle)}] / [{error(shipped)}] % of cars and "
        f"people; at 480x320 [{small_phantoms}] % of the frames have a phantom instead of [{shipped_phantoms}],"
    )
    yield measurements(
        f"rtmlib on the same file takes [{ms(points['rtmlib, same file'])}] ms; YOLOX-nano on the real drive "
        f"[{nano_ms['ours']}] ms, rtmlib [{nano_ms['rtmlib']}]."
    )


def track_chart(chart: Any) -> Iterator[Quote]:
    points = by_method(chart)
    settings = {method: point["settings"] for method, point in points.items()}
    exact, balanced = settings["exact"]["all"], settings["balanced"]["all"]
    sparse, no_turn, tracker = "every 4th frame, no flow", "tracker without the turn", "tracker"
    smoothed = settings["tracker + smoothing"]
    late = max(abs(smoothed[f"lag_of_{what}_frames"]) for what in ("legs", "braking_cars"))
    frames = sum(numbers(chart["data"].split(": ")[1]))
    yield readme(
        f"| IDF1 [{exact['idf1']}], MOTA [{exact['mota']}], [{exact['switches']}] switch in [{frames}] frames; "
        f"`balanced` [{balanced['idf1']}], [{balanced['mota']}], [{balanced['switches']}] |"
    )
    yield measurements(
        f"`exact` has IDF1 [{exact['idf1']}], MOTA [{exact['mota']}] and [{exact['switches']}] id switch in [{frames}] "
        f"frames of crossings, traffic, turns and braking, `balanced` [{balanced['idf1']}], [{balanced['mota']}] and "
        f"[{balanced['switches']}], at [{ms(points['exact'])}] and [{ms(points['balanced'])}] ms a frame beside the "
        "networks"
    )
    yield measurements(
        f"a look at every 4th frame and straight lines between, [{settings[sparse]['all']['idf1']}], "
        f"[{settings[sparse]['all']['mota']}] and [{settings[sparse]['all']['switches']}] at [{ms(points[sparse])}];"
    )
    yield measurements(
        f"without the camera's turn the tracker alone makes [{settings[no_turn]['all']['switches']}] switches instead "
        f"of [{settings[tracker]['all']['switches']}]."
    )
    yield measurements(
        f"from [{settings[tracker]['jitter_of_parked_cars_px']}] to [{smoothed['jitter_of_parked_cars_px']}] px; "
        f"walking legs and braking cars lag by at most [{late}] frames"
    )


def count_chart(chart: Any) -> Iterator[Quote]:
    points = by_method(chart)
    keyframes, everything = points["keyframes (default)"], points["every frame"]
    _, clips, *_ = numbers(chart["data"])
    yield measurements(
        f"counting on every frame keeps [{100 - error(keyframes)}] % too, for [{ms(keyframes)}] ms a source frame "
        f"instead of [{ms(everything)}]."
    )
    yield measurements(f"keep all of them at the same cost in this sample of [{clips}];")


def ego_chart(chart: Any) -> Iterator[Quote]:
    points = by_method(chart)
    default, stock = points["ladder at 1/2 (default)"], points["stock findEssentialMat + recoverPose"]
    dearer = [points[method] for method in ("ladder at full size", "ladder + windowed refinement")]

    def rotation(point: Any) -> float:
        return further_errors(point)[0]

    bought = [100 * (1 - rotation(point) / rotation(default)) for point in dearer]
    times = [ms(point) / ms(default) for point in dearer]
    yield readme(f"one fitted scale | [{error(default)}] m off; stock OpenCV [{error(stock)}] m |")
    yield measurements(
        f"[{len(points)}] methods on KITTI 03 and three street drives: the default is [{error(default)}] m off after 5 "
        f"s, with one fitted scale, where stock OpenCV (`findEssentialMat` + `recoverPose`) is [{error(stock)}] m off"
    )
    yield measurements(
        f"buy [{min(bought)}] to [{max(bought)}] % of the rotation error for [{min(times)}] to [{max(times)}] times "
        "the cost"
    )


def ego_video_chart(chart: Any) -> Iterator[Quote]:
    points = by_method(chart)
    default, every_pixel, vtk = (points[name] for name in ("grid of 8 (default)", "every pixel", "pyvista (VTK)"))
    away_from_edges, from_every_pixel = further_errors(default)
    yield measurements(
        f"[{ms(default)}] / [{ms(every_pixel)}] / [{ms(vtk)}] ms a frame; the default is [{error(default)}] of 255 "
        f"grey levels from VTK, [{away_from_edges}] away from edges, and [{from_every_pixel}] from every pixel |"
    )
    yield measurements(f"coordinates on every 8th pixel are [{from_every_pixel}] of 255 grey levels from")


def train_chart(chart: Any) -> Iterator[Quote]:
    plain, checkpointing = (by_method(chart)[method] for method in ("192x128, rank 64", "checkpointing"))
    memory = error(checkpointing) / error(plain)
    time = checkpointing["ms_per_step"]["median"] / plain["ms_per_step"]["median"]
    yield measurements(
        f"checkpointing takes [{100 * (1 - memory)}] % less memory for [{100 * (time - 1)}] % more time at small size"
    )


def generate_chart(chart: Any) -> Iterator[Quote]:
    points = by_method(chart)
    off = {method: 100 * further_errors(point)[0] for method, point in points.items()}
    seconds = {method: point["ms_per_clip"]["median"] / 1000 for method, point in points.items()}
    draft = (seconds["4 steps, 6 drafts"] - seconds["4 steps"]) / 5
    yield measurements(
        f"4 steps are [{off['4 steps']}] % of the futures' spread off at [{seconds['4 steps']}] s a clip, 30 steps "
        f"[{off['30 steps']}] % at [{seconds['30 steps']}] s; a further motion draft of 4 steps costs [{draft}] s."
    )


def keypoints_stability(stability: Any) -> Iterator[Quote]:
    rows = {(row["scenario"], row["unit"]): row for row in stability["rows"] if row["method"] == "balanced"}
    bounded = [row for row in stability["rows"] if row["bound"]]
    missed = sum(row["verdict"] != "held" for row in bounded)
    streets, frames = numbers(stability["data"].split("seeds")[0])
    yield readme(
        f"| [{len(bounded)}] bounds in [{len({row['scenario'] for row in bounded})}] scenarios: light, weather, blur, "
        f"coding, boards, distance, cuts | [{len(bounded) - missed}] held, [{IN_WORDS[missed]}] missed |"
    )
    yield readme(f"| condition (effort `balanced`, [{streets}] streets) |")
    yield measurements(f"A row is [{streets * frames}] frames:")

    def bound(row: Any) -> str:
        return f"{numbers(row['bound'])[0]:g}" if row["bound"] else "reported"

    def held(*some: Any) -> str:
        return verdict(all(row["verdict"] != "not held" for row in some))

    def beside(row: Any) -> str:
        return f"[{bound(row)}], [{held(row)}]" if row["bound"] else "[reported]"

    def phantoms(scenario: str) -> Any:
        return rows[scenario, "% of frames with a phantom"]

    clear = rows["undisturbed", "% of points right"]
    clear_cars, _, clear_people, _ = numbers(clear["note"])
    yield readme(
        f"| undisturbed | PCK [{clear['figure']}] % | [{clear_cars}], [{clear_people}] % | "
        f"[{phantoms('undisturbed')['figure']}] % |"
    )
    people_lost = {}
    for name, scenario in {
        "dusk": "dusk, gain 0.4",
        "night": "night, gain 0.15",
        "rain": "rain streaks",
        "glare": "windscreen glare",
        "blur 5 px": "motion blur 5 px",
        "blur 15 px": "motion blur 15 px",
        "H.264 crf 40": "H.264 at crf 40",
    }.items():
        lost, phantom = rows[scenario, "points of PCK lost"], phantoms(scenario)
        cars, _, people, _ = numbers(lost["note"])
        people_lost[name] = clear_people - people
        yield readme(
            f"| {name} | [{lost['figure']}] ({beside(lost)}) | [{cars - clear_cars}], [{people - clear_people}] | "
            f"[{phantom['figure']}] % ({beside(phantom)}) |"
        )
    yield readme(
        f"(table above: [{people_lost['night']}] points lost at night, [{people_lost['blur 15 px']}] by strong blur, "
        f"[{people_lost['H.264 crf 40']}] at crf 40)"
    )

    boards = [f"{share} % of a car behind a board" for share in (25, 50, 75)]
    lost = [rows[board, "points of PCK lost"] for board in boards]
    hidden = [rows[board, "% of hidden points scored below 0.3"] for board in boards]
    near, far, farthest = (rows[f"cars {height} px high", "% found"] for height in (48, 24, 12))
    crossing, column = rows["two people cross", "id switches"], rows["one second behind a column", "id switches"]
    cut, frozen = rows["a cut", "objects carried across"], rows["a frozen second", "% of the box diagonal drifted"]
    untold = rows["a frozen second that nobody tells of", "% of the box diagonal drifted"]
    empty = rows["an empty road, 1 min", "s, the longest phantom"]
    sure = [rows[f"points that score 0.9, {where}", "% right"] for where in ("undisturbed", "in every condition")]

    def listed(some: list[Any]) -> str:
        return ", ".join(f"[{row['figure']}]" for row in some)

    def share_found(row: Any) -> str:
        return f"[{row['figure']}] % of [{numbers(row['note'])[0]}]"

    yield readme(
        f"PCK lost of what shows | {listed(lost)} | {', '.join(f'[{bound(row)}]' for row in lost)}: [{held(*lost)}] |"
    )
    yield readme(f"hidden points scored below 0.3 | {listed(hidden)} % | [{bound(hidden[0])}] %: [{held(*hidden)}] |")
    yield readme(
        f"| cars 48, 24, 12 px high: found | {share_found(near)}, {share_found(far)}, {share_found(farthest)} | "
        f"[{bound(near)}], [{bound(far)}] %, [{bound(farthest)}]: [{held(near, far, farthest)}] |"
    )
    yield readme(
        f"one second behind a column: id switches | [{crossing['figure']}]; [{column['figure']}] | "
        f"[{bound(crossing)}]; [{bound(column)}]: [{held(crossing, column)}] |"
    )
    yield readme(
        f"no drift ([{untold['figure']}] % of the box if the cut did not tell); no phantom | "
        f"[{held(cut, frozen, empty)}] |"
    )
    yield readme(
        f"are right | [{sure[0]['figure']}] % undisturbed, [{sure[1]['figure']}] % in all conditions | "
        f"[{bound(sure[0])}] %: [{held(*sure)}] |"
    )


def ego_stability(stability: Any) -> Iterator[Quote]:
    rows = [row for row in stability["rows"] if row["method"] == "default"]
    scenarios = {row["scenario"].split()[0] for row in rows}
    missed = [row for row in rows if row["verdict"] == "not held"]
    highway, kitti = (row for row in rows if "crf 40" in row["scenario"])
    (highway_deg, *_), (kitti_deg, clean_kitti_deg, *_) = numbers(highway["note"]), numbers(kitti["note"])
    yield measurements(
        f"plays [{len(scenarios)}] scenarios on streets with exact truth and on KITTI 03. The default holds every "
        f"bound but [{IN_WORDS[len(missed)]}], both of H.264 at crf 40 ([{highway_deg}] degrees a frame on the "
        f"motorway, [{kitti_deg}] on KITTI where clean video gives [{clean_kitti_deg}]; the bound is "
        f"[{numbers(kitti['bound'])[0]}] times clean)"
    )
    yield readme(
        f"costs the camera estimate [{mean((highway['figure'], kitti['figure']))}] times its clean error, with a "
        "confidence"
    )


CHARTS: dict[str, Quotes] = {
    "chart-keypoints": keypoints_chart,
    "chart-detect": detect_chart,
    "chart-track": track_chart,
    "chart-count": count_chart,
    "chart-ego": ego_chart,
    "chart-ego-video": ego_video_chart,
    "chart-train": train_chart,
    "chart-generate": generate_chart,
    "stability-keypoints": keypoints_stability,
    "stability-ego": ego_stability,
}
