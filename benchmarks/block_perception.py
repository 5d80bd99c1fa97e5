"""Measure how accurately a camera locates thrown balls, and how many balls an arm then blocks.

    python -m benchmarks.block_perception [--num 2000] [--throws 1000] [--timed 50]
                                          [--rendered 12] [--seed 7] [--out DIR]
                                          [--parts errors,images,pipeline,planning]

A robot arm blocks thrown balls with a shield. Throws are drawn from the suites `short`, from 6 to 8
m away, and `pole`, from 6 to 12 m away.

Part `errors`: a camera observes balls from time 0 up to a given time. Then the ball's flight is
fitted to all observations, with known gravity [Natarajan2024, eqs 5 to 8]. An inner and an outer
box stand around the arm. The error is the distance of the fitted from the true position when the
ball is midway between the boxes, perpendicular to the flight. A shield that may meet the ball 0.1 m
off its middle tolerates an error of 0.1 m. Observations have equal noise in all directions, or the
noise of a stereo camera. Stereo observations are weighted by their noise, or equally as in the
paper's eq. 8. The success in the run's summary is the share of errors below 0.1 m for the suite
`short`, with 60 frames per second, 2 cm of noise, and a fit at 0.25 s.

Part `images`: throws of `short` are rendered, 60 images per second. Each image gets depth noise.
The ball is found by a colour mask and outlier rejection, and its centroid is converted to the world
frame with a simulated calibration. Then the flight is fitted. The table also has errors for the
same throws with the noise model of a stereo camera instead of images. Two times are measured on one
core, without compilation: from image and depth to the centroid, and from observations to the
flight. They contain neither the simulation of the noise nor a real camera's depth computation.

Part `pipeline`: throws of `short` are observed, fitted, planned for, and judged against the true
ball. The arm has the joint limits R1, and may meet a ball up to 0.1 m off the shield's middle and
up to 30 degrees aslant. It plans once at a fixed time, or once at the last frame after which a
motion is still in time, or repeatedly. Its motion starts 50 ms after the frame, a time called
overhead. The column `on the shield` counts balls that meet the shield anywhere on its face. The
table compares times as in [Natarajan2024, eq. 1]: sensing, overhead and motion must end before the
ball arrives.

Part `planning`: the planner is timed for one throw at a time. Planning should take less time than
the overhead.
"""

import dataclasses
import os
import time
from collections import Counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import planner_jax as pj
from planner_jax.ball.flight import BallState, drag_free_flight
from planner_jax.benchmarks.rendered_balls.segment import ball_thresholds, noisy_depth, sighting
from planner_jax.benchmarks.run import Bench, argument_parser, begin, parse_names
from planner_jax.core import GRAVITY
from planner_jax.robot.arm_file import irb1600
from planner_jax.runs.summary import percent, wilson_interval
from planner_jax.runs.timing import measure_warm
from planner_jax.sims.perception.camera import project
from planner_jax.sims.perception.contact_check import end_at_contact
from planner_jax.sims.perception.flight_fit import across_std, belief_at, error_across, fit_flight
from planner_jax.sims.perception.noise import StereoNoise, depth_std, information
from planner_jax.sims.perception.observation import (
    Eye,
    cautious,
    eye,
    fit_errors,
    fit_until,
    frame_times,
    see,
    watch,
)
from planner_jax.sims.perception.receding import AIMS, decide
from planner_jax.task.block.case import ANYWHERE
from planner_jax.task.block.problem.flight import flight_of
from planner_jax.task.block.replan import ReplanBlock

RATES = (30.0, 60.0, 120.0)  # [Hz] Frame rates of the camera.
STDS = (0.01, 0.02, 0.03)  # [m] Standard deviations of each observed coordinate.
MOMENTS = (0.08, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4)  # [s] Times at which flights are fitted.
ROOM = 0.1  # [m] A smaller error of the fitted position counts as success.
# Suite of throws, frame rate [Hz], noise of each coordinate [m], and time of the fit [s] for which
# the run's summary states the share of errors below 0.1 m.
BAR = ("short", 60.0, 0.02, 0.25)
RENDERED_RATE = 60.0  # [Hz] Frame rate of rendered images.
TIMED = 200  # Number of camera frames, and of flight fits, that are timed.
OVERHEAD = 0.05  # [s] Time from a camera frame until the motion that uses it may start.
PARTS = ("errors", "images", "pipeline", "planning")
# Row of the table of simulated arms -> (noise, times, options). The noise is the standard deviation
# [m] of each observed coordinate, or None for the noise of a stereo camera. The arm plans from the
# first to the last time [s] at a rate [Hz]. Options of `decide`, which simulates the arm: `patient`
# lets the arm wait for more observations while it can still block; without `again` the arm plans
# only one motion.
PIPELINES: dict[str, tuple[float | None, tuple[float, float, float], dict[str, Any]]] = {
    "once": (0.02, (0.25, 0.25, 60.0), {}),
    "once, stereo": (None, (0.25, 0.25, 60.0), {}),
    "once, at the last moment": (0.02, (0.2, 0.3, 60.0), {"patient": True, "again": False}),
    "again, 10 Hz": (0.02, (0.25, 0.75, 10.0), {}),
    "again, 20 Hz": (0.02, (0.25, 0.75, 20.0), {}),
    "again, 20 Hz, stereo": (None, (0.25, 0.75, 20.0), {}),
    "again from 0.15 s, 20 Hz": (0.02, (0.15, 0.75, 20.0), {}),
}


@jax.jit
def errors_after(
    cases: Any, eye: Eye, times: Array, places: Array, moments: Array, middle: Array
) -> tuple[Array, Array]:
    """Fit the flights of B balls at M times; return the errors of the fitted positions.

    The camera `eye` observes the positions `places` (B, K, 3) [m] at the times `times` (K,) [s].
    Fit m uses the observations up to the time `moments[m]` (M,) [s]. Returns the errors of the
    fitted positions at the times `middle` (B,) [s], and the standard deviations that the fit
    estimates for them, both (B, M) [m] and perpendicular to the flight. `cases` has the true balls.
    """

    def one(ball: BallState, gravity: Array, places: Array, middle: Array) -> Any:
        truth = drag_free_flight(ball, middle, gravity)

        def after(moment: Array) -> tuple[Array, Array]:
            fit = fit_until(eye, times, places, gravity, moment)
            belief = belief_at(fit, middle, gravity)
            return error_across(belief, truth), across_std(belief)

        return jax.vmap(after)(moments)

    return jax.vmap(one)(cases.ball, cases.gravity, places, middle)


@jax.jit
def middle_of(cases: Any) -> Array:
    flights = jax.vmap(flight_of)(cases)
    return 0.5 * (flights.earliest + flights.latest)


class Table:
    """Printed table of position errors, with a column for each time at which flights are fitted.

    An entry has the median error, and the share of errors below 0.1 m (`ROOM`).
    """

    def __init__(self, bench: Bench):
        self.bench = bench
        heads = [f"{moment:g} s" for moment in MOMENTS]
        bench.say("| suite | frames | noise | " + " | ".join(heads) + " |")
        bench.say("|---|---|---|" + "---|" * len(heads))

    def line(self, suite: str, rate: float, noise: str, errors: np.ndarray, stds: Any) -> None:
        within = np.mean(errors < ROOM, axis=0)  # False for balls not seen (NaN).
        medians = np.nanmedian(errors, axis=0)
        cells = [
            f"{median:.3f} m, {100 * share:.1f} %"
            for median, share in zip(medians, within, strict=True)
        ]
        self.bench.say(f"| {suite} | {rate:g} Hz | {noise} | " + " | ".join(cells) + " |")
        truth = np.sqrt(np.nanmean(errors**2, axis=0) / np.nanmean(np.asarray(stds) ** 2, axis=0))
        for k, moment in enumerate(MOMENTS):
            self.bench.row(
                suite=suite,
                rate=rate,
                noise=noise,
                moment=moment,
                num=len(errors),
                median=medians[k],
                within=within[k],
                over_believed=truth[k],
            )


def report_models(bench: Bench, num: int, seed: int) -> None:
    bench.say(f"Median error, and share of {num} throws within {ROOM:g} m", "")
    table, moments = Table(bench), jnp.asarray(MOMENTS)
    for suite in ("short", "pole"):
        cases = pj.block.draw(num, suite, seed)
        middle = middle_of(cases)
        for rate in RATES:
            times = jnp.asarray(frame_times(eye(rate=rate), max(MOMENTS)), jnp.float32)
            for std in (*STDS, None):
                sensor = eye(rate=rate, std=std)
                places = watch(cases, sensor, times, jax.random.key(seed))
                found = [
                    np.asarray(each)
                    for each in errors_after(cases, sensor, times, places, moments, middle)
                ]
                table.line(suite, rate, "stereo" if std is None else f"{100 * std:g} cm", *found)
                if (suite, rate, std, BAR[3]) == BAR:
                    bench.count(found[0][:, MOMENTS.index(BAR[3])] < ROOM)
                if std is None and rate == RENDERED_RATE:
                    alike = eye(rate=rate, std=1.0)  # Equal noise gives all frames equal weight.
                    found = errors_after(cases, alike, times, places, moments, middle)
                    table.line(suite, rate, "stereo, unweighted", np.asarray(found[0]), found[1])


def report_images(bench: Bench, num: int, seed: int) -> None:
    from planner_jax.benchmarks.rendered_balls.board import calibrate_camera
    from planner_jax.benchmarks.rendered_balls.camera import RenderError, SceneCamera

    sensor, thresholds = eye(rate=RENDERED_RATE), ball_thresholds()
    assert isinstance(sensor.noise, StereoNoise)
    cases = pj.block.draw(num, "short", seed)
    camera, found = calibrate_camera(irb1600(), sensor.camera, sensor.noise, seed=seed)
    off = 1e3 * np.linalg.norm(camera.position - np.asarray(sensor.camera.position))
    bench.say("", f"Calibration from 20 views: {off:.2g} mm off, residual {found.residual:.2f}")
    times = frame_times(sensor, max(MOMENTS))
    paths = jax.jit(jax.vmap(jax.vmap(drag_free_flight, (None, 0, None)), (0, None, 0)))
    truth = np.asarray(paths(cases.ball, jnp.asarray(times, jnp.float32), cases.gravity).pos)
    scene = jax.tree.map(lambda leaf: np.asarray(leaf)[0], cases.scene)
    noisy, seen_in = jax.jit(noisy_depth), jax.jit(sighting)
    places, seconds, frame_seconds = np.full_like(truth, np.nan), [], []
    try:
        scene_camera = SceneCamera(sensor.camera, scene)
    except RenderError as error:
        bench.say("", f"No images: {error}")
        return
    keys = jax.random.split(jax.random.key(seed), truth.shape[:2])
    with scene_camera:
        for k, path in enumerate(truth):
            for n, place in enumerate(path):
                began = time.perf_counter()
                image, depth = scene_camera.take(place)
                seconds.append(time.perf_counter() - began)
                depth, trust = map(
                    np.asarray, noisy(keys[k, n], sensor.camera, sensor.noise, depth)
                )
                began = time.perf_counter()
                places[k, n] = np.asarray(seen_in(image, depth, trust, camera, thresholds).place)
                frame_seconds.append(time.perf_counter() - began)
    report_frames(bench, sensor, truth, places)
    bench.say(f"Rendering takes {1e3 * np.median(seconds):.0f} ms a frame (median).", "")
    table, moments, middle = Table(bench), jnp.asarray(MOMENTS), middle_of(cases)
    times = jnp.asarray(times, jnp.float32)
    modelled_places = watch(cases, sensor, times, jax.random.key(seed))
    for name, given in (("images", jnp.asarray(places)), ("stereo", modelled_places)):
        errors = errors_after(cases, sensor, times, given, moments, middle)
        table.line(f"short, {num} throws", RENDERED_RATE, name, np.asarray(errors[0]), errors[1])
    report_times(bench, sensor, times, places[0], frame_seconds[1:])


def report_frames(bench: Bench, sensor: Eye, truth: np.ndarray, places: np.ndarray) -> None:
    """Report errors of ball positions that were found in images: mean and standard deviation.

    Errors in the image plane are in pixels. Errors along the camera's axis are divided by the
    standard deviation of the noise model. `sensor` has the camera and its noise model, `places` the
    positions found, `truth` the true positions, both (B, K, 3) [m] for B balls and K images.
    """
    camera: Any = sensor.camera
    noise: Any = sensor.noise
    seen = np.asarray(np.isfinite(places).all(axis=-1))
    pixels, depths = map(np.asarray, project(camera, jnp.asarray(truth)))
    found, deep = map(
        np.asarray, project(camera, jnp.asarray(np.where(seen[..., None], places, truth)))
    )
    across = (found - pixels)[seen]
    along = ((deep - depths) / np.asarray(depth_std(camera, noise, jnp.asarray(depths))))[seen]
    bench.say(
        f"Seen in {100 * seen.mean():.1f} % of {seen.size} frames; off by {across.std():.3f} px "
        f"(mean {across.mean(axis=0)[0]:.3f}, {across.mean(axis=0)[1]:.3f}; the model has "
        f"{float(noise.pixel_std):g}), depths by {along.std():.2f} deviations of the model "
        f"(mean {along.mean():.2f})"
    )
    bench.note(pixel_std=across.std(), depth_over_model=along.std(), seen=seen.mean())


def report_times(
    bench: Bench, sensor: Eye, times: Array, places: np.ndarray, frame_seconds: list[float]
) -> None:
    camera, noise = sensor.camera, sensor.noise

    @jax.jit
    def fit(times: Array, places: Array, gravity: Array) -> Any:
        weights = information(camera, noise, places)
        return belief_at(fit_flight(times, places, weights, gravity), times[0], gravity)

    # The fit takes NumPy arrays, because a real camera delivers positions to the host. The arrays
    # have a constant size, so that the fit is compiled only once.
    until, gravity = np.asarray(times), np.float32(GRAVITY)
    jax.block_until_ready(fit(until, places, gravity))
    fit_seconds = []
    for _ in range(TIMED):
        began = time.perf_counter()
        np.asarray(fit(until, places, gravity).mean)
        fit_seconds.append(time.perf_counter() - began)
    figures = {}
    for name, seconds in (("frame", frame_seconds[-TIMED:]), ("fit", fit_seconds)):
        p50, p99 = 1e3 * np.percentile(seconds, [50, 99])
        figures |= {f"{name}_p50_ms": p50, f"{name}_p99_ms": p99}
    bench.say(
        "",
        f"A frame of {camera.size[0]} x {camera.size[1]} p50 {figures['frame_p50_ms']:.2f} ms, p99 "
        f"{figures['frame_p99_ms']:.2f} ms; a fit of {len(until)} observations p50 "
        f"{figures['fit_p50_ms']:.3f} ms, p99 {figures['fit_p99_ms']:.3f} ms; "
        f"{jax.devices()[0].platform}, load average {os.getloadavg()[0]:.1f}",
    )
    bench.note(**figures)


def moments_of(first: float, last: float, rate: float) -> list[float]:
    """Return equally spaced times from `first` to `last` [s], `rate` of them per second."""
    return [first + k / rate for k in range(int(np.floor((last - first) * rate + 1e-6)) + 1)]


def pipeline(bench: Bench, num: int, seed: int) -> None:
    bench.say("", f"{num} throws of short, R1 wide, seed {seed}: the whole pipeline", "")
    bench.say(
        "| decided | noise | success % (95 %) | on the shield, % | without a plan, % | motions | "
        "first fit within 0.1 m, % | sensing + overhead + motion = contact, s (medians) | s |",
        "|" + "---|" * 9,
    )
    planner = pj.block.planner()
    cases = jax.tree.map(np.asarray, pj.block.draw(num, "short", seed, regime="R1", wide=True))
    for name, (std, (first, last, rate), options) in PIPELINES.items():
        sensor, began = eye(std=std), time.perf_counter()
        moments = moments_of(first, last, rate)
        done = decide(planner, cases, sensor, moments, overhead=OVERHEAD, seed=seed, **options)
        met = end_at_contact(done.cases, done.plans)
        some = pj.are_solved(met)
        verdict = pj.block.judge(done.cases, met)
        anywhere = dataclasses.replace(
            done.cases,
            offset=np.full_like(done.cases.offset, ANYWHERE[0]),
            tilt=np.full_like(done.cases.tilt, ANYWHERE[1]),
        )
        good, on_it = verdict.success & some, pj.block.judge(anywhere, met).success & some
        errors, _ = fit_errors(done.cases, pj.take(done.fits, 0))
        start = np.median(np.asarray(done.start)[good])
        contact = np.median(np.asarray(met.contact_time)[good])
        low, high = (100.0 * end for end in wilson_interval(int(good.sum()), num))
        spent = time.perf_counter() - began
        bench.say(
            f"| {name} | {'stereo' if std is None else f'{100 * std:g} cm'} | "
            f"{percent(int(good.sum()), num)} ({low:.1f} to {high:.1f}) | "
            f"{percent(int(on_it.sum()), num)} | {percent(int((~some).sum()), num)} | "
            f"{done.motions.mean():.1f} | {100.0 * np.mean(np.asarray(errors) < ROOM):.1f} | "
            f"{start - OVERHEAD:.3f} + {OVERHEAD:g} + {contact - start:.3f} = {contact:.3f} | "
            f"{spent:.0f} |"
        )
        bench.count(good)
        bench.row(
            pipeline=name,
            std=std,
            num=num,
            success=int(good.sum()),
            on_shield=int(on_it.sum()),
            planned=int(some.sum()),
            failed=dict(Counter(verdict.failed_limit[some & ~good].tolist())),
            motions=done.motions.mean(),
            begun=start,
            contact=contact,
        )


def planning(bench: Bench, num: int, seed: int) -> None:
    cases = jax.tree.map(np.asarray, pj.block.draw(num, "short", seed, regime="R1", wide=True))
    planner, sensor = pj.block.planner(), eye(std=0.02)
    known = [
        see(cases, sensor, moment, overhead=OVERHEAD, seed=seed).cases for moment in (0.25, 0.3)
    ]
    first, later = (jax.tree.map(np.asarray, each) for each in known)
    plans, seconds = time_with_aims(planner, first)
    tasks = ReplanBlock().begin(first, plans, later.delay - first.delay, ball=later.ball)
    moving = pj.take(tasks, np.flatnonzero(pj.are_solved(plans)))
    again, more = time_with_aims(ReplanBlock(), moving)
    rows = (("first", seconds, plans), ("next", more, again))
    for name, spent, found in rows:
        some = pj.are_solved(found)
        quick, slow = 1e3 * np.percentile(spent, [50, 99])
        bench.say(
            "",
            f"Planning the {name} motion of one throw, {len(spent)} throws: p50 {quick:.1f} ms, "
            f"p99 {slow:.1f} ms; {percent(int(some.sum()), len(some))} % have one, and "
            f"{percent(int((some & (spent > OVERHEAD)).sum()), len(some))} % later than the "
            "overhead allows; "
            f"{jax.devices()[0].platform}, load average {os.getloadavg()[0]:.1f}",
        )
        bench.note(**{f"{name}_planning_p50_ms": quick, f"{name}_planning_p99_ms": slow})


def time_with_aims(planner: Any, entries: Any) -> tuple[Any, np.ndarray]:
    (num,), own = entries.batch_shape, isinstance(planner, ReplanBlock)
    aimed = []
    for aim in AIMS:
        case = cautious(entries.case if own else entries, **dataclasses.asdict(aim))
        case = jax.tree.map(np.asarray, case)
        aimed.append(dataclasses.replace(entries, case=case) if own else case)
    found, seconds = [], np.zeros(num)
    for k in range(num):
        plan: Any = None
        for each in aimed:
            entry = pj.take(each, k)
            plan, spent = measure_warm(lambda entry=entry: pj.plan(planner, entry))
            seconds[k] += spent
            if pj.are_solved(plan):
                break
        found.append(plan)
    return jax.tree.map(lambda *leaves: np.stack(leaves), *found), seconds


def main() -> None:
    counts = {"num": 2000, "throws": 1000, "timed": 50, "rendered": 12, "seed": 7}
    parser = argument_parser("block_perception", __doc__, **counts)
    parser.add_argument(
        "--parts",
        default=",".join(PARTS),
        help=f"parts to run, of {', '.join(PARTS)}; default: all",
    )
    options = parser.parse_args()
    parts = parse_names(parser, "--parts", options.parts, PARTS)
    with begin(parser, options) as bench:
        if "errors" in parts:
            report_models(bench, options.num, options.seed)
        if "images" in parts:
            report_images(bench, options.rendered, options.seed)
        if "pipeline" in parts:
            pipeline(bench, options.throws, options.seed)
        if "planning" in parts:
            planning(bench, options.timed, options.seed)


if __name__ == "__main__":
    main()
