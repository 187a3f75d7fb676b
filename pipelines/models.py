"""The networks' files: which there are, where they lie, and whether they are what they should be.

Owns the table of known files, the folder, checksums and downloads. Opens no network. A new file is
one entry of MODELS.
"""

from __future__ import annotations

import difflib
import hashlib
import http.client
import os
import shutil
import urllib.error
import urllib.request
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from pipelines.errors import ModelError

_CHUNK_BYTES = 1 << 20
_TIMEOUT_S = 30.0
_PROGRAM = "python3 -m app models"


@dataclass(frozen=True, slots=True)
class KnownModel:
    """One file of the table.

    file_name: in the models' folder. what, licence: in words. setting: which setting takes a path
    of one's own in its place, empty for a file that only others are made from. url: the publisher's
    address, empty where there is no such file to download. sha256: in hex, or its first digits
    where the publisher states no more, or empty where it differs from export to export. size_mb: of
    the download. made_from: the file that `models export` makes this one from. advice: how to come
    by it where it cannot be fetched.
    """

    file_name: str
    what: str
    licence: str
    setting: str = ""
    url: str = ""
    sha256: str = ""
    size_mb: int = 0
    made_from: str = ""
    advice: str = ""


MODELS = {
    "yolo_seg": KnownModel(
        "yolo_seg.onnx",
        "a YOLOv8 or YOLO11 segmentation network; quick on a CPU",
        "AGPL-3.0 (Ultralytics' weights), so never shipped with this project",
        "detector.model",
        advice="export one with Ultralytics' package: "
        "`yolo export model=yolov8n-seg.pt format=onnx dynamic=True`",
    ),
    "mask_rcnn": KnownModel(
        "maskrcnn_resnet50_fpn_coco.onnx",
        "torchvision's Mask R-CNN, trained on COCO; more exact, for a GPU",
        "BSD-3-Clause (torchvision)",
        "detector.model",
        made_from="mask_rcnn_weights",
    ),
    "mask_rcnn_weights": KnownModel(
        "maskrcnn_resnet50_fpn_coco-bf2d0c1e.pth",
        "the weights that mask_rcnn is made from",
        "BSD-3-Clause (torchvision)",
        url="https://download.pytorch.org/models/maskrcnn_resnet50_fpn_coco-bf2d0c1e.pth",
        sha256="bf2d0c1e",  # torchvision puts the first digits into its file names
        size_mb=170,
    ),
    "pwc_net": KnownModel(
        "pwc_net.pth.tar",
        "PWC-Net's published weights for PyTorch, for the flow `pwc_net`",
        "CC BY-NC-SA 4.0 (NVIDIA): not for commercial use",
        "flow.model",
        advice="take pwc_net.pth.tar from the folder PyTorch of NVIDIA's repository PWC-Net",
    ),
}


def models_folder() -> Path:
    """$DYOB_MODELS, else dyob-slam/models in the user's cache: clones share these large files."""
    chosen = os.environ.get("DYOB_MODELS")
    cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(chosen) if chosen else Path(cache) / "dyob-slam" / "models"


def known_model(name: str) -> KnownModel:
    """The entry of the table; raises ModelError for an unknown name, with the nearest one."""
    if name not in MODELS:
        nearest = difflib.get_close_matches(name, MODELS, 1, 0.4)
        hint = f"did you mean {nearest[0]!r}? " if nearest else ""
        raise ModelError(f"Unknown model {name!r}; {hint}There are: {', '.join(MODELS)}.")
    return MODELS[name]


def model_path(name: str) -> Path:
    """Where the file of the model lies or would lie."""
    return models_folder() / known_model(name).file_name


def is_at_hand(name: str) -> bool:
    """Whether the models' folder holds the file, good or not."""
    return model_path(name).is_file()


def find_model(name: str, explicit_path: str | Path = "") -> Path:
    """The file of a model: `explicit_path` where given, else the one in the models' folder.

    Raises ModelError, with what to type, where it is missing, empty, or no longer what it was when
    it came there. A file of one's own is taken as it is.
    """
    if explicit_path:
        path = Path(explicit_path).expanduser()
        if not path.is_file():
            raise ModelError(
                f"{name}: expected a model file, found nothing at {path}; {how_to_get(name)}"
            )
        return path
    path = model_path(name)
    if not path.is_file():
        raise ModelError(f"{name}: its file {path} is missing; {how_to_get(name)}")
    check_model(name, path)
    return path


def how_to_get(name: str) -> str:
    """The commands that bring the model, as the end of a sentence."""
    model = known_model(name)
    ways = []
    if model.url or model.made_from:
        ways.append(f"type `{_PROGRAM} fetch {name}`")
    if model.advice:
        ways.append(model.advice)
    ways.append(f"bring a file of your own in by `{_PROGRAM} add {name} FILE`")
    if model.setting:
        ways.append(f"or name one with `--set {model.setting}=FILE`")
    return ", ".join(ways)


def check_model(name: str, path: Path) -> None:
    """Raise ModelError unless the file has the checksum of the table or of when it was stored."""
    expected = _stored_sha256(path) or known_model(name).sha256
    found = file_sha256(path) if expected else ""
    if not found.startswith(expected):
        raise ModelError(
            f"{name}: expected {path} to have the sha256 {expected}, found {found}, so it is "
            f"damaged or another file; {how_to_get(name)}"
        )


def file_sha256(path: Path) -> str:
    """Hex digits of the file's checksum; raises ModelError where it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise ModelError(f"{path}: cannot read this file ({error.strerror or error})") from error


def add_model(name: str, source: Path) -> Path:
    """Copy a file into the models' folder, checked; returns where it is now."""
    model = known_model(name)
    if not source.is_file():
        raise ModelError(f"{name}: expected a file to add, found none at {source}")
    with storing(name) as fresh:
        shutil.copyfile(source, fresh)
        _check_against(fresh, model.sha256, f"{name}: {source}")
    return model_path(name)


def fetch_model(name: str, progress: Callable[[int, int], None] | None = None) -> Path:
    """Download a file into the models' folder, checked; one that is there and good is kept.

    progress: called with bytes so far and in all. Raises ModelError where there is nothing to
    download, where it cannot be had, and where the checksum differs (nothing is kept then).
    """
    model = known_model(name)
    if is_at_hand(name):
        try:
            check_model(name, model_path(name))
            return model_path(name)
        except ModelError:
            pass  # damaged: fetched anew
    if not model.url:
        raise ModelError(f"{name}: there is no address to download it from; {how_to_get(name)}")
    with storing(name) as fresh:
        _download(name, fresh, progress or (lambda done, total: None))
        _check_against(fresh, model.sha256, f"{name}: what came from {model.url}")
    return model_path(name)


@contextmanager
def storing(name: str) -> Iterator[Path]:
    """A fresh path in the models' folder, which becomes the model's file if the block succeeds.

    Its checksum is noted beside it, so that later damage is seen. If the block fails nothing is
    left behind, and an older file stays.
    """
    path = model_path(name)
    fresh = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield fresh
        with fresh.open("rb+") as file:
            os.fsync(file.fileno())
        digest = file_sha256(fresh)
        _note_of(path).unlink(missing_ok=True)  # no moment with a note of another file
        fresh.replace(path)
        _note_of(path).write_text(f"{digest}  {path.name}\n", encoding="utf-8")
    except OSError as error:
        raise ModelError(
            f"{name}: cannot write {path} ({error.strerror or error}); make room, or set "
            "DYOB_MODELS to a folder that can be written"
        ) from error
    finally:
        with suppress(OSError):
            fresh.unlink(missing_ok=True)


def _note_of(path: Path) -> Path:
    """A line as the command sha256sum writes and checks it."""
    return path.with_name(path.name + ".sha256")


def _stored_sha256(path: Path) -> str:
    try:
        return _note_of(path).read_text(encoding="utf-8").split()[0]
    except (OSError, UnicodeDecodeError, IndexError):
        return ""


def _check_against(path: Path, expected: str, subject: str) -> None:
    found = file_sha256(path) if expected else ""
    if not found.startswith(expected):
        raise ModelError(
            f"{subject}: expected the sha256 {expected}, found {found}; it was not kept, "
            "try again or take the file from its publisher"
        )


def _download(name: str, path: Path, progress: Callable[[int, int], None]) -> None:
    url = MODELS[name].url
    try:
        with urllib.request.urlopen(url, timeout=_TIMEOUT_S) as reply, path.open("wb") as file:
            total, done = int(reply.headers.get("Content-Length") or 0), 0
            while chunk := reply.read(_CHUNK_BYTES):
                file.write(chunk)
                done += len(chunk)
                progress(done, max(total, done))
    except (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError) as no:
        reason = getattr(no, "reason", None) or no
        raise ModelError(
            f"cannot fetch {url} ({reason}); is there a network? A file that came another way "
            f"is brought in by `{_PROGRAM} add {name} FILE`"
        ) from no
    if done < total:
        raise ModelError(f"{url}: expected {total} bytes, found {done}; try again")
