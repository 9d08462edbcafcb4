"""What the documents say of benchmarks, of the shipped models and of the study."""

from collections.abc import Iterator
from typing import Any

from document_quotes import IN_WORDS, Quote, Quotes, measurements, ms, readme, results, street_models, verdict


def shipped_models(judged: Any) -> Iterator[Quote]:
    of = judged["figures"]
    share = {name: 100 * figure for name, figure in of.items()}
    cars, people, lane_px, count = of["car_pck10"], of["person_pck10"], of["lane_error_px"], share["count_exact"]
    hidden_cars, hidden_people = share["car_hidden_below_0.3"], share["person_hidden_below_0.3"]
    right_cars, right_people = share["car_right_above_0.9"], share["person_right_above_0.9"]
    aims = verdict(cars >= 0.95 and people >= 0.9 and count >= 90 and lane_px <= 4)
    yield readme(
        f"| PCK [{cars}], [{people}]; [{count}] ± [{share['count_exact_standard_error']}] % of frames; [{lane_px}] px "
        f"| 0.95, 0.90; 90 %; 4 px: [{aims}] |"
    )
    yield street_models(
        f"| cars found (at least 32 px high, 30 % visible) | [{share['car_recall']}] %, "
        f"[{of['car_phantoms_per_frame']}] phantoms a frame |"
    )
    yield street_models(
        f"| people found | [{share['person_recall']}] %, [{of['person_phantoms_per_frame']}] phantoms a frame |"
    )
    yield street_models(
        f"| frames with the exact count of cars and people | [{count}] %, standard error over streets "
        f"[{share['count_exact_standard_error']}] ("
    )
    yield street_models(f"PCK@0.1 of cars' visible points | [{cars}] | 0.95, [{verdict(cars >= 0.95)}] |")
    yield street_models(f"PCK@0.1 of people's visible points | [{people}] | 0.90, [{verdict(people >= 0.9)}] |")
    yield street_models(
        f"| lanes, mean distance | [{lane_px}] px, [{share['lane_recall']}] % found | 4 px, [{verdict(lane_px <= 4)}] |"
    )
    yield street_models(
        f"| hidden points scored below 0.3 | cars [{hidden_cars}] %, people [{hidden_people}] % | 90 %, "
        f"[{verdict(min(hidden_cars, hidden_people) >= 90)}] |"
    )
    yield street_models(
        f"| points scored 0.9 or more that are right | cars [{right_cars}] %, people [{right_people}] % | 85 %, "
        f"[{verdict(min(right_cars, right_people) >= 85)}] |"
    )
    yield street_models(
        f"(`--extractors street_fields`) | [{share['fields_car_recall']}] % found, PCK@0.1 [{of['fields_car_pck10']}] |"
    )


def models_of_two_cores(judged: Any) -> Iterator[Quote]:
    of, ships, time = judged["figures"], results("street_models")["figures"], judged["time"]

    def share(figures: Any, name: str) -> str:
        return f"[{100 * figures[name]}]"

    def pck(figures: Any) -> str:
        return f"[{figures['car_pck10']}], [{figures['person_pck10']}]"

    def found(figures: Any) -> str:
        return f"{share(figures, 'car_recall')}, {share(figures, 'person_recall')} %"

    yield readme(
        f"| the same, trained anew on two cores in [{time['wall_s'] / 60}] minutes | PCK {pck(of)}; "
        f"**{share(of, 'count_exact')} %**; [{of['lane_error_px']}] px |"
    )
    yield street_models(
        f"it took [{time['wall_s'] / 60}] minutes ([{time['wall_s']}] s, [{time['cpu_s']}] of processor time,"
    )
    yield street_models(f"| PCK@0.1 of cars' and people's visible points | {pck(of)} | {pck(ships)} |")
    yield street_models(
        f"| frames with the exact count | {share(of, 'count_exact')} %, standard error "
        f"{share(of, 'count_exact_standard_error')} | {share(ships, 'count_exact')} % |"
    )
    yield street_models(f"| lanes, mean distance | [{of['lane_error_px']}] px | [{ships['lane_error_px']}] px |")
    yield street_models(f"| cars and people found | {found(of)} | {found(ships)} |")
    yield street_models(f"| training time | [{time['wall_s'] / 60}] minutes |")


def models_cost(bench: Any) -> Iterator[Quote]:
    yield readme(f"and [{bench['total_ms']}] ms on an Intel Xeon with AVX-512")
    yield street_models(f"and [{bench['total_ms']}] ms in three runs in a row on an Intel Xeon")


def counts_in_labels(bench: Any) -> Iterator[Quote]:
    efforts = ("exact", "balanced", "fast")
    exact, balanced, fast, alone = (100 * bench[look]["count_exact"] for look in (*efforts, "single frames"))
    spread = [100 * bench[effort]["standard_error"] for effort in efforts]
    yield readme(
        f"are exact in [{exact}], [{balanced}] and [{fast}] % of the frames (`exact`, `balanced`, `fast`), in single "
        f"looks in [{alone}] ("
    )
    yield street_models(
        f"bench_counts.py`, [{bench['streets']}] streets of [{bench['frames'] / bench['streets']}] frames) | `exact` "
        f"[{exact}] %, `balanced` [{balanced}] %, `fast` [{fast}] % ("
    )
    yield street_models(f"standard errors [{min(spread)}] to [{max(spread)}]; single frames there [{alone}] % |")
    yield measurements(f"to [{exact}] % of frames with exact counts in labels,")


def cutting(bench: Any) -> Iterator[Quote]:
    work, time = bench["ratios"]["cpu_s"], bench["ratios"]["wall_s"]
    yield readme(f"| [{work['ours_over_bare_pass']}] times the work of one bare ffmpeg pass |")
    yield measurements(
        f"| [{work['per_clip_over_ours']}] times less work, [{time['per_clip_over_ours']}] times sooner; "
        f"[{work['ours_over_bare_pass']}] of the work of one bare ffmpeg pass, [{time['ours_over_bare_pass']}] of its "
        f"time; [{bench['peak_memory_mb']}] MB |"
    )


def skeletons(bench: Any) -> Iterator[Quote]:
    rate, bound = bench["methods"]["draw car66"]["frames_per_second"], bench["target_frames_per_second"]
    yield readme(f"| [{rate}] frames/s | [{bound}]: [{verdict(rate >= bound)}] |")
    yield measurements(f"at 768x512 | [{rate}] frames/s |")


def skeletons_read_back(bench: Any) -> Iterator[Quote]:
    one, pile = bench["rows"]["1 car66"], bench["rows"]["20 car66"]
    yield measurements(
        f"| [{one['ms'] / 1000}] s / [{pile['ms'] / 1000}] s; all points of one car; of a pile half, "
        f"[{100 * pile['of_them_right']}] % of them right,"
    )


def ego_motion(bench: Any) -> Iterator[Quote]:
    kitti, calibration = bench["kitti_03_half_size"], bench["calibration"]
    fitted, metric = kitti["displacement_51_frames_fitted_m"], kitti["displacement_51_frames_metric_m"]
    errors = [abs(video["error"]) for video in calibration["videos"]]
    yield readme(f"| [{fitted}] / [{metric}] m off, [{ms(kitti)}] ms a frame |")
    yield measurements(
        f"rotation [{kitti['rotation_deg_per_frame']}] degrees a frame, direction "
        f"[{kitti['direction_ground_plane_deg']}] degrees in the ground plane ([{kitti['direction_3d_deg']}] in space,"
    )
    yield measurements(
        f"over 51 frames [{fitted}] m with one fitted scale, [{metric}] m metric; [{ms(kitti)}] ms a frame |"
    )
    yield measurements(f"at 640x427 and 24 fps | [{ms(bench['street_640x427'])}] ms a frame |")
    yield measurements(
        f"| median error [{100 * calibration['median_error']}] %, [{100 * max(errors)}] % at most; "
        f"[{len(errors) * calibration['share_within_one_sigma']}] of [{len(errors)}] within one stated sigma |"
    )


def field_decoding(bench: Any) -> Iterator[Quote]:
    dense = bench["scenes"]["20 car66 and 6 lanes"]
    yield measurements(f"20 cars of 66 points and 6 lanes | [{dense['median_ms']}] ms a frame |")


def parity(bench: Any) -> Iterator[Quote]:
    yield measurements(
        f"[{bench['frames']}] real frames, [{bench['boxes']}] boxes | boxes equal, points within "
        f"[{bench['worst_point_px']}] px |"
    )


def batches(bench: Any) -> Iterator[Quote]:
    alone = next(case for case in bench["cases"] if case["model"] == "yolox_nano" and case["batch"] == 1)
    yield measurements(f"| YOLOX-nano | [{alone['cpu_ms']}] ms a frame;")


def street(bench: Any) -> Iterator[Quote]:
    dense, bend = bench["scenes"]["traffic"], bench["scenes"]["sharp_turn"]
    yield measurements(
        f"| [{dense['frames_per_second']}] frames/s in dense traffic to [{bend['frames_per_second']}] on a bend"
    )


def trainer(bench: Any) -> Iterator[Quote]:
    overhead, paired = bench["overhead_percent"], bench["overhead_percent_by_difference"]
    low, high = bench["overhead_percent_by_difference_95_interval"]
    yield readme(f"| a training step over the bare loop | [{overhead}] % on an Intel Xeon")
    yield readme(f"measured before) | 3 %: **[{verdict(overhead <= 3)}]** |")
    yield measurements(
        f"(steps of [{bench['bare_step_ms']}] ms, one thread) | [{overhead}] % (bound 3 %; paired steps say "
        f"[{paired}], 95 % interval [{low}] to [{high}]); [{bench['waiting_percent_of_200_ms_steps']}] % of the time "
        "waits for latents"
    )
    yield measurements(
        f"a checkpoint of [{bench['checkpoint_megabytes']}] MB | [{bench['real_size_samples_per_second_per_worker']}] "
        f"samples/s a worker; [{bench['checkpoint_wall_s']}] s |"
    )


def evaluation(bench: Any) -> Iterator[Quote]:
    rows, (width, height) = bench["rows"], bench["size"]
    again, slow, held = (rows[name] for name in ("encoded again", "at 0.8 speed", "first frame held"))
    blurred = rows["blurred by 4 px"]
    costs = [row["ms_per_frame"] for row in rows.values() if "ms_per_frame" in row]
    yield measurements(
        f"([{width}]x[{height}], [{bench['frames']}] frames) | encoded again: minADE [{again['min_ade_m']}] m, as the "
        f"noise floor; played at 0.8 speed: [{slow['min_ade_m']}] m found where [{slow['exact_ade_m']}] m is true; "
        f"first frame held: [{held['min_ade_m']}] m, exactly;"
    )
    yield measurements(
        f"no answer about the camera in [{bench['clips'] - blurred['ego_clips']}] of [{bench['clips']}] clips; box IoU "
        f"[{again['box_iou']}], [{slow['box_iou']}], [{held['box_iou']}], [{blurred['box_iou']}]; [{min(costs)}] to "
        f"[{max(costs)}] ms of processor time"
    )


def study(judged: Any) -> Iterator[Quote]:
    def mean_of(arm: str, figure: str) -> float:
        return judged["arms"][arm][figure]["mean"]

    def difference(question: str) -> str:
        (asked,) = (asked for asked in judged["questions"] if asked["name"] == question)
        span = asked["figures"]["keypoint_error"]["difference"]
        return f"[{span['mean']}] px ([{span['low']}] to [{span['high']}]"

    minutes = judged["processor_s"]["in all"] / 60
    verdicts = [question["verdict"] for question in judged["questions"]]
    undecided = f"{IN_WORDS[verdicts.count('inconclusive')]} of {IN_WORDS[len(verdicts)]}"
    arms = [arm for arm in judged["arms"] if not arm.startswith("[")]
    off_px, off_m = ([mean_of(arm, figure) for arm in arms] for figure in ("keypoint_error", "min_ade"))
    yield readme(f"| [{verdicts[0]}] at [{minutes}] processor minutes, as are four other questions |")
    yield measurements(
        f"| does the method work, at [{minutes}] of 360 processor minutes | inconclusive, [{undecided}]:"
    )
    yield measurements(
        f"it finds [{100 * mean_of('[vae]', 'recall')}] % of the cars, [{mean_of('[vae]', 'keypoint_error')}] px off, "
        f"where the first frame held is [{mean_of('[held]', 'keypoint_error')}] px off and another street's video "
        f"[{mean_of('[another street]', 'keypoint_error')}])"
    )
    yield measurements(
        f"At [{minutes}] processor minutes of the 360 it is made for the arms are [{min(off_px)}] to [{max(off_px)}] "
        "px off:"
    )
    yield measurements(
        f"minADE is [{min(off_m)}] to [{max(off_m)}] m, better than [{mean_of('[held]', 'min_ade')}] for the first "
        f"frame held and no better than [{mean_of('[another street]', 'min_ade')}] for another street's video"
    )
    yield measurements(f"motion + appearance against end to end is {difference('decoupling')};")
    boxes, noise = (difference(name).replace(" px", "") for name in ("control: boxes", "noise"))
    yield measurements(f"skeletons against boxes {boxes}), targeted noise {noise})")


BENCHMARKS: dict[str, Quotes] = {
    "street_models": shipped_models,
    "street_models_two_cores": models_of_two_cores,
    "bench_street_models": models_cost,
    "bench_counts": counts_in_labels,
    "cut": cutting,
    "skeleton_video": skeletons,
    "skeleton_reading": skeletons_read_back,
    "ego": ego_motion,
    "fields": field_decoding,
    "parity_rtmlib": parity,
    "batches": batches,
    "bench_street": street,
    "trainer": trainer,
    "bench_evaluate": evaluation,
    "study": study,
}
