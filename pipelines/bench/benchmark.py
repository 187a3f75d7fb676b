"""`Benchmark`: runs sequences one by one and keeps what came out, after each of them.

Owns bench.json. A run that fails is an entry that says so; what goes on after it is the caller's.
"""

from __future__ import annotations

import logging
import os
import platform
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from pipelines.bench.cases import BenchCase, Progress, labels_of
from pipelines.bench.measures import FRAME_TIME, errors_of, means_of
from pipelines.bench.published import published_for
from pipelines.bench.report import bench_text
from pipelines.config import Config
from pipelines.errors import DyObError
from pipelines.io import folder as names
from pipelines.io.config import config_to_dict
from pipelines.io.files import disk_error, write_json, write_text, write_yaml
from pipelines.io.folder import check_output
from pipelines.io.result import Result
from pipelines.io.timings import WALL, stage_summaries
from pipelines.runner import Sink, run

RESULTS_NAME = "bench"  # ends the name of a new folder
BENCH_JSON, BENCH_MD, RUNS = "bench.json", "bench.md", "runs"
DONE, FAILED, STOPPED = "done", "failed", "stopped"
_log = logging.getLogger("dyob.bench")


class Benchmark:
    """Some cases, each to be run with the seeds 0 to `runs` - 1, and the folder they fill.

    `content` is what bench.json holds. Runs are full result folders in runs/, without pictures.
    """

    def __init__(
        self,
        folder: Path | str,
        cases: Sequence[BenchCase],
        config: Config,
        *,
        runs: int = 1,
        frames: int | None = None,
    ) -> None:
        """Raises DyObError where `folder` holds something else, or cannot be written."""
        self.folder = Path(folder)
        self._cases = tuple(cases)
        # What every frame saw serves `optimize`; for many runs it would fill the disk.
        self._config = replace(config, batch=replace(config.batch, record=False))
        self._n_runs, self._frames = runs, frames
        check_output(self.folder, BENCH_JSON)
        self.content: dict[str, Any] = {
            "started": time.strftime("%Y-%m-%d %H:%M:%S"),
            "machine": machine(),
            "runs": runs,
            "frames": frames,
            "stopped": False,
            "sequences": [
                {"label": label, **asdict(case), "is_noisy": case.is_noisy, "runs": []}
                for label, case in zip(labels_of(cases), self._cases, strict=True)
            ],
        }
        self.write()
        write_yaml(self.folder / names.CONFIG, config_to_dict(self._config))

    def pending(self) -> Iterator[tuple[int, int]]:
        """(case, seed) in the order to run them: all sequences once before any a second time."""
        for seed in range(self._n_runs):
            for case in range(len(self._cases)):
                yield case, seed

    def label(self, case: int) -> str:
        return str(self.content["sequences"][case]["label"])

    def run(
        self,
        case: int,
        seed: int,
        *,
        sinks: Iterable[Sink] = (),
        rendering: Progress = lambda done, total: None,
        optimising: Progress = lambda done, total: None,
    ) -> str:
        """Run one case with one seed, and note how it ended: the state.

        rendering, optimising: called with (done, total). No error of the run is raised, be it the
        data's fault or the program's; a KeyboardInterrupt outside of the frames is.
        """
        entry: dict[str, Any] = {"seed": seed, "state": FAILED, "load": _load()}
        folder = Path(RUNS) / f"{self.label(case)}-{seed}"
        begin = time.monotonic()
        try:
            sequence = self._cases[case].open(seed, rendering)
            self._describe(case, sequence)
            try:
                result = run(
                    sequence,
                    replace(self._config, tracking=replace(self._config.tracking, seed=seed)),
                    self.folder / folder,
                    frames=self._frames,
                    sinks=sinks,
                    batch_progress=optimising,
                )
            finally:
                self._cases[case].discard(sequence, seed)
            entry |= {"folder": str(folder), **_outcome(result)}
        except DyObError as error:
            entry["sentence"] = str(error)
        except Exception as error:  # the others are still worth running
            _log.exception("a defect in %s, seed %d", self.label(case), seed)
            entry["sentence"] = f"a defect of DyOb-SLAM: {type(error).__name__}: {error}"
        entry["seconds"] = round(time.monotonic() - begin, 2)
        self._add(case, entry)
        return str(entry["state"])

    def write(self, *, stopped: bool = False) -> None:
        """bench.json and bench.md, with what there is by now."""
        self.content["stopped"] = stopped
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DyObError(disk_error(self.folder, error)) from error
        write_json(self.folder / BENCH_JSON, self.content)
        write_text(self.folder / BENCH_MD, bench_text(self.content))

    def _describe(self, case: int, sequence: Any) -> None:
        known = published_for(sequence.dataset, sequence.name)
        self.content["sequences"][case] |= {
            "name": sequence.name,
            "dataset": sequence.dataset,
            "width": sequence.camera.width,
            "height": sequence.camera.height,
            "n_frames": len(sequence),
            "published": [asdict(entry) for entry in known],
        }

    def _add(self, case: int, entry: dict[str, Any]) -> None:
        sequence = self.content["sequences"][case]
        sequence["runs"].append(entry)
        errors = [run["errors"] for run in sequence["runs"] if run["state"] == DONE]
        sequence["mean"] = means_of(errors)
        known = [{k: v for k, v in run.items() if k != FRAME_TIME.key} for run in errors]
        sequence["alike"] = len(known) > 1 and all(run == known[0] for run in known[1:])


def _outcome(result: Result) -> dict[str, Any]:
    """What bench.json keeps of a run's metrics.json and timings.json."""
    counts = result.metrics["run"]
    entry: dict[str, Any] = {"state": DONE, "frames": counts["frames"]}
    entry["tracked"] = counts["tracked"]
    if counts["interrupted"]:
        entry |= {"state": STOPPED, "sentence": f"after {counts['frames']} frames"}
    elif counts["tracked"] == 0:
        entry |= {"state": FAILED, "sentence": "no frame could be tracked; see its run.log"}
    entry["timings"] = {
        stage: {key: values[key] for key in ("median_ms", "p95_ms")}
        for stage, values in stage_summaries(result.timings).items()
    }
    entry["errors"] = errors_of(result.metrics)
    entry["errors"][FRAME_TIME.key] = entry["timings"].get(WALL, {}).get("median_ms")
    return entry


def machine() -> dict[str, Any]:
    """The processor and what else the times depend on."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
    }


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or "unknown processor"


def _load() -> float | None:
    """How many programs wanted the processor in the last minute; more than cores spoil times."""
    try:
        return round(os.getloadavg()[0], 2)
    except OSError:
        return None
