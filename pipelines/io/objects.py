"""Moving objects as text: objects.csv, a row per object and frame, and a trajectory per object.

Owns the columns of both. Knows neither the tracker nor the truth (that is `object_truth`).
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import DyObError, FormatError
from pipelines.geometry import T_from_q_xyzw, orthonormalise, q_xyzw_from_T
from pipelines.io.files import disk_error, write_text
from pipelines.io.trajectory import write_tum
from pipelines.object_types import ObjectEstimates, ObjectState
from pipelines.types import Array

KMH = 3.6  # km/h in 1 m/s
SUFFIX = "_tum.txt"
BOX = ("x1_px", "y1_px", "x2_px", "y2_px")
POSE = ("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw")
L_COLUMNS, H_COLUMNS = tuple(f"L_{name}" for name in POSE), tuple(f"H_{name}" for name in POSE)
IDENTITY = ("frame", "timestamp_s", "object_id", "class_name", "score", "state")
SPEED = ("speed_kmh", "speed_std_kmh")
CENTER, VELOCITY = ("center_x_m", "center_y_m", "center_z_m"), ("vx_mps", "vy_mps", "vz_mps")
SMOOTHED = ("smoothed_speed_kmh", "smoothed_speed_std_kmh")
SPREAD = ("H_std_t_m", "H_std_R_deg")
SIZE = ("size_x_m", "size_y_m", "size_z_m")
POSE_SPREAD = ("L_std_t_m", "L_std_R_deg")
COLUMNS = (
    *IDENTITY, *BOX, "n_points", *L_COLUMNS, *H_COLUMNS, *SPEED,
    *CENTER, *VELOCITY, *SMOOTHED, *SPREAD, *SIZE, *POSE_SPREAD,
)  # fmt: skip


def write_objects(
    path: Path | str, objects: ObjectEstimates, pose_std: Array | None = None
) -> None:
    """Write objects.csv: its header, then a row per object and frame in their order.

    L is the object's pose and H its motion since the frame before, both in the world, as position
    and quaternion. speed_kmh is that of eq. (6) where there is an H, the filter's in coasting rows,
    and else empty, as all that is not known is. H_std_ are the square roots of the traces of H's
    two diagonal covariance blocks. pose_std: (M, 2) the same of L in m and deg, which only a batch
    knows. Raises DyObError where the disk refuses.
    """
    if pose_std is None:
        pose_std = np.full((len(objects), len(POSE_SPREAD)), np.nan)
    write_table(path, COLUMNS, _rows(objects, pose_std))


def read_objects(path: Path | str) -> ObjectEstimates:
    """The rows of objects.csv.

    The file holds no full covariances: each H gets the round ones of the same traces, or NaN.

    Raises FormatError, with the line's number, where a column is missing or a cell is no number.
    """
    table = Table(Path(path))
    if not table.rows:
        return ObjectEstimates.empty()
    Hs = table.poses(H_COLUMNS)
    has_motion = np.isfinite(Hs).all((1, 2))
    speeds = table.numbers(SPEED) / KMH
    speeds[~has_motion] = np.nan  # a coasting row shows the filter's, which is not eq. (6)'s
    return ObjectEstimates(
        frame_index=table.integers("frame"),
        timestamp_s=table.numbers(("timestamp_s",))[:, 0],
        object_id=table.integers("object_id"),
        class_name=table.words("class_name"),
        score=table.numbers(("score",))[:, 0],
        state=table.words("state"),
        boxes_px=table.numbers(BOX),
        n_points=table.integers("n_points"),
        Ts_world_object=table.poses(L_COLUMNS),
        Hs_world_curr_prev=Hs,
        motion_covariances=_round_covariances(table.numbers(SPREAD)),
        centers_m=table.numbers(CENTER),
        speed_mps=speeds[:, 0],
        speed_std_mps=speeds[:, 1],
        velocities_mps=table.numbers(VELOCITY),
        velocity_std_mps=table.numbers(SMOOTHED[1:])[:, 0] / KMH,
        extents_m=table.numbers(SIZE),
    )


def write_object_trajectories(folder: Path | str, objects: ObjectEstimates) -> list[Path]:
    """A TUM file a lasting object, as 003_car_tum.txt: T_world_object where it is known.

    Files of earlier objects are removed. Returns the paths written. Raises DyObError where the
    disk refuses.
    """
    folder = Path(folder)
    known = objects[np.flatnonzero(np.isfinite(objects.Ts_world_object).all((1, 2)))]
    written = []
    try:
        if len(known):
            folder.mkdir(exist_ok=True)
        for object_id in np.unique(known.object_id):
            own = known[known.object_id == object_id]
            path = folder / f"{int(object_id):03d}_{_file_word(own.class_name)}{SUFFIX}"
            write_tum(path, own.timestamp_s, orthonormalise(own.Ts_world_object))
            written.append(path)
        for stale in set(folder.glob(f"*{SUFFIX}")) - set(written):
            stale.unlink()
    except OSError as error:
        raise DyObError(disk_error(folder, error)) from error
    return written


def write_table(path: Path | str, columns: Iterable[str], rows: Iterable[Iterable[str]]) -> None:
    """Write a CSV file of text cells in one step."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    write_text(path, text.getvalue())


class Table:
    """A CSV file whose columns are asked for by name, with errors that name file and line."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with path.open(encoding="utf-8", newline="") as file:
                reader = csv.DictReader(file)
                self.rows = list(reader)
                self._header = tuple(reader.fieldnames or ())
        except (OSError, UnicodeDecodeError, csv.Error) as error:
            raise FormatError(
                f"{path}: expected a table of objects, found it unreadable ({error}); "
                "run the sequence again or restore the file"
            ) from error
        self.require(("frame", "object_id"))

    def require(self, columns: Iterable[str]) -> None:
        """Raise FormatError where a column is missing."""
        missing = [name for name in columns if name not in self._header]
        if missing:
            raise FormatError(
                f"{self.path}: expected the column {missing[0]}, found "
                f"{', '.join(self._header[:4]) or 'no header'} ...; run the sequence again"
            )

    def words(self, column: str) -> NDArray[np.str_]:
        """(N,) text."""
        self.require((column,))
        return np.array([row[column] or "" for row in self.rows], str)

    def integers(self, column: str) -> NDArray[np.int64]:
        """(N,) whole numbers."""
        return np.array(self._convert(column, int), np.int64)

    def numbers(self, columns: tuple[str, ...]) -> Array:
        """(N, len(columns)) float64, NaN where a cell is empty."""
        values = [self._convert(column, _number) for column in columns]
        return np.array(values, float).reshape(len(columns), len(self.rows)).T

    def poses(self, columns: tuple[str, ...]) -> Array:
        """(N, 4, 4) of position and quaternion columns, NaN where one of them is empty."""
        values = self.numbers(columns)
        Ts = np.full((len(values), 4, 4), np.nan)
        known = np.isfinite(values).all(1)
        short = known & (np.linalg.norm(values[:, 3:], axis=1) < 0.5)
        if short.any():
            raise FormatError(
                f"{self.path}, line {2 + int(np.flatnonzero(short)[0])}: expected a unit "
                f"quaternion in {columns[3]} to {columns[6]}, found one shorter than 0.5"
            )
        if known.any():
            Ts[known] = T_from_q_xyzw(values[known, :3], values[known, 3:])
        return Ts

    def _convert(self, column: str, convert: Callable[[str], float]) -> list[float]:
        self.require((column,))
        values = []
        for line, row in enumerate(self.rows, 2):
            try:
                values.append(convert(row[column]))
            except (TypeError, ValueError) as error:
                raise FormatError(
                    f"{self.path}, line {line}: expected a number in {column}, found "
                    f"'{row[column]}'; repair the line or run the sequence again"
                ) from error
        return values


def pose_cells(Ts: Array) -> list[list[str]]:
    """Seven cells a pose of (N, 4, 4): position and quaternion, empty where it is not known."""
    known = np.isfinite(Ts).all((1, 2))
    values = np.full((len(Ts), 7), np.nan)
    if known.any():
        values[known, :3] = Ts[known, :3, 3]
        values[known, 3:] = q_xyzw_from_T(orthonormalise(Ts[known]))
    return [[cell(value, 12) for value in row] for row in values]


def cell(value: float, digits: int = 9) -> str:
    """A number with that many significant digits; empty where it is not finite."""
    return f"{value:.{digits}g}" if np.isfinite(value) else ""


def _number(text: str) -> float:
    return float(text) if text else np.nan


def _round_covariances(spread: Array) -> Array:
    """(N, 6, 6) diagonal ones of [omega, v], of standard deviations (N, 2) in m and deg."""
    std = np.column_stack([np.radians(spread[:, 1]), spread[:, 0]]) / np.sqrt(3.0)
    covariances = np.zeros((len(spread), 6, 6))
    axes = np.arange(6)
    covariances[:, axes, axes] = np.repeat(std**2, 3, axis=1)
    covariances[~np.isfinite(std).all(1)] = np.nan
    return covariances


def _rows(objects: ObjectEstimates, pose_std: Array) -> Iterable[list[str]]:
    spread_m, spread_deg = motion_spread(objects)
    coasting = objects.state == str(ObjectState.COASTING)
    smoothed = objects.smoothed_speed_mps
    speed = np.where(coasting, smoothed, objects.speed_mps)
    speed_std = np.where(coasting, objects.velocity_std_mps, objects.speed_std_mps)
    Ls, Hs = pose_cells(objects.Ts_world_object), pose_cells(objects.Hs_world_curr_prev)
    for i in range(len(objects)):
        numbers = [
            *(KMH * speed[i : i + 1]), *(KMH * speed_std[i : i + 1]),
            *objects.centers_m[i], *objects.velocities_mps[i],
            KMH * smoothed[i], KMH * objects.velocity_std_mps[i],
            spread_m[i], spread_deg[i], *objects.extents_m[i], *pose_std[i],
        ]  # fmt: skip
        yield [
            str(objects.frame_index[i]), f"{objects.timestamp_s[i]:.9f}",
            str(objects.object_id[i]), str(objects.class_name[i]), cell(objects.score[i], 4),
            str(objects.state[i]), *(cell(value, 7) for value in objects.boxes_px[i]),
            str(objects.n_points[i]), *Ls[i], *Hs[i], *(cell(value) for value in numbers),
        ]  # fmt: skip


def motion_spread(objects: ObjectEstimates) -> tuple[Array, Array]:
    """Standard deviations (M,) of H's translation in m and rotation in deg: sqrt of the traces."""
    variances = np.diagonal(objects.motion_covariances, axis1=1, axis2=2)
    R_std_rad, t_std_m = (np.sqrt(variances[:, part].sum(1)) for part in (slice(3), slice(3, 6)))
    return t_std_m, np.degrees(R_std_rad)


def _file_word(class_names: NDArray[np.str_]) -> str:
    """The commonest class name, as a file name may hold it."""
    name = Counter(class_names.tolist()).most_common(1)[0][0]
    return re.sub(r"[^A-Za-z0-9-]+", "-", name).strip("-") or "object"
