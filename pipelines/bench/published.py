"""What others score on sequences that we can run too: figures with their sources, to stand beside.

Owns the figures and how a sequence is recognised. They are facts copied by hand, and are never used
to compute anything.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

Values = dict[str, float]

PEERS = "Run by this project's authors on the same files, two cores, no GPU"
DYNOSAM = "Morris et al., DynoSAM, T-RO 2025, tables I and IV (second-hand); RMSE"
DYNASLAM = "Bescos et al., DynaSLAM, RA-L 2018"
DROIDW = "table in DROID-W, arXiv 2603.19076"

PAPER = (
    "The paper (DyOb-SLAM) shows its figures for kitti-0000-0013, 55 frames, as pictures only. Its "
    "text tells how much larger its errors are than VDO-SLAM's on the same frames, over 5 runs: "
    "camera 0.003-0.005 in translation and 0.007-0.017 in rotation, objects 0.009-0.03 and "
    "0.05-0.17 (no units; VDO-SLAM's are m and deg a frame), the first run being the worst. Of its "
    "speed error it says both that it is better and that it is 0.96-1.20 more."
)


@dataclass(frozen=True, slots=True)
class Published:
    """One system's figures on one sequence, by the keys of `measures.MEASURES`.

    frames: how many of the sequence they are over, None where the source does not say.
    """

    system: str
    source: str
    values: Values
    frames: int | None = None


_TRACKING_FRAMES = {
    "0000": 154, "0001": 447, "0002": 233, "0003": 144, "0004": 314, "0005": 297, "0006": 270,
    "0018": 339, "0020": 837,
}  # fmt: skip
# ATE m, RPE m and RPE deg of the camera; motion m and motion deg of objects, where they are given.
_TRACKING_KEYS = ("ate_m", "rpe_trans_m", "rpe_rot_deg", "motion_trans_m", "motion_rot_deg")
_KITTI_TRACKING: dict[str, dict[str, tuple[float, ...]]] = {
    "DynaSLAM II": {
        "0000": (1.29, 0.04, 0.06),
        "0001": (2.31, 0.05, 0.04),
        "0002": (0.91, 0.04, 0.02),
        "0003": (0.69, 0.04, 0.06),
        "0004": (1.42, 0.07, 0.06),
        "0005": (1.34, 0.06, 0.03),
        "0006": (0.19, 0.02, 0.04),
        "0018": (1.09, 0.05, 0.02),
        "0020": (1.36, 0.07, 0.04),
    },
    "VDO-SLAM": {
        "0000": (3.37, 0.09, 0.08, 0.11, 1.38),
        "0001": (6.74, 0.15, 0.05, 0.35, 2.15),
        "0002": (2.47, 0.05, 0.03, 0.43, 1.68),
        "0003": (2.12, 0.09, 0.03, 0.15, 0.39),
        "0004": (4.53, 0.14, 0.06, 0.38, 2.80),
        "0005": (3.80, 0.11, 0.03, 0.19, 0.48),
        "0006": (0.45, 0.04, 0.10, 0.11, 2.80),
        "0018": (9.94, 0.09, 0.03, 0.16, 0.36),
        "0020": (7.82, 0.30, 0.04, 0.57, 0.47),
    },
    "DynoSAM (WCME)": {
        "0000": (0.82, 0.04, 0.04, 0.15, 1.29),
        "0001": (2.00, 0.04, 0.03, 0.34, 0.86),
        "0002": (0.73, 0.03, 0.02, 0.40, 1.06),
        "0003": (0.82, 0.05, 0.05, 0.15, 0.26),
        "0004": (2.01, 0.06, 0.06, 0.09, 1.01),
        "0005": (1.58, 0.05, 0.05, 0.13, 0.49),
        "0006": (0.31, 0.01, 0.05, 0.11, 0.39),
        "0018": (1.84, 0.04, 0.04, 0.20, 0.60),
        "0020": (1.26, 0.02, 0.04, 0.05, 0.33),
    },
}

# Sequence: frames; then t_rel %, r_rel deg in 100 m and ATE m of ORB-SLAM2 and DynaSLAM, stereo.
_KITTI_ODOMETRY = {
    "00": (4541, (0.70, 0.25, 1.3), (0.74, 0.26, 1.4)),
    "01": (1101, (1.39, 0.21, 10.4), (1.57, 0.22, 9.4)),
    "02": (4661, (0.76, 0.23, 5.7), (0.80, 0.24, 6.7)),
    "03": (801, (0.71, 0.18, 0.6), (0.69, 0.18, 0.6)),
    "04": (271, (0.48, 0.13, 0.2), (0.45, 0.09, 0.2)),
    "05": (2761, (0.40, 0.16, 0.8), (0.40, 0.16, 0.8)),
    "06": (1101, (0.51, 0.15, 0.8), (0.50, 0.17, 0.8)),
    "07": (1101, (0.50, 0.28, 0.5), (0.52, 0.29, 0.5)),
    "08": (4071, (1.05, 0.32, 3.6), (1.05, 0.32, 3.5)),
    "09": (1591, (0.87, 0.27, 3.2), (0.93, 0.29, 1.6)),
    "10": (1201, (0.60, 0.27, 1.0), (0.67, 0.32, 1.2)),
}
_ODOMETRY_KEYS = ("t_rel_percent", "r_rel_deg", "ate_m")

# ATE in m of RGB-D sequences with people (TUM, Bonn), by the ends of their folders' names.
_RGBD = {
    "freiburg3_walking_static": (("ORB-SLAM2", DYNASLAM, 0.090), ("DynaSLAM", DYNASLAM, 0.006)),
    "freiburg3_walking_xyz": (("ORB-SLAM2", DYNASLAM, 0.459), ("DynaSLAM", DYNASLAM, 0.015)),
    "freiburg3_walking_rpy": (("ORB-SLAM2", DYNASLAM, 0.662), ("DynaSLAM", DYNASLAM, 0.035)),
    "freiburg3_walking_halfsphere": (("ORB-SLAM2", DYNASLAM, 0.351), ("DynaSLAM", DYNASLAM, 0.025)),
    "freiburg3_sitting_xyz": (("ORB-SLAM2", DYNASLAM, 0.009), ("DynaSLAM", DYNASLAM, 0.015)),
    "freiburg3_sitting_halfsphere": (("ORB-SLAM2", DYNASLAM, 0.020), ("DynaSLAM", DYNASLAM, 0.017)),
    "bonn_balloon": (("ORB-SLAM2", DROIDW, 0.065), ("DynaSLAM", DROIDW, 0.030)),
    "bonn_balloon2": (("ORB-SLAM2", DROIDW, 0.230), ("DynaSLAM", DROIDW, 0.029)),
    "bonn_crowd": (("ORB-SLAM2", DROIDW, 0.049), ("DynaSLAM", DROIDW, 0.016)),
    "bonn_crowd2": (("ORB-SLAM2", DROIDW, 0.098), ("DynaSLAM", DROIDW, 0.031)),
    "bonn_person_tracking": (("ORB-SLAM2", DROIDW, 0.069), ("DynaSLAM", DROIDW, 0.061)),
    "bonn_person_tracking2": (("ORB-SLAM2", DROIDW, 0.079), ("DynaSLAM", DROIDW, 0.078)),
    "bonn_moving_nonobstructing_box": (("ORB-SLAM2", DROIDW, 0.032), ("DynaSLAM", DROIDW, 0.232)),
    "bonn_moving_nonobstructing_box2": (("ORB-SLAM2", DROIDW, 0.039), ("DynaSLAM", DROIDW, 0.039)),
}  # fmt: skip


def _measured(
    system: str, frames: int, camera: tuple[float, ...], objects: Values | None = None
) -> Published:
    """camera: RPE m, RPE deg, ATE m, and ms a frame where it was taken. RMSE, as ours."""
    keys = ("rpe_trans_m", "rpe_rot_deg", "ate_m", "frame_ms")
    return Published(system, PEERS, dict(zip(keys, camera, strict=False)) | (objects or {}), frames)


def _objects(trans_m: float, rot_deg: float, kmh: float, **more: float) -> Values:
    return {"motion_trans_m": trans_m, "motion_rot_deg": rot_deg, "speed_kmh": kmh, **more}


# Generated sequences and cuts of real ones that the authors ran the peers on.
_MEASURED = {
    "drive": (
        _measured("VDO-SLAM", 100, (0.00081, 0.0006, 0.004, 71), _objects(0.0019, 0.0023, 0.028)),
        _measured("ORB-SLAM3, no masks", 100, (0.0096, 0.022, 0.023, 20)),
        _measured("DynaSLAM, masks given", 100, (0.0113, 0.026, 0.020, 42)),
    ),
    "drive_deg": (
        _measured(
            "VDO-SLAM", 100, (0.0062, 0.0094, 0.028, 73),
            _objects(0.0175, 0.180, 0.32, coverage_share=0.84, false_movers=59),
        ),
        _measured("ORB-SLAM3, no masks", 100, (0.0101, 0.021, 0.032, 20)),
        _measured("DynaSLAM, masks given", 100, (0.0115, 0.026, 0.026, 42)),
    ),
    "room": (
        _measured("VDO-SLAM", 120, (0.00015, 0.0043, 0.0009), _objects(0.00017, 0.0047, 0.003)),
        _measured("ORB-SLAM3, no masks", 120, (0.0184, 0.24, 0.024, 13)),
        _measured("DynaSLAM, masks given", 120, (0.0061, 0.082, 0.007, 23)),
    ),
    "room_deg": (
        _measured("VDO-SLAM", 120, (0.0015, 0.0227, 0.0165), _objects(0.0041, 0.50, 0.095)),
        _measured("DynaSLAM, masks given", 120, (0.0066, 0.086, 0.007, 23)),
    ),
    "7scenes_redkitchen_200f": (_measured("ORB-SLAM3", 200, (0.0110, 0.40, 0.053, 15)),),
    "kitti_odom06_000-050_stereo": (_measured("ORB-SLAM3", 51, (0.0117, 0.064, 0.035, 32)),),
}  # fmt: skip


def published_for(dataset: str, name: str) -> list[Published]:
    """What is known of a sequence, by its layout and name; empty for most."""
    found = list(_MEASURED.get(name, ())) if dataset != "simulated" else []
    return [*found, *_of_kitti_tracking(dataset, name), *_of_kitti_odometry(dataset, name),
            *_of_rgbd(dataset, name)]  # fmt: skip


def _of_kitti_tracking(dataset: str, name: str) -> Iterator[Published]:
    """Of the layout itself, of VDO-SLAM's, and of the replayed scenes simulated:kitti_NNNN."""
    pattern = r"(\d{4})" if dataset == "kitti_tracking" else r"kitti_(?:tracking_)?(\d{4})(?!\d).*"
    match = re.fullmatch(pattern, name)
    if match is None or dataset not in ("kitti_tracking", "vdo", "simulated"):
        return
    source = DYNOSAM
    if dataset == "simulated":
        source += "; on the real recording, ours is rendered"
    for system, rows in _KITTI_TRACKING.items():
        if match[1] in rows:
            known = dict(zip(_TRACKING_KEYS, rows[match[1]], strict=False))
            yield Published(system, source, known, _TRACKING_FRAMES[match[1]])


def _of_kitti_odometry(dataset: str, name: str) -> Iterator[Published]:
    match = re.fullmatch(r"(?:kitti_odom)?(\d\d)(?!\d).*", name)
    if dataset != "kitti_odometry" or match is None or match[1] not in _KITTI_ODOMETRY:
        return
    frames, *rows = _KITTI_ODOMETRY[match[1]]
    for system, values in zip(("ORB-SLAM2", "DynaSLAM"), rows, strict=True):
        known = dict(zip(_ODOMETRY_KEYS, values, strict=True))
        yield Published(system, f"{DYNASLAM}, table V", known, frames)


def _of_rgbd(dataset: str, name: str) -> Iterator[Published]:
    match = re.fullmatch(r"(?:rgbd_(?:dataset_)?)?((?:freiburg3|bonn)_\w+)", name)
    if dataset == "tum_rgbd" and match is not None:
        for system, source, ate_m in _RGBD.get(match[1], ()):
            yield Published(system, source, {"ate_m": ate_m})
