"""Reads the single files of a sequence: images, depth, flow, instance labels.

Owns decoding and the sentences about files that cannot be used. Knows no folder layout.
Every reader takes the expected size and raises FrameError, naming the file, what was expected,
what was found and what to do; DamagedFileError, one of them, where the file itself is broken.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.datasets.palette import indices_as_grey, is_palette_png
from pipelines.errors import DatasetError, FrameError
from pipelines.types import Image

Size = tuple[int, int]  # width, height in pixels
DepthForm = Literal["metric", "disparity"]
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp")
MIN_DEPTH_M, MAX_DEPTH_M = 1e-3, 1e3  # beyond these a depth is a fault of its file, not a place
FLO_MAGIC = 202021.25  # Middlebury's sanity value at the head of a .flo file
FLO_UNKNOWN_PX = 1e9  # Middlebury: components beyond this say "unknown"
SATURATED = 65535  # the largest value of 16 bits: "no reading" or "nearer than can be told"


class DamagedFileError(FrameError):
    """A file is empty, cut short or not of its format, so that nothing of it can be used."""


@dataclass(frozen=True)
class DepthCoding:
    """How the integers of a depth image become metres.

    form "metric": Z = value / factor. form "disparity": Z = bf / (value / factor), bf in px * m.
    """

    form: DepthForm
    factor: float
    bf: float = 0.0
    _metres: NDArray[np.float32] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.form not in ("metric", "disparity"):
            raise DatasetError(
                f"Depth form: expected 'metric' or 'disparity', found {self.form!r}; "
                "set depth_form to one of them."
            )
        if not self.factor > 0 or (self.form == "disparity" and not self.bf > 0):
            raise DatasetError(
                "Depth scale: expected a positive factor (and bf for disparities), found "
                f"factor {self.factor:g}, bf {self.bf:g}; correct them in the settings."
            )
        values = np.arange(SATURATED + 1, dtype=np.float64)
        with np.errstate(divide="ignore"):
            metres = (
                values / self.factor if self.form == "metric" else self.bf * self.factor / values
            )
        metres[[0, SATURATED]] = np.nan
        # A table of all 16-bit values is exact and faster than arithmetic on the image.
        object.__setattr__(self, "_metres", clean_depth(metres))

    def to_metres(self, raw: NDArray[np.uint16]) -> NDArray[np.float32]:
        """(H, W) float32 metres of raw values (H, W); NaN where 0, saturated or absurd."""
        return np.asarray(cv2.LUT(raw, self._metres), np.float32)


def clean_depth(depth_m: NDArray) -> NDArray[np.float32]:
    """`depth_m` as float32 with NaN where it is not a distance: not finite, <= 0, beyond 1 km."""
    depth = np.array(depth_m, np.float32)
    with np.errstate(invalid="ignore"):
        depth[~((depth >= MIN_DEPTH_M) & (depth <= MAX_DEPTH_M))] = np.nan
    return depth


def read_image(path: Path, size: Size | None = None) -> Image:
    """Grey (H, W) or RGB (H, W, 3) uint8, as the file has it. Raises FrameError."""
    pixels = _decode(path, "an image")
    if pixels.dtype != np.uint8:
        raise FrameError(
            f"Image {path}: expected 8 bits a channel, found {pixels.dtype}; convert the images."
        )
    _check_size(path, "image", pixels, size)
    if pixels.ndim == 2:
        return pixels
    if pixels.shape[2] not in (3, 4):
        raise FrameError(
            f"Image {path}: expected grey or colour, found {pixels.shape[2]} channels; "
            "convert the images."
        )
    code = cv2.COLOR_BGR2RGB if pixels.shape[2] == 3 else cv2.COLOR_BGRA2RGB
    return np.asarray(cv2.cvtColor(pixels, code), np.uint8)


def read_depth_values(path: Path, size: Size | None = None) -> NDArray[np.uint16]:
    """Raw values (H, W) of a 16-bit depth or disparity image. Raises FrameError."""
    values = _decode(path, "a depth image")
    if values.dtype != np.uint16 or values.ndim != 2:
        channels = 1 if values.ndim == 2 else values.shape[2]
        raise FrameError(
            f"Depth {path}: expected a 16-bit image of one channel, found {values.dtype} of "
            f"{channels}; write depth as 16-bit PNG."
        )
    _check_size(path, "depth", values, size)
    return values


def read_depth(path: Path, coding: DepthCoding, size: Size | None = None) -> NDArray[np.float32]:
    """Depth (H, W) float32 in metres, NaN unknown, from a 16-bit image or a .npy of metres."""
    if path.suffix != ".npy":
        return coding.to_metres(read_depth_values(path, size))
    depth = _load_array(path, "a depth array")
    if depth.ndim != 2 or not np.issubdtype(depth.dtype, np.floating):
        raise FrameError(
            f"Depth {path}: expected (H, W) floats in metres, found {depth.shape} {depth.dtype}."
        )
    _check_size(path, "depth", depth, size)
    return clean_depth(depth)


def read_flow(path: Path, size: Size | None = None) -> NDArray[np.float32]:
    """Optical flow (H, W, 2) float32 in pixels, NaN unknown, from Middlebury .flo or .npy."""
    if path.suffix == ".npy":
        flow = np.array(_load_array(path, "a flow array"), np.float32)
        if flow.ndim != 3 or flow.shape[2] != 2:
            raise FrameError(f"Flow {path}: expected (H, W, 2), found {flow.shape}.")
    else:
        flow = _read_flo(path)
    _check_size(path, "flow", flow, size)
    # False where anything is NaN as well; most files hold nothing unknown, and scans are cheap.
    if not (flow.max() < FLO_UNKNOWN_PX and flow.min() > -FLO_UNKNOWN_PX):
        flow[~(np.abs(flow) < FLO_UNKNOWN_PX).all(2)] = np.nan
    return flow


def read_normalised_flow(path: Path, size: Size | None = None) -> NDArray[np.float32]:
    """Flow (H, W, 2) float32 in pixels, NaN unknown, from Virtual KITTI's 16-bit colour PNG.

    Red and green hold du / (W - 1) and dv / (H - 1) of -1 to 1 as 0 to 65535; blue is 0 where there
    is no flow, as in the sky. Raises FrameError.
    """
    pixels = _decode(path, "a flow image")  # blue, green, red
    if pixels.dtype != np.uint16 or pixels.ndim != 3 or pixels.shape[2] != 3:
        raise FrameError(
            f"Flow {path}: expected a 16-bit image of three channels, found {pixels.dtype} "
            f"{pixels.shape}; copy the file as it was published."
        )
    _check_size(path, "flow", pixels, size)
    height, width = pixels.shape[:2]
    flow = pixels[..., 2:0:-1].astype(np.float32) * np.float32(2 / SATURATED) - np.float32(1)
    flow *= np.array([width - 1, height - 1], np.float32)
    flow[pixels[..., 0] == 0] = np.nan
    return np.ascontiguousarray(flow)


def read_labels(path: Path, size: Size) -> NDArray[np.int32]:
    """Instance labels (H, W) int32, 0 background, from .txt, .png or .npy. Raises FrameError.

    Of a PNG with a palette the indices are the labels.
    """
    if path.suffix == ".txt":
        labels = _read_label_text(path, size)
    elif path.suffix == ".npy":
        labels = _load_array(path, "a label array")
    else:
        labels = _decode(path, "a label image", indices=True)
    if labels.ndim != 2 or not np.issubdtype(labels.dtype, np.integer):
        raise FrameError(
            f"Labels {path}: expected one integer per pixel, found {labels.shape} {labels.dtype}."
        )
    _check_size(path, "labels", labels, size)
    return np.maximum(labels, 0).astype(np.int32)


def _read_bytes(path: Path, what: str) -> bytes:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DamagedFileError(
            f"{path}: expected {what}, but it cannot be read ({error.strerror or error})."
        ) from error
    if not content:
        raise DamagedFileError(f"{path}: expected {what}, found an empty file; copy it again.")
    return content


def _decode(path: Path, what: str, indices: bool = False) -> NDArray:
    read = _read_bytes(path, what)
    if indices and is_palette_png(read):
        read = indices_as_grey(read)
    content = np.frombuffer(read, np.uint8)
    try:
        pixels = cv2.imdecode(content, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise DamagedFileError(
            f"{path}: expected {what}, found {content.size} bytes that cannot be decoded; "
            "the file is damaged or cut short, copy it again."
        )
    return np.asarray(pixels)


def _load_array(path: Path, what: str) -> NDArray:
    _read_bytes(path, what)
    try:
        return np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise DamagedFileError(
            f"{path}: expected {what}, found no valid .npy file ({error})."
        ) from error


def _read_flo(path: Path) -> NDArray[np.float32]:
    content = _read_bytes(path, "an optical flow (.flo)")
    if len(content) < 12 or np.frombuffer(content, "<f4", 1)[0] != FLO_MAGIC:
        raise DamagedFileError(
            f"Flow {path}: expected a Middlebury .flo file, found another format."
        )
    width, height = (int(n) for n in np.frombuffer(content, "<i4", 2, 4))
    if width <= 0 or height <= 0 or len(content) != 12 + 8 * width * height:
        raise DamagedFileError(
            f"Flow {path}: expected {width} x {height} vectors as its head says, found "
            f"{len(content) - 12} bytes; the file is damaged or cut short."
        )
    return np.frombuffer(content, "<f4", 2 * width * height, 12).reshape(height, width, 2).copy()


def _read_label_text(path: Path, size: Size) -> NDArray[np.int32]:
    width, height = size
    content = _read_bytes(path, "a matrix of labels")
    try:
        values = _numbers(content)
    except (UnicodeDecodeError, ValueError, DeprecationWarning) as error:
        raise DamagedFileError(f"Labels {path}: expected integers, found other text.") from error
    if values.size != width * height:
        raise FrameError(
            f"Labels {path}: expected {width} x {height} = {width * height} integers, "
            f"found {values.size}; masks and images must have one size."
        )
    return values.reshape(height, width)


def _numbers(content: bytes) -> NDArray[np.int32]:
    """The whole numbers (N,) of a text, line by line: lines of single digits need no parser.

    Most lines of labels are such, and their digits are every other byte.
    """
    parts = []
    for line in content.splitlines():
        digits = line[::2]
        if digits.isdigit() and (len(line) < 2 or line[1::2].isspace()):
            parts.append(np.frombuffer(digits, np.uint8) - np.uint8(ord("0")))
        elif line and not line.isspace():
            parts.append(np.fromstring(line.decode("ascii"), np.int32, sep=" "))
    return np.concatenate([np.empty(0, np.int32), *parts], dtype=np.int32)


def _check_size(path: Path, what: str, pixels: NDArray, size: Size | None) -> None:
    height, width = pixels.shape[:2]
    if size is not None and (width, height) != size:
        raise FrameError(
            f"{path}: expected {what} of {size[0]} x {size[1]} pixels as the sequence has, "
            f"found {width} x {height}; all files of a sequence must have one size."
        )
