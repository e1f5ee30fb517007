"""One evaluation from start to files: the daemon plays a recording, we listen, then score."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from prism_edge.all_or_nothing import put_whole
from prism_edge.bus.keys import check_endpoint, check_robot_name
from prism_edge.bus.session import Bus
from prism_edge.bus.vacancy import check_vacant, free_endpoint
from prism_edge.config import WITHOUT_NETWORK, BusConfig, Config, LogConfig, SourceConfig
from prism_edge.errors import ConfigError, EvaluationError, say
from prism_edge.evaluation.daemon import SUPERVISOR, Daemon
from prism_edge.evaluation.files import digests_of, files_of
from prism_edge.evaluation.metrics import metrics
from prism_edge.evaluation.played import played
from prism_edge.evaluation.progress import Progress
from prism_edge.evaluation.recorder import Recorder
from prism_edge.evaluation.recording import Recording
from prism_edge.evaluation.resources import Meter, Usage
from prism_edge.evaluation.results import CONFIG, FILES, LOG, MAP, PATHS, Results, alone_in, results_in
from prism_edge.evaluation.trajectory import NS, Trajectory, read_tum, write_tum
from prism_edge.messages import MapSnapshot, WholeMap
from prism_edge.processes import processes_for
from prism_edge.sources import Slot, Source, open_source
from prism_edge.sources.live.open import is_live
from prism_edge.sources.schedule import GAP
from prism_edge.sources.truth import read_truth

# The first frame waits this long after the daemon is ready, so that we, who connect at the same time, are
# linked to every process by then; it is part of no figure.
_WAIT_S = 1.0
_SAMPLE_S = 1.0
_LOOK_S = 0.1
_LAST_FRAME_S = 10.0  # for the last frames to be tracked once the source has ended
_MAP_S = 20.0  # for all of the map, a large one's hundreds of megabytes too
_SILENCE_S = 120.0  # without any frame: the run is given up


@dataclasses.dataclass(frozen=True)
class Heard:
    """What a run left behind, before anything is scored."""

    recording: Recording
    snapshot: MapSnapshot | None  # None: the backend never answered
    map: WholeMap | None  # None: there is none
    usage: Usage
    ready_s: float | None


def evaluate(
    config: Config,
    out: Path,
    truth: Path | None = None,
    settle_s: float = 60.0,
    command: Sequence[str] = SUPERVISOR,
    quiet: bool = False,
    keep_endpoint: bool = False,
    further: Sequence[str] = (),
) -> dict[str, Any]:
    """Runs ``config`` through the daemon, and writes live.tum, final.tum, metrics.json, the map and more.

    All of them go to ``out``.

    ``truth`` is a TUM file to score against instead of the sequence's own; either is read before the run, so
    that a damaged one is said at once, and stays in this process. ``settle_s`` is how long the last
    optimisation may take; ``quiet`` shows no progress on stderr; without ``keep_endpoint`` the default
    endpoint gives way to a free one, for runs side by side. ``further`` names what the caller makes of
    results: an earlier run's goes with the rest.
    Returns the metrics. Call it from the main thread. Raises SourceError or ConfigError for an unusable
    sequence or its truth, BusError where another daemon has the endpoint, DaemonError with the daemon's own
    exit code where it fails, and EvaluationError for an unusable ``truth``, and where the run broke a rule or
    there is nothing to score (with files written).
    """
    source = _playable(config.source)
    first, frame_count = _extent(source)
    made_of = played(config.source, source, truth)
    if truth is not None and not os.path.isfile(truth):
        what = "a folder: a TUM file is wanted" if os.path.isdir(truth) else "no such file"
        raise EvaluationError(f"{truth}: {what}: nothing to score against")
    # Where the truth that was given lies among the results, it stays as it is.
    kept = {truth.resolve()} if truth is not None else set()
    named = files_of(config, Path(made_of.truth_file) if made_of.truth_file else None)
    written = {(out / name).resolve() for name in PATHS}
    written |= {(out / name).resolve() for name in (*FILES, *further)} - kept
    for file in named:
        if file.resolve() in written:
            raise EvaluationError(f"{file} would be overwritten by the run's own: name another folder for it")
    true_path = _truth(config, truth)
    made_of = dataclasses.replace(made_of, files=digests_of(named))
    config = as_it_runs(config if keep_endpoint else on_free_endpoint(config))
    check_vacant(config.bus.endpoint)
    results = Results(out, kept, further)
    with alone_in(out):
        with results:
            results.prepare(config)
            if not config.depth.network and not quiet:
                say(f"prism-edge: warning: depth {WITHOUT_NETWORK}")
            heard = _run(config, out, settle_s, Progress(frame_count, quiet), command, results)
            results.begin()

        live = heard.recording.live()
        final, missing = Trajectory.of([]), 0
        if heard.snapshot is not None:
            # The map's world frame is the first camera's, and `map` begins where base_link was then.
            final, missing = heard.recording.final(heard.snapshot, heard.snapshot.base_from_camera)
        with results_in(out):
            write_tum(out / "live.tum", live)
            write_tum(out / "final.tum", final)
            if heard.map is not None:
                put_whole(out / MAP, heard.map.data.tobytes())
            elif heard.snapshot is not None and len(heard.snapshot.points):
                say(f"prism-edge: warning: the map did not come in {_MAP_S:.0f} s: no {MAP}")
            if true_path is not None and (out / "truth.tum").resolve() not in kept:
                write_tum(out / "truth.tum", true_path)
        report = metrics(
            config=config,
            recording=heard.recording,
            snapshot=heard.snapshot,
            usage=heard.usage,
            ready_s=heard.ready_s,
            first_stamp_ns=first.stamp_ns if first else None,
            live=live,
            final=final,
            final_missing=missing,
            truth=true_path,
            truth_name=str(truth) if truth else "the sequence's own",
            played=made_of.after(out / LOG),
        )
        with results_in(out):
            put_whole(out / "metrics.json", f"{json.dumps(report, indent=2, allow_nan=False)}\n".encode())
        if report["violations"]:
            raise EvaluationError(f"the run is void: {'; '.join(report['violations'])}")
        if report["unscored"]:
            raise EvaluationError(f"the run can't be scored: {report['unscored']}; {out} holds what there is")
        return report


def extent(config: SourceConfig) -> tuple[Slot | None, int | None]:
    """First place and number of frames of a source that can be played (None: not to be known).

    A synthetic source is not opened for that: it would build its whole world. Raises SourceError or
    ConfigError where the source is unusable, EvaluationError where it is a live camera.
    """
    return _extent(_playable(config))


def _playable(config: SourceConfig) -> Source:
    """A source that has an end, still closed; raises as :func:`extent`."""
    if is_live(config.uri):
        raise EvaluationError("a live camera has neither an end nor truth: evaluate a recording of it")
    if config.loop:
        raise ConfigError("source.loop: an evaluation ends with its recording: leave it out")
    return open_source(config)


def _extent(source: Source) -> tuple[Slot | None, int | None]:
    with contextlib.nullcontext() if source.synthetic else source:
        count = source.frame_count
        while (first := source.peek()) is not None and first.out_of_line:  # no moment of the recording
            source.skip()
        return first, count


def on_free_endpoint(config: Config) -> Config:
    """The configuration with a free loopback port in place of the default endpoint; another is kept."""
    if config.bus.endpoint != BusConfig().endpoint:
        return config
    return dataclasses.replace(config, bus=dataclasses.replace(config.bus, endpoint=free_endpoint()))


def as_it_runs(config: Config) -> Config:
    """The configuration with what an evaluation sets by itself. Raises ConfigError."""
    source = dataclasses.replace(config.source, wait_s=max(config.source.wait_s, _WAIT_S))
    check_robot_name(config.robot)
    check_endpoint(config.bus.endpoint)
    # What is to be known of the figures stands on the log, and is read there.
    level = "debug" if config.log.level == "debug" else "info"
    return dataclasses.replace(config, source=source, log=LogConfig("text", level))


def _run(
    config: Config,
    out: Path,
    settle_s: float,
    progress: Progress,
    command: Sequence[str],
    results: Results,
) -> Heard:
    recorder: Recorder | None = None
    try:
        with contextlib.ExitStack() as stack:
            daemon = stack.enter_context(
                Daemon(out / CONFIG, out / LOG, config.supervisor.stop_s, command)
            )
            bus = stack.enter_context(Bus.open(config, "eval"))
            recorder = Recorder(bus, config.frames)
            bus.pulse.ready()
            stack.enter_context(progress)
            meter = Meter(daemon.pid, "supervisor")
            ready_s = _listen(config, daemon, recorder, meter, progress, results)
            progress.say("waiting for the last optimisation")
            snapshot = _settled(bus, daemon, settle_s)
            whole = bus.ask("whole_map", _MAP_S) if snapshot is not None else None
            return Heard(recorder.close(), snapshot, whole, meter.usage, ready_s)
    except BaseException:  # of Ctrl-C and SIGTERM, too
        if recorder is not None and results.begun:
            results.keep_until_here(recorder.close().live())
        raise


def _listen(
    config: Config,
    daemon: Daemon,
    recorder: Recorder,
    meter: Meter,
    progress: Progress,
    results: Results,
) -> float | None:
    """Follows the run until its last frame has been tracked; seconds from start to ready (None: never)."""
    awaited = {process.name for process in processes_for(config)}
    ready_ns, begun = 0, False
    next_sample_s = time.monotonic()
    ended_s, frames, heard_s = None, 0, time.monotonic() + config.supervisor.start_s + config.source.wait_s
    while not recorder.complete:
        recorder.wait(_LOOK_S)
        daemon.check()
        for beat in recorder.poll():
            meter.name(beat.pid, beat.process)
            if GAP in beat.values:
                heard_s = time.monotonic()
            if beat.process in awaited and beat.state != "starting":
                awaited.remove(beat.process)
                since = beat.activity_since_ns if beat.state == "ready" else beat.monotonic_ns
                ready_ns = max(ready_ns, since)
        now = time.monotonic()
        if not begun and (not awaited or recorder.frames):
            begun = True
            results.begin()
            meter.begin()
        if begun and now >= next_sample_s:
            next_sample_s = now + _SAMPLE_S
            meter.sample()
            progress.at(recorder.position)
        if recorder.frames > frames:
            frames, heard_s = recorder.frames, now
        if now - heard_s > _SILENCE_S:
            raise EvaluationError(f"no frame was tracked for {_SILENCE_S:.0f} s: the run is given up")
        if recorder.ended is not None:
            ended_s = ended_s or now
            if now - max(ended_s, heard_s if frames else 0.0) > _LAST_FRAME_S:
                break  # the last frames were lost with a process
    meter.end()
    progress.at(recorder.position)
    return None if awaited else (ready_ns - daemon.started_ns) / NS


def _settled(bus: Bus, daemon: Daemon, settle_s: float) -> MapSnapshot | None:
    """The map after its last optimisation, or the latest there is when ``settle_s`` is over."""
    deadline = time.monotonic() + settle_s
    latest: MapSnapshot | None = None
    while True:
        latest = bus.ask("map_snapshot") or latest
        if (latest is not None and latest.settled) or time.monotonic() > deadline:
            return latest
        daemon.check()
        time.sleep(_LOOK_S)


def _truth(config: Config, file: Path | None) -> Trajectory | None:
    if file is not None:
        return read_tum(file)
    own = read_truth(config.source.uri)
    return None if own is None else Trajectory(*own)
